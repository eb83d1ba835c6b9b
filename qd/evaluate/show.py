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
from sim.files.intervals import format_value

_WIDTH = 160  # of tables in a file
_FORMS = {"goal": ".3f", "success": ".3f", "fallen": ".3f", "reward": ".1f"}


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


def _rate_cells(row: Mapping[str, Any]) -> list[str]:
    return [format_value(row[f"{rate}_rate"], row.get(f"{rate}_interval")) for rate in RATES]


def show_rates(report: dict[str, Any]) -> None:
    """Prints the rates of one controller, as ``base.json`` has them."""
    rows = []
    for name in ("hand_crafted", "hard_random"):
        groups = {SETS[name]: report[name]}
        groups |= {f"  {key}": group for key, group in (report[name]["by_type"] or {}).items()}
        groups |= {f"  level {key}": group for key, group in (report[name]["by_level"] or {}).items()}
        rows += [(label, *_rate_cells(group), group["terrains"]) for label, group in groups.items()]
    show_table(report["policy"], ("", *map(MEASURES.__getitem__, RATES), "terrains"), rows)
    error = format_value(report["flat"]["vx_error_mean"], None)
    print(f"flat ground: v_x is off its command by {error} m/s (root mean square)")


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


def show_pack(report: dict[str, Any]) -> None:
    """Prints the rates of a pack's controllers, as ``pack.json`` has them."""
    verdicts = Counter(entry["verdict"] for entry in report["terrains"])
    title = ", ".join(f"{verdict}: {count} terrains" for verdict, count in verdicts.items())
    _show_pack_rates(title, report["rates"])


def show_pack_test(report: dict[str, Any]) -> None:
    """Prints how many terrains of a pack a controller fails, beside the pack's controllers."""
    title = f"pack {report['pack']['folder']} of {report['pack']['robot']}"
    _show_pack_rates(title, {"this": report["rates"], **report["beside"]})
    for group, counts in report["by"].items():
        rows = [(value, count["failing"], count["terrains"]) for value, count in counts.items()]
        show_table(f"failed, by {group}", ("", "fails", "of"), rows)


def _show_pack_rates(title: str, rates: Mapping[str, dict[str, Any]]) -> None:
    rows = []
    for name, row in rates.items():
        families = f"{row['failing_families']} of {row['families']}"
        rows.append((name, *_rate_cells(row), f"{row['failing']} of {row['terrains']}", families))
    show_table(title, ("", *map(MEASURES.__getitem__, RATES), "fails", "families"), rows)
