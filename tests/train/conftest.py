"""One small task for all tests of the room: what is compiled for one serves the others."""

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest

from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from train.cfg import CurriculumCfg, FinetuneCfg, TaskCfg
from train.finetune import begin_finetuning, find_training_elites
from train.ppo.checkpoint import read_start
from train.ppo.training import Training
from train.task.task import CommandTask

NUM_ENVS = 6
CURRICULUM = CurriculumCfg(num_columns=2, noise_columns=1)


@pytest.fixture
def make_task(device: str) -> Callable[..., CommandTask]:
    def make(seed: int = 0, num_envs: int = NUM_ENVS, robot: str = "anymal", **changes: object) -> CommandTask:
        cfg = TaskCfg.of(get_robot(robot), curriculum=CURRICULUM, **changes)
        return CommandTask(get_robot(robot), cfg, num_envs=num_envs, device=device, seed=seed)

    return make


@pytest.fixture(scope="session")
def shared_task(device: str) -> CommandTask:
    """A task that tests may step and change, but not count on finding at its beginning."""
    return CommandTask(get_robot("anymal"), TaskCfg(curriculum=CURRICULUM), num_envs=NUM_ENVS, device=device, seed=1)


def begun(robot: RobotCfg, cfg: FinetuneCfg, run: Path) -> Training:
    """A fine-tuning on the CPU that has not iterated yet."""
    start = read_start(Path(cfg.policy or robot.policy_file), robot)
    cfg = replace(cfg, ppo=replace(cfg.ppo, hidden_dims=start.hidden_dims)).sized(robot, "cpu")
    elites = find_training_elites(robot, cfg)
    return begin_finetuning(robot, cfg, run, device="cpu", settings={}, saved=None, elites=elites, start=start)
