"""The controllers of rsl_rl's checkpoints."""

import torch

from sim.controllers.runner import Recurrent, with_rows_of_zeros

ACTIVATIONS: dict[str, type[torch.nn.Module]] = {
    "elu": torch.nn.ELU, "selu": torch.nn.SELU, "relu": torch.nn.ReLU, "lrelu": torch.nn.LeakyReLU,
    "tanh": torch.nn.Tanh, "sigmoid": torch.nn.Sigmoid, "softplus": torch.nn.Softplus, "gelu": torch.nn.GELU,
    "swish": torch.nn.SiLU, "mish": torch.nn.Mish, "identity": torch.nn.Identity,
}  # fmt: skip
"""What rsl_rl calls the functions between layers."""


class MlpPolicy(torch.nn.Module):
    """Multilayer perceptron: rsl_rl's ``MLPModel`` without its distribution."""

    def __init__(self, state: dict[str, torch.Tensor], activation: str = "elu") -> None:
        """Build from rsl_rl's keys ``mlp.<k>.weight`` / ``.bias`` and, if any, ``obs_normalizer._mean`` / ``._std``."""
        super().__init__()
        self.activation = activation
        weights = {key.removeprefix("mlp."): value for key, value in state.items() if key.startswith("mlp.")}
        layers: list[torch.nn.Module] = []
        for index in sorted(int(key.removesuffix(".weight")) for key in weights if key.endswith(".weight")):
            size, width = weights[f"{index}.weight"].shape
            layers += [torch.nn.Linear(width, size), ACTIVATIONS[activation]()]
        self.layers = torch.nn.Sequential(*layers[:-1])
        self.layers.load_state_dict(weights)
        self.mean = torch.nn.Buffer(state.get("obs_normalizer._mean", torch.zeros(1)).float())
        self.std = torch.nn.Buffer(state.get("obs_normalizer._std", torch.ones(1)).float())
        self.normalised = "obs_normalizer._mean" in state

    @property
    def sizes(self) -> tuple[int, int]:
        """Observation and action size."""
        linear = [layer for layer in self.layers if isinstance(layer, torch.nn.Linear)]
        return linear[0].in_features, linear[-1].out_features

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
        kind = {4: torch.nn.LSTM, 3: torch.nn.GRU}[gates // size]
        super().__init__([torch.zeros(layers, 1, size)] * (2 if kind is torch.nn.LSTM else 1), 1)
        self.rnn = kind(width, size, layers)
        self.rnn.load_state_dict(weights)
        self.head = MlpPolicy(state, activation)
        self.sizes = width, self.head.sizes[1]

    def step(self, rows: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        """Mean actions, and the state after them."""
        out, after = self.rnn(self.head.normalise(rows)[None], tuple(state) if len(state) == 2 else state[0])
        return self.head.layers(out[0]), [*after] if len(state) == 2 else [after]
