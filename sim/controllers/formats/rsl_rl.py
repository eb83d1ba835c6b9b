"""Checkpoints of rsl_rl 1 to 5: plain tensors, read as data alone, and the networks that they make."""

import re
import warnings
import zipfile
from pathlib import Path
from typing import Any

import torch
from torch import nn

from sim.controllers.runner import Recurrent, with_rows_of_zeros
from sim.controllers.spec import agent_file
from sim.files.settings import read_yaml

_LAYERS = (nn.ELU, nn.SELU, nn.ReLU, nn.Tanh, nn.Sigmoid, nn.Softplus, nn.GELU, nn.Mish, nn.Identity)
ACTIVATIONS = {layer.__name__.lower(): layer for layer in _LAYERS} | {"lrelu": nn.LeakyReLU, "swish": nn.SiLU}
"""What rsl_rl calls the functions between layers."""
_FORMER_NAMES = {"actor.": "mlp.", "memory_a.rnn.": "rnn.rnn.", "actor_obs_normalizer.": "obs_normalizer."}
"""Prefixes of an actor's tensors in rsl_rl 1 to 4, and in rsl_rl 5."""
_FORMER_PREFIX = re.compile(f"^({'|'.join(map(re.escape, _FORMER_NAMES))})")
_KNOWN_NAMES = (
    r"mlp\.\d+\.(weight|bias)|rnn\.rnn\.\w+|obs_normalizer\.(_mean|_var|_std|count)|"
    r"distribution\.(log_)?std_param|(log_)?std|critic.*|memory_c\.rnn\.\w+"
)
_ELU_KEYS = {"actor_state_dict", "iter", "trained_on"}  # a checkpoint of ours that has these alone has ELU


class MlpPolicy(nn.Module):
    """Multilayer perceptron: rsl_rl's ``MLPModel`` without its distribution."""

    def __init__(self, state: dict[str, torch.Tensor], activation: str = "elu") -> None:
        """Build from rsl_rl's keys ``mlp.<k>.weight`` / ``.bias`` and, if any, ``obs_normalizer._mean`` / ``._std``."""
        super().__init__()
        self.activation = activation
        weights = {key.removeprefix("mlp."): value for key, value in state.items() if key.startswith("mlp.")}
        indices = sorted(int(key.removesuffix(".weight")) for key in weights if key.endswith(".weight"))
        shapes = [weights[f"{index}.weight"].shape for index in indices]
        layers = [layer for size, width in shapes for layer in (nn.Linear(width, size), ACTIVATIONS[activation]())]
        self.layers = nn.Sequential(*layers[:-1])
        self.sizes = shapes[0][1], shapes[-1][0]
        self.layers.load_state_dict(weights)
        self.mean = nn.Buffer(state.get("obs_normalizer._mean", torch.zeros(1)).float())
        self.std = nn.Buffer(state.get("obs_normalizer._std", torch.ones(1)).float())
        self.normalised = "obs_normalizer._mean" in state

    def normalise(self, observation: torch.Tensor) -> torch.Tensor:
        """Observation rows as the layers see them."""
        return (observation - self.mean) / (self.std + 1e-2) if self.normalised else observation

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Mean actions, shape (num_envs, num_joints)."""
        return self.layers(with_rows_of_zeros(self.normalise(observation)))[: len(observation)]


class RnnPolicy(Recurrent):
    """LSTM or GRU, and a perceptron of what it says: rsl_rl's ``RNNModel`` without its distribution."""

    def __init__(self, state: dict[str, torch.Tensor], activation: str = "elu") -> None:
        """Build from :class:`MlpPolicy`'s keys and ``rnn.rnn.<name>``."""
        weights = {key.removeprefix("rnn.rnn."): value for key, value in state.items() if key.startswith("rnn.rnn.")}
        gates, width = weights["weight_ih_l0"].shape
        size = weights["weight_hh_l0"].shape[1]
        layers = sum(name.startswith("weight_ih_l") for name in weights)
        kind = {4: nn.LSTM, 3: nn.GRU}[gates // size]
        super().__init__([torch.zeros(layers, 1, size)] * (2 if kind is nn.LSTM else 1), 1)
        self.rnn = kind(width, size, layers)
        self.rnn.load_state_dict(weights)
        self.head = MlpPolicy(state, activation)
        self.sizes = width, self.head.sizes[1]

    def step(self, rows: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Mean actions, and the state after them."""
        out, after = self.rnn(self.head.normalise(rows)[None], tuple(state) if len(state) == 2 else state[0])
        return self.head.layers(out[0]), [*after] if len(state) == 2 else [after]


def read_weights(path: Path) -> Any:
    """What ``torch.save`` wrote, as data only; a ValueError if it is damaged, any error if it is foreign or code."""
    if zipfile.is_zipfile(path):  # torch does not compare checksums: a flipped bit would be another weight
        try:
            with zipfile.ZipFile(path) as members:
                damaged = members.testzip()
        except Exception as error:  # zipfile and zlib answer damage with a dozen types
            raise ValueError(f"{type(error).__name__}: {error}") from None
        if damaged is not None:
            raise ValueError(f"its member '{damaged}' does not have its checksum")
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns of TorchScript files
        return torch.load(path, map_location="cpu", weights_only=True)


def make_actor(content: Any, path: Path, activation: str | None) -> MlpPolicy | RnnPolicy:
    """The actor of a file, from what :func:`read_weights` returned; without ``activation`` the file must name it."""
    state = _read_state(content, path)
    if activation is None:
        is_ours = {"iter"} <= content.keys() <= _ELU_KEYS or str(content.get("format", "")).startswith("faultline")
        activation = content.get("activation", "elu" if is_ours else None)
        if activation is None and (agent := agent_file(path)) is not None:
            activation = read_activation(read_yaml(agent))
        if activation is None:
            remedy = 'put the agent.yaml of its training beside it, or write activation = "elu" into a controller.toml'
            raise ValueError(f"policy '{path}' does not say what is between its layers: {remedy}")
        if not isinstance(activation, str) or activation not in ACTIVATIONS:
            raise ValueError(f"policy '{path}': activation must be one of {', '.join(ACTIVATIONS)}, got {activation}")
    try:
        return (RnnPolicy if any(key.startswith("rnn.") for key in state) else MlpPolicy)(state, activation)
    except (KeyError, RuntimeError, AttributeError, TypeError, IndexError, ValueError, ZeroDivisionError) as error:
        raise ValueError(f"policy '{path}' holds a damaged layer: {error}; save the checkpoint anew") from error


def _read_state(content: Any, path: Path) -> dict[str, torch.Tensor]:
    tables = [content.get(f"{kind}_state_dict") for kind in ("actor", "model")] if isinstance(content, dict) else []
    state: dict[Any, torch.Tensor] = next((table for table in tables if isinstance(table, dict)), {})
    names = {key: _FORMER_PREFIX.sub(lambda match: _FORMER_NAMES[match[0]], str(key)) for key in state}
    if "mlp.0.weight" not in names.values():
        got = ", ".join(map(str, state or content)) if isinstance(content, dict) else type(content).__name__
        must = "'actor_state_dict' with 'mlp.0.weight', or 'model_state_dict' with 'actor.0.weight'"
        raise ValueError(f"policy '{path}' is no rsl_rl checkpoint: expected {must}, got {got}")
    if not isinstance(separate := content.get("obs_norm_state_dict") or {}, dict):
        raise ValueError(f"policy '{path}': obs_norm_state_dict must be a table, got {type(separate).__name__}")
    normaliser = {f"obs_normalizer.{key}": value for key, value in separate.items()}
    names |= {key: key for key in normaliser}
    if unknown := ", ".join(str(key) for key, name in names.items() if not re.fullmatch(_KNOWN_NAMES, name)):
        raise ValueError(f"policy '{path}' is more than an MLP or RNN, by {unknown}: export TorchScript or ONNX")
    statistics = {name.partition(".")[2] for name in names.values() if name.startswith("obs_normalizer.")}
    if statistics and not {"_mean", "_std"} <= statistics:
        raise ValueError(f"policy '{path}' must have _mean and _std of its normaliser, got {sorted(statistics)}")
    return {names[key]: value for key, value in state.items()} | normaliser


def read_activation(agent: dict[str, Any]) -> Any:
    """The function between the actor's layers in the content of an agent.yaml; None if it has none."""
    tables = [agent.get(name) for name in ("actor", "policy")]
    return next((table["activation"] for table in tables if isinstance(table, dict) and "activation" in table), None)
