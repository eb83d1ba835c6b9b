"""The networks that a fine-tuning begins with, out of a controller's file."""

from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from sim.policy.loaders import MlpPolicy, load_policy, read_weights
from sim.robots.robot import RobotCfg

_STD = "distribution.std_param"
State = dict[str, torch.Tensor]
"""Weights under rsl_rl's keys."""


@dataclass(frozen=True, kw_only=True)
class Start:
    """A trained actor, and its critic where it is known."""

    actor: State
    critic: State | None
    hidden_dims: tuple[int, ...]
    """Hidden layers of both."""


def read_start(path: Path, robot: RobotCfg) -> Start:
    """Networks of an rsl_rl checkpoint, fit to be trained on.

    A normaliser of the observations becomes part of the first layer: (x - mean) / (std + .01) is linear. The critic of
    such a file is left: its own normaliser is another.

    Args:
        path: The checkpoint.
        robot: Whose controller it is.

    Raises:
        ValueError: If it is no such file, of another robot, or its standard deviation or critic cannot be trained on.
    """
    policy = load_policy(path, robot, "cpu")
    if not isinstance(policy, MlpPolicy):
        raise ValueError(
            f"a fine-tuning starts from an rsl_rl checkpoint (actor_state_dict), got another kind of controller: {path}"
        )
    content = read_weights(path)
    actor = {key: value for key, value in content["actor_state_dict"].items() if not key.startswith("obs_normalizer.")}
    if policy.normalised:
        weight = actor["mlp.0.weight"] / (policy.std.flatten() + 1e-2)
        actor |= {"mlp.0.weight": weight, "mlp.0.bias": actor["mlp.0.bias"] - weight @ policy.mean.flatten()}
    hidden = tuple(layer.out_features for layer in policy.layers if isinstance(layer, torch.nn.Linear))[:-1]
    critic = None if policy.normalised else content.get("critic_state_dict")
    _check_std(actor, robot, path)
    if critic is not None:
        _check_critic(critic, (policy.sizes[0], *hidden, 1), path)
    return Start(actor=actor, critic=critic, hidden_dims=hidden)


def _check_std(actor: State, robot: RobotCfg, path: Path) -> None:
    std = actor.get(_STD)
    fits = std is None or (std.shape == (robot.num_joints,) and bool((std > 0.0).all()) and bool(std.isfinite().all()))
    if not fits:
        raise ValueError(
            f"{path}: {_STD}, the standard deviation of the actions, must be {robot.num_joints} numbers above 0, got "
            f"{' '.join(str(std).split())}: leave it out, or give another controller"
        )


def _check_critic(critic: Any, sizes: tuple[int, ...], path: Path) -> None:
    expected = {}
    for k, (width, out) in enumerate(pairwise(sizes)):
        expected |= {f"mlp.{2 * k}.weight": (out, width), f"mlp.{2 * k}.bias": (out,)}
    tensors = isinstance(critic, dict) and all(isinstance(value, torch.Tensor) for value in critic.values())
    if not tensors or {key: tuple(value.shape) for key, value in critic.items()} != expected:
        raise ValueError(
            f"{path}: its critic (critic_state_dict) must have the actor's hidden layers {list(sizes[1:-1])}, "
            f"{sizes[0]} inputs and one output, got another: leave it out of the file, and one is trained"
        )
    if not all(bool(value.isfinite().all()) for value in critic.values()):
        raise ValueError(f"{path}: its critic (critic_state_dict) has weights that are not finite: leave it out")
