"""The tables of the paper: every controller on every set, with intervals, and what that says of the terrains.

All numbers are means over the terrains of a set, each the mean over its valid episodes; intervals are 95 %, bootstrap
over terrains, of elites over families of kin, with the same resamples for every controller.

A controller *fails* a terrain if fewer than half of its valid episodes there reach the goal; an episode with a base
collision does not. Of two controllers, a terrain is then *mended* (the first fails, the second does not), *still
failing* (both), *newly broken* (the second alone) or fine with both. A terrain that is a matter of luck to either falls
on one side by chance: *clear* are those changes where the 95 % intervals (Wilson) of the two goal rates do not overlap.
"""

import re
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.measures import MEASURES, Families, Measured, interval_of, mean_of, of_terrains
from qd.evaluate.publish import published
from qd.evaluate.sets import FROM_ARCHIVE, TerrainSet
from qd.fitness import FAILING_GOAL_RATE
from sim.files.intervals import MAX_T_VALUES, t_interval, wilson_interval
from sim.policy.spec import MARK, controller_hash, firsts, kind_of
from sim.robots.robot import RobotCfg

KINDS = ("mended", "still_failing", "newly_broken", "fine")
"""What may have become of a terrain."""
CERTIFIED = {"certified_goal": "goal", "certified_success": "success"}
"""Measures on the certified terrains of a set alone, by what they measure: there goals can be gained."""
RATES = ("success", "goal", "fallen", *CERTIFIED)
"""Measures that lie between 0 and 1, and so do their intervals."""
Crossed = Mapping[str, Mapping[str, Measured]]
"""Set -> controller -> what it made of the set's terrains."""


def make_tables(
    crossed: Crossed,
    sets: Mapping[str, TerrainSet],
    robot: RobotCfg,
    seed: int,
    *,
    hashes: Mapping[str, str | None] | None = None,
) -> dict[str, Any]:
    """Everything that ``tables.json`` says of crossings, as JSON values.

    Args:
        crossed: What controllers made of the terrains.
        sets: The terrains.
        robot: The robot.
        seed: Of bootstraps.
        hashes: Of the controllers by name, to tell which of them certify or were searched.

    Returns:
        ``success``, ``goal``, ``fallen`` (fractions), ``reward`` (sum over 20 s): set -> controller -> mean;
        ``penalties``: set -> controller -> penalty -> mean, scaled; ``intervals``: the same five with [lower, upper];
        ``certified_goal`` and ``certified_success`` likewise, of sets whose elites have certificates, on the certified
        ones alone, with ``intervals``, and about them ``certified`` (:func:`about_certified`);
        ``outcomes`` and ``invalid_terrains``: counts; ``over_seeds``: mean over the controllers of a kind
        (:func:`over_seeds`); ``differences`` of every two kinds' first controllers by set
        (:func:`differences`); ``traversable`` by generated set (:func:`split_by_goal`); ``terrains``: set ->
        number of terrains; ``paper``: the paper's numbers likewise, None of a robot it has none of; ``reward_weights``.
    """
    means, families = _statistics(crossed, lambda _, values: mean_of(values)), _families(sets)
    certified = _on_certified(crossed, sets, lambda values, _: mean_of(values))
    return {
        **means,
        **certified,
        "certified": about_certified(sets, hashes or {}),
        "over_seeds": over_seeds({**means, **certified}, (*MEASURES, *CERTIFIED)),
        "intervals": {
            **_statistics(crossed, lambda name, values: interval_of(values, seed, families[name])),
            **_on_certified(crossed, sets, lambda values, families: interval_of(values, seed, families)),
        },
        "terrains": {name: len(chosen) for name, chosen in sets.items()},
        "outcomes": _by_controller(crossed, lambda one: one.outcomes),
        "invalid_terrains": _by_controller(crossed, lambda one: int((~one.valid).sum())),
        "differences": {
            name: differences({who: row[who] for who in firsts(row)}, sets[name].numbers, seed, families[name])
            for name, row in crossed.items()
        },
        "traversable": {
            name: split_by_goal(row, sets[name].numbers, seed, families[name])
            for name, row in crossed.items()
            if name in FROM_ARCHIVE
        },
        "paper": published(robot.name),
        "reward_weights": {
            **{name: weight for name, weight in asdict(robot.training.rewards).items() if weight},
            "only_positive": robot.training.only_positive,
        },
    }


def _families(sets: Mapping[str, TerrainSet]) -> dict[str, Families]:
    return {name: chosen.families for name, chosen in sets.items()}


def _on_certified(
    crossed: Crossed, sets: Mapping[str, TerrainSet], of: Callable[[NDArray[np.float64], Families], Any]
) -> dict[str, Any]:
    """Each of :data:`CERTIFIED`: set -> controller -> what ``of`` makes of certified terrains and their families."""
    members = {name: one.certificates.certified for name, one in sets.items() if one.certificates is not None}
    return {
        key: {
            name: {
                who: of(one.values[measure][member], of_terrains(sets[name].families, member))
                for who, one in crossed[name].items()
            }
            for name, member in members.items()
        }
        for key, measure in CERTIFIED.items()
    }


def about_certified(sets: Mapping[str, TerrainSet], hashes: Mapping[str, str | None]) -> dict[str, Any]:
    """What certified terrains there are, and whose rates on them are biased by how they were chosen.

    Args:
        sets: The terrains.
        hashes: Of the controllers by name.

    Returns:
        Set -> number of certified ``terrains``; ``certifiers``, name -> how many of them it certifies; ``chosen_by``,
        controller -> ``certifier``, which crossed some of them to certify them, or ``searched``, which failed them
        all: the rate of the first is biased upward, that of the other downward.
    """
    found = {}
    for name, chosen in sets.items():
        given = chosen.certificates
        if given is not None:
            counts = dict(zip(given.certifiers, given.given.sum(axis=0).tolist(), strict=True))
            of_hash = dict(zip(given.sha256, given.certifiers, strict=True))
            roles = {given.searched_sha256: "searched"}
            roles |= {sha256: "certifier" for sha256, who in of_hash.items() if counts[who]}
            found[name] = {
                "terrains": int(given.certified.sum()),
                "certifiers": counts,
                "chosen_by": {who: roles[sha] for who, sha in hashes.items() if sha is not None and sha in roles},
            }
    return found


def split_by_goal(
    row: Mapping[str, Measured], numbers: NDArray[np.int64], seed: int, families: Families = None
) -> dict[str, Any]:
    """Terrains that any of the controllers crossed, and those that none did: the search may ask for what nobody can.

    A terrain counts as crossed if at least one episode of one controller reached the goal. With more or better
    controllers, or more episodes, more terrains would be: a lower bound of what is traversable.

    Args:
        row: What each controller made of T terrains.
        numbers: Number of each terrain, shape (T,).
        seed: Of the bootstrap over terrains.
        families: Of terrains that are not independent, shape (T,).

    Returns:
        ``crossed`` and ``never_crossed``: their ``count``, ``share`` with ``interval``, numbers as ``terrains``, and
        each of :data:`qd.evaluate.measures.MEASURES` as controller -> mean, with ``intervals``; terrains that are
        invalid with every controller are in neither.
    """
    judged = np.any([one.valid for one in row.values()], axis=0)
    ever = np.any([one.goals > 0 for one in row.values()], axis=0)
    found = {}
    for name, member in (("crossed", ever & judged), ("never_crossed", ~ever & judged)):
        found[name] = {
            **_counted(member, judged, numbers, seed, families),
            **{key: {who: mean_of(one.values[key][member]) for who, one in row.items()} for key in MEASURES},
            "intervals": {
                key: {
                    who: interval_of(one.values[key][member], seed, of_terrains(families, member))
                    for who, one in row.items()
                }
                for key in MEASURES
            },
        }
    return found


def difference(
    before: Measured, after: Measured, numbers: NDArray[np.int64], seed: int, families: Families = None
) -> dict[str, Any]:
    """What became of each terrain from one controller to another, and what the second gains in the mean.

    Args:
        before: What the first made of T terrains.
        after: What the second made of the same.
        numbers: Number of each terrain, shape (T,).
        seed: Of the bootstrap over terrains.
        families: Of terrains that are not independent, shape (T,).

    Returns:
        As JSON values: ``compared`` terrains (valid for both); for each of :data:`KINDS` their ``count``, ``share``,
        the 95 % ``interval`` of the share, the numbers of all but the fine ones as ``terrains``, and of those mended or
        newly broken how many are ``clear``; and ``gain``: measure -> mean difference with its interval, terrain by
        terrain.
    """
    both = before.valid & after.valid
    fails = [np.where(both, one.values["goal"] < FAILING_GOAL_RATE, False) for one in (before, after)]
    members = {
        "mended": fails[0] & ~fails[1],
        "still_failing": fails[0] & fails[1],
        "newly_broken": ~fails[0] & fails[1],
        "fine": ~fails[0] & ~fails[1] & both,
    }
    limits = [_wilson_limits(one) for one in (before, after)]
    apart = (limits[0][:, 1] < limits[1][:, 0]) | (limits[1][:, 1] < limits[0][:, 0])
    found: dict[str, Any] = {"compared": int(both.sum())}
    for kind, member in members.items():
        found[kind] = _counted(member, both, numbers, seed, families)
        if kind in ("mended", "newly_broken"):
            found[kind]["clear"] = int((member & apart).sum())
    del found["fine"]["terrains"]  # the most, and nothing is to be seen on them
    gains = {name: (after.values[name] - before.values[name])[both] for name in MEASURES}
    found["gain"] = {
        name: {"mean": mean_of(gain), "interval": interval_of(gain, seed, of_terrains(families, both))}
        for name, gain in gains.items()
    }
    return found


def differences(
    crossed: dict[str, Measured], numbers: NDArray[np.int64], seed: int, families: Families = None
) -> dict[str, Any]:
    """:func:`difference` of every two controllers, the earlier named one first, under ``first -> second``."""
    return {
        f"{first} -> {second}": difference(crossed[first], crossed[second], numbers, seed, families)
        for first, second in combinations(crossed, 2)
    }


def _counted(
    member: NDArray[np.bool_],
    among: NDArray[np.bool_],
    numbers: NDArray[np.int64],
    seed: int,
    families: Families,
) -> dict[str, Any]:
    shares = member[among].astype(float)
    return {
        "count": int(member.sum()),
        "share": mean_of(shares),
        "interval": interval_of(shares, seed, of_terrains(families, among)),
        "terrains": np.sort(numbers[member]).tolist(),
    }


def _wilson_limits(one: Measured) -> NDArray[np.float64]:
    """Interval of the goal rate on each terrain, shape (T, 2); anything possible on an invalid one."""
    counts = zip(one.goals.tolist(), one.episodes.tolist(), strict=True)
    return np.array([wilson_interval(goals, episodes) for goals, episodes in counts])


def check_seeds(controllers: Mapping[str, str]) -> None:
    """Refuse one training as several: the interval over its "seeds" would be none.

    Args:
        controllers: Policy of each controller by its name.

    Raises:
        ValueError: If two of a kind are the same controller, or a name is no kind with at most one seed.
    """
    for name in controllers:
        if not re.fullmatch(f"[^{MARK}]+({MARK}[^{MARK}]+)?", name):
            raise ValueError(f"a controller is named KIND or KIND{MARK}SEED, as C-G{MARK}1, got '{name}'")
    known: dict[tuple[str, str], str] = {}
    for name, policy in controllers.items():
        key = (kind_of(name), controller_hash(policy) or policy)
        if key in known:
            raise ValueError(
                f"{known[key]} and {name} must be of one kind from different seeds, got the same controller twice: "
                "name another file, or leave one out"
            )
        known[key] = name


def over_seeds(tables: dict[str, Any], measures: Iterable[str]) -> dict[str, Any]:
    """Mean over the controllers of each kind that has several.

    Args:
        tables: Measure -> set -> controller -> value.
        measures: Some of its measures.

    Returns:
        Measure -> set -> kind -> ``mean``, 95 % t ``interval`` over controllers and their ``values``; empty where no
        kind has several. A mean is None where one of the values is, an interval too where there are more than
        :data:`sim.files.intervals.MAX_T_VALUES`.
    """
    found: dict[str, Any] = {}
    for measure in measures:
        for name, row in tables[measure].items():
            for kind in dict.fromkeys(map(kind_of, row)):
                values = [value for who, value in row.items() if kind_of(who) == kind]
                if len(values) > 1:
                    summary = _summary(values, is_rate=measure in RATES)
                    found.setdefault(measure, {}).setdefault(name, {})[kind] = summary
    return found


def _summary(values: list[float | None], *, is_rate: bool) -> dict[str, Any]:
    numbers = [value for value in values if value is not None]
    if len(numbers) < len(values):
        return {"mean": None, "interval": None, "values": values}
    interval = t_interval(np.array(numbers)) if len(numbers) <= MAX_T_VALUES else None
    if interval is not None and is_rate:
        interval = [max(interval[0], 0.0), min(interval[1], 1.0)]
    return {"mean": sum(numbers) / len(numbers), "interval": interval, "values": values}


def _statistics(crossed: Crossed, of: Callable[[str, NDArray[np.float64]], Any]) -> dict[str, Any]:
    """Each of the measures, and ``penalties``: set -> controller -> what ``of`` makes of set and terrains' values."""
    tables: dict[str, Any] = {
        key: {name: {who: of(name, one.values[key]) for who, one in row.items()} for name, row in crossed.items()}
        for key in MEASURES
    }
    tables["penalties"] = {
        name: {who: {key: of(name, values) for key, values in one.penalties.items()} for who, one in row.items()}
        for name, row in crossed.items()
    }
    return tables


def _by_controller(crossed: Crossed, of: Callable[[Measured], Any]) -> dict[str, dict[str, Any]]:
    """Set -> controller -> what ``of`` makes of what it made of the set."""
    return {name: {who: of(one) for who, one in row.items()} for name, row in crossed.items()}
