"""Tables of an evaluation and of the rounds of a hardening, as data for a page."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from qd.evaluate import labels
from qd.evaluate.labels import FATES, SETS
from qd.evaluate.tables import as_tables
from qd.search.directory import ROUNDS_FILE
from qd.show.report.page import Table, check_page, origin_rows, percent, publish_page
from sim.files.atomic import read_json
from sim.files.command import command_line
from sim.files.intervals import format_value
from sim.files.provenance import without_machine
from sim.robots.find import get_robot

_COUNTS = ("elites", "failing", "confirmed", "certified", "faults")
MEASURES = {name: labels.MEASURES[name] for name in ("goal", "success", "reward")}
"""Labels of the shown measures; the first two are fractions."""


def compare_controllers(tables: Mapping[str, Any], *, file: str = "", searched: str | None = None) -> dict[str, Any]:
    """Values of the template, from tables as ``tables.json`` has them.

    ``searched`` is the hash of the page's controller. Each measure has a table with a row a controller; ``certified``
    has goal rates on certified terrains alone, ``changes`` the fates of terrains between two controllers.
    """
    hashes = {about["sha256"] for about in tables["controllers"].values()}
    return {
        "file": file,
        "episodes": tables["episodes"],
        "of_searched": searched is None or searched in hashes,
        "measures": [(label, _measure_table(tables, measure)) for measure, label in MEASURES.items()],
        "certified": _certified_table(tables),
        "changes": _changes_table(tables),
    }


def _format(measure: str, value: float | None, limits: Sequence[float] | None) -> str:
    if measure == "reward":
        return format_value(value, limits, ".1f")
    if value is None:
        return "-"
    return percent(value) + (f" ({100 * limits[0]:.0f} to {100 * limits[1]:.0f})" if limits else "")


def _head(names: Iterable[str], terrains: Mapping[str, int]) -> list[str]:
    return ["controller", *(f"{SETS.get(name, name)} ({terrains[name]:,})" for name in names)]


def _measure_table(tables: Mapping[str, Any], measure: str) -> Table:
    """A row a controller, and the mean over those of one kind that differ in their seed."""
    values = tables[measure]
    intervals = tables["intervals"][measure]
    rows = [
        [controller, *(_format(measure, values[name][controller], intervals[name][controller]) for name in values)]
        for controller in tables["controllers"]
    ]
    means = tables["over_seeds"].get(measure, {})
    for kind in next(iter(means.values()), {}):
        seeds = [means[name][kind] for name in values]
        cells = [_format(measure, mean["mean"], mean["interval"]) for mean in seeds]
        rows.append([f"{kind}, mean of {len(seeds[0]['values'])}", *cells])
    return Table(head=_head(values, tables["terrains"]), rows=rows)


def _certified_table(tables: Mapping[str, Any]) -> Table | None:
    sets = {name: about for name, about in (tables.get("certified") or {}).items() if about["terrains"]}
    if not sets:
        return None
    values = tables["certified_goal"]
    intervals = tables["intervals"]["certified_goal"]
    rows = [[controller] for controller in tables["controllers"]]
    for name, about in sets.items():
        for row in rows:
            role = about["chosen_by"].get(row[0])
            rate = _format("certified_goal", values[name][row[0]], intervals[name][row[0]])
            row.append(rate + (f", {role}" if role else ""))
    return Table(head=_head(sets, {name: about["terrains"] for name, about in sets.items()}), rows=rows)


def _changes_table(tables: Mapping[str, Any]) -> Table:
    """Fates of terrains between two controllers; pairs with the first controller stand first."""
    first = next(iter(tables["controllers"]))
    rows = {False: [], True: []}
    for name, changes in tables["differences"].items():
        for pair, change in changes.items():
            if " -> " in pair:  # others are of kinds of controllers
                counts = [f"{change[fate]['count']}" for fate in FATES]
                row = [f"{SETS.get(name, name)}: {pair}", *counts, f"{change['compared']}"]
                rows[pair.startswith(f"{first} -> ")].append(row)
    return Table(head=["terrains", *FATES.values(), "compared"], rows=rows[True] + rows[False])


def write_rounds(run: Path, robot: str | None, out: Path | None) -> Path:
    """Writes the page; returns its file."""
    content = _read_rounds(run, robot)
    out = out or run / "report.html"
    check_page(out)
    rounds = content["rounds"]
    rows = []
    for row in rounds:
        counts = [format_value(row.get(key), None, ",") for key in ("episodes", *_COUNTS)]
        rows.append([row["controller"], *counts, ", ".join(row["certifiers"]) or "nobody"])
    return publish_page(
        out,
        "rounds.html",
        robot=content["robot"],
        run=without_machine(str(run)),
        rounds=rounds,
        counts=Table(head=["controller searched", "episodes", *_COUNTS, "crossed by"], rows=rows),
        goals={
            SETS.get(name, f"{name}, held out"): {key: 100.0 * rate for key, rate in rates.items() if rate is not None}
            for name, rates in content["tables"]["goal"].items()
        },
        compared=compare_controllers(content["tables"]),
        choices=content.get("choices", {}),
        origin=origin_rows(content),
        reports=[command_line("report", robot=robot, run=run / row["search"]) for row in rounds],
    )


def _read_rounds(run: Path, robot: str | None) -> dict[str, Any]:
    file = run / ROUNDS_FILE
    content = read_json(file)
    if not content.get("rounds"):
        raise ValueError(f"{file} must have a search that is over, got none: let the hardening go on")
    try:
        content["tables"] = as_tables({"robot": content["robot"], **content["tables"]})
        if not all({"controller", "search", "certifiers", "faults"} <= set(row) for row in content["rounds"]):
            raise ValueError("a round lacks a name")
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file} must be of `faultline harden`, got another or a damaged file: {error}") from None
    if robot is not None and get_robot(robot).name != content["robot"]:
        raise ValueError(f"{file} is of robot {content['robot']}, got --robot {robot}: give that robot or another run")
    for row in content["rounds"]:  # without a specialist faults are by the panel
        row["faults"] = row.get("faults_panel") if row["faults"] is None else row["faults"]
    return content
