"""The evaluation's tables: what ``tables.json`` says of controllers on sets of terrains.

A controller *fails* a terrain if under half of its valid episodes reach the goal; an episode with a base collision
does not. Between two controllers, a terrain is *mended* (the first fails, the second does not), *still failing* (both
fail), *newly broken* (the second alone fails) or *fine* (neither fails). Where a goal rate is near a half, a change may
be chance. A change is *clear* if the 95 % intervals (Wilson) of the two goal rates do not overlap.
"""

import re
from collections.abc import Callable, Mapping
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.labels import CERTIFIED, COMPARED, MEASURES
from qd.evaluate.measures import Performance, kind_mean, measure_bounds, select_families, valid_interval, valid_mean
from qd.evaluate.sets import TerrainSet
from qd.search.fitness import FAILING_GOAL_RATE
from sim.controllers.spec import controller_hash
from sim.files.atomic import read_json
from sim.files.intervals import wilson_interval
from sim.robots.robot import RobotCfg, check_robot_digest

Tables = dict[str, Any]
"""Numbers of controllers on sets of terrains, as JSON values; rates are fractions, None where no terrain is valid.

- ``goal``, ``success``, ``fallen``, ``reward``: set -> controller -> mean over the set's terrains; ``certified_goal``
  and ``certified_success`` over its certified terrains alone; ``penalties`` by penalty, scaled.
- ``intervals``: measure -> set -> controller -> 95 % interval, None where the spread is unknown.
- ``over_seeds``: measure -> set -> kind with several controllers -> ``mean``, ``interval`` over terrains and
  controllers, and ``values`` of the controllers.
- ``certified``: set -> number of ``terrains``; ``certifiers``, how many terrains each certifies; and ``chosen_by``,
  controller -> ``certifier``, whose rate on them is biased upward, or ``searched``, whose rate is biased downward.
- ``differences``: set -> ``first -> second`` -> ``compared`` terrains, which are valid for both; ``mended``,
  ``still_failing``, ``newly_broken`` and ``fine``, each with its ``count`` and the numbers of its ``terrains`` (not of
  the fine ones); how many changes are ``clear``; ``gain``, measure -> ``mean`` difference with its ``interval``.
- ``terrains``: set -> number of terrains; ``episodes``: number on each.
- ``controllers``: ``policy`` and ``sha256`` by name.
"""
_MEASURES = (*MEASURES, *CERTIFIED)

Value = TypeVar("Value")
Performances = Mapping[str, Mapping[str, Performance]]
"""Set -> controller -> its numbers on the set's terrains."""


def read_tables(file: Path, robot: RobotCfg) -> Tables:
    """The tables of a robot to report."""
    if not file.exists():
        raise FileNotFoundError(f"no tables at {file}: `faultline evaluate` writes them")
    try:
        tables = as_tables(read_json(file))
    except ValueError as error:
        raise ValueError(f"{file} must hold the tables of `faultline evaluate`: {error}: give that file") from None
    if tables["robot"] != robot.name:
        raise ValueError(f"{file} must be of robot {robot.name}, got {tables['robot']}: give other tables")
    check_robot_digest(tables, robot, file, "make them anew")
    return tables


def as_tables(content: Any) -> Tables:
    """Checks that JSON values are tables, with a value of each controller on each set."""
    keys = (*_MEASURES, "robot", "controllers", "intervals", "over_seeds", "certified", "differences", "terrains")
    if missing := [key for key in keys if key not in content]:
        raise ValueError(f"it lacks {', '.join(missing)}")
    for measure in _MEASURES:
        rows = [*content[measure].values(), *content["intervals"].get(measure, {}).values()]
        if any(row.keys() != content["controllers"].keys() for row in rows):
            raise ValueError(f"{measure} must have a value of every controller on each set")
    return content


def make_tables(
    performances: Performances,
    sets: Mapping[str, TerrainSet],
    robot: RobotCfg,
    *,
    controllers: Mapping[str, Mapping[str, str | None]],
    episodes: int,
    seed: int,
) -> Tables:
    """The tables of controllers on sets of terrains."""
    means = _compute_statistics(performances, sets, lambda values, *_: valid_mean(values))
    return {
        "robot": robot.name,
        "episodes": episodes,
        "controllers": controllers,
        **means,
        "certified": _count_certified(sets, controllers),
        "over_seeds": over_seeds(performances, sets, seed),
        "intervals": _compute_statistics(
            performances, sets, lambda values, families, bounds: valid_interval(values, seed, families, bounds)
        ),
        "terrains": {name: len(terrains) for name, terrains in sets.items()},
        "differences": {
            name: {
                f"{first} -> {second}": difference(row[first], row[second], sets[name], seed)
                for first, second in combinations(_first_names(row), 2)
            }
            for name, row in performances.items()
        },
    }


def _compute_statistics(
    performances: Performances, sets: Mapping[str, TerrainSet], statistic: Callable[..., Any]
) -> dict[str, Any]:
    """Each measure and ``penalties``: set -> controller -> a statistic of the terrains' values, families and bounds."""
    tables: dict[str, Any] = {key: {} for key in (*MEASURES, "penalties", *CERTIFIED)}
    for name, row in performances.items():
        families = sets[name].families
        for key, measure, mask in _list_measures(sets[name]):
            masked = select_families(families, mask)
            tables[key][name] = {
                controller: statistic(performance.values[measure][mask], masked, measure_bounds(measure))
                for controller, performance in row.items()
            }
        tables["penalties"][name] = {
            controller: {key: statistic(values, families, None) for key, values in performance.penalties.items()}
            for controller, performance in row.items()
        }
    return tables


def _list_measures(terrains: TerrainSet) -> list[tuple[str, str, NDArray[np.bool_]]]:
    """Key of each number of a set, its measure, and the mask of its terrains, shape (T,)."""
    everywhere = np.ones(len(terrains), bool)
    measures = [(key, key, everywhere) for key in MEASURES]
    if terrains.certified is not None:
        measures += [(key, measure, terrains.certified) for key, measure in CERTIFIED.items()]
    return measures


def _count_certified(
    sets: Mapping[str, TerrainSet], controllers: Mapping[str, Mapping[str, str | None]]
) -> dict[str, Any]:
    certified = {}
    for name, terrains in sets.items():
        if terrains.certified is None or terrains.elites is None:
            continue
        elites = terrains.elites
        certificates = elites.certificates & elites.failing[:, None]
        certifiers = dict(zip(elites.certifiers, certificates.sum(axis=0).tolist(), strict=True))
        roles: dict[str | None, str] = {elites.policy_sha256: "searched"}
        for sha256, certifier in zip(elites.certifier_sha256, elites.certifiers, strict=True):
            if certifiers[certifier]:
                roles[sha256] = "certifier"
        hashes = {controller: about["sha256"] for controller, about in controllers.items()}
        certified[name] = {
            "terrains": int(terrains.certified.sum()),
            "certifiers": certifiers,
            "chosen_by": {controller: roles[sha] for controller, sha in hashes.items() if sha and sha in roles},
        }
    return certified


def difference(before: Performance, after: Performance, terrains: TerrainSet, seed: int) -> dict[str, Any]:
    """What became of each terrain of a set from one controller to another, and the mean gain of the second."""
    valid = before.valid & after.valid
    families = select_families(terrains.families, valid)
    failed, fails = (valid & (controller.values["goal"] < FAILING_GOAL_RATE) for controller in (before, after))
    limits = _wilson_limits(before)
    then_limits = _wilson_limits(after)
    clear = (limits[:, 1] < then_limits[:, 0]) | (then_limits[:, 1] < limits[:, 0])
    mended = failed & ~fails
    broken = ~failed & fails

    def describe(mask: NDArray[np.bool_]) -> dict[str, Any]:
        return {"count": int(mask.sum()), "terrains": np.sort(terrains.numbers[mask]).tolist()}

    def gain(name: str) -> dict[str, Any]:
        values = (after.values[name] - before.values[name])[valid]
        bounds = measure_bounds(name, differences=True)
        return {"mean": valid_mean(values), "interval": valid_interval(values, seed, families, bounds)}

    return {
        "compared": int(valid.sum()),
        "mended": {**describe(mended), "clear": int((mended & clear).sum())},
        "still_failing": describe(failed & fails),
        "newly_broken": {**describe(broken), "clear": int((broken & clear).sum())},
        "fine": {"count": int((valid & ~failed & ~fails).sum())},
        "gain": {name: gain(name) for name in MEASURES},
    }


def is_regression(tables: Mapping[str, Any]) -> bool:
    """Whether the goal rate's difference of :data:`COMPARED` elites, new minus old, has an interval wholly below 0.

    A terrain that newly fails alone is no regression, since among hundreds some do by chance. Tables of other sets and
    controllers have none.
    """
    pairs = tables["differences"].get(COMPARED)
    interval = pairs["old -> new"]["gain"]["goal"]["interval"] if pairs else None
    return interval is not None and interval[1] < 0.0


def _wilson_limits(measured: Performance) -> NDArray[np.float64]:
    """Interval of the goal rate on each terrain, shape (T, 2); anything possible on an invalid one."""
    counts = zip(measured.goals.tolist(), measured.episodes.tolist(), strict=True)
    return np.array([wilson_interval(goals, episodes) for goals, episodes in counts])


def check_seeds(controllers: Mapping[str, str]) -> None:
    """Refuses the same training twice under one kind, since an interval over seeds needs different ones."""
    names: dict[tuple[str, str], str] = {}
    for name, policy in controllers.items():
        if not re.fullmatch("[^@]+(@[^@]+)?", name):
            raise ValueError(f"a controller must be named KIND or KIND@SEED, as C-G@1, got '{name}'")
        key = (_get_kind(name), controller_hash(policy) or policy)
        if key in names:
            raise ValueError(f"{names[key]} and {name} must be different trainings, got the same controller twice")
        names[key] = name


def _get_kind(name: str) -> str:
    """The kind of a controller by its name: ``C-G`` for C-G, C-G@1 and C-G@2, which differ in their seeds."""
    return name.partition("@")[0]


def by_kind(row: Mapping[str, Value]) -> dict[str, list[Value]]:
    """Groups values of controllers, by name, by the controllers' kinds."""
    kinds: dict[str, list[Value]] = {}
    for name, value in row.items():
        kinds.setdefault(_get_kind(name), []).append(value)
    return kinds


def _first_names(row: Mapping[str, Any]) -> list[str]:
    """The first controller of each kind, in order."""
    return [names[0] for names in by_kind({name: name for name in row}).values()]


def over_seeds(performances: Performances, sets: Mapping[str, TerrainSet], seed: int) -> dict[str, Any]:
    """Mean over the controllers of each kind that has several: measure -> set -> kind."""
    summaries: dict[str, dict[str, dict[str, Any]]] = {}
    for name, row in performances.items():
        families = sets[name].families
        for kind, trainings in by_kind(row).items():
            for key, measure, mask in _list_measures(sets[name]) if len(trainings) > 1 else ():
                values = np.array([training.values[measure][mask] for training in trainings])
                mean = kind_mean([values], select_families(families, mask), seed, measure)
                summary = {number: mean and mean[number] for number in ("mean", "interval")}
                summary["values"] = [valid_mean(training) for training in values]
                summaries.setdefault(key, {}).setdefault(name, {})[kind] = summary
    return summaries
