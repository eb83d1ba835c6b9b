"""Figures of evaluations: tables and doses."""

from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure

from qd.evaluate.labels import SETS
from qd.fitness import FAILING_GOAL_RATE
from sim.files.figures import bar_lengths, new_figure
from sim.policy.spec import firsts, kind_of

_PANELS = {
    "goal": ("goal reached\n[% of episodes]", 100.0),
    "success": ("no base collision\n[% of episodes]", 100.0),
    "reward": ("training reward\n[sum over 20 s]", 1.0),
}
_DOSE_COLUMNS = 4
# Of controllers, in order: the colours are Okabe and Ito's, which are apart for every kind of colour blindness.
_COLOURS = ("#000000", "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
_MARKERS = ("o", "s", "^", "v", "P", "X", "<", ">", "p")


def draw_tables(report: Mapping[str, Any]) -> Figure:
    """Goal rate, no base collision and reward of all controllers by set, with intervals; seeds of a kind look alike."""
    figure, controllers = new_figure(13.0, 4.2), list(report["controllers"])
    kinds = [kind_of(first) for first in firsts(controllers)]
    step = min(0.16, 0.7 / len(controllers))
    for panel, (measure, (label, factor)) in enumerate(_PANELS.items(), 1):
        axes, sets = figure.add_subplot(1, len(_PANELS), panel), list(report[measure])
        for number, controller in enumerate(controllers):
            place = kinds.index(kind_of(controller))
            means = np.array([report[measure][name][controller] for name in sets], np.float64)
            limits = [report["intervals"][measure][name][controller] for name in sets]
            axes.errorbar(
                np.arange(len(sets)) + step * (number - (len(controllers) - 1) / 2),
                factor * means, factor * bar_lengths(means, limits), linestyle="", capsize=3,
                marker=_MARKERS[place % len(_MARKERS)], color=_COLOURS[place % len(_COLOURS)],
                label=kinds[place] if controller in firsts(controllers) else "",
            )  # fmt: skip
        labels = [str(SETS.get(name, name)).replace(", ", ",\n") for name in sets]
        axes.set_xticks(range(len(sets)), labels, fontsize=8.5)
        axes.set_xlim(-0.5, len(sets) - 0.5)
        axes.grid(axis="y", alpha=0.3)
        axes.set_ylabel(label)
    part = ", validation" if report.get("part") == "validation" else ""
    figure.suptitle(f"{report['robot']}{part}: {report['episodes']} episodes on each terrain, 95 % intervals")
    handles = figure.axes[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=8, frameon=False)
    return figure


def draw_dose(report: Mapping[str, Any]) -> Figure:
    """Goal rate over the dose with its interval, small axes an element, a line a controller; harder is to the right."""
    elements = list(report["titles"])
    columns = min(_DOSE_COLUMNS, len(elements))
    rows = -(-len(elements) // columns)
    figure = new_figure(max(6.0, 3.3 * columns), 1.0 + 2.5 * rows)
    contact = "contact resolved" if report["resolved"] else "at the search's settings"
    figure.suptitle(f"{report['robot']}: robots that reach the goal, {contact}, with 95 % intervals")
    panels = [figure.add_subplot(rows, columns, place + 1) for place in range(len(elements))]
    for axes, element in zip(panels, elements, strict=True):
        of_element = [row for row in report["dose"] if row["element"] == element]
        for number, controller in enumerate(report["controllers"]):
            known = [row for row in of_element if row["controller"] == controller and row["goal_rate"] is not None]
            values = [row["value"] for row in known]
            colour, marker = _COLOURS[number % len(_COLOURS)], _MARKERS[number % len(_MARKERS)]
            rates = [100.0 * row["goal_rate"] for row in known]
            axes.plot(values, rates, label=controller, color=colour, marker=marker, markersize=4)
            low, high = ([100.0 * row["interval"][end] for row in known] for end in (0, 1))
            axes.fill_between(values, low, high, color=colour, alpha=0.15, linewidth=0)
        first, last = of_element[0], of_element[-1]
        title, _, others = report["titles"][element].partition(", ")
        axes.set_title(f"{title}\n{others}", fontsize=9)
        axes.set_xlabel(f"{first['parameter']} [{first['unit']}]" if first["unit"] else first["parameter"], fontsize=8)
        axes.set_ylim(-3, 103)
        axes.axhline(100.0 * FAILING_GOAL_RATE, color="0.7", linewidth=0.8, zorder=0)
        axes.tick_params(labelsize=8)
        if first["value"] > last["value"]:
            axes.invert_xaxis()
    for axes in panels[::columns]:
        axes.set_ylabel("reach the goal [%]", fontsize=8)
    handles = panels[0].get_legend_handles_labels()
    figure.legend(*handles, loc="outside lower center", ncols=len(report["controllers"]), frameon=False)
    return figure
