"""Made-up crossings, sets and tables."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace

import numpy as np

from qd.evaluate.measures import Measured, measure
from qd.evaluate.sets import TerrainSet, plain_set
from qd.evaluate.tables import Tables, make_tables
from sim.robots.find import get_robot
from tests.qd.stand_in import Stub
from tests.train.results import BAD, GOAL, HIT, LATE, result_of

PENALTIES = ("yaw_rate", "vel_x", "vel_y", "contact_force", "stumble", "collision")


class Crosser:
    """Opens evaluators that cross by a rule: policy and terrains -> on which of these all robots reach the goal."""

    def __init__(self, rule: Callable[[str, np.ndarray], Sequence[bool]] = lambda policy, terrains: [True] * 999):
        self.opened, self.lots, self.rule = [], [], rule

    @contextmanager
    def open(self, cfg):
        self.opened.append(cfg)

        def evaluate(terrains, seeds):
            self.lots.append((cfg.policy, len(seeds)))
            rows = [
                [GOAL if goal else HIT] * cfg.num_replicas for goal in self.rule(cfg.policy, terrains)[: len(seeds)]
            ]
            return result_of(rows, names=PENALTIES, reward=np.full(np.shape(rows), 9.0) if cfg.reward else None)

        yield Stub(evaluate)


def make_set(name: str, count: int, first: int = 0) -> TerrainSet:
    """A set of hard-random terrains that are numbered from ``first`` on."""
    return replace(plain_set("hard_random", count, 0), name=name, numbers=np.arange(first, first + count))


def make_measured(goals: Sequence[int], *, of: int = 20, reward: float = 10.0, bad: Sequence[int] = ()) -> Measured:
    """A controller that reached the goal in so many of ``of`` episodes of each terrain; ``bad`` ones are invalid."""
    rows = [[GOAL] * count + [HIT if count % 2 else LATE] * (of - count) for count in goals]
    for terrain in bad:
        rows[terrain] = [BAD] * of
    return measure(result_of(rows, reward=np.full((len(goals), of), reward)), (1.0, 1.0))


def make_report(goals: Mapping[str, Mapping[str, Sequence[int]]], *, of: int = 4) -> Tables:
    """Tables of ANYmal: set -> controller -> on each terrain, in how many of ``of`` episodes it reached the goal."""
    crossed = {name: {who: make_measured(counts, of=of) for who, counts in row.items()} for name, row in goals.items()}
    sets = {name: make_set(name, len(next(iter(row.values())))) for name, row in goals.items()}
    controllers = {who: {"policy": who, "sha256": None} for who in next(iter(goals.values()))}
    return make_tables(crossed, sets, get_robot("anymal"), controllers=controllers, episodes=of, seed=0)
