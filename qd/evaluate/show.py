"""What evaluations print: rates, tables and packs."""

import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from qd.evaluate.labels import COMPARED, MEASURES, RATES, SETS
from qd.evaluate.tables import is_regression
from sim.files.command import say
from sim.files.intervals import value_words

_WIDTH = 160  # of tables in a file
_FORMS = {"goal": ".3f", "success": ".3f", "fallen": ".3f", "reward": ".1f"}


def show_table(title: str, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """Prints a table; its first column is the rows' names."""
    console = Console(markup=False, highlight=False, width=None if sys.stdout.isatty() else _WIDTH)
    table = Table(box=None, pad_edge=False)
    for place, column in enumerate(head):
        table.add_column(column, justify="right" if place else "left", overflow="fold")
    for row in rows:
        table.add_row(*map(str, row))
    console.print(f"\n{title}", style="bold")
    console.print(table)


def _heads(measures: Iterable[str]) -> list[str]:
    return ["", *(MEASURES[measure] for measure in measures)]


def _rate_cells(row: Mapping[str, Any]) -> list[str]:
    return [value_words(row[f"{rate}_rate"], row.get(f"{rate}_interval")) for rate in RATES]


def show_rates(report: dict[str, Any]) -> None:
    """Prints the rates of one controller, as ``base.json`` has them."""
    sets, rows = {SETS[name]: report[name] for name in ("hand_crafted", "hard_random")}, []
    for label, group in sets.items():
        parts = {f"  {key}": part for key, part in (group["by_type"] or {}).items()}
        parts |= {f"  level {key}": part for key, part in (group["by_level"] or {}).items()}
        rows += [(key, *_rate_cells(part), part["terrains"]) for key, part in ({label: group} | parts).items()]
    show_table(report["policy"], (*_heads(RATES), "terrains"), rows)
    error = value_words(report["flat"]["vx_error_mean"], None)
    print(f"flat ground: v_x is off its command by {error} m/s (root mean square)")


def show_tables(report: dict[str, Any]) -> None:
    """Prints the means of every set with every controller, and what became of terrains."""
    for name, count in report["terrains"].items():
        limits = {measure: report["intervals"][measure][name] for measure in _FORMS}
        rows = [
            (who, *(value_words(report[key][name][who], limits[key][who], form) for key, form in _FORMS.items()))
            for who in report["controllers"]
        ]
        title = f"{SETS.get(name, name)}: {count} terrains x {report['episodes']} episodes"
        show_table(title, _heads(_FORMS), rows)
    rows = []
    for name, pairs in report["differences"].items():
        for pair, change in pairs.items():
            changed = (f"{change[fate]['count']} ({change[fate]['clear']})" for fate in ("mended", "newly_broken"))
            gain = value_words(change["gain"]["goal"]["mean"], change["gain"]["goal"]["interval"], "+.3f")
            rows.append((f"{name}, {pair}", *changed, change["still_failing"]["count"], change["compared"], gain))
    if rows:
        title = "terrains on which under half of the episodes reach the goal; in brackets beyond chance"
        show_table(title, ("", "mended", "newly broken", "still failing", "of", "gain of the goal rate"), rows)


def show_comparison(report: dict[str, Any]) -> None:
    """Prints what became of elites from an old controller to a new one."""
    change = report["differences"][COMPARED]["old -> new"]
    for name in ("old", "new"):
        goal = value_words(report["goal"][COMPARED][name], report["intervals"]["goal"][COMPARED][name])
        say(f"{name}: {goal} of the robots reach the goal")
    for fate, words, style in (("newly_broken", "newly failed", "red"), ("mended", "newly crossed", "green")):
        count, numbers = change[fate]["count"], ", ".join(map(str, change[fate]["terrains"]))
        which = f", {change[fate]['clear']} of them beyond chance: {numbers}" if count else ""
        say((f"{count} of {change['compared']} elites {words}", style if count else ""), which)
    gain = value_words(change["gain"]["goal"]["mean"], change["gain"]["goal"]["interval"], "+.3f")
    verdict = ("a regression", "bold red") if is_regression(report) else ("no regression", "bold green")
    say(f"new - old: {gain}, 95 % interval over families: ", verdict)


def show_pack(report: dict[str, Any]) -> None:
    """Prints the rates of a pack's controllers, as ``pack.json`` has them."""
    verdicts = Counter(about["verdict"] for about in report["terrains"])
    title = ", ".join(f"{verdict}: {count} terrains" for verdict, count in verdicts.items())
    _show_pack_rates(title, report["rates"])


def show_pack_test(report: dict[str, Any]) -> None:
    """Prints what of a pack a controller fails, beside the pack's controllers."""
    title = f"pack {report['pack']['folder']} of {report['pack']['robot']}"
    _show_pack_rates(title, {"this": report["rates"], **report["beside"]})
    for group, parts in report["by"].items():
        rows = [(value, part["failing"], part["terrains"]) for value, part in parts.items()]
        show_table(f"failed, by {group}", ("", "fails", "of"), rows)


def _show_pack_rates(title: str, rates: Mapping[str, dict[str, Any]]) -> None:
    rows = [
        (name, *_rate_cells(row), f"{row['failing']} of {row['terrains']}",
         f"{row['failing_families']} of {row['families']}")
        for name, row in rates.items()
    ]  # fmt: skip
    show_table(title, (*_heads(RATES), "fails", "families"), rows)
