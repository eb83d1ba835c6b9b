"""Small things that tests of several rooms are made of: archives, terrains and controllers."""

import socket
from collections.abc import Mapping, Sequence
from dataclasses import fields, replace
from pathlib import Path

import numpy as np
import torch
from rsl_rl.models import MLPModel
from tensordict import TensorDict

from kernels.super_gaussian import LOWER, UPPER
from qd.evaluate.sets import TerrainSet, plain_set
from qd.evaluate.tables import Performance, Tables, make_tables, measure
from qd.search.archive import Archive, FreshValues, no_outcomes, no_witnesses, write_archive
from qd.search.fitness import Evaluation
from sim.files.atomic import to_json
from sim.robots.find import get_robot
from sim.robots.robot import ROBOTS, robot_identity
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.qd.stand_in import BAD, GOAL, HIT, LATE, result_of

OBSERVATIONS, ACTIONS = 235, 12


def rows_of(*shape: int) -> torch.Tensor:
    """Random observation rows of ANYmal."""
    return torch.randn((*shape, OBSERVATIONS), generator=torch.Generator().manual_seed(1))


def free_port() -> int:
    """A port of this host that nobody listens on."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def small_archive(num_elites: int = 3) -> Archive:
    rng = np.random.default_rng(num_elites)
    columns = rng.random((num_elites, 2))
    rows = rng.random(num_elites)
    return Archive(
        robot="anymal",
        **robot_identity(ROBOTS["anymal"]),
        space="super_gaussian",
        penalties=("yaw_rate", "vel_x"),
        scales=(0.5, 2.0),
        intervals=10,
        collision_bit=False,
        iterations=7,
        genes=rng.uniform(-1, 1, (num_elites, 64)).astype(np.float32),
        ratios=columns,
        cell=np.arange(num_elites),
        fitness=np.sort(rows)[::-1] - 1.0,
        penalty_mean=columns,
        penalty_std=columns,
        collision_rate=rows,
        goal_rate=rows,
        fallen_rate=rows,
        end_position=np.column_stack([6.0 + rows, 4.0 - rows]).astype(np.float32),
        invalid_episodes=np.zeros(num_elites, int),
        episodes=np.full(num_elites, 4),
        iteration=np.arange(num_elites) + 1,
        **no_outcomes(num_elites),
    )


def make_archive(num_elites: int, *, robot: str = "anymal", seed: int = 0) -> Archive:
    """So many elites with hard-random genes, one a cell, which all of a robot's penalties make and nobody crosses."""
    columns, rates = np.full((num_elites, 6), 1.0 / 6.0), np.zeros(num_elites)
    return replace(
        small_archive(num_elites), robot=robot, **robot_identity(ROBOTS[robot]), iterations=3,
        penalties=ROBOTS["anymal"].penalties, scales=(1.0,) * 6, ratios=columns, penalty_mean=columns,
        penalty_std=columns, collision_rate=rates, goal_rate=rates, fallen_rate=rates,
        genes=np.clip(SUPER_GAUSSIAN.hard_random(max(num_elites, 1), seed)[:num_elites], -1.0, 1.0),
        fitness=np.linspace(9.0, 1.0, num_elites), end_position=np.full((num_elites, 2), 6.0, np.float32),
        iteration=np.ones(num_elites, np.int64),
    )  # fmt: skip


def bump(*, x, sigma_x, height, y=4.0, sigma_y=3.0) -> np.ndarray:
    """Genes of a bump, by default as broad as can be across the way."""
    values = np.array([x, y, sigma_x, sigma_y, 4.0, 4.0, 0.0, height])
    return (2.0 * (values - LOWER) / (UPPER - LOWER) - 1.0).astype(np.float32)


def fresh_values(archive: Archive) -> FreshValues:
    """Forty fresh episodes that say half the fitness, and otherwise what the elites had."""
    same = {field.name: getattr(archive, field.name) for field in fields(Evaluation)}
    changed = {"fitness": archive.fitness / 2, "episodes": np.full(len(archive), 40)}
    return FreshValues(**same | changed, reproduced=np.arange(len(archive)) % 2 == 0)


def judged_archive() -> Archive:
    """Five elites: a fault, one confirmed alone, one certified alone, one that fails alone, one that does not fail.

    Counts are goal, base collision, other, invalid. Of 20 episodes 9 are under half, 10 are not.
    """
    archive = small_archive(5)
    fresh = replace(fresh_values(archive), goal_rate=np.array([0.0, 0.475, 0.2, 0.1, 0.5]))
    under, half = [9, 6, 5, 0], [10, 10, 0, 0]
    never, much = [0, 0, 0, 0], [20, 0, 0, 0]
    return replace(
        archive,
        fresh=fresh,
        resolved_outcomes=np.array([under, under, half, half, under]),
        certifiers=("C-G", "S"),
        certifier_sha256=("a" * 64, "b" * 64),
        certifier_outcomes=np.array([[under, half], [half, never], [much, under], [under, under], [much, much]]),
        certifier_resolved_outcomes=np.array(
            # C-G has 6 of 20 invalid on the second, more than a quarter: it certifies nothing
            [[never, half], [[14, 0, 0, 6], never], [half, never], [never, never], [much, much]]
        ),
    )


def steered_archive() -> Archive:
    """The judged archive with ways: on the line of elite 1 by the searched controller, around of elite 3 by C-G."""
    witnesses = no_witnesses(5, 0.5)
    witnesses.walker[[1, 3]], witnesses.kind[[1, 3]], witnesses.way[[1, 3], :, 0] = ["searched", "C-G"], [3, 1], 0.5
    witnesses.counts[[1, 3]] = [[[0, 0, 0, 20], [17, 17, 18, 20]]], [[[0, 0, 0, 20], [0, 3, 14, 20]]]
    return replace(judged_archive(), witnesses=witnesses)


def make_set(count: int, first: int = 0) -> TerrainSet:
    """A set of hard-random terrains that are numbered from ``first`` on."""
    return replace(plain_set("hard_random", count, 0), numbers=np.arange(first, first + count))


def make_measured(goals: Sequence[int], *, of: int = 20, reward: float = 10.0, bad: Sequence[int] = ()) -> Performance:
    """A controller that reached the goal in so many of ``of`` episodes of each terrain; ``bad`` ones are invalid."""
    rows = [[GOAL] * count + [HIT if count % 2 else LATE] * (of - count) for count in goals]
    for terrain in bad:
        rows[terrain] = [BAD] * of
    return measure(result_of(rows, reward=np.full((len(goals), of), reward)), (1.0, 1.0))


def make_report(goals: Mapping[str, Mapping[str, Sequence[int]]], *, of: int = 4) -> Tables:
    """Tables of ANYmal: set -> controller -> on each terrain, in how many of ``of`` episodes it reached the goal."""
    crossed = {name: {who: make_measured(counts, of=of) for who, counts in row.items()} for name, row in goals.items()}
    sets = {name: make_set(len(next(iter(row.values())))) for name, row in goals.items()}
    controllers = {who: {"policy": who, "sha256": None} for who in next(iter(goals.values()))}
    return make_tables(crossed, sets, get_robot("anymal"), controllers=controllers, episodes=of, seed=0)


def write_run(folder: Path, archive: Archive, settings: dict | None = None) -> Path:
    """A run's directory, with as much of its config as is read for its settings."""
    folder.mkdir(parents=True)
    write_archive(folder / "archive.npz", archive)
    if settings is not None:
        config = {"settings": settings, "iterations": archive.iterations, "device": "CPU", "sessions": []}
        (folder / "config.json").write_bytes(to_json(config))
    return folder


def rsl_rl_actor(observations=OBSERVATIONS, actions=ACTIONS, normalised=False):
    """rsl_rl's own actor, with a normaliser that has seen something."""
    torch.manual_seed(0)
    rows = TensorDict({"policy": torch.randn(64, observations) * 3 + 1}, batch_size=64)
    noise = {"distribution_cfg": {"class_name": "GaussianDistribution", "init_std": 1.0}}
    actor = MLPModel(rows, {"actor": ["policy"]}, "actor", actions, (32, 16), "elu", normalised, **noise)
    return seen(actor, rows) if normalised else actor.eval()


def seen(actor, rows):
    """An actor of rsl_rl whose normaliser has seen rows."""
    actor.train()
    actor.obs_normalizer.update(rows["policy"])
    return actor.eval()


def save_checkpoint(path, state, **more):
    """As rsl_rl's runner saves it, but that it says what is between its layers."""
    content = {"actor_state_dict": state, "critic_state_dict": {}, "iter": 7, "infos": None, "activation": "elu"}
    torch.save(content | more, path)
    return path
