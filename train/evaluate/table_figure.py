"""The tables as a figure, with the paper's own numbers beside ours."""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from sim.files.atomic import write_atomically
from sim.policy.spec import kind_of
from train.evaluate.seeds import firsts
from train.evaluate.table_print import published_value

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

SET_LABELS = {
    "hand_crafted": "hand-crafted",
    "hard_random": "hard-random",
    "generated": "generated,\nheld out",
    "generated_far": "generated,\nfarthest third",
}
"""Sets as axis labels."""

_PANELS = {
    "success": ("success: no base collision\n[% of episodes]", 100.0),
    "goal": ("goal reached\n[% of episodes]", 100.0),
    "reward": ("training reward\n[sum over 20 s]", 1.0),
}
# Okabe and Ito's colours, apart for every kind of colour blindness; markers tell them apart in grey too.
_COLOURS = ("#000000", "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
_MARKERS = ("o", "s", "^", "v", "P", "X", "<", ">", "p")
_CHANGES = {"mended": "#0072b2", "still_failing": "#bbbbbb", "newly_broken": "#d55e00"}
_PAPER_LABEL = "of that name in the paper"


def write_figure(path: Path, report: dict[str, Any]) -> None:
    """Draw the tables and write them as PNG, atomically.

    Args:
        path: File to write.
        report: As ``tables.json`` has it.
    """
    buffer = io.BytesIO()
    draw_tables(report).savefig(buffer, format="png", dpi=150)
    write_atomically(path, buffer.getvalue())


def draw_tables(report: dict[str, Any]) -> "Figure":
    """Success, goal rate and reward of every controller by set with 95 % intervals, and what became of terrains.

    Args:
        report: As ``tables.json`` has it.
    """
    from matplotlib.figure import Figure

    pairs = _pairs_from_first(report)
    figure = Figure(figsize=(11.5, 8.0) if pairs else (13.0, 4.2), layout="constrained")
    panels = np.ravel(figure.subplots(2, 2) if pairs else figure.subplots(1, 3))
    for axes, (measure, (label, factor)) in zip(panels, _PANELS.items(), strict=False):
        _draw_measure(axes, report, measure, factor)
        axes.set_ylabel(label)
    if pairs:
        _draw_changes(panels[3], report, pairs)
    sizes = "; ".join(f"{_on_one_line(name)}: {count}" for name, count in report["terrains"].items())
    title = f"{report['robot']}: {report['episodes']} episodes on each terrain, 95 % intervals over terrains"
    figure.suptitle(f"{title}\nterrains: {sizes}", fontsize=11)
    figure.legend(handles=_legend(panels[0]), loc="outside lower center", ncols=8, frameon=False)
    return figure


def _legend(axes: "Axes") -> list[Any]:
    """The controllers of a panel, and what a hollow diamond is if there is one."""
    from matplotlib.lines import Line2D

    handles, labels = axes.get_legend_handles_labels()
    ours = [handle for handle, label in zip(handles, labels, strict=True) if label != _PAPER_LABEL]
    if _PAPER_LABEL in labels:
        style = {"marker": "D", "markersize": 9, "markerfacecolor": "none", "color": "0.4", "linestyle": ""}
        ours.append(Line2D([], [], label=_PAPER_LABEL, **style))
    return ours


def _on_one_line(name: str) -> str:
    return SET_LABELS[name].replace("\n", " ")


def _draw_measure(axes: "Axes", report: dict[str, Any], measure: str, factor: float) -> None:
    """Points of all controllers side by side over each set."""
    names = list(report[measure])
    controllers = list(report[measure][names[0]])
    kinds = firsts(controllers)
    step = min(0.16, 0.7 / len(controllers))
    for index, who in enumerate(controllers):
        shift = step * (index - (len(controllers) - 1) / 2)
        kind = [kind_of(first) for first in kinds].index(kind_of(who))  # other seeds look like the first one
        colour, marker = _COLOURS[kind % len(_COLOURS)], _MARKERS[kind % len(_MARKERS)]
        there = [place for place, name in enumerate(names) if report[measure][name][who] is not None]
        values = factor * np.array([report[measure][names[place]][who] for place in there])
        limits = factor * np.array([report["intervals"][measure][names[place]][who] for place in there]).reshape(-1, 2)
        lengths = np.maximum([values - limits[:, 0], limits[:, 1] - values], 0.0)  # equal limits may be off by rounding
        places = np.array(there) + shift
        label = _label(kind_of(who), controllers) if who in kinds else ""
        axes.errorbar(places, values, lengths, linestyle="", marker=marker, color=colour, capsize=3, label=label)
        paper = [published_value(report, measure, name, who) for name in names]
        known = [place for place, value in enumerate(paper) if value is not None]
        if known:
            heights = [factor * value for value in paper if value is not None]
            style = {"markersize": 10, "markerfacecolor": "none", "color": colour}
            axes.plot(np.array(known) + shift, heights, "D", label=_PAPER_LABEL, **style)
    axes.set_xticks(range(len(names)), [SET_LABELS[name] for name in names])
    axes.set_xlim(-0.5, len(names) - 0.5)
    axes.grid(axis="y", alpha=0.3)


def _label(kind: str, controllers: Sequence[str]) -> str:
    seeds = [kind_of(who) for who in controllers].count(kind)
    return kind if seeds == 1 else f"{kind} ({seeds} seeds)"


def _pairs_from_first(report: dict[str, Any]) -> list[str]:
    """Differences of every other controller from the first one."""
    first = next(iter(report["controllers"]))
    return [pair for pair in next(iter(report["differences"].values())) if pair.startswith(f"{first} -> ")]


def _draw_changes(axes: "Axes", report: dict[str, Any], pairs: Sequence[str]) -> None:
    """Share of the terrains that are mended, still failing or newly broken: one bar a controller, set by set."""
    names = list(report["differences"])
    rows = [(name, pair) for name in names for pair in pairs]
    places = [place + 1 + place // len(pairs) for place in range(len(rows))]  # a line for each set's name
    left = np.zeros(len(rows))
    for kind, colour in _CHANGES.items():
        shares = np.array([100.0 * (report["differences"][name][pair][kind]["share"] or 0.0) for name, pair in rows])
        axes.barh(places, shares, left=left, color=colour, label=kind.replace("_", " "))
        left += shares
    for k, name in enumerate(names):
        axes.annotate(
            _on_one_line(name), (0.0, k * (len(pairs) + 1)), xytext=(3, 0), textcoords="offset points", va="center",
            fontsize=9,
        )  # fmt: skip
    first, _, _ = pairs[0].partition(" -> ")
    axes.set_yticks(places, [pair.partition(" -> ")[2] for _, pair in rows], fontsize=8)
    axes.set_ylim(max(places) + 0.7, -0.7)
    axes.set_xlabel(
        f"failed terrains, held against {first} [% of terrains]\n(under half of the episodes reach the goal)"
    )
    axes.set_xlim(left=0)
    axes.legend(frameon=False, fontsize=8, loc="best")
    axes.grid(axis="x", alpha=0.3)
    axes.set_axisbelow(True)
