"""Tables in data for a page: of an evaluation, and of the rounds of a hardening."""

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
"""Measures shown, in words; the first two are fractions."""


def compare_controllers(tables: Mapping[str, Any], *, file: str = "", searched: str | None = None) -> dict[str, Any]:
    """Tables as ``tables.json`` has them, and their file; ``searched`` is the hash of the controller of the page.

    What the template takes: episodes a terrain, whether the searched controller is among them or nobody knows, measures
    in words, each with a table of a row a controller, goal rates on certified terrains alone, if some are known, and
    what became of terrains from one controller to another.
    """
    hashes = {about["sha256"] for about in tables["controllers"].values()}
    return {
        "file": file,
        "episodes": tables["episodes"],
        "of_searched": searched is None or searched in hashes,
        "measures": [(words, _measure_table(tables, measure)) for measure, words in MEASURES.items()],
        "certified": _certified_table(tables),
        "changes": _changes_table(tables),
    }


def _value(measure: str, value: float | None, limits: Sequence[float] | None) -> str:
    if measure == "reward":
        return format_value(value, limits, ".1f")
    if value is None:
        return "-"
    return percent(value) + (f" ({100 * limits[0]:.0f} to {100 * limits[1]:.0f})" if limits else "")


def _head(names: Iterable[str], terrains: Mapping[str, int]) -> list[str]:
    return ["controller", *(f"{SETS.get(name, name)} ({terrains[name]:,})" for name in names)]


def _measure_table(tables: Mapping[str, Any], measure: str) -> Table:
    """A row a controller, and the mean over those of one kind that differ in their seed."""
    values, intervals = tables[measure], tables["intervals"][measure]
    rows = [
        [controller, *(_value(measure, values[name][controller], intervals[name][controller]) for name in values)]
        for controller in tables["controllers"]
    ]
    means = tables["over_seeds"].get(measure, {})
    for kind in next(iter(means.values()), {}):
        of_kind = [means[name][kind] for name in values]
        rows.append(
            [f"{kind}, mean of {len(of_kind[0]['values'])}",
             *(_value(measure, mean["mean"], mean["interval"]) for mean in of_kind)]
        )  # fmt: skip
    return Table(head=_head(values, tables["terrains"]), rows=rows)


def _certified_table(tables: Mapping[str, Any]) -> Table | None:
    known = {name: about for name, about in (tables.get("certified") or {}).items() if about["terrains"]}
    if not known:
        return None
    values, intervals = tables["certified_goal"], tables["intervals"]["certified_goal"]
    rows = [[controller] for controller in tables["controllers"]]
    for name, about in known.items():
        for row in rows:
            role = about["chosen_by"].get(row[0])
            words = _value("certified_goal", values[name][row[0]], intervals[name][row[0]])
            row.append(words + (f", {role}" if role else ""))
    return Table(head=_head(known, {name: about["terrains"] for name, about in known.items()}), rows=rows)


def _changes_table(tables: Mapping[str, Any]) -> Table:
    """What became of the terrains, from the first controller to the others before all other pairs."""
    first = next(iter(tables["controllers"]))
    pairs = [
        (pair, name, change) for name, pairs in tables["differences"].items()
        for pair, change in pairs.items() if " -> " in pair  # others are of kinds of controllers
    ]  # fmt: skip
    pairs.sort(key=lambda row: not row[0].startswith(f"{first} -> "))
    rows = [
        [f"{SETS.get(name, name)}: {pair}", *(f"{change[fate]['count']}" for fate in FATES),
         f"{change['compared']}"]
        for pair, name, change in pairs
    ]  # fmt: skip
    return Table(head=["terrains", *FATES.values(), "compared"], rows=rows)


def write_rounds(run: Path, robot: str | None, out: Path | None) -> Path:
    """Writes the page; returns its file."""
    content = _read_rounds(run, robot)
    out = out or run / "report.html"
    check_page(out)
    rounds = content["rounds"]
    rows = [
        [row["controller"], *(format_value(row.get(key), None, ",") for key in ("episodes", *_COUNTS)),
         ", ".join(row["certifiers"]) or "nobody"] for row in rounds
    ]  # fmt: skip
    return publish_page(
        out,
        "rounds.html",
        robot=content["robot"],
        run=without_machine(str(run)),
        rounds=rounds,
        counts=Table(head=["controller searched", "episodes", *_COUNTS, "crossed by"], rows=rows),
        goals={
            SETS.get(name, f"{name}, held out"): {who: 100.0 * rate for who, rate in rates.items() if rate is not None}
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
    for row in content["rounds"]:  # without a specialist the faults are those that the panel shows
        row["faults"] = row.get("faults_panel") if row["faults"] is None else row["faults"]
    return content
