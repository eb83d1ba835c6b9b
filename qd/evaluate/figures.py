"""The figure of doses."""

from collections.abc import Mapping
from typing import Any

from matplotlib.figure import Figure

from qd.fitness import FAILING_GOAL_RATE
from sim.files.figures import new_figure

_DOSE_COLUMNS = 4
# Of controllers, in order: the colours are Okabe and Ito's, which are apart for every kind of colour blindness.
_COLOURS = ("#000000", "#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00")
_MARKERS = ("o", "s", "^", "v", "P", "X", "<", ">", "p")


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
