"""Made-up sets and tables."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from qd.evaluate.measures import Performance, measure
from qd.evaluate.sets import TerrainSet, plain_set
from qd.evaluate.tables import Tables, make_tables
from sim.robots.find import get_robot
from tests.qd.stand_in import BAD, GOAL, HIT, LATE, result_of


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
