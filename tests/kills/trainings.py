"""A training of a fraction of a second by its own command, on a task that is built once before children are forked."""

from pathlib import Path
from typing import Any

import torch

from sim.files.command import run_command
from sim.robots.find import get_robot
from tests.kills.steps import Steps
from train.commands import Train
from train.ppo import training
from train.ppo.checkpoint import CHECKPOINT, read_checkpoint
from train.task.cfg import CurriculumCfg, TaskCfg
from train.task.task import CommandTask

_ROBOT = get_robot("anymal")
_CFG = TaskCfg(curriculum=CurriculumCfg(num_columns=2, noise_columns=1))
TASK = CommandTask(_ROBOT, _CFG, num_envs=6, device="cpu", seed=0)
"""As new in every child; a process that trains twice gets what the first training left."""


_FLAGS = (
    "--device cpu --num-envs 6 --task.curriculum.num-columns 2 "
    "--task.curriculum.noise-columns 1 --ppo.hidden-dims 16 8 --ppo.steps-per-env 4 --ppo.epochs 1 --ppo.mini-batches 2"
)  # every iteration is saved


def train(run_dir: Path, *, iterations: int, resume: Path | None = None) -> int:
    """Begins a training or goes on with what is left of it; returns the command's exit code.

    Args:
        run_dir: Where it works, and goes on if there is a checkpoint.
        iterations: Iterations in all.
        resume: The same directory, to go on by its own settings.
    """
    training.CommandTask = lambda *_, **__: TASK  # pyright: ignore[reportAttributeAccessIssue]
    training.SAVE_EVERY_S = 0.0
    flags = ["--run-dir", str(run_dir)] if resume is None else ["--resume", str(resume)]
    return run_command(Train, [*_FLAGS.split(), *flags, "--iterations", str(iterations)], name="train")


def train_watched(run_dir: Path, *, iterations: int, **watched: Any) -> int:
    """The same while its steps are watched (:class:`tests.kills.steps.Steps`)."""
    Steps(run_dir, **watched)
    return train(run_dir, iterations=iterations)


def saved(run_dir: Path) -> dict[str, Any]:
    """All of a checkpoint but what a clock says; empty without one."""
    path = run_dir / CHECKPOINT
    if not path.exists():
        return {}
    return {key: value for key, value in read_checkpoint(path).items() if key != "progress"}


def equal(first: Any, second: Any) -> bool:
    """Whether two contents of checkpoints agree bit for bit."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(equal(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(equal, first, second))
    return torch.equal(first, second) if isinstance(first, torch.Tensor) else first == second
