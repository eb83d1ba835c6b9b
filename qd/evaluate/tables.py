"""Numbers of controllers on terrains, and the evaluation's tables of them: what ``tables.json`` says.

A controller *fails* a terrain if under half of its valid episodes reach the goal. Between two controllers, a terrain is
*mended* (the first alone fails), *still failing*, *newly broken* (the second alone fails) or *fine*. A change is
*clear* if the 95 % intervals (Wilson) of the two goal rates do not overlap; else it may be chance.
"""

import re
import sys
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from itertools import combinations
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from rich.console import Console
from rich.table import Table
from scipy.special import stdtrit

from kernels.episode import Outcome
from qd.evaluate.labels import CERTIFIED, COMPARED, MEASURES, RATES, SETS
from qd.evaluate.sets import TerrainSet
from qd.search.fitness import FAILING_GOAL_RATE
from sim.controllers.spec import controller_hash
from sim.files.atomic import read_json
from sim.files.command import say
from sim.files.intervals import DIFFERENCES, bootstrap_interval, format_value, wilson_interval
from sim.files.intervals import RATES as BOUNDS
from sim.rates import counted_episodes, terrain_means
from sim.robots.robot import RobotCfg, check_robot_digest
from sim.rollout import RolloutResult
from sim.terrains.hand_crafted import CROSSING_TYPES

Tables = dict[str, Any]
"""Numbers of controllers on sets of terrains, as JSON values; rates are fractions, None where no terrain is valid.

- ``goal``, ``success``, ``fallen``, ``reward``: set -> controller -> mean; ``certified_goal`` and ``certified_success``
  over certified terrains alone; ``penalties`` by penalty, scaled; ``intervals``: measure -> the same.
- ``over_seeds``: measure -> set -> kind with several controllers -> ``mean``, ``interval``, ``values``.
- ``certified``: set -> ``terrains``; ``certifiers``, how many each certifies; ``chosen_by``, controller ->
  ``certifier``, whose rate on them is biased upward, or ``searched``, whose rate is biased downward.
- ``differences``: set -> ``first -> second`` -> ``compared`` terrains; fates, each with ``count``, ``terrains`` and how
  many are ``clear``; ``gain``, measure -> ``mean`` difference with its ``interval``.
"""
VELOCITY_FROM_S = 2.0  # the velocity error counts from this time of an episode on [s]: before it the robot gets going
_MEASURES = (*MEASURES, *CERTIFIED)
_WIDTH = 160  # of tables in a file
_FORMS = {"goal": ".3f", "success": ".3f", "fallen": ".3f", "reward": ".1f"}


@dataclass(frozen=True, kw_only=True)
class Performance:
    """A controller's numbers on each of T terrains, by valid episodes; NaN where over a quarter of them are invalid."""

    values: dict[str, NDArray[np.float64]]  # mean of each measure on each terrain, shape (T,)
    penalties: dict[str, NDArray[np.float64]]  # mean of each scaled penalty on each terrain, shape (T,)
    goals: NDArray[np.int64]  # valid episodes that reached the goal, shape (T,)
    episodes: NDArray[np.int64]  # valid episodes, shape (T,); 0 on an invalid terrain


def valid_mean(values: NDArray[np.float64]) -> float | None:
    """Mean over terrains, shape (T,), without the invalid ones, which are NaN; None without any."""
    valid = values[~np.isnan(values)]
    return float(valid.mean()) if len(valid) else None


def valid_interval(
    values: NDArray[np.float64], seed: int, families: NDArray[np.int64] | None, bounds: tuple[float, float] | None
) -> list[float] | None:
    """95 % interval of :func:`valid_mean`: bootstrap over terrains, or over their families."""
    valid = ~np.isnan(values)
    families = None if families is None else families[valid]
    return bootstrap_interval(values[valid], seed, families=families, bounds=bounds)


def measure_bounds(measure: str, *, differences: bool = False) -> tuple[float, float] | None:
    """Least and largest value of a measure, or of differences of it; None if it has no bounds."""
    return (DIFFERENCES if differences else BOUNDS) if CERTIFIED.get(measure, measure) in RATES else None


def kind_mean(
    values: Sequence[NDArray[np.float64]], families: NDArray[np.int64] | None, seed: int, measure: str = "goal"
) -> dict[str, Any] | None:
    """The mean of a measure for one kind of controller, or the difference of two kinds, the first minus the second.

    ``values`` has the measure for each kind, shape (num_trainings, num_terrains). Returns ``mean``, its 95 %
    ``interval`` and the number of trainings (``seeds``) of each kind; None without a terrain that is valid for all. The
    interval is Student's, of the variances over families (bootstrap) and over trainings, with Satterthwaite's degrees
    of freedom (1946), no narrower than the bootstrap's. One training says nothing of others.
    """
    valid = np.logical_and.reduce([np.isfinite(kind).all(axis=0) for kind in values])
    if not valid.any():
        return None
    kinds = [sign * kind[:, valid] for sign, kind in zip((1.0, -1.0), values, strict=False)]
    by_terrain = np.sum([kind.mean(axis=0) for kind in kinds], axis=0)
    bounds = measure_bounds(measure, differences=len(kinds) > 1)
    bootstrap = valid_interval(by_terrain, seed, None if families is None else families[valid], bounds)
    variances = [(kind.mean(axis=1).var(ddof=1) / len(kind), len(kind) - 1) for kind in kinds if len(kind) > 1]
    variance = sum(value for value, _ in variances)
    if bootstrap is not None:
        variance = ((bootstrap[1] - bootstrap[0]) / (2.0 * stdtrit(np.inf, 0.975))) ** 2 + variance
    spread = sum(value**2 / freedom for value, freedom in variances)
    freedom = variance**2 / spread if spread > 0.0 else np.inf
    mean = float(by_terrain.mean())
    interval = bootstrap
    if variances:
        half = float(stdtrit(freedom, 0.975) * np.sqrt(variance))
        low, high = bootstrap or (mean, mean)
        interval = [min(mean - half, low), max(mean + half, high)]
    if interval and bounds:
        interval = np.clip(interval, *bounds).tolist()
    return {"mean": mean, "interval": interval, "seeds": [len(kind) for kind in kinds]}


def terrain_rates(result: RolloutResult) -> dict[str, NDArray[np.float64]]:
    """``success`` (no base collision), ``goal`` and ``fallen`` rate of each terrain, shape (T,); NaN if invalid."""
    counted = counted_episodes(result.invalid)
    hits = {"success": ~result.base_collision, "goal": result.reached_goal, "fallen": result.fallen}
    return {name: terrain_means(hit, counted) for name, hit in hits.items()}


def measure(result: RolloutResult, scales: Sequence[float]) -> Performance:
    """A controller's numbers from its crossings with their reward; ``scales`` has each penalty's scale, in order."""
    if result.reward is None:
        raise ValueError("crossings must come with their reward, got none: ask the evaluator for it (reward=True)")
    counted = counted_episodes(result.invalid)
    return Performance(
        values={**terrain_rates(result), "reward": terrain_means(result.reward, counted)},
        penalties={
            name: terrain_means(result.penalties[..., column] / scale, counted)
            for column, (name, scale) in enumerate(zip(result.penalty_names, scales, strict=True))
        },
        goals=(result.reached_goal & counted).sum(axis=1),
        episodes=counted.sum(axis=1),
    )


def summarise_crossings(
    result: RolloutResult, seed: int, *, types: np.ndarray | None = None, levels: np.ndarray | None = None
) -> dict[str, Any]:
    """Rates over a set of terrains, with 95 % intervals and, where known, by type and level."""
    rates = {f"{name}_rate": values for name, values in terrain_rates(result).items()}

    def summarise(mask: NDArray[np.bool_]) -> dict[str, Any]:
        return {"terrains": int(mask.sum())} | {name: valid_mean(values[mask]) for name, values in rates.items()}

    counts = {outcome: int((result.outcome == outcome).sum()) for outcome in Outcome}
    return {
        **summarise(np.ones(len(result.outcome), bool)),
        **{f"{name}_interval": valid_interval(values, seed, None, BOUNDS) for name, values in rates.items()},
        "episodes": int(result.outcome.size),
        "outcomes": {end.name.lower(): count for end, count in counts.items() if count or end < Outcome.TILT},
        "invalid_terrains": int(np.isnan(rates["success_rate"]).sum()),
        "by_type": None if types is None else {CROSSING_TYPES[k]: summarise(types == k) for k in np.unique(types)},
        "by_level": None if levels is None else {str(k): summarise(levels == k) for k in np.unique(levels)},
    }


def velocity_error(result: RolloutResult, seed: int) -> dict[str, Any]:
    """Error of v_x in valid episodes, of penalties from :data:`VELOCITY_FROM_S` on: root of its mean square [m/s]."""
    counted_s = result.duration_s - VELOCITY_FROM_S
    usable = ~result.invalid & (counted_s > 0.0)
    error = np.sqrt(result.penalties[..., result.penalty_names.index("vel_x")] / np.where(usable, counted_s, 1.0))
    per_terrain = np.array([row[use].mean() for row, use in zip(error, usable, strict=True) if use.any()])
    return {
        "vx_error_mean": float(error[usable].mean()) if usable.any() else None,
        "vx_error_interval": bootstrap_interval(per_terrain, seed),
        "episodes": int(usable.sum()),
        "goal_rate": float(result.reached_goal[~result.invalid].mean()) if not result.invalid.all() else None,
    }


Sets = Mapping[str, TerrainSet]
Controllers = Mapping[str, Mapping[str, str | None]]  # policy and sha256 by name
Performances = Mapping[str, Mapping[str, Performance]]  # set -> controller -> its numbers on the set's terrains


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
    performances: Performances, sets: Sets, robot: RobotCfg, *, controllers: Controllers, episodes: int, seed: int
) -> Tables:
    """The tables of controllers on sets of terrains."""
    means: dict[str, dict[str, Any]] = {key: {} for key in (*_MEASURES, "penalties")}
    intervals: dict[str, dict[str, Any]] = {key: {} for key in means}
    for name, row in performances.items():
        families = sets[name].families
        for key, values in _list_measures(sets[name], row):
            means[key][name], intervals[key][name] = _summarise(values, seed, families, measure_bounds(key))
        penalties = {label: _summarise(measured.penalties, seed, families, None) for label, measured in row.items()}
        means["penalties"][name] = {label: mean for label, (mean, _) in penalties.items()}
        intervals["penalties"][name] = {label: interval for label, (_, interval) in penalties.items()}
    return {
        "robot": robot.name,
        "episodes": episodes,
        "controllers": controllers,
        **means,
        "certified": _count_certified(sets, controllers),
        "over_seeds": over_seeds(performances, sets, seed),
        "intervals": intervals,
        "terrains": {name: len(terrains) for name, terrains in sets.items()},
        "differences": {
            name: {
                f"{first} -> {second}": difference(row[first], row[second], sets[name], seed)
                for (first, *_), (second, *_) in combinations(by_kind({name: name for name in row}).values(), 2)
            }
            for name, row in performances.items()
        },
    }


def _summarise(values: Mapping[str, NDArray[np.float64]], *sample: Any) -> tuple[dict[str, Any], dict[str, Any]]:
    """Means of values and their intervals over a ``sample`` as :func:`valid_interval` takes it, by name."""
    means = {name: valid_mean(value) for name, value in values.items()}
    return means, {name: valid_interval(value, *sample) for name, value in values.items()}


def _list_measures(
    terrains: TerrainSet, row: Mapping[str, Performance]
) -> Iterator[tuple[str, dict[str, NDArray[np.float64]]]]:
    """Each measure of a set: its value on each terrain by controller, NaN where the terrain does not count."""
    for measure in MEASURES:
        yield measure, {name: measured.values[measure] for name, measured in row.items()}
    certified = terrains.certified
    if certified is not None:
        for key, measure in CERTIFIED.items():
            yield key, {name: np.where(certified, measured.values[measure], np.nan) for name, measured in row.items()}


def _count_certified(sets: Sets, controllers: Controllers) -> dict[str, Any]:
    certified = {}
    for name, terrains in sets.items():
        elites = terrains.elites
        if elites is None or not elites.certifiers:
            continue
        counts = (elites.certificates & elites.failing[:, None]).sum(axis=0).tolist()
        roles = {elites.policy_sha256: "searched"}
        roles |= {digest: "certifier" for digest, count in zip(elites.certifier_sha256, counts, strict=True) if count}
        roles.pop(None, None)
        certified[name] = {
            "terrains": int(elites.certified_by_controllers.sum()),
            "certifiers": dict(zip(elites.certifiers, counts, strict=True)),
            "chosen_by": {by: roles[about["sha256"]] for by, about in controllers.items() if about["sha256"] in roles},
        }
    return certified


def difference(before: Performance, after: Performance, terrains: TerrainSet, seed: int) -> dict[str, Any]:
    """What became of each terrain of a set from one controller to another, and the mean gain of the second."""
    valid = (before.episodes > 0) & (after.episodes > 0)
    failed, fails = (valid & (controller.values["goal"] < FAILING_GOAL_RATE) for controller in (before, after))
    counts = (zip(by.goals.tolist(), by.episodes.tolist(), strict=True) for by in (before, after))
    limits, then_limits = (np.array([wilson_interval(*pair) for pair in pairs]) for pairs in counts)
    clear = (limits[:, 1] < then_limits[:, 0]) | (then_limits[:, 1] < limits[:, 0])
    mended, broken = failed & ~fails, ~failed & fails

    def describe(mask: NDArray[np.bool_]) -> dict[str, Any]:
        return {"count": int(mask.sum()), "terrains": np.sort(terrains.numbers[mask]).tolist()}

    def gain(name: str) -> dict[str, Any]:
        values = after.values[name] - before.values[name]
        bounds = measure_bounds(name, differences=True)
        return {"mean": valid_mean(values), "interval": valid_interval(values, seed, terrains.families, bounds)}

    return {
        "compared": int(valid.sum()),
        "mended": {**describe(mended), "clear": int((mended & clear).sum())},
        "still_failing": describe(failed & fails),
        "newly_broken": {**describe(broken), "clear": int((broken & clear).sum())},
        "fine": {"count": int((valid & ~failed & ~fails).sum())},
        "gain": {name: gain(name) for name in MEASURES},
    }


def is_regression(tables: Mapping[str, Any]) -> bool:
    """Whether :data:`COMPARED` elites have a difference of the goal rate, new minus old, wholly below 0."""
    pairs = tables["differences"].get(COMPARED)
    interval = pairs["old -> new"]["gain"]["goal"]["interval"] if pairs else None
    return interval is not None and interval[1] < 0.0


def check_seeds(controllers: Mapping[str, str]) -> None:
    """Refuses the same training twice under one kind, since an interval over seeds needs different ones."""
    names: dict[tuple[str, str], str] = {}
    for name, policy in controllers.items():
        if not re.fullmatch("[^@]+(@[^@]+)?", name):
            raise ValueError(f"a controller must be named KIND or KIND@SEED, as C-G@1, got '{name}'")
        key = (name.partition("@")[0], controller_hash(policy) or policy)
        if key in names:
            raise ValueError(f"{names[key]} and {name} must be different trainings, got the same controller twice")
        names[key] = name


def by_kind(row: Mapping[str, Any]) -> dict[str, list[Any]]:
    """Groups values of controllers, by name, by their kinds: C-G, C-G@1 and C-G@2 differ in their seeds alone."""
    kinds: dict[str, list[Any]] = {}
    for name, value in row.items():
        kinds.setdefault(name.partition("@")[0], []).append(value)
    return kinds


def over_seeds(performances: Performances, sets: Sets, seed: int) -> dict[str, Any]:
    """Mean over the controllers of each kind that has several: measure -> set -> kind."""
    summaries: dict[str, dict[str, dict[str, Any]]] = {}
    for name, row in performances.items():
        for key, values in _list_measures(sets[name], row):
            for kind, trainings in by_kind(values).items():
                if len(trainings) > 1:
                    mean = kind_mean([np.array(trainings)], sets[name].families, seed, key)
                    summary = {number: mean and mean[number] for number in ("mean", "interval")}
                    summary["values"] = [valid_mean(training) for training in trainings]
                    summaries.setdefault(key, {}).setdefault(name, {})[kind] = summary
    return summaries


def show_table(title: str, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Prints a table; its first column has the rows' names."""
    console = Console(markup=False, highlight=False, width=None if sys.stdout.isatty() else _WIDTH)
    table = Table(*head[:1], box=None, pad_edge=False)
    for column in head[1:]:
        table.add_column(column, justify="right", overflow="fold")
    for row in rows:
        table.add_row(*map(str, row))
    console.print(f"\n{title}", style="bold")
    console.print(table)


def rate_cells(row: Mapping[str, Any]) -> list[str]:
    """Rates with their intervals, one cell each."""
    return [format_value(row[f"{rate}_rate"], row.get(f"{rate}_interval")) for rate in RATES]


def show_tables(report: dict[str, Any]) -> None:
    """Prints the means of every set with every controller, and what became of terrains."""
    for name, count in report["terrains"].items():
        limits = {measure: report["intervals"][measure][name] for measure in _FORMS}
        rows = [
            (label, *(format_value(report[key][name][label], limits[key][label], form) for key, form in _FORMS.items()))
            for label in report["controllers"]
        ]
        title = f"{SETS.get(name, name)}: {count} terrains x {report['episodes']} episodes"
        show_table(title, ("", *map(MEASURES.__getitem__, _FORMS)), rows)
    rows = []
    for name, pairs in report["differences"].items():
        for pair, change in pairs.items():
            changed = (f"{change[fate]['count']} ({change[fate]['clear']})" for fate in ("mended", "newly_broken"))
            gain = format_value(change["gain"]["goal"]["mean"], change["gain"]["goal"]["interval"], "+.3f")
            rows.append((f"{name}, {pair}", *changed, change["still_failing"]["count"], change["compared"], gain))
    if rows:
        title = "terrains on which under half of the episodes reach the goal; in brackets beyond chance"
        show_table(title, ("", "mended", "newly broken", "still failing", "of", "gain of the goal rate"), rows)


def show_comparison(report: dict[str, Any]) -> None:
    """Prints what became of elites from an old controller to a new one."""
    change = report["differences"][COMPARED]["old -> new"]
    for name in ("old", "new"):
        goal = format_value(report["goal"][COMPARED][name], report["intervals"]["goal"][COMPARED][name])
        say(f"{name}: {goal} of the robots reach the goal")
    for fate, label, style in (("newly_broken", "newly failed", "red"), ("mended", "newly crossed", "green")):
        count = change[fate]["count"]
        numbers = ", ".join(map(str, change[fate]["terrains"]))
        clear = f", {change[fate]['clear']} of them beyond chance: {numbers}" if count else ""
        say((f"{count} of {change['compared']} elites {label}", style if count else ""), clear)
    gain = format_value(change["gain"]["goal"]["mean"], change["gain"]["goal"]["interval"], "+.3f")
    verdict = ("a regression", "bold red") if is_regression(report) else ("no regression", "bold green")
    say(f"new - old: {gain}, 95 % interval over families: ", verdict)
