"""Which real obstacle at which size stops a controller: goal rate against a stair's rise, a ditch's width, friction."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qd.evaluate.evaluate import sized_evaluator
from qd.fitness import FAILING_GOAL_RATE
from qd.fresh import Open
from qd.workers.evaluator import check_policy, open_evaluator, origin_of
from sim.files.atomic import prepare_output
from sim.files.command import OfRobot, Where, naming_what_is_next, publish, split_words
from sim.files.intervals import value_words, wilson_interval
from sim.files.records import robot_identity
from sim.files.settings import setting
from sim.policy.spec import about_controllers, controllers_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from qd.evaluate.sets import TerrainSet
    from sim.rollout import RolloutResult
    from sim.spaces.dose import Dose

_FULL = (20, 4)  # terrains a value and episodes a terrain
_SMALL = (8, 2)  # on a machine without a GPU
_COLUMNS = 4  # of the figure


@dataclass(frozen=True, kw_only=True)
class MeasureDose(OfRobot, Where):
    """Measure which real obstacle at which size stops a controller.

    One obstacle stands alone on flat ground, and one of its sizes grows: the rise of stairs, the width of a ditch; or
    the ground is level and its friction falls. For each value the command measures how many robots reach the goal.
    Terrains of a value differ in where the obstacle begins, evenly over 1 m, and in the seeds of their episodes. All
    values and controllers have the same places and seeds. After a kill the same command goes on.
    """

    policies: tuple[str, ...] = ()
    """Controllers, each NAME=FILE, NAME=file.py:callable, NAME=module:callable or NAME=shipped; base=shipped if left
    out."""
    elements: tuple[str, ...] = ()
    """Obstacles: stairs_up, stairs_down, step_up, step_down, sill, rail, pallet, ramp_up, ramp_down, cross_slope,
    ditch, beam, stones, rubble; grounds: friction, softness. All of them if left out."""
    values: tuple[str, ...] = ()
    """Other values of some obstacles, each ELEMENT=VALUE,VALUE,...: stairs_up=0.15,0.2,0.25. They may lie beyond what
    the space course has."""
    at: tuple[str, ...] = ()
    """Other sizes of obstacles beside the one that grows, each NAME=VALUE: tread=0.25 depth=0.3."""
    resolved: bool = False
    """Cross with contact resolved: steps of 1 ms and a contact time constant of 3 ms; about five times the work."""
    terrains: int | None = setting(None, least=1)
    """Terrains a value; 20 on CUDA, 8 on the CPU."""
    episodes: int | None = setting(None, least=1)
    """Episodes a terrain; 4 on CUDA, 2 on the CPU."""
    seed: int = setting(0, least=0)
    """Draws other episodes."""
    out: Path | None = None
    """File for the numbers; runs/<robot>-dose/dose.json, with contact resolved dose-resolved.json. The figure is
    written beside it as .png."""
    run_dir: Path | None = None
    """Folder in which crossings are kept; runs/<robot>-dose."""

    def execute(self) -> None:
        """Measures."""
        with naming_what_is_next("what is crossed is kept", lambda: "The same command goes on."):
            measure_dose(self)


def measure_dose(flags: MeasureDose, *, open_evaluator: Open = open_evaluator) -> dict[str, Any]:
    """Cross every value of every dose with every controller, print, write and draw what came of it; returns the report.

    Args:
        flags: What to measure, with whom, where.
        open_evaluator: Opens what crosses terrains.

    Raises:
        ValueError: If a flag's value cannot be used; raised before any long work.
        EvaluatorError: If a worker is lost; what was crossed is kept.
    """
    from qd.evaluate.crossings import cross_all
    from sim.robots.robot import get_robot
    from sim.spaces.dose import chosen_doses

    robot = get_robot(flags.robot)
    evaluator = replace(sized_evaluator(flags, robot, _FULL, _SMALL, "a value"), resolved=flags.resolved)
    doses = chosen_doses(split_words(flags.elements), _values_of(flags.values), _sizes_of(flags.at))
    controllers = controllers_of(flags.policies, robot)
    for policy in controllers.values():
        check_policy(policy, robot, evaluator.device)
    run_dir = flags.run_dir or Path("runs") / f"{robot.name}-dose"
    kept = run_dir / "crossings"
    prepare_output(kept / "any")  # last: what is refused leaves no folder

    def measure() -> dict[str, Any]:
        sets = {name: set_of(name, dose, evaluator.num_terrains, flags.seed) for name, dose in doses.items()}
        results = cross_all(controllers, sets, evaluator, kept, open_evaluator=open_evaluator)
        lines = [
            (dose, [{**row, "resolved": flags.resolved} for row in rows_of(name, dose, who, results[name][who])])
            for name, dose in doses.items()
            for who in controllers
        ]
        return {
            **origin_of(evaluator.device, flags.seed, flags.workers),
            "robot": robot.name,
            **robot_identity(robot),
            "resolved": flags.resolved,
            "terrains": evaluator.num_terrains,
            "episodes": evaluator.num_replicas,
            "controllers": about_controllers(controllers, robot),
            "titles": {name: dose.describe() for name, dose in doses.items()},
            "dose": [row for _, rows in lines for row in rows],
            "half": [half_of(dose, rows) for dose, rows in lines],
        }

    out = flags.out or run_dir / ("dose-resolved.json" if flags.resolved else "dose.json")
    return publish(out, measure, print_dose, draw=_picture_of)


def _values_of(words: Sequence[str]) -> dict[str, list[float]]:
    """Values by element, as the command line has them."""
    found = {}
    for word in " ".join(words).split():
        name, _, values = word.partition("=")
        found[name] = [
            _number(value, f"values must be ELEMENT=VALUE,VALUE,..., got '{word}'") for value in values.split(",")
        ]
    return found


def _sizes_of(words: Sequence[str]) -> dict[str, float]:
    """Sizes by name, as the command line has them."""
    parts = [word.partition("=") for word in split_words(words)]
    return {name: _number(value, f"at must be NAME=VALUE, got '{name}={value}'") for name, _, value in parts}


def _number(text: str, complaint: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"{complaint}: expected numbers such as 0.25") from None


def set_of(name: str, dose: "Dose", num_terrains: int, seed: int) -> "TerrainSet":
    """The terrains of a dose, those of all values at one place behind each other, so that workers share the hard ones.

    Args:
        name: Name of the dose.
        dose: The dose.
        num_terrains: Terrains a value.
        seed: Draws their episodes, the same ones for all doses.
    """
    from qd.evaluate.sets import TerrainSet, set_rng
    from sim.space import SUPER_GAUSSIAN
    from sim.spaces.dose import LEVEL_SPACE

    rng = set_rng("dose", seed)
    seeds = rng.integers(2**32, size=num_terrains, dtype=np.uint32).repeat(len(dose.values))
    return TerrainSet(
        name=name,
        terrains=dose.terrains(num_terrains, rng),
        seeds=seeds,
        numbers=np.arange(len(seeds)),
        space=LEVEL_SPACE if dose.kind is None else SUPER_GAUSSIAN.name,  # the latter does not matter to heights
    )


def rows_of(name: str, dose: "Dose", who: str, result: "RolloutResult") -> list[dict[str, Any]]:
    """What came of a dose for one controller, a row a value, the easiest first.

    A value with more than a quarter of invalid episodes has no rates.

    Args:
        name: Name of the dose.
        dose: The dose.
        who: Name of the controller.
        result: Crossings of its terrains, as :func:`set_of` orders them.
    """
    from sim.rates import hits_of

    def by_value(array: NDArray[Any]) -> NDArray[Any]:
        return array.reshape(-1, len(dose.values), array.shape[1]).swapaxes(0, 1).reshape(len(dose.values), -1)

    outcome, fallen = by_value(result.outcome), by_value(result.fallen)
    goal, counted = hits_of(outcome, "goal")
    success, _ = hits_of(outcome, "success")
    rows = []
    for number, value in enumerate(dose.values):
        count = int(counted[number].sum())
        row: dict[str, Any] = {
            "element": name, "parameter": dose.parameter, "value": value, "unit": dose.unit, "at": dict(dose.others),
            "controller": who, "episodes": count, "left_out": outcome.shape[1] - count,
        }  # fmt: skip
        for rate, hits in {"goal": goal, "success": success, "fallen": fallen & counted}.items():
            number_of_hits = int(hits[number].sum())
            row[f"{rate}_rate"] = number_of_hits / count if count else None
            limits = list(wilson_interval(number_of_hits, count)) if count else None
            row["interval" if rate == "goal" else f"{rate}_interval"] = limits
        rows.append(row)
    return rows


def half_of(dose: "Dose", rows: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """Where under half of the robots begin to reach the goal, by straight lines between the values.

    Args:
        dose: The dose.
        rows: Those of one controller, the easiest first.

    Returns:
        ``element``, ``parameter``, ``unit``, ``controller``, ``value``, ``interval`` and ``words``. The interval ends
        where the limits of the goal rates pass a half. None stands for what lies beyond the values.
    """
    known = [row for row in rows if row["goal_rate"] is not None]
    values = [row["value"] for row in known]
    value = _passes_half(values, [row["goal_rate"] for row in known])
    limits = [_passes_half(values, [row["interval"][end] for row in known]) for end in (0, 1)]
    about = {key: rows[0][key] for key in ("element", "parameter", "unit", "controller")}
    interval = limits if dose.harder_up else limits[::-1]
    return {**about, "value": value, "interval": interval, "words": _half_words(dose, known, value, interval)}


def _passes_half(values: Sequence[float], rates: Sequence[float]) -> float | None:
    """Value at which rates first fall below a half; None if they never do, or are below at once."""
    below = [place for place, rate in enumerate(rates) if rate < FAILING_GOAL_RATE]
    if not below or below[0] == 0:
        return None
    last, first = below[0] - 1, below[0]
    share = (rates[last] - FAILING_GOAL_RATE) / (rates[last] - rates[first])
    return values[last] + share * (values[first] - values[last])


def _half_words(
    dose: "Dose", rows: Sequence[dict[str, Any]], value: float | None, interval: Sequence[float | None]
) -> str:
    if not rows:
        return "too many episodes are invalid"
    what = f"a {dose.parameter} of"
    if value is None and rows[0]["goal_rate"] < FAILING_GOAL_RATE:
        return f"under half of the robots reach the goal even at {what} {dose.in_words(rows[0]['value'])}"
    if value is None:
        last = f"{'up' if dose.harder_up else 'down'} to {dose.in_words(rows[-1]['value'])}"
        return f"over half of the robots reach the goal at every {dose.parameter}, {last}"
    low, high = (None if limit is None else dose.in_words(limit) for limit in interval)
    between = ""
    if low is not None and high is not None:
        between = f" ({low.removesuffix(dose.unit).strip()} to {high})"
    elif low is not None:
        between = f" ({low} or more)"
    elif high is not None:
        between = f" ({high} or less)"
    return f"half of the robots reach the goal at {what} {dose.in_words(value)}{between}"


def _by_element(rows: Sequence[dict[str, Any]]) -> dict[str, dict[str, list[dict[str, Any]]]]:
    """Element -> controller -> its rows."""
    found: dict[str, dict[str, list[dict[str, Any]]]] = {}
    for row in rows:
        found.setdefault(row["element"], {}).setdefault(row["controller"], []).append(row)
    return found


def print_dose(report: dict[str, Any]) -> None:
    """Prints the goal rates of every element by value and controller, and where under half reach the goal."""
    halves = _by_element(report["half"])
    for element, lines in _by_element(report["dose"]).items():
        first = next(iter(lines.values()))
        print(f"{report['titles'][element]}: robots that reach the goal")
        print(f"  {_label(first[0]):<20}" + "".join(f"{row['value']:>8g}" for row in first))
        for who, rows in lines.items():
            print(f"  {who:<20}" + "".join(f"{value_words(row['goal_rate'], None, '.0%'):>8}" for row in rows))
        for who in lines:
            print(f"  {who}: {halves[element][who][0]['words']}")
    print("Of the intervals, 95 %, the file has those of the rates; those in words are where they pass a half.")


def _label(row: dict[str, Any]) -> str:
    return f"{row['parameter']} [{row['unit']}]" if row["unit"] else row["parameter"]


def _picture_of(report: dict[str, Any]) -> bytes:
    from sim.files.figures import as_png

    return as_png(draw_dose(report))


def draw_dose(report: dict[str, Any]) -> "Figure":
    """Goal rate over the dose with its interval, small axes an element, a line a controller; harder is to the right."""
    from qd.evaluate.show import COLOURS, MARKERS
    from sim.files.figures import new_figure

    doses = _by_element(report["dose"])
    columns = min(_COLUMNS, len(doses))
    rows = -(-len(doses) // columns)
    figure = new_figure(max(6.0, 3.3 * columns), 1.0 + 2.5 * rows)
    contact = "contact resolved" if report["resolved"] else "at the search's settings"
    figure.suptitle(f"{report['robot']}: robots that reach the goal, {contact}, with 95 % intervals")
    panels = [figure.add_subplot(rows, columns, place + 1) for place in range(len(doses))]
    for axes, (element, lines) in zip(panels, doses.items(), strict=True):
        for number, (who, of_one) in enumerate(lines.items()):
            known = [row for row in of_one if row["goal_rate"] is not None]
            values = [row["value"] for row in known]
            look = {"color": COLOURS[number % len(COLOURS)], "marker": MARKERS[number % len(MARKERS)], "markersize": 4}
            axes.plot(values, [100.0 * row["goal_rate"] for row in known], label=who, **look)
            low, high = ([100.0 * row["interval"][end] for row in known] for end in (0, 1))
            axes.fill_between(values, low, high, color=look["color"], alpha=0.15, linewidth=0)
        first = next(iter(lines.values()))
        title, _, others = report["titles"][element].partition(", ")
        axes.set_title(f"{title}\n{others}", fontsize=9)
        axes.set_xlabel(_label(first[0]), fontsize=8)
        axes.set_ylim(-3, 103)
        axes.axhline(100.0 * FAILING_GOAL_RATE, color="0.7", linewidth=0.8, zorder=0)
        axes.tick_params(labelsize=8)
        if first[0]["value"] > first[-1]["value"]:
            axes.invert_xaxis()
    for axes in panels[::columns]:
        axes.set_ylabel("reach the goal [%]", fontsize=8)
    figure.legend(
        *panels[0].get_legend_handles_labels(), loc="outside lower center", ncols=len(report["controllers"]),
        frameon=False,
    )  # fmt: skip
    return figure
