"""The evaluation's tables: what ``tables.json`` says of controllers on sets of terrains.

A controller *fails* a terrain where under half of its valid episodes there reach the goal; an episode with a base
collision does not. Of two controllers, a terrain is then *mended* (the first fails, the second does not), *still
failing* (both), *newly broken* (the second alone) or *fine* with both. A terrain that is a matter of luck to either
falls on one side by chance: *clear* are those changes where the 95 % intervals (Wilson) of the two goal rates do not
overlap.
"""

import re
from collections.abc import Callable, Iterable, Mapping
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
from sim.robots.identity import check_robot_digest
from sim.robots.robot import RobotCfg

Tables = dict[str, Any]
"""What is said of controllers on sets of terrains, as JSON values; rates are fractions, None where no terrain is valid.

- ``goal``, ``success``, ``fallen``, ``reward``: set -> controller -> mean over the set's terrains; ``certified_goal``
  and ``certified_success`` over its certified terrains alone; ``penalties`` by penalty, scaled.
- ``intervals``: measure -> set -> controller -> 95 % interval, None where nothing is known of the spread.
- ``over_seeds``: measure -> set -> kind of which there are several controllers -> ``mean``, ``interval`` over
  terrains and controllers, and ``values`` of these.
- ``certified``: set -> how many ``terrains``; ``certifiers``, how many each of them certifies; and ``chosen_by``,
  controller -> ``certifier``, whose rate on them is biased upward, or ``searched``, whose rate is biased downward.
- ``differences``: set -> ``first -> second`` -> ``compared`` terrains, which are valid for both; ``mended``,
  ``still_failing``, ``newly_broken`` and ``fine``, each with its ``count`` and the numbers of its ``terrains`` (not of
  the fine ones); how many changes are ``clear``; ``gain``, measure -> ``mean`` difference with its ``interval``.
- ``terrains``: how many, by set; ``episodes``: on each.
- ``controllers``: ``policy`` and ``sha256`` by name.
"""
_MEASURES = (*MEASURES, *CERTIFIED)

Value = TypeVar("Value")
Crossed = Mapping[str, Mapping[str, Performance]]
"""Set -> controller -> what it made of the set's terrains."""


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
    """JSON values as tables; refuses what has no value of each controller on each set."""
    keys = (*_MEASURES, "robot", "controllers", "intervals", "over_seeds", "certified", "differences", "terrains")
    if missing := [key for key in keys if key not in content]:
        raise ValueError(f"it lacks {', '.join(missing)}")
    for measure in _MEASURES:
        rows = [*content[measure].values(), *content["intervals"].get(measure, {}).values()]
        if any(row.keys() != content["controllers"].keys() for row in rows):
            raise ValueError(f"{measure} must have a value of every controller on each set")
    return content


def make_tables(
    crossed: Crossed,
    sets: Mapping[str, TerrainSet],
    robot: RobotCfg,
    *,
    controllers: Mapping[str, Mapping[str, str | None]],
    episodes: int,
    seed: int,
) -> Tables:
    """Everything that the tables say of crossings."""
    means = _statistics(crossed, sets, lambda values, *_: valid_mean(values))
    return {
        "robot": robot.name,
        "episodes": episodes,
        "controllers": controllers,
        **means,
        "certified": _about_certified(sets, controllers),
        "over_seeds": over_seeds(crossed, sets, seed),
        "intervals": _statistics(crossed, sets, lambda values, *about: valid_interval(values, seed, *about)),
        "terrains": {name: len(terrains) for name, terrains in sets.items()},
        "differences": {
            name: {
                f"{first} -> {second}": difference(row[first], row[second], sets[name], seed)
                for first, second in combinations(_firsts(row), 2)
            }
            for name, row in crossed.items()
        },
    }


def _statistics(crossed: Crossed, sets: Mapping[str, TerrainSet], statistic: Callable[..., Any]) -> dict[str, Any]:
    """Each measure and ``penalties``: set -> controller -> a statistic of the terrains' values, families and bounds."""
    tables: dict[str, Any] = {key: {} for key in (*MEASURES, "penalties", *CERTIFIED)}
    for name, row in crossed.items():
        families = sets[name].families
        for key, measure, member in _groups(sets[name]):
            about = select_families(families, member), measure_bounds(measure)
            tables[key][name] = {
                who: statistic(measured.values[measure][member], *about) for who, measured in row.items()
            }
        tables["penalties"][name] = {
            who: {key: statistic(values, families, None) for key, values in measured.penalties.items()}
            for who, measured in row.items()
        }
    return tables


def _groups(terrains: TerrainSet) -> list[tuple[str, str, NDArray[np.bool_]]]:
    """Key of each number of a set, the measure that it is of, and on which of its terrains, shape (T,)."""
    everywhere = np.ones(len(terrains), bool)
    groups = [(key, key, everywhere) for key in MEASURES]
    if terrains.certified is not None:
        groups += [(key, measure, terrains.certified) for key, measure in CERTIFIED.items()]
    return groups


def _about_certified(
    sets: Mapping[str, TerrainSet], controllers: Mapping[str, Mapping[str, str | None]]
) -> dict[str, Any]:
    certified = {}
    for name, terrains in sets.items():
        if terrains.certified is None or terrains.elites is None:
            continue
        faults = terrains.elites.counts
        given = faults.certificates() & terrains.elites.failing[:, None]
        counts = dict(zip(faults.certifiers, given.sum(axis=0).tolist(), strict=True))
        roles: dict[str | None, str] = {terrains.elites.policy_sha256: "searched"}
        by_hash = zip(faults.certifier_sha256, faults.certifiers, strict=True)
        roles |= {sha256: "certifier" for sha256, certifier in by_hash if counts[certifier]}
        hashes = {controller: about["sha256"] for controller, about in controllers.items()}
        certified[name] = {
            "terrains": int(terrains.certified.sum()),
            "certifiers": counts,
            "chosen_by": {controller: roles[sha] for controller, sha in hashes.items() if sha and sha in roles},
        }
    return certified


def difference(before: Performance, after: Performance, terrains: TerrainSet, seed: int) -> dict[str, Any]:
    """What became of each terrain of a set from one controller to another, and what the second gains in the mean."""
    both = before.valid & after.valid
    kin = select_families(terrains.families, both)
    fails, then_fails = (both & (rates.values["goal"] < FAILING_GOAL_RATE) for rates in (before, after))
    limits, then_limits = _wilson_limits(before), _wilson_limits(after)
    apart = (limits[:, 1] < then_limits[:, 0]) | (then_limits[:, 1] < limits[:, 0])

    def changed(member: NDArray[np.bool_]) -> dict[str, Any]:
        return {"count": int(member.sum()), "terrains": np.sort(terrains.numbers[member]).tolist()}

    mended, broken = fails & ~then_fails, ~fails & then_fails
    gains = {name: (after.values[name] - before.values[name])[both] for name in MEASURES}
    return {
        "compared": int(both.sum()),
        "mended": {**changed(mended), "clear": int((mended & apart).sum())},
        "still_failing": changed(fails & then_fails),
        "newly_broken": {**changed(broken), "clear": int((broken & apart).sum())},
        "fine": {"count": int((both & ~fails & ~then_fails).sum())},
        "gain": {
            name: {
                "mean": valid_mean(gain),
                "interval": valid_interval(gain, seed, kin, measure_bounds(name, differences=True)),
            }
            for name, gain in gains.items()
        },
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
    """Refuses one training as several: the interval over its "seeds" would be none."""
    known: dict[tuple[str, str], str] = {}
    for name, policy in controllers.items():
        if not re.fullmatch("[^@]+(@[^@]+)?", name):
            raise ValueError(f"a controller must be named KIND or KIND@SEED, as C-G@1, got '{name}'")
        key = (_kind_of(name), controller_hash(policy) or policy)
        if key in known:
            raise ValueError(f"{known[key]} and {name} must be different trainings, got the same controller twice")
        known[key] = name


def _kind_of(name: str) -> str:
    """The kind of a controller by its name: C-G of C-G, and of C-G@1 and C-G@2, which have other seeds."""
    return name.partition("@")[0]


def by_kind(row: Mapping[str, Value]) -> dict[str, list[Value]]:
    """What there is of each kind of controller, by the kinds, from what there is of each controller by its name."""
    kinds: dict[str, list[Value]] = {}
    for name, value in row.items():
        kinds.setdefault(_kind_of(name), []).append(value)
    return kinds


def _firsts(names: Iterable[str]) -> list[str]:
    """The first controller of each kind, in order."""
    first = {_kind_of(name): name for name in reversed([*names])}
    return [first[kind] for kind in dict.fromkeys(map(_kind_of, names))]


def over_seeds(crossed: Crossed, sets: Mapping[str, TerrainSet], seed: int) -> dict[str, Any]:
    """Mean over the controllers of each kind that has several: measure -> set -> kind."""
    summaries: dict[str, dict[str, dict[str, Any]]] = {}
    for name, row in crossed.items():
        several = {kind: of_kind for kind, of_kind in by_kind(row).items() if len(of_kind) > 1}
        for kind, of_kind in several.items():
            for key, measure, member in _groups(sets[name]):
                values = np.array([measured.values[measure][member] for measured in of_kind])
                mean = kind_mean([values], select_families(sets[name].families, member), seed, measure)
                summary = {part: mean and mean[part] for part in ("mean", "interval")}
                summary["values"] = [valid_mean(of_one) for of_one in values]
                summaries.setdefault(key, {}).setdefault(name, {})[kind] = summary
    return summaries
