"""Checkpoints of trainings, and the networks that a fine-tuning begins with; code in a file never runs."""

import io
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from sim.controllers.described import ControllerCfg, Described, read_controller
from sim.controllers.formats.rsl_rl import ACTIVATIONS, MlpPolicy, read_weights
from sim.controllers.loaders import load_described, load_policy
from sim.controllers.spec import in_one_line, weights_file
from sim.files.atomic import write_atomically
from sim.robots.robot import RobotCfg

FORMAT = "faultline training checkpoint 2"
CHECKPOINT = "checkpoint.pt"
"""File of a training's directory that it goes on from."""
POLICY = "policy.pt"
"""File of a training's directory with its controller."""
DESCRIPTION = "controller"
"""Key of a checkpoint with the description of its controller, if it has one, as TOML."""
STD = "distribution.std_param"
"""Key of the standard deviation of the actions in an actor's state."""
_NOISES = (STD, "distribution.log_std_param", "std", "log_std")
_DEFAULT_NOISE = 0.3  # for a file without it: about the noise at the end of trainings
State = dict[str, torch.Tensor]
"""Weights under rsl_rl's keys."""


def write_checkpoint(path: Path, content: dict[str, Any]) -> None:
    """Writes a checkpoint, whole or not at all."""
    buffer = io.BytesIO()
    torch.save({"format": FORMAT, **content}, buffer)
    write_atomically(path, buffer.getvalue())


def read_checkpoint(path: Path) -> dict[str, Any]:
    """Content of a checkpoint that :func:`write_checkpoint` wrote, tensors on the CPU."""
    try:
        content = read_weights(path)
    except Exception as error:  # a stream of pickle opcodes can fail with anything
        raise ValueError(f"{path} must be the checkpoint of a training, got {in_one_line(error)}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"{path} must be a '{FORMAT}', got another kind of file: name the directory of a training")
    return content


@dataclass(frozen=True, kw_only=True)
class Start:
    """A trained actor, and its critic if known."""

    actor: State
    critic: State | None
    hidden_dims: tuple[int, ...]
    """Hidden layers of both."""
    controller: ControllerCfg | None = None
    """Description of a described actor: its observations, its actions and the activation between its layers."""


def read_start(path: Path, robot: RobotCfg) -> Start:
    """Networks of an rsl_rl checkpoint or a described controller, for a fine-tuning.

    A normaliser of the observations becomes part of the first layer, which drops the critic, as that has another one.
    """
    if path.name == CHECKPOINT and path.is_file() and DESCRIPTION in (saved := read_checkpoint(path)):
        policy = load_described(read_controller(path, saved[DESCRIPTION]), path, robot, "cpu", path)
    else:
        policy = load_policy(path, robot, "cpu")
    if isinstance(policy, Described):
        network = plain_layers(policy.network, str(path))
        weights = path if path.name == CHECKPOINT else weights_file(path)
        # TorchScript does not say its noise.
        content = read_weights(weights) if weights and isinstance(policy.network, MlpPolicy) else {}
        stored = content.get("actor_state_dict", content.get("model_state_dict", {}))
        noise = [torch.exp(stored[name]) if "log" in name else stored[name] for name in _NOISES if name in stored]
        std = (noise or [torch.full((network.sizes[1],), _DEFAULT_NOISE)])[0].float()
        actor = {f"mlp.{key}": value.detach().clone() for key, value in network.layers.state_dict().items()}
        critic = content.get("critic_state_dict") if path.name == CHECKPOINT else None
        start = _make_start(network, actor | {STD: std}, critic, robot, path)
        return replace(start, controller=replace(policy.cfg, policy=POLICY, activation=network.activation))
    content = read_weights(path) if isinstance(policy, MlpPolicy) else {}
    if not isinstance(policy, MlpPolicy) or policy.activation != "elu" or "actor_state_dict" not in content:
        rule = "a controller.toml, or from an rsl_rl 5 checkpoint (actor_state_dict) with ELU between its layers"
        remedy = f"describe it in a controller.toml, or train one with `{robot.train_command}`"
        raise ValueError(f"a fine-tuning starts from {rule}, got another kind of controller: {path}; {remedy}")
    actor = {key: value for key, value in content["actor_state_dict"].items() if not key.startswith("obs_normalizer.")}
    critic = None if policy.normalised else content.get("critic_state_dict")
    return _make_start(policy, actor, critic, robot, path)


def _make_start(policy: MlpPolicy, actor: State, critic: Any, robot: RobotCfg, path: Path) -> Start:
    if policy.normalised:
        weight = actor["mlp.0.weight"] / (policy.std.flatten() + 1e-2)
        actor |= {"mlp.0.weight": weight, "mlp.0.bias": actor["mlp.0.bias"] - weight @ policy.mean.flatten()}
    hidden = tuple(layer.out_features for layer in policy.layers if isinstance(layer, torch.nn.Linear))[:-1]
    std = actor.get(STD)
    count = policy.sizes[1]
    if std is not None and (std.shape != (count,) or not bool(((std > 0.0) & std.isfinite()).all())):
        rule = f"{path}: {STD}, the standard deviation of the actions, must be {count} numbers above 0"
        raise ValueError(f"{rule}, got {' '.join(str(std).split())}: leave it out, or give another controller")
    if critic is not None:
        expected = {}
        for k, (width, out) in enumerate(pairwise((robot.observation_size, *hidden, 1))):
            expected |= {f"mlp.{2 * k}.weight": (out, width), f"mlp.{2 * k}.bias": (out,)}
        tensors = isinstance(critic, dict) and all(isinstance(value, torch.Tensor) for value in critic.values())
        shapes = {key: tuple(value.shape) for key, value in critic.items()} if tensors else {}
        if shapes != expected or not all(bool(value.isfinite().all()) for value in critic.values()):
            rule = f"{path}: critic_state_dict must have finite weights and the actor's hidden layers {list(hidden)}"
            raise ValueError(f"{rule}, got others: leave it out of the file, and a critic is trained")
    return Start(actor=actor, critic=critic, hidden_dims=hidden)


@torch.inference_mode()
def plain_layers(network: Any, name: str) -> MlpPolicy:
    """A network as a perceptron; a TorchScript module, of file ``name``, must compute the same as its layers."""
    if isinstance(network, MlpPolicy):
        return network
    module = getattr(network, "module", None)
    tensors = module.state_dict() if module is not None and not hasattr(network, "reset") else {}
    weights = [key for key, value in tensors.items() if key.endswith("weight") and value.ndim == 2]
    layers = [key.removesuffix("weight") for key in weights]
    state = {}
    for k, layer in enumerate(layers):
        state |= {f"mlp.{2 * k}.{key}": tensors[layer + key] for key in ("weight", "bias") if layer + key in tensors}
    is_complete = len(layers) > 1 and len(state) == 2 * len(layers)
    names = {key: key.rpartition(".")[2] for key in tensors}
    state |= {f"obs_normalizer.{name}": tensors[key] for key, name in names.items() if name in ("_mean", "_std")}
    for activation in ACTIVATIONS if is_complete else ():
        try:
            policy = MlpPolicy(state, activation)
            rows = torch.randn(64, policy.sizes[0], generator=torch.Generator().manual_seed(0))
            rows = policy.mean + policy.std * rows * torch.logspace(-1, 1, 64)[:, None]  # far from 0, limits show
            if torch.allclose(policy(rows), network(rows), rtol=1e-4, atol=1e-4):
                return policy
        except (KeyError, RuntimeError):
            break
    rule = f"finetune needs a network of plain layers with one kind of activation, got another in {name}"
    raise ValueError(f"{rule}: give an rsl_rl checkpoint or its TorchScript as the description's policy")
