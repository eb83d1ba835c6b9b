"""Which real obstacle at which size stops a controller: goal rate against a stair's rise, a ditch's width, friction.

A dose is one obstacle alone on flat ground, an element of a course of any size (:mod:`sim.terrains.elements`), or one
ground or condition everywhere, of which one number grows.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from kernels.episode import Kind, Outcome
from kernels.ground import MAX_TIME_CONSTANT_S, MIN_FRICTION, MIN_TIME_CONSTANT_S
from qd.evaluate.evaluate import cross_sets, crossings_folder, fill_sizes
from qd.evaluate.sets import TerrainSet, draw_seeds, set_rng
from qd.evaluate.tables import show_table
from qd.search.directory import RUNS
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.compute import Compute, check_policy
from sim.controllers.described import observed_terms
from sim.controllers.spec import describe_controllers
from sim.files.command import publish
from sim.files.figures import as_png, new_figure
from sim.files.intervals import format_value, resamples, wilson_interval
from sim.rates import counted_episodes
from sim.robots.find import read_stray
from sim.robots.robot import RobotCfg, robot_identity
from sim.rollout import RolloutResult
from sim.terrains.conditions.kinds import CONDITIONS
from sim.terrains.elements.kinds import ELEMENTS
from sim.terrains.quantities import Quantity, Sweep
from sim.terrains.spaces.registry import check_conditions, load_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.spaces.wider import ground_genes
from sim.terrains.terrains import Terrains

_SIZES = {"full": (20, 4), "small": (8, 2)}  # terrains a value and episodes a terrain; small without a GPU
_COLUMNS = 4
_RESAMPLES = 1000
_BEYOND = {"first": "before the first", "last": "beyond the last", "invalid": "unknown, episodes are invalid"}
# Of controllers, in order: the colours are Okabe and Ito's, which are apart for every kind of colour blindness.
_COLOURS = ("#000000", "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
_MARKERS = ("o", "s", "^", "v", "P", "X", "<", ">", "p")
_MAPPED = 0.5  # share of their height that bumps have under errors of the map, which level ground does not show
_SOFT = (0.015, 0.02, 0.03, 0.04, 0.05, 0.06)
_GROUNDS = (
    (Quantity(name="friction", low=MIN_FRICTION, high=1.0), (1.0, 0.7, 0.5, 0.4, 0.35, 0.3, 0.25, 0.2, 0.15)),
    (Quantity(name="softness", low=1.1 * MIN_TIME_CONSTANT_S, high=MAX_TIME_CONSTANT_S, unit="s"), _SOFT),
)


@dataclass(frozen=True, kw_only=True)
class Dose(Sweep):
    """An obstacle, a ground or a condition, of which one quantity grows."""

    quantities: Mapping[str, Quantity]
    make: Callable[[Mapping[str, Any], int, np.random.Generator], NDArray[np.float32]] = field(compare=False)
    space: str = SUPER_GAUSSIAN.name  # terrain space of its genes; of heights any

    def describe(self) -> str:
        """The obstacle and its other quantities: ``stairs up, tread 0.30 m, flight 5 steps``."""
        texts = [self.title]
        for name, value in self.others.items():
            unit = self.quantities[name].unit
            texts.append(f"{name} {value:.0f} {unit}" if unit == "steps" else f"{name} {value:.2f} {unit}")
        return ", ".join(texts)

    def changed(self, values: Iterable[float] | None, others: Mapping[str, float]) -> "Dose":
        """The same with other values, the easiest first, and other quantities where it has them."""
        changed = {name: value for name, value in others.items() if name in self.others}
        values = self.values if values is None else sorted(values, reverse=self.values[-1] < self.values[0])
        if not values or len(set(values)) < len(values):
            raise ValueError(f"{self.title}: values of {self.parameter} must be some, each once, got {values}")
        for name, value in [*((self.parameter, value) for value in values), *changed.items()]:
            quantity = self.quantities[name]
            steps = value / quantity.step if quantity.step else 0.0
            if not quantity.low <= value <= quantity.high or abs(steps - round(steps)) > 1e-6:
                every = f" in steps of {quantity.step:g}" if quantity.step else ""
                limits = f"{quantity.low:g} to {quantity.high:g} {quantity.unit}".rstrip()
                raise ValueError(f"{self.title}: {name} must be {limits}{every}, got {value:g}")
        return replace(self, values=tuple(values), others={**self.others, **changed})

    def terrains(self, count: int, rng: np.random.Generator) -> NDArray[np.float32]:
        """Heights [m] or genes, one of each value, then the next of each; obstacles begin at nodes spread over 1 m."""
        return self.make({**self.others, self.parameter: np.array(self.values)}, count, rng)


def _dose_level(
    name: str, sweep: Sweep, quantity: Quantity, to_genes: Callable[[Any], NDArray[Any]], height: float = 0.0
) -> Dose:
    """Level ground, or hard-random terrains of so much ``height``, with a map or condition of (num_values, G) genes."""

    def make(quantities: Mapping[str, Any], count: int, rng: np.random.Generator) -> NDArray[np.float32]:
        genes = to_genes({**sweep.others, sweep.parameter: quantities[name]})
        level = np.zeros((count, SUPER_GAUSSIAN.num_genes))
        bumps = SUPER_GAUSSIAN.scaled(SUPER_GAUSSIAN.hard_random(count, rng), height) if height else level
        rows = np.repeat(bumps, len(genes), axis=0), np.tile(genes, (count, 1))
        return np.concatenate(rows, axis=1).astype(np.float32)

    space = f"{SUPER_GAUSSIAN.name}+{name}"
    return Dose(name, sweep.values, title=sweep.title, quantities={name: quantity}, make=make, space=space)


def all_doses() -> dict[str, Dose]:
    """Every dose by its name: obstacles, then grounds, then conditions."""
    doses = dict[str, Dose]()
    for element in ELEMENTS.values():
        for name, sweep in element.doses.items():
            titled: dict[str, Any] = {**vars(sweep), "title": name.replace("_", " ")}
            doses[name] = Dose(**titled, quantities=element.quantities, make=partial(element.lay_alone, sweep.turn))
    for quantity, values in _GROUNDS:
        sweep = Sweep(quantity.name, values, title="level ground")
        doses[quantity.name] = _dose_level(quantity.name, sweep, quantity, ground_genes)
    for name, condition in CONDITIONS.items():
        if sweep := condition.dose:
            (gene,) = (gene for gene in condition.genes if gene.name == sweep.parameter)
            height = _MAPPED if condition.observed == "scan" else 0.0
            doses[name] = _dose_level(name, sweep, replace(gene, low=max(0.0, gene.low)), condition.to_genes, height)
    return doses


def parse_doses(texts: Sequence[str], at: Sequence[str]) -> dict[str, Dose]:
    """Some doses, in their order: ``stairs_up``, or ``ditch=0.2,0.4``; ``at`` has other quantities, ``tread=0.25``."""
    doses, chosen, others = all_doses(), dict[str, Sequence[float] | None](), dict[str, float]()
    word = ""
    try:
        for word in " ".join(texts).split():
            name, equals, values = word.partition("=")
            chosen[name] = [*map(float, values.split(","))] if equals else None
        for word in " ".join(at).split():
            name, _, value = word.partition("=")
            others[name] = float(value)
    except ValueError:
        raise ValueError(f"expected NAME=NUMBER, as in tread=0.25, got {word}") from None
    chosen = chosen or {name: None for name in doses if name not in CONDITIONS}
    if unknown := chosen.keys() - doses.keys():
        raise ValueError(f"elements must be some of {', '.join(doses)}, got {', '.join(sorted(unknown))}")
    doses = {name: dose for name, dose in doses.items() if name in chosen}
    allowed = sorted({name for dose in doses.values() for name in dose.others})
    if wrong := others.keys() - set(allowed):
        rule = f"quantities that the elements have beside the one that grows ({', '.join(allowed) or 'none'})"
        raise ValueError(f"at must name {rule}, got {', '.join(sorted(wrong))}: leave that out")
    return {name: dose.changed(chosen[name], others) for name, dose in doses.items()}


def measure_dose(
    robot: RobotCfg,
    controllers: dict[str, str],
    doses: Mapping[str, Dose],
    *,
    compute: Compute,
    resolved: bool = False,
    terrains: int | None = None,
    episodes: int | None = None,
    seed: int = 0,
    out: Path | None = None,
) -> dict[str, Any]:
    """Lets controllers cross all values of doses, of sizes that suit the device; prints, writes and draws the rates."""
    count, episodes = fill_sizes(compute, terrains, episodes, **_SIZES)
    conditions = [name for name in doses if name in CONDITIONS]
    if any(CONDITIONS[name].asks == Kind.ROUTE for name in conditions):
        read_stray(robot, resolved=resolved)  # or refuses
    for policy in controllers.values():
        check_conditions(conditions, robot, observed_terms(policy))
        check_policy(policy, robot, compute.device)
    out = out or RUNS / f"{robot.name}-dose" / ("dose-resolved.json" if resolved else "dose.json")

    def measure() -> dict[str, Any]:
        sets = {name: dose_set(dose, count, seed) for name, dose in doses.items()}
        engine, cache = "resolved" if resolved else "search", crossings_folder(robot)
        results = cross_sets(controllers, sets, robot, compute, episodes, engine=engine, cache=cache)
        rows = {
            (name, controller): measure_rates(name, dose, controller, results[name][controller])
            for name, dose in doses.items()
            for controller in controllers
        }
        return {
            **compute.origin(seed),
            "robot": robot.name,
            **robot_identity(robot),
            "resolved": resolved,
            "terrains": count,
            "episodes": episodes,
            "controllers": describe_controllers(controllers, robot),
            "titles": {name: dose.describe() for name, dose in doses.items()},
            "dose": [{**row, "resolved": resolved} for dosed in rows.values() for row in dosed],
            "half": [find_half(doses[name], dosed, results[name][by]) for (name, by), dosed in rows.items()],
        }

    return publish(out, measure, show_dose, draw=lambda report: as_png(draw_dose(report)))


def dose_set(dose: Dose, num_terrains: int, seed: int) -> TerrainSet:
    """Terrains of a dose, all values of one place behind each other: so workers share the hard ones. ``seed`` draws."""
    rng = set_rng("dose", seed)
    seeds = draw_seeds(rng, num_terrains).repeat(len(dose.values))
    values = dose.terrains(num_terrains, rng)
    kind: dict[str, Any] = {"heights" if values.ndim == 3 else "genes": values}
    terrains = Terrains(seeds=seeds, space=load_space(dose.space), **kind)
    return TerrainSet(terrains=terrains, numbers=np.arange(len(seeds)))


def measure_rates(name: str, dose: Dose, controller: str, result: RolloutResult) -> list[dict[str, Any]]:
    """Rates of one controller on a dose, a row a value, the easiest first; None with too many invalid episodes."""
    unit = dose.quantities[dose.parameter].unit
    about: dict[str, Any] = {"element": name, "parameter": dose.parameter, "unit": unit, "at": dict(dose.others)}
    rows = []
    for number, value in enumerate(dose.values):
        outcome, fallen = (array[number :: len(dose.values)].ravel() for array in (result.outcome, result.fallen))
        counted = counted_episodes(outcome == Outcome.INVALID)
        count = int(counted.sum())
        row = {**about, "value": value, "controller": controller, "episodes": count, "left_out": len(counted) - count}
        hits = {"goal": outcome == Outcome.GOAL, "fallen": fallen, "success": outcome != Outcome.BASE_COLLISION}
        for rate, is_hit in hits.items():
            num_hits = int((is_hit & counted).sum())
            row[f"{rate}_rate"] = num_hits / count if count else None
            interval = "interval" if rate == "goal" else f"{rate}_interval"
            row[interval] = list(wilson_interval(num_hits, count)) if count else None
        rows.append(row)
    return rows


def find_half(dose: Dose, rows: Sequence[dict[str, Any]], result: RolloutResult) -> dict[str, Any]:
    """Where robots begin to pass less than half of the time, by straight lines between the values.

    The 95 % ``interval`` is by bootstrap over the terrains of a value. None is ``beyond`` the values: before the
    ``first``, behind the ``last``, or where all episodes are ``invalid``.
    """
    crossed = [number for number, row in enumerate(rows) if row["goal_rate"] is not None]
    half: dict[str, Any] = {key: rows[0][key] for key in ("element", "parameter", "unit", "controller")}
    unknown = half | {"value": None, "beyond": "invalid", "interval": [None, None]}
    if not crossed:
        return unknown
    counted = counted_episodes(result.outcome == Outcome.INVALID)
    masks = ((result.outcome == Outcome.GOAL) & counted, counted)
    hits, counts = (mask.sum(axis=1).reshape(-1, len(rows))[:, crossed] for mask in masks)
    drawn = resamples(len(hits), 0, _RESAMPLES)
    with np.errstate(invalid="ignore"):
        drawn_steps = [_find_crossing(rates) for rates in (drawn @ hits) / (drawn @ counts)]
    step = _find_crossing(hits.sum(axis=0) / counts.sum(axis=0))
    # The values between which it lies; outside of all, the last or the first and that beyond it.
    before, after = np.interp([np.floor(step), np.ceil(step)], range(len(crossed)), crossed)
    if (after - before > 1) or (step == np.inf and after < len(rows) - 1) or (step == -np.inf and before > 0):
        return unknown
    steps = (step, *np.quantile(drawn_steps, [0.025, 0.975], method="inverted_cdf"))
    values = [rows[number]["value"] for number in crossed]
    value, *limits = (float(np.interp(at, range(len(values)), values)) if np.isfinite(at) else None for at in steps)
    beyond = None if value is not None else "last" if step > 0 else "first"
    interval = limits if dose.values[-1] >= dose.values[0] else limits[::-1]
    return {**half, "value": value, "beyond": beyond, "interval": interval}


def _find_crossing(rates: NDArray[np.floating]) -> float:
    """Index with a fraction where rates fall below a half: infinite if nowhere, -infinite if the first is below."""
    below = np.flatnonzero(rates < FAILING_GOAL_RATE)
    if not len(below) or below[0] == 0:
        return -np.inf if len(below) else np.inf
    last, first = rates[below[0] - 1], rates[below[0]]
    return float(below[0] - 1 + (last - FAILING_GOAL_RATE) / (last - first))


def show_dose(report: dict[str, Any]) -> None:
    """Prints the goal rates of every element by value and controller, and where under half of the robots pass."""
    for element, title in report["titles"].items():
        rows = [row for row in report["dose"] if row["element"] == element]
        lines = []
        for half in (half for half in report["half"] if half["element"] == element):
            rates = [row["goal_rate"] for row in rows if row["controller"] == half["controller"]]
            low, high = (format_value(limit, None, ".2f") for limit in half["interval"])
            passed = f"{half['value']:.2f} ({low} to {high})" if half["value"] is not None else _BEYOND[half["beyond"]]
            lines.append((half["controller"], *(format_value(rate, None, ".0%") for rate in rates), passed))
        values = [f"{row['value']:g}" for row in rows if row["controller"] == rows[0]["controller"]]
        head = (_label_parameter(rows[0]), *values, "half of the robots pass")
        show_table(f"{title}: robots that pass", head, lines)


def _label_parameter(row: Mapping[str, Any]) -> str:
    return f"{row['parameter']} [{row['unit']}]" if row["unit"] else row["parameter"]


def draw_dose(report: Mapping[str, Any]) -> Figure:
    """Goal rate over the dose with its interval, small axes an element, a line a controller; harder is to the right."""
    elements = list(report["titles"])
    columns = min(_COLUMNS, len(elements))
    rows = -(-len(elements) // columns)
    figure = new_figure(max(6.0, 3.3 * columns), 1.0 + 2.5 * rows)
    contact = "contact resolved" if report["resolved"] else "at the search's settings"
    figure.suptitle(f"{report['robot']}: robots that pass, {contact}, with 95 % intervals")
    panels = [figure.add_subplot(rows, columns, number) for number in range(1, 1 + len(elements))]
    for axes, element in zip(panels, elements, strict=True):
        element_rows = [row for row in report["dose"] if row["element"] == element]
        styles = zip(report["controllers"], cycle(_COLOURS), cycle(_MARKERS), strict=False)
        for controller, colour, marker in styles:
            rated = [row for row in element_rows if row["controller"] == controller and row["goal_rate"] is not None]
            values = [row["value"] for row in rated]
            rates = [100.0 * row["goal_rate"] for row in rated]
            axes.plot(values, rates, label=controller, color=colour, marker=marker, markersize=4)
            low, high = ([100.0 * row["interval"][end] for row in rated] for end in (0, 1))
            axes.fill_between(values, low, high, color=colour, alpha=0.15, linewidth=0)
        title, _, others = report["titles"][element].partition(", ")
        axes.set_title(f"{title}\n{others}", fontsize=9)
        axes.set_xlabel(_label_parameter(element_rows[0]), fontsize=8)
        axes.set_ylim(-3, 103)
        axes.axhline(100.0 * FAILING_GOAL_RATE, color="0.7", linewidth=0.8, zorder=0)
        axes.tick_params(labelsize=8)
        if element_rows[0]["value"] > element_rows[-1]["value"]:
            axes.invert_xaxis()
    for axes in panels[::columns]:
        axes.set_ylabel("pass [%]", fontsize=8)
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=len(report["controllers"]), frameon=False)
    return figure
