"""The controllers of rsl_rl's checkpoints."""

import re

import torch

from sim.policy.runner import Recurrent, with_rows_of_zeros

ACTIVATIONS: dict[str, type[torch.nn.Module]] = {
    "elu": torch.nn.ELU, "selu": torch.nn.SELU, "relu": torch.nn.ReLU, "lrelu": torch.nn.LeakyReLU,
    "tanh": torch.nn.Tanh, "sigmoid": torch.nn.Sigmoid, "softplus": torch.nn.Softplus, "gelu": torch.nn.GELU,
    "swish": torch.nn.SiLU, "mish": torch.nn.Mish, "identity": torch.nn.Identity,
}  # fmt: skip
"""What rsl_rl calls the functions between layers."""


class MlpPolicy(torch.nn.Module):
    """Multilayer perceptron: rsl_rl's ``MLPModel`` without its distribution."""

    def __init__(self, state: dict[str, torch.Tensor], activation: str = "elu") -> None:
        """Build from rsl_rl's keys ``mlp.<k>.weight`` / ``.bias`` and, if any, ``obs_normalizer._mean`` / ``._std``.

        Between layers is one of :data:`ACTIVATIONS`.
        """
        super().__init__()
        self.activation = activation
        indices = sorted(int(m.group(1)) for key in state if (m := re.fullmatch(r"mlp\.(\d+)\.weight", key)))
        layers: list[torch.nn.Module] = []
        for index in indices:
            weight = state[f"mlp.{index}.weight"]
            layer = torch.nn.Linear(weight.shape[1], weight.shape[0])
            layer.weight.data.copy_(weight)
            layer.bias.data.copy_(state[f"mlp.{index}.bias"])
            layers += [layer, ACTIVATIONS[activation]()]
        self.layers = torch.nn.Sequential(*layers[:-1])
        self.mean = torch.nn.Buffer(state.get("obs_normalizer._mean", torch.zeros(1)).float())
        self.std = torch.nn.Buffer(state.get("obs_normalizer._std", torch.ones(1)).float())
        self.normalised = "obs_normalizer._mean" in state

    @property
    def sizes(self) -> tuple[int, int]:
        """Observation and action size."""
        linear = [layer for layer in self.layers if isinstance(layer, torch.nn.Linear)]
        return linear[0].in_features, linear[-1].out_features

    def forward(self, observation: torch.Tensor) -> torch.Tensor:
        """Mean actions, shape (num_envs, num_joints)."""
        if self.normalised:
            observation = (observation - self.mean) / (self.std + 1e-2)
        return self.layers(with_rows_of_zeros(observation))[: len(observation)]


class RnnPolicy(Recurrent):
    """LSTM or GRU, and a perceptron of what it says: rsl_rl's ``RNNModel`` without its distribution."""

    def __init__(self, state: dict[str, torch.Tensor], activation: str = "elu") -> None:
        """Build from :class:`MlpPolicy`'s keys and ``rnn.rnn.<name>``."""
        weights = {key.removeprefix("rnn.rnn."): value for key, value in state.items() if key.startswith("rnn.rnn.")}
        gates, width = weights["weight_ih_l0"].shape
        size = weights["weight_hh_l0"].shape[1]
        layers = sum(name.startswith("weight_ih_l") for name in weights)
        kind = {4: torch.nn.LSTM, 3: torch.nn.GRU}[gates // size]
        super().__init__([torch.zeros(layers, 1, size)] * (2 if kind is torch.nn.LSTM else 1), 1)
        self.rnn = kind(width, size, layers)
        self.rnn.load_state_dict(weights)
        self.head = MlpPolicy({key: value for key, value in state.items() if key.startswith("mlp.")}, activation)
        self.mean = torch.nn.Buffer(state.get("obs_normalizer._mean", torch.zeros(1)).float())
        scale = state["obs_normalizer._std"].float() + 1e-2 if "obs_normalizer._std" in state else torch.ones(1)
        self.scale = torch.nn.Buffer(scale)
        self.sizes = width, self.head.sizes[1]

    def step(self, rows: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Mean actions, and the state after them."""
        rows = (rows - self.mean) / self.scale
        out, after = self.rnn(rows[None], tuple(state) if len(state) == 2 else state[0])
        return self.head(out[0]), [*after] if len(state) == 2 else [after]
