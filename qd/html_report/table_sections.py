"""The page's chapters about an evaluation: the tables, and the same terrain before and after fine-tuning."""

from typing import Any

from qd.html_report.outcomes import ENDS
from qd.html_report.page import Absent, Block, Section, Table, Text
from qd.html_report.shown import Shown, counted, percent, picture
from qd.html_report.table_figures import draw_tables
from qd.html_report.tables import CHANGES, MEASURES
from qd.html_report.terrain_figures import draw_maps
from qd.next_commands import make_command

_ARRIVED = next(iter(ENDS.values()))


def tables_section(shown: Shown) -> Section:
    """Controllers on the evaluation's sets."""
    section, tables = Section("Controllers compared", "tables"), shown.material.tables
    if tables is None:
        about = f"Left out: there are no evaluation tables at {shown.material.tables_file}. They are made by"
        section.blocks.append(Absent(about, _command(shown)))
        return section
    section.blocks += [
        Text(_told(tables)),
        picture("tables", draw_tables(tables), "Success, goal rate and reward of every controller on every set"),
        *(_measure_table(tables, measure) for measure in MEASURES),
    ]
    changes = _changes_table(tables)
    if changes is not None:
        section.blocks += changes
    return section


def _command(shown: Shown) -> str:
    """What makes the tables."""
    material = shown.material
    return make_command(
        "evaluate",
        robot=material.robot.spec,
        policies="base=shipped C-G=FILE",
        archive=material.run,
        out=material.tables_file,
    )


def _told(tables: dict[str, Any]) -> str:
    """How the controllers fare on the hardest set, in a sentence."""
    first, *others = tables["controllers"]
    text = (
        f"{counted(len(tables['controllers']), 'controller')} on {counted(len(tables['terrains']), 'set')} of "
        f"terrains ({', '.join(f'{name}: {count}' for name, count in tables['terrains'].items())}), "
        f"{tables['episodes']} episodes on each terrain; intervals are 95 %, over terrains."
    )
    known = {name: row for name, row in tables["goal"].items() if row[first] is not None}
    if not known:
        return text
    hardest = min(known, key=lambda name: known[name][first])
    text += (
        f" {first} fares worst on {hardest}: {_value(tables, 'goal', hardest, first)} of its episodes reach the goal"
    )
    better = [f"{who} {_value(tables, 'goal', hardest, who)}" for who in others]
    return f"{text}; {', '.join(better)}." if better else f"{text}."


def _value(tables: dict[str, Any], measure: str, name: str, who: str) -> str:
    value, limits = tables[measure][name][who], tables["intervals"][measure][name][who]
    if value is None:
        return "-"
    if measure == "reward":
        return f"{value:.1f} ({limits[0]:.1f} to {limits[1]:.1f})"
    return f"{percent(value)} ({percent(limits[0])} to {percent(limits[1])})"


def _measure_table(tables: dict[str, Any], measure: str) -> Table:
    controllers = list(tables["controllers"])
    rows = [[name, *(_value(tables, measure, name, who) for who in controllers)] for name in tables[measure]]
    return Table([MEASURES[measure], *controllers], rows)


def _changes_table(tables: dict[str, Any]) -> list[Block] | None:
    """What became of the terrains between every two controllers."""
    rows = []
    for name, pairs in tables["differences"].items():
        for pair, found in pairs.items():
            counts = [f"{found[kind]['count']}" for kind in CHANGES]
            rows.append([f"{name}: {pair}", *counts, f"{found['compared']}"])
    if not rows:
        return None
    head = ["terrains", *(kind.replace("_", " ") for kind in CHANGES), "compared"]
    return [Text("Terrains that a controller fails, under half of its episodes reaching the goal, from the first "
                 "controller to the second:"), Table(head, rows)]  # fmt: skip


def before_after_section(shown: Shown) -> Section | None:
    """Two controllers' paths on the same terrains; None without tables."""
    if shown.changes is None:
        return None
    section = Section("The same terrain before and after", "before-after")
    if not shown.pairs:
        reason = shown.changes.reason or shown.not_crossed
        section.blocks.append(Absent(f"Left out. {reason} New tables are made by", _command(shown)))
        return section
    for change, (before, after) in shown.pairs.items():
        rates = {change.before: before.rates[_ARRIVED], change.after: after.rates[_ARRIVED]}
        told = ", ".join(f"{rate} with {who}" for who, rate in rates.items())
        text = (
            f"Elite {change.number}, {change.kind} from {change.before} to {change.after} by the tables; crossed again "
            f"from the same starts, robots that reached the goal: {told}."
        )
        maps = {f"{who}: {rate.hits} of {rate.count} reach the goal": crossed
                for (who, rate), crossed in zip(rates.items(), (before, after), strict=True)}  # fmt: skip
        title = f"{shown.material.archive.robot}, elite {change.number}: {change.before} and {change.after}"
        name = f"change-{change.number}"
        shows = f"Paths of {change.before} and of {change.after} on elite {change.number}"
        section.blocks += [Text(text), picture(name, draw_maps(maps, title), shows)]
    return section
