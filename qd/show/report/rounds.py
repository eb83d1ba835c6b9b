"""The page of a hardening: faults by round, rates by round, and what became of terrains."""

from pathlib import Path
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qd.evaluate.labels import SETS
from qd.evaluate.tables import as_tables
from qd.run.directory import ROUNDS_FILE
from qd.show.report.evaluation import MEASURES, by_kind, changes_tables, measure_table
from qd.show.report.material import check_page
from qd.show.report.page import (
    Block,
    Section,
    absent,
    at_a_glance,
    counted,
    origin_table,
    paragraph,
    picture,
    publish_page,
    table,
)
from sim.files.atomic import read_json
from sim.files.command import command_line
from sim.files.figures import bar_lengths, new_figure
from sim.files.records import without_machine
from sim.robots.find import get_robot

_COUNTS = ("elites", "failing", "confirmed", "certified", "faults")
_BARS = {"failing": ("#56b4e9", ""), "confirmed": ("#0072b2", "//"), "faults": ("#d55e00", "..")}
_LINES = (("#0072b2", "o"), ("#d55e00", "X"), ("#009e73", "s"), ("#cc79a7", "^"), ("#e69f00", "D"), ("#56b4e9", "v"),
          ("#000000", "P"))  # fmt: skip


def write_rounds(run: Path, robot: str | None, out: Path | None) -> Path:
    """Writes the page; returns its file."""
    content = _read(run, robot)
    out = out or run / "report.html"
    check_page(out)
    nothing_trained = absent("Nothing is trained yet: there are no two controllers to compare.")
    sections = [
        Section("Faults by round", "faults", _faults(content)),
        Section("Rates by round", "rates", _rates(content)),
        *_choices(content),
        Section("What became of terrains", "changes", changes_tables(content["tables"]) or [nothing_trained]),
        Section("Where this comes from", "origin", _origin(content, run)),
    ]
    lead = f"Made from {without_machine(str(run))}: a search for what breaks a controller, a training on it, and again."
    title = f"{content['robot']} hardened: {counted(len(content['rounds']) - 1, 'round')} of search and training"
    return publish_page(out, title, lead, sections)


def _read(run: Path, robot: str | None) -> dict[str, Any]:
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


def _faults(content: dict[str, Any]) -> list[Block]:
    """What each search found."""
    first, last = content["rounds"][0], content["rounds"][-1]
    glance = [
        (f"faults of {row['controller']}, in {_number(row.get('episodes'))} episodes", _number(row["faults"]))
        for row in ([first] if first is last else [first, last])
    ]
    text = (
        f"Each search is against one controller. A terrain is failing if under half of the robots reach the goal in 40 "
        "fresh episodes, confirmed if they do not with contact resolved either, and a fault if another controller "
        f"({', '.join(first['certifiers']) or 'nobody'}) crosses it. Two searches of one controller may find numbers "
        "of faults that differ several times over: read the counts beside the rates below."
    )
    head = ["controller", "search", "episodes", *_COUNTS, "others"]
    rows = [
        [row["controller"], row["search"], *(_number(row.get(key)) for key in ("episodes", *_COUNTS)),
         ", ".join(row["certifiers"])] for row in content["rounds"]
    ]  # fmt: skip
    shows = "Failing elites, those confirmed, and faults of the search against every controller"
    return [at_a_glance(glance), paragraph(text), picture("faults", draw_faults(content), shows), table(head, rows)]


def _number(count: int | None) -> str:
    return "-" if count is None else f"{count:,}"


def draw_faults(content: dict[str, Any]) -> Figure:
    """What the search against every controller found, as bars."""
    rows = content["rounds"]
    figure = new_figure(max(6.0, 1.5 * len(rows) + 2.0), 4.0)
    axes = figure.subplots()
    places, width = np.arange(len(rows)), 0.26
    for shift, (name, (colour, hatch)) in enumerate(_BARS.items(), start=-1):
        counts = [row.get(name) or 0 for row in rows]
        bars = axes.bar(places + width * shift, counts, width, color=colour, hatch=hatch, edgecolor="white", label=name)
        axes.bar_label(bars, [_number(row.get(name)) for row in rows], fontsize=8)
    axes.set_xticks(places, [row["controller"] for row in rows])
    axes.set_ylabel("terrains of the search's archive")
    axes.set_xlabel("controller that was searched")
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
    axes.legend(frameon=False, ncols=len(_BARS), loc="lower center", bbox_to_anchor=(0.5, 1.0))
    return figure


def _rates(content: dict[str, Any]) -> list[Block]:
    """Every controller on the fixed sets and on the archives."""
    tables = by_kind(content["tables"])
    text = (
        "Every controller on the same terrains from the same starts: hand-crafted and hard-random ones, and of each "
        "search elites that no training drew, though they may lie close to some that were. "
        f"{content['tables']['episodes']} episodes a terrain; intervals are 95 %, bootstrap over terrains. Elites were "
        "chosen because the controller of their own search struggled there: against that one another looks better "
        "by chance too."
    )
    shows = "Goal rate and rate without a base collision of every controller on every set with intervals"
    drawn = picture("rates", draw_rates(content), shows)
    return [paragraph(text), drawn, *(measure_table(tables, measure) for measure in MEASURES)]


def draw_rates(content: dict[str, Any]) -> Figure:
    """Goal rate and success of every controller: a line a set over the rounds."""
    figure = new_figure(12.0, 4.6)
    panels = figure.subplots(1, 2, sharex=True, sharey=True)
    for axes, measure in zip(panels, ("goal", "success"), strict=True):
        _draw_lines(axes, content["tables"], measure)
        axes.set_ylabel(f"{MEASURES[measure]} [%]")
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=4, frameon=False)
    return figure


def _draw_lines(axes: Axes, tables: dict[str, Any], measure: str) -> None:
    """Each set's rates with their intervals."""
    controllers = list(tables["controllers"])
    count = len(tables[measure])
    for k, (name, row) in enumerate(tables[measure].items()):
        colour, marker = _LINES[k % len(_LINES)]
        known = [place for place, controller in enumerate(controllers) if row[controller] is not None]
        rates = np.array([row[controllers[place]] for place in known])
        limits = [tables["intervals"][measure][name][controllers[place]] for place in known]
        values, lengths = 100.0 * rates, 100.0 * bar_lengths(rates, limits)
        places = np.array(known) + 0.06 * (k - (count - 1) / 2)
        label = SETS.get(name, f"{name}, held out")
        axes.errorbar(places, values, lengths, color=colour, marker=marker, capsize=3, label=label, linewidth=1.2)
    axes.set_xticks(range(len(controllers)), controllers, rotation=20 if len(controllers) > 5 else 0)
    axes.set_ylim(-3, 103)
    axes.grid(alpha=0.3)


def _choices(content: dict[str, Any]) -> list[Section]:
    """Which trainings were kept; nothing where all of them were kept unasked."""
    choices = content.get("choices", {})
    if not choices:
        return []
    text = (
        "After each training the controller reached the goal on validation terrains, which are not those reported, "
        "this often: the mean of hand-crafted ones, hard-random ones, and elites of the archives trained on. A "
        "controller that is worse there than the one before, or on ordinary terrains more than a point worse than the "
        "base, is not kept. The next training then begins with the one before."
    )
    rows = [[name, "kept" if choice["kept"] else "not kept", choice["why"]] for name, choice in choices.items()]
    blocks = [paragraph(text), table(["training", "", "why"], rows, words=True)]
    return [Section("Which trainings were kept", "choices", blocks)]


def _origin(content: dict[str, Any], run: Path) -> list[Block]:
    """Where the numbers come from, and how to look closer."""
    closer = [without_machine(command_line("report", run=run / row["search"])) for row in content["rounds"]]
    return [
        paragraph(f"The numbers are those of {run / ROUNDS_FILE}. It was begun with:"),
        table(["", ""], origin_table(content), words=True),
        paragraph(f"Each search has a page of its own: {', '.join(f'`{command}`' for command in closer)}."),
    ]
