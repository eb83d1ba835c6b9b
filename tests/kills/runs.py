"""A search and a training of a fraction of a second, by their own commands, and what each comes to."""

from functools import cache
from pathlib import Path
from typing import Any

import torch

import faultline
from qd.search import results
from qd.search.archive import ARCHIVE_FILE
from qd.search.checkpoint import load_checkpoint
from qd.search.directory import CHECKPOINT_FILE, CONFIG_FILE
from sim.robots.find import get_robot
from tests.kills.faults import Steps
from tests.qd.searches import crossing_by, rows_of
from tests.qd.stand_in import open_stand_in
from train.cfg import CurriculumCfg, TaskCfg
from train.ppo import training
from train.ppo.checkpoint import CHECKPOINT, read_checkpoint
from train.ppo.training import POLICY
from train.task.task import CommandTask

_SEARCH = (
    "archive --device cpu --policy tests.sim.policies:stand --seed 5 --replicas 2 --method cma_mae+map_elites "
    "--scheduler.emitters 2 --scheduler.batch-size 4 --scheduler.restart-rule 4 --fitness.intervals 3"
)  # networks of a surrogate would learn longer than the stand-in takes; few cells make a small checkpoint
_TRAIN = (
    "train --device cpu --num-envs 6 --task.curriculum.num-columns 2 --task.curriculum.noise-columns 1 "
    "--ppo.hidden-dims 16 8 --ppo.steps-per-env 4 --ppo.epochs 1 --ppo.mini-batches 2"
)
_OF_A_CLOCK = ("rollout_s", "physics_steps", "robot_steps", "idle_share")


@cache
def task() -> CommandTask:
    """The task of the training, as new in every child that was forked after it was built."""
    cfg = TaskCfg(curriculum=CurriculumCfg(num_columns=2, noise_columns=1))
    return CommandTask(get_robot("anymal"), cfg, num_envs=6, device="cpu", seed=0)


def search(path: Path, *, iterations: int, **watched: Any) -> int:
    """Begins a search over the stand-in evaluator or goes on with it; returns the command's exit code.

    The run directory is watched by :class:`tests.kills.faults.Steps` if it is said how.
    """
    results.write_figures = lambda folder, archive, metrics: []  # which would take a second
    argv = _SEARCH.split()
    argv = [*argv[:5], "--resume"] if (path / CONFIG_FILE).exists() else [*argv, "--run-dir"]
    if watched:
        Steps(path, **watched)
    with crossing_by(open_stand_in):
        return faultline.main([*argv, str(path), "--iterations", str(iterations)])


def search_outcome(path: Path) -> tuple[Any, ...]:
    """What a search comes to: the archive's bytes, its metrics without a clock's, and what it would ask next."""
    scheduler = load_checkpoint(path / CHECKPOINT_FILE)["scheduler"]
    rows = [{key: value for key, value in row.items() if key not in _OF_A_CLOCK} for row in rows_of(path)]
    assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
    return (path / ARCHIVE_FILE).read_bytes(), rows, scheduler.ask().tobytes()


def saved_iterations(path: Path) -> int:
    """Iterations that the checkpoint of a search has; 0 without one."""
    file = path / CHECKPOINT_FILE
    return len(load_checkpoint(file)["metrics"]) if file.exists() else 0


def train(path: Path, *, iterations: int, **watched: Any) -> int:
    """Begins a training or goes on with it, saving every iteration; arguments and result as of :func:`search`."""
    training.CommandTask = lambda *_, **__: task()
    training.SAVE_EVERY_S = 0.0
    if watched:
        Steps(path, **watched)
    return faultline.main([*_TRAIN.split(), "--run-dir", str(path), "--iterations", str(iterations)])


def train_outcome(path: Path) -> tuple[Any, ...]:
    """What a training comes to: its iterations and controller. Weights differ, for episodes begin anew on a resume."""
    policy = torch.load(path / POLICY, weights_only=True)
    return saved_updates(path), policy["iter"], {key: value.shape for key, value in policy["actor_state_dict"].items()}


def saved_updates(path: Path) -> int:
    """Iterations that the checkpoint of a training has; 0 without one."""
    file = path / CHECKPOINT
    return read_checkpoint(file)["iter"] if file.exists() else 0
