"""The tables of the paper: every controller on every set, with intervals, and what that says of the terrains.

All numbers are means over the terrains of a set, each the mean over its valid episodes; intervals are 95 %, bootstrap
over terrains, with the same resamples for every controller.
"""

from collections.abc import Callable, Mapping
from dataclasses import asdict
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.files.intervals import paired_interval
from sim.robots.robot import RobotCfg
from train.evaluate.differences import differences
from train.evaluate.measures import MEASURES, Measured
from train.evaluate.paper import published
from train.evaluate.seeds import firsts, over_seeds
from train.evaluate.sets import FROM_ARCHIVE, TerrainSet

Crossed = Mapping[str, Mapping[str, Measured]]
"""Set -> controller -> what it made of the set's terrains."""


def make_tables(crossed: Crossed, sets: Mapping[str, TerrainSet], robot: RobotCfg, seed: int) -> dict[str, Any]:
    """Everything that ``tables.json`` says of crossings, as JSON values.

    Args:
        crossed: What each controller made of each set.
        sets: The sets.
        robot: Robot settings.
        seed: Of the bootstrap.

    Returns:
        ``success``, ``goal``, ``fallen`` (fractions), ``reward`` (sum over 20 s): set -> controller -> mean;
        ``penalties``: set -> controller -> penalty -> mean, scaled; ``intervals``: the same five with [lower, upper];
        ``outcomes`` and ``invalid_terrains``: counts; ``over_seeds``: mean over the controllers of a kind
        (:func:`train.evaluate.seeds.over_seeds`); ``differences`` of every two kinds' first controllers by set
        (:mod:`train.evaluate.differences`); ``traversable`` by generated set (:func:`split_by_goal`); ``terrains``: set ->
        number of terrains; ``paper``: the paper's numbers likewise, None of a robot it has none of; ``reward_weights``.
    """
    means = _statistics(crossed, _mean)
    return {
        **means,
        "over_seeds": over_seeds(means, MEASURES),
        "intervals": _statistics(crossed, lambda values: _interval(values, seed)),
        "terrains": {name: len(chosen) for name, chosen in sets.items()},
        "outcomes": _by_controller(crossed, lambda one: one.outcomes),
        "invalid_terrains": _by_controller(crossed, lambda one: int((~one.valid).sum())),
        "differences": {
            name: differences({who: row[who] for who in firsts(row)}, sets[name].numbers, seed)
            for name, row in crossed.items()
        },
        "traversable": {
            name: split_by_goal(row, sets[name].numbers, seed) for name, row in crossed.items() if name in FROM_ARCHIVE
        },
        "paper": published(robot.name),
        "reward_weights": {
            **{name: weight for name, weight in asdict(robot.training.rewards).items() if weight},
            "only_positive": robot.training.only_positive,
        },
    }


def split_by_goal(row: Mapping[str, Measured], numbers: NDArray[np.int64], seed: int) -> dict[str, Any]:
    """Terrains that any of the controllers crossed, and those that none did: the search may ask for what nobody can.

    A terrain counts as crossed if at least one episode of one controller reached the goal. With more or better
    controllers, or more episodes, more terrains would be: a lower bound of what is traversable.

    Args:
        row: What each controller made of T terrains.
        numbers: Number of each terrain, shape (T,).
        seed: Of the bootstrap.

    Returns:
        ``crossed`` and ``never_crossed``: their ``count``, ``share`` with ``interval``, numbers as ``terrains``, and
        each of :data:`train.evaluate.measures.MEASURES` as controller -> mean, with ``intervals``; invalid terrains, with every
        controller, are in neither.
    """
    judged = np.any([one.valid for one in row.values()], axis=0)
    ever = np.any([one.goals > 0 for one in row.values()], axis=0)
    found = {}
    for name, member in (("crossed", ever & judged), ("never_crossed", ~ever & judged)):
        shares = member[judged].astype(float)
        found[name] = {
            "count": int(member.sum()),
            "share": _mean(shares),
            "interval": _interval(shares, seed),
            "terrains": np.sort(numbers[member]).tolist(),
            **{key: {who: _mean(one.values[key][member]) for who, one in row.items()} for key in MEASURES},
            "intervals": {
                key: {who: _interval(one.values[key][member], seed) for who, one in row.items()} for key in MEASURES
            },
        }
    return found


def _statistics(crossed: Crossed, of: Callable[[NDArray[np.float64]], Any]) -> dict[str, Any]:
    """Each of the measures, and ``penalties``: set -> controller -> what ``of`` makes of the terrains' values."""
    tables: dict[str, Any] = {
        name: _by_controller(crossed, lambda one, name=name: of(one.values[name])) for name in MEASURES
    }
    tables["penalties"] = _by_controller(
        crossed, lambda one: {name: of(values) for name, values in one.penalties.items()}
    )
    return tables


def _by_controller(crossed: Crossed, of: Callable[[Measured], Any]) -> dict[str, dict[str, Any]]:
    """Set -> controller -> what ``of`` makes of what it made of the set."""
    return {name: {who: of(one) for who, one in row.items()} for name, row in crossed.items()}


def _valid(values: NDArray[np.float64]) -> NDArray[np.float64]:
    return values[~np.isnan(values)]


def _mean(values: NDArray[np.float64]) -> float | None:
    kept = _valid(values)
    return float(kept.mean()) if len(kept) else None


def _interval(values: NDArray[np.float64], seed: int) -> list[float] | None:
    return paired_interval(_valid(values), seed)
