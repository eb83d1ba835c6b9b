"""A training of a fraction of a second by its own command, on a task that is built once before children are forked."""

from pathlib import Path
from typing import Any

import torch

from sim.files.command import exit_code_of
from sim.robots.robot import get_robot
from tests.kills.steps import Steps
from train import base
from train.ppo.learner import read_checkpoint
from train.ppo.cfg import PpoCfg
from train.ppo.run import CHECKPOINT
from train.task.cfg import TaskCfg
from train.task.cfg import CurriculumCfg
from train.task.task import CommandTask

_ROBOT = get_robot("anymal")
_CFG = TaskCfg(curriculum=CurriculumCfg(num_columns=2, noise_columns=1))
_PPO = PpoCfg(hidden_dims=(16, 8), steps_per_env=4, epochs=1, mini_batches=2)
TASK = CommandTask(_ROBOT, _CFG, num_envs=6, device="cpu", seed=0)
"""As new in every child; a process that trains twice gets what the first training left."""


def config(run_dir: Path, iterations: int) -> base.BaseCfg:
    """Settings that begin a training, or go on with what is left of it; every iteration is saved."""
    resume = run_dir if (run_dir / CHECKPOINT).exists() else None
    sizes = {"num_envs": 6, "iterations": iterations, "rows": 100, "save_every_s": 0.0}
    return base.BaseCfg(run_dir=run_dir, resume=resume, device="cpu", task=_CFG, ppo=_PPO, **sizes)


def train(run_dir: Path, *, iterations: int) -> int:
    """Begins a training or goes on with it; returns the command's exit code."""
    base.CommandTask = lambda *_, **__: TASK
    return exit_code_of(lambda: base.train(config(run_dir, iterations)))


def train_watched(run_dir: Path, *, iterations: int, **watched: Any) -> int:
    """The same while its steps are watched (:class:`tests.kills.steps.Steps`)."""
    Steps(run_dir, **watched)
    return train(run_dir, iterations=iterations)


def saved(run_dir: Path) -> dict[str, Any]:
    """All of a checkpoint but what a clock says; empty without one."""
    path = run_dir / CHECKPOINT
    if not path.exists():
        return {}
    content = read_checkpoint(path, "anymal")
    return {key: value for key, value in content.items() if key != "extra"}


def equal(first: Any, second: Any) -> bool:
    """Whether two contents of checkpoints agree bit for bit."""
    if isinstance(first, dict):
        return first.keys() == second.keys() and all(equal(first[key], second[key]) for key in first)
    if isinstance(first, list | tuple):
        return len(first) == len(second) and all(map(equal, first, second))
    return torch.equal(first, second) if isinstance(first, torch.Tensor) else first == second
