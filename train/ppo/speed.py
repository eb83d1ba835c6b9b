"""How fast training is: environment steps per second with learning, ``python -m train.ppo.speed --num-envs 4096 8192``."""

import json
import statistics
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import tyro

from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.command import exit_code_of
from sim.files.provenance import provenance
from sim.robots.robot import RobotCfg, get_robot
from sim.simulation import resolve_device
from train.ppo.learner import Learner
from train.ppo.ppo import PpoCfg
from train.task.cfg import TaskCfg
from train.task.task import CommandTask
from train.task.vec_env import CommandVecEnv


@dataclass(frozen=True, kw_only=True)
class SpeedCfg:
    """Time training iterations, simulation and learning together."""

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py)."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    num_envs: tuple[int, ...] = (4096, 8192)
    """Numbers of robots to time."""
    iterations: int = 40
    """Iterations timed, after 10 that are not."""
    seed: int = 0
    """Seed of everything drawn."""
    out: Path | None = None
    """Also write the numbers to this file."""


def time_training(robot: RobotCfg, num_envs: int, *, iterations: int, device: str, seed: int) -> dict[str, Any]:
    """Median time of an iteration and what follows from it.

    The shipped controller, where there is one, walks the robots, so that contacts are those of the better part of a
    training; its weights go on being trained.
    """
    task = CommandTask(robot, TaskCfg.of(robot), num_envs=num_envs, device=device, seed=seed)
    learner = Learner(CommandVecEnv(task), PpoCfg(init_noise_std=0.5), seed=seed)
    if robot.policy_file.exists():
        shipped = torch.load(robot.policy_file, map_location="cpu", weights_only=True)["actor_state_dict"]
        learner.alg.get_policy().load_state_dict(shipped)
    for _ in range(10):
        learner.iterate()
    timed = [learner.iterate() for _ in range(iterations)]
    seconds = statistics.median(step.collection_s + step.learning_s for step in timed)
    return {
        "num_envs": num_envs,
        "iteration_s": seconds,
        "collection_s": statistics.median(step.collection_s for step in timed),
        "learning_s": statistics.median(step.learning_s for step in timed),
        "train_env_steps_per_s": learner.steps_per_iteration / seconds,
    }


def measure(cfg: SpeedCfg) -> int:
    """Time what is asked for, print it, write the file.

    Raises:
        ValueError: If something asked for cannot be had; raised before any long work.
    """
    robot, device = get_robot(cfg.robot), resolve_device(cfg.device)
    if cfg.out is not None:
        prepare_output(cfg.out)
    runs = [
        time_training(robot, count, iterations=cfg.iterations, device=device, seed=cfg.seed) for count in cfg.num_envs
    ]
    report = {**provenance(device, cfg.seed), "robot": robot.name, "training": runs}
    print(json.dumps(report, indent=2))
    if cfg.out is not None:
        write_atomically(cfg.out, to_json(report))
    return 0


def main() -> int:
    """Command line; returns the exit status."""
    cfg = tyro.cli(SpeedCfg, description=__doc__)
    return exit_code_of(lambda: measure(cfg))


if __name__ == "__main__":
    sys.exit(main())
