"""The tables of an evaluation, in data."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qd.evaluate import labels
from qd.evaluate.tables import read_tables
from qd.show.report.page import Table, percent
from sim.files.intervals import value_words
from sim.files.records import without_machine
from sim.robots.robot import RobotCfg

MEASURES = {name: labels.MEASURES[name] for name in ("goal", "success", "reward")}
"""Measures shown, in words; the first two are fractions."""


@dataclass(frozen=True, kw_only=True)
class Compared:
    """Controllers on the sets of an evaluation."""

    file: str
    """The tables' file; empty of those that a hardening has."""
    episodes: int
    """On each terrain."""
    of_searched: bool
    """Whether the controller that was searched is among them, or nobody knows."""
    measures: Sequence[tuple[str, Table]]
    """What is measured, and a row a controller."""
    certified: Table | None
    """Goal rates on certified terrains alone; None where none are known."""
    changes: Table
    """What became of terrains from one controller to another."""


def read_compared(file: Path, robot: RobotCfg, searched: str | None) -> Compared:
    """The tables in a file, of a robot; ``searched`` is the hash of the searched controller."""
    return compared_of({**read_tables(file, robot)}, file=without_machine(str(file)), searched=searched)


def compared_of(tables: Mapping[str, Any], *, file: str = "", searched: str | None = None) -> Compared:
    """Tables as ``tables.json`` has them; ``searched`` is the hash of the controller that a page is about."""
    hashes = {about["sha256"] for about in tables["controllers"].values()}
    return Compared(
        file=file,
        episodes=tables["episodes"],
        of_searched=searched is None or searched in hashes,
        measures=[(words, _measure_table(tables, measure)) for measure, words in MEASURES.items()],
        certified=_certified_table(tables),
        changes=_changes_table(tables),
    )


def _value(measure: str, value: float | None, limits: Sequence[float] | None) -> str:
    if measure == "reward":
        return value_words(value, limits, ".1f")
    if value is None:
        return "-"
    return percent(value) + (f" ({100 * limits[0]:.0f} to {100 * limits[1]:.0f})" if limits else "")


def _head(names: Iterable[str], terrains: Mapping[str, int]) -> list[str]:
    return ["controller", *(f"{labels.SETS.get(name, name)} ({terrains[name]:,})" for name in names)]


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
    pairs = [(pair, name, change) for name, pairs in tables["differences"].items() for pair, change in pairs.items()]
    pairs.sort(key=lambda row: not row[0].startswith(f"{first} -> "))
    rows = [
        [f"{labels.SETS.get(name, name)}: {pair}", *(f"{change[fate]['count']}" for fate in labels.FATES),
         f"{change['compared']}"]
        for pair, name, change in pairs
    ]  # fmt: skip
    return Table(head=["terrains", *labels.FATES.values(), "compared"], rows=rows)
