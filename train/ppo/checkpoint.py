"""Checkpoints of trainings, and the networks that a fine-tuning begins with; no code in a file is run."""

import io
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import torch

from sim.files.atomic import write_atomically
from sim.policy.loaders import load_policy, read_weights, reason_of
from sim.policy.mlp import MlpPolicy
from sim.robots.robot import RobotCfg

FORMAT = "faultline training checkpoint 2"
CHECKPOINT = "checkpoint.pt"
"""File of a training's directory that it goes on from."""
STD = "distribution.std_param"
"""Key of the standard deviation of the actions in an actor's state."""
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
        raise ValueError(f"{path} must be the checkpoint of a training, got {reason_of(error)}") from error
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise ValueError(f"{path} must be a '{FORMAT}', got another kind of file: name the directory of a training")
    return content


@dataclass(frozen=True, kw_only=True)
class Start:
    """A trained actor, and its critic where it is known."""

    actor: State
    critic: State | None
    hidden_dims: tuple[int, ...]
    """Hidden layers of both."""

    def with_noise_of(self, other: "Start") -> "Start":
        """The same with another's standard deviation of the actions, where that is known."""
        noise = {STD: other.actor[STD]} if STD in other.actor else {}
        return replace(self, actor={**self.actor, **noise})


def read_start(path: Path, robot: RobotCfg) -> Start:
    """Networks of an rsl_rl checkpoint, fit to be trained on.

    A normaliser of the observations becomes part of the first layer: (x - mean) / (std + .01) is linear. The critic of
    such a file is left: its own normaliser is another.
    """
    policy = load_policy(path, robot, "cpu")
    if not isinstance(policy, MlpPolicy):
        raise ValueError(
            f"a fine-tuning starts from an rsl_rl checkpoint (actor_state_dict), got another kind of controller: "
            f"{path}; train one with `{robot.train_command}`, and leave --policy out"
        )
    content = read_weights(path)
    if policy.activation != "elu" or "actor_state_dict" not in content:
        raise ValueError(
            f"a fine-tuning starts from an rsl_rl 5 checkpoint (actor_state_dict) with ELU between its layers, got "
            f"{policy.activation} and {', '.join(content)}: {path}; give another controller"
        )
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
    std = actor.get(STD)
    if std is not None and (std.shape != (robot.num_joints,) or not bool(((std > 0.0) & std.isfinite()).all())):
        raise ValueError(
            f"{path}: {STD}, the standard deviation of the actions, must be {robot.num_joints} numbers above 0, got "
            f"{' '.join(str(std).split())}: leave it out, or give another controller"
        )


def _check_critic(critic: Any, sizes: tuple[int, ...], path: Path) -> None:
    expected = {}
    for k, (width, out) in enumerate(pairwise(sizes)):
        expected |= {f"mlp.{2 * k}.weight": (out, width), f"mlp.{2 * k}.bias": (out,)}
    tensors = isinstance(critic, dict) and all(isinstance(value, torch.Tensor) for value in critic.values())
    shapes = {key: tuple(value.shape) for key, value in critic.items()} if tensors else {}
    if shapes != expected or not all(bool(value.isfinite().all()) for value in critic.values()):
        raise ValueError(
            f"{path}: critic_state_dict must have finite weights and the actor's hidden layers {list(sizes[1:-1])}, "
            "got others: leave it out of the file, and a critic is trained"
        )
