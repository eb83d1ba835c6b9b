"""The controllers of rsl_rl's checkpoints."""

import re

import torch

from sim.policy.runner import with_rows_of_zeros


class MlpPolicy(torch.nn.Module):
    """Multilayer perceptron with ELU between its layers: rsl_rl's ``MLPModel`` without its distribution."""

    def __init__(self, state: dict[str, torch.Tensor]) -> None:
        """Build from rsl_rl's keys ``mlp.<k>.weight`` / ``.bias`` and, if any, ``obs_normalizer._mean`` / ``._std``."""
        super().__init__()
        indices = sorted(int(m.group(1)) for key in state if (m := re.fullmatch(r"mlp\.(\d+)\.weight", key)))
        layers: list[torch.nn.Module] = []
        for index in indices:
            weight = state[f"mlp.{index}.weight"]
            layer = torch.nn.Linear(weight.shape[1], weight.shape[0])
            layer.weight.data.copy_(weight)
            layer.bias.data.copy_(state[f"mlp.{index}.bias"])
            layers += [layer, torch.nn.ELU()]
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
