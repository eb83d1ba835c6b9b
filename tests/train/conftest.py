"""One small task for all tests of the room, and controllers that a fine-tuning begins with."""

import tests.imports

# isort: split
import tests.toys  # noqa: F401  before anything reads the registries

# isort: split
import itertools
import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from qd.evaluate.sets import TRAINED_ON, hash_elites
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from train.cfg import CurriculumCfg, FinetuneCfg, PpoCfg, TaskCfg
from train.finetune import find_training_elites, first_facts
from train.ppo.checkpoint import STD, read_start
from train.ppo.training import Training
from train.task.task import CommandTask
from train.task.tiles import Mix

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
    mix, facts = Mix(cfg=cfg, elites=elites, device="cpu"), first_facts(robot, cfg, elites, start)
    return Training(robot, cfg, run, device="cpu", settings={}, saved=None, mix=mix, facts=facts, start=start)


PPO = PpoCfg(steps_per_env=4, epochs=1, mini_batches=2)


def layers(*sizes, between=torch.nn.ELU):
    """Linear layers of these sizes, and what is between them."""
    parts = [part for pair in itertools.pairwise(sizes) for part in (torch.nn.Linear(*pair), between())]
    return torch.nn.Sequential(*parts[:-1])


def write_actor(path, *, hidden=(16, 8), critic=False, critic_hidden=None, **extra):
    """A controller of random layers, as rsl_rl writes it."""
    torch.manual_seed(0)
    actor = {STD: torch.full((12,), 0.3), **layers(235, *hidden, 12).state_dict(prefix="mlp."), **extra}
    content = {"actor_state_dict": actor, "activation": "elu"}
    if critic:
        content["critic_state_dict"] = layers(235, *(critic_hidden or hidden), 1).state_dict(prefix="mlp.")
    torch.save(content, path)
    return path


def write_trained(folder: Path, genes: np.ndarray) -> Path:
    """A controller whose record says that it was trained on elites, genes of shape (num_elites, num_genes)."""
    path = write_actor(folder / "tuned.pt")
    path.with_suffix(".train.json").write_text(json.dumps({TRAINED_ON: hash_elites(genes)}))
    return path
