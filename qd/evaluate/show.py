"""What evaluations print: rates, tables and packs."""

import sys
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from rich.console import Console
from rich.table import Table

from qd.evaluate.labels import CERTIFIED, MEASURES, SETS
from sim.files.command import say
from sim.files.intervals import value_words

_WIDTH = 160  # of tables in a file
_FORMS = {"goal": ".3f", "success": ".3f", "fallen": ".3f", "reward": ".1f"}
_BIASED = {
    None: "",
    "searched": "too low, since the terrains were chosen by its failures",
    "certifier": "too high, since some terrains were chosen by its successes",
}


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


def show_rates(report: dict[str, Any]) -> None:
    """Prints the rates of one controller, as ``base.json`` has them."""
    rows = []
    for name in ("hand_crafted", "hard_random"):
        groups = {SETS[name]: report[name]}
        groups |= {f"  {key}": group for key, group in (report[name]["by_type"] or {}).items()}
        groups |= {f"  level {key}": group for key, group in (report[name]["by_level"] or {}).items()}
        for label, group in groups.items():
            rates = (value_words(group[f"{key}_rate"], group.get(f"{key}_interval")) for key in ("goal", "success"))
            rows.append((label, *rates, value_words(group["fallen_rate"], None), group["terrains"]))
    show_table(report["policy"], ("", MEASURES["goal"], MEASURES["success"], "fallen", "terrains"), rows)
    error = value_words(report["flat"]["vx_error_mean"], None)
    print(f"flat ground: v_x is off its command by {error} m/s (root mean square)")
    _show_invalid({SETS[name]: report[name]["outcomes"] for name in ("hand_crafted", "hard_random")})


def _show_invalid(outcomes: Mapping[str, Mapping[str, int]]) -> None:
    for label, counts in outcomes.items():
        if counts["invalid"]:
            share = counts["invalid"] / sum(counts.values())
            print(f"{label}: {counts['invalid']} episodes are invalid ({share:.1%}) and left out; they may be failures")


def show_tables(report: dict[str, Any]) -> None:
    """Prints ``tables.json``: every set with every controller, and what became of terrains."""
    if report.get("part") == "validation":
        print("\nValidation terrains, to choose settings by. Rates to report are of part test.")
    for name in report["goal"]:
        rows = [
            (controller, *_cells(report, name, controller, _FORMS), _paper_cell(report, name, controller))
            for controller in report["goal"][name]
        ]
        title = f"{SETS.get(name, name)}: {report['terrains'][name]} terrains x {report['episodes']} episodes"
        show_table(title, ("", *(MEASURES[key] for key in _FORMS), "paper: success, reward"), rows)
    for name, about in report["certified"].items():
        certifiers = ", ".join(f"{certifier} {count}" for certifier, count in about["certifiers"].items())
        title = f"{SETS.get(name, name)}, certified: {about['terrains']} of {report['terrains'][name]} ({certifiers})"
        rows = [
            (controller, *_cells(report, name, controller, CERTIFIED), _BIASED[about["chosen_by"].get(controller)])
            for controller in report["goal"][name]
        ]
        head = ("", *(MEASURES[measure] for measure in CERTIFIED.values()), "biased")
        show_table(title, head, rows if about["terrains"] else [])
    rows = [
        (f"{name}, {kind}, {measure.replace('_', ' ')}", value_words(summary["mean"], summary["interval"]))
        for measure, sets in report["over_seeds"].items()
        for name, kinds in sets.items()
        for kind, summary in kinds.items()
    ]
    if rows:
        show_table("several controllers of a kind: mean, 95 % t interval over them", ("", "mean"), rows)
    by_controller = {
        f"{name}, {controller}": values
        for name, row in report["penalties"].items()
        for controller, values in row.items()
    }
    rows = [
        (label, *(value_words(value, None, ".2f") for value in values.values()))
        for label, values in by_controller.items()
    ]
    show_table("scaled penalties", ("", *next(iter(by_controller.values()))), rows)
    _show_differences(report["differences"])
    _show_invalid(
        {
            f"{controller} on {name}": counts
            for name, row in report["outcomes"].items()
            for controller, counts in row.items()
        }
    )


def _cells(report: dict[str, Any], name: str, controller: str, measures: Iterable[str]) -> list[str]:
    intervals = report["intervals"]
    return [
        value_words(report[key][name][controller], intervals[key][name][controller], _FORMS.get(key, ".3f"))
        for key in measures
    ]


def published_value(report: Mapping[str, Any], measure: str, name: str, controller: str) -> float | None:
    """The paper's number of a measure, a set and a controller's name; None where it has none."""
    return (report["paper"] or {}).get(measure, {}).get(name, {}).get(controller)


def _paper_cell(report: dict[str, Any], name: str, controller: str) -> str:
    success, reward = (published_value(report, key, name, controller) for key in ("success", "reward"))
    return "" if success is None else f"{success:.3f}, {reward:.1f}"


def _show_differences(differences: dict[str, Any]) -> None:
    rows = []
    for name, pairs in differences.items():
        for pair, about in pairs.items():
            changed = (f"{about[kind]['count']} ({about[kind]['clear']})" for kind in ("mended", "newly_broken"))
            gain = value_words(about["gain"]["goal"]["mean"], about["gain"]["goal"]["interval"], "+.3f")
            rows.append((f"{name}, {pair}", *changed, about["still_failing"]["count"], about["compared"], gain))
    if rows:
        title = "terrains on which under half of the episodes reach the goal; in brackets beyond chance"
        show_table(title, ("", "mended", "newly broken", "still failing", "of", "gain of the goal rate"), rows)


def show_comparison(report: dict[str, Any]) -> None:
    """Prints what became of elites from an old controller to a new one."""
    change = report["differences"]["elites"]["old -> new"]
    for name in ("old", "new"):
        goal = value_words(report["goal"]["elites"][name], report["intervals"]["goal"]["elites"][name])
        say(f"{name}: {goal} of the robots reach the goal")
    for fate, words, style in (("newly_broken", "newly failed", "red"), ("mended", "newly crossed", "green")):
        count, numbers = change[fate]["count"], ", ".join(map(str, change[fate]["terrains"]))
        which = f", {change[fate]['clear']} of them beyond chance: {numbers}" if count else ""
        say((f"{count} of {change['compared']} elites {words}", style if count else ""), which)
    gain = value_words(change["gain"]["goal"]["mean"], change["gain"]["goal"]["interval"], "+.3f")
    verdict = ("a regression", "bold red") if report["regression"] else ("no regression", "bold green")
    say(f"new - old: {gain}, 95 % interval over families: ", verdict)


def show_pack(report: dict[str, Any]) -> None:
    """Prints the rates of a pack's controllers, as ``pack.json`` has them."""
    verdicts = Counter(about["verdict"] for about in report["terrains"])
    title = ", ".join(f"{verdict}: {count} terrains" for verdict, count in verdicts.items())
    _show_pack_rates(title, report["rates"])


def show_pack_test(report: dict[str, Any]) -> None:
    """Prints what of a pack a controller fails, beside the pack's controllers."""
    rates = {"this": report["rates"], **report["beside"]}
    _show_pack_rates(f"pack {report['pack']['folder']} of {report['pack']['robot']}", rates)
    modes = {mode["mode"]: f"{mode['mode']}: {mode['ending']}, {mode['marked_by']}" for mode in report["pack"]["modes"]}
    for group in ("verdict", "mode", "cause", "kind"):
        rows = [
            (
                modes.get(about[group], about[group]) if group == "mode" else about[group] or "not looked for",
                about["terrains"],
                *about["failing"].values(),
            )
            for about in report["by"][group]
        ]
        show_table(f"failed, by {group}", ("", "terrains", *rates), rows)


def _show_pack_rates(title: str, rates: Mapping[str, dict[str, Any]]) -> None:
    rows = [
        (
            controller,
            *(value_words(row[f"{key}_rate"], row[f"{key}_interval"]) for key in ("goal", "success", "fallen")),
            f"{row['failing']} of {row['terrains']}",
            f"{row['failing_families']} of {row['families']}",
        )
        for controller, row in rates.items()
    ]
    show_table(title, ("", *(MEASURES[key] for key in ("goal", "success", "fallen")), "fails", "families"), rows)
