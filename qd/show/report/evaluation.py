"""The page's chapter about an evaluation."""

from pathlib import Path
from typing import Any

from qd.evaluate import labels
from qd.show.report.material import Shown
from qd.show.report.page import Block, Folded, Picture, absent, counted, paragraph, percent, table
from sim.files.command import command_line
from sim.files.intervals import value_words
from sim.files.records import without_machine
from sim.policy.spec import kind_of

MEASURES = {name: labels.MEASURES[name] for name in ("goal", "success", "reward")}
"""Measures shown, in words; the first two are fractions."""
_GENERATED = labels.HELD_OUT[0]  # elites that were held out of training
CERTIFIED = {name: labels.MEASURES[measure] for name, measure in labels.CERTIFIED.items()}
"""Measures on certified terrains alone, in words."""


def tables_section(shown: Shown) -> list[Block]:
    """Controllers on the evaluation's sets."""
    tables = shown.material.tables
    if tables is None:
        place = without_machine(str(shown.material.tables_file))
        about = f"Left out: there are no evaluation tables at {place}. They are made by"
        return [absent(about, _command(shown))]
    kinds = by_kind(tables)
    return [
        *_of_others(shown, tables),
        paragraph(_compared(tables, kinds)),
        *(measure_table(kinds, measure) for measure in MEASURES),
        *certified_table(kinds),
        Folded("Show the figure", drawn) if (drawn := _drawn(shown.material.tables_file.with_suffix(".png"))) else "",
        Folded("Show what became of terrains", changes) if (changes := changes_tables(tables)) else "",
    ]


def _of_others(shown: Shown, tables: dict[str, Any]) -> list[Block]:
    """That the tables say nothing of the controller that was searched, if so."""
    searched = shown.material.archive.policy_sha256
    if searched is None or searched in {about["sha256"] for about in tables["controllers"].values()}:
        return []
    text = "None of these controllers is the one whose archive this page is about. Tables with it are made by"
    return [absent(text, _command(shown))]


def _drawn(figure: Path) -> list[Block]:
    """The figure that the evaluation drew beside its tables, if it is there."""
    shows = "Goal rate, no base collision and reward of every controller on every set, and what became of terrains"
    return [Picture("tables.png", figure.read_bytes(), shows)] if figure.exists() else []


def _command(shown: Shown) -> str:
    """What makes the tables."""
    material = shown.material
    return without_machine(
        command_line(
            "evaluate",
            robot=material.robot.spec,
            policies=["base=shipped", "C-G=FILE"],
            archive=material.run,
            out=material.tables_file,
        )
    )


def _compared(tables: dict[str, Any], kinds: dict[str, Any]) -> str:
    """Who was compared on what, in a sentence or two."""
    sets = ", ".join(f"{_label(name)}: {count}" for name, count in tables["terrains"].items())
    text = (
        f"{counted(len(tables['controllers']), 'controller')} on {counted(len(tables['terrains']), 'set')} of "
        f"terrains ({sets}), {tables['episodes']} episodes on each terrain; intervals are 95 %, over terrains"
    )
    over_seeds = len(kinds["controllers"]) < len(tables["controllers"])
    text += ", of several trainings that differ in their seed over these." if over_seeds else "."
    return (
        f"{text} No base collision is what the paper calls success. A robot that stands still or walks off has none "
        "either: it may have 100 % there and never reach the goal. Read the goal rate first."
    )


def _label(name: str) -> str:
    return labels.SETS.get(name, name)


def _value(tables: dict[str, Any], measure: str, name: str, controller: str) -> str:
    value, limits = tables[measure][name][controller], tables["intervals"][measure][name][controller]
    if measure == "reward":
        return value_words(value, limits, ".1f")
    if value is None:
        return "-"
    return percent(value) + (f" ({percent(limits[0])} to {percent(limits[1])})" if limits else "")


def measure_table(tables: dict[str, Any], measure: str) -> str:
    """A measure of every controller on every set, with intervals."""
    controllers = list(tables["controllers"])
    rows = [
        [_label(name), *(_value(tables, measure, name, controller) for controller in controllers)]
        for name in tables[measure]
    ]
    return table([MEASURES[measure], *controllers], rows)


def certified_table(kinds: dict[str, Any]) -> list[Block]:
    """Goal rate and no base collision on certified terrains alone; nothing where none are known."""
    known = {name: about for name, about in (kinds.get("certified") or {}).items() if about["terrains"]}
    if not known:
        return []
    rows = [
        [f"{_label(name)} ({about['terrains']} certified): {words}",
         *(_value(kinds, key, name, controller) + _role(about, names)
           for controller, names in kinds["members"].items())]
        for name, about in known.items() for key, words in CERTIFIED.items()
    ]  # fmt: skip
    text = (
        "Certified terrains alone, which the searched controller fails and another one crosses: there goals can be "
        "gained. The rate of a controller that was searched is too low there and that of a certifier too high, since "
        "the terrains were chosen by what they do."
    )
    return [paragraph(text), table(["certified terrains", *kinds["members"]], rows)]


def _role(about: dict[str, Any], members: list[str]) -> str:
    """What controllers have to do with how terrains were certified, after a comma; empty if nothing."""
    roles = {about["chosen_by"][name] for name in members if name in about["chosen_by"]}
    return "".join(f", {role}" for role in sorted(roles))


def changes_tables(tables: dict[str, Any]) -> list[Block]:
    """What became of the terrains from the first controller to every other, and folded between the others."""
    first = next(iter(tables["controllers"]))
    from_first, others = [], []
    for name, pairs in tables["differences"].items():
        for pair, change in pairs.items():
            counts = [f"{change[kind]['count']}" for kind in labels.FATES]
            row = [f"{_label(name)}: {pair}", *counts, f"{change['compared']}"]
            (from_first if pair.startswith(f"{first} -> ") else others).append(row)
    if not from_first and not others:
        return []
    head = ["terrains", *labels.FATES.values(), "compared"]
    text = (
        "Terrains that a controller fails, under half of its episodes reaching the goal, from the first controller to "
        "the second; of several trainings the first one:"
    )
    blocks: list[Block] = [paragraph(text), table(head, from_first)]
    return [*blocks, table(head, others, folded=f"Show {counted(len(others), 'other pair')}")] if others else blocks


def by_kind(tables: dict[str, Any]) -> dict[str, Any]:
    """The tables with one column a kind of controller, where a kind was trained from several seeds.

    Of several, measures are the mean over them and ``intervals`` that of the mean, under the kind's name with the
    number of its seeds. ``members`` has the controllers of each kind.
    """
    members: dict[str, list[str]] = {}
    for controller in tables["controllers"]:
        members.setdefault(kind_of(controller), []).append(controller)
    kinds = {f"{kind} ({len(names)} seeds)" if len(names) > 1 else names[0]: names for kind, names in members.items()}
    joined = {**tables, "controllers": {label: tables["controllers"][names[0]] for label, names in kinds.items()}}
    joined |= {"members": kinds, "intervals": dict(tables["intervals"])}
    for measure in (*MEASURES, *(CERTIFIED if tables.get("certified") else ())):
        values, limits = {}, {}
        for name in tables[measure]:
            means = tables["over_seeds"].get(measure, {}).get(name, {})
            pairs = {label: _of_kind(tables, measure, name, names, means) for label, names in kinds.items()}
            values[name] = {label: value for label, (value, _) in pairs.items()}
            limits[name] = {label: interval for label, (_, interval) in pairs.items()}
        joined[measure], joined["intervals"][measure] = values, limits
    return joined


def _of_kind(
    tables: dict[str, Any], measure: str, name: str, members: list[str], means: dict[str, Any]
) -> tuple[float | None, list[float] | None]:
    """Value and interval of a kind of controller on a set."""
    if len(members) == 1:
        return tables[measure][name][members[0]], tables["intervals"][measure][name][members[0]]
    about = means.get(kind_of(members[0]), {"mean": None, "interval": None})
    return about["mean"], about["interval"]
