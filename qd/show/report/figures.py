"""The figure of the failure modes.

Okabe and Ito's colours, apart for every kind of colour blindness; markers and hatches tell the same apart in grey.
"""

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qd.groups import TOLERANCE, Elites, Modes
from qd.show.figures import label_of, look_of
from sim.files.figures import new_figure

_ENDS = (("goal_rate", "goal", "#009e73", "o"), ("collision_rate", "base collision", "#d55e00", "X"),
         ("other_rate", "stuck, late or off", "#0072b2", "s"))  # fmt: skip


def draw_modes(elites: Elites, modes: Modes) -> Figure:
    """The failure modes: their mean shares, how their crossings end, and how well divisions separate."""
    figure = new_figure(12.0, max(3.4, 0.5 * len(modes.modes) + 2.2))
    left, middle, right = figure.subplots(1, 3, width_ratios=(1.5, 1.2, 0.9))
    places = np.arange(len(modes.modes))
    start = np.zeros(len(places))
    for column, penalty in enumerate(elites.penalties):
        shares = 100.0 * np.array([mode.ratios[column] for mode in modes.modes])
        left.barh(places, shares, left=start, label=label_of(penalty), **look_of(penalty).bar)
        start += shares
    for shift, (name, label, colour, marker) in zip((-0.22, 0.0, 0.22), _ENDS, strict=True):
        rates = [100.0 * getattr(mode, name) for mode in modes.modes]
        middle.plot(
            rates, places + shift, linestyle="", marker=marker, markersize=8, color=colour, label=label, alpha=0.9
        )
    names = [f"mode {mode.number}: {mode.ending}\n{len(mode.members):,} elites" for mode in modes.modes]
    left.set_yticks(places, names)
    middle.set_yticks(places, [])
    for axes, label in ((left, "mean share of the penalties [%]"), (middle, "mean share of the crossings [%]")):
        axes.set_ylim(len(places) - 0.5, -0.5)
        axes.set_xlabel(label)
        axes.grid(axis="x", alpha=0.3)
        axes.set_axisbelow(True)
        for place in places[1:]:
            axes.axhline(place - 0.5, color="0.85", linewidth=0.8, zorder=0)
        axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), ncols=2 if axes is left else 1, frameon=False,
                    fontsize=9)  # fmt: skip
    left.set_xlim(0, 100)
    middle.set_xlim(-3, 103)
    _draw_silhouettes(right, modes)
    return figure


def _draw_silhouettes(axes: Axes, modes: Modes) -> None:
    axes.set_xlabel("number of modes")
    axes.set_ylabel("mean silhouette")
    if not modes.silhouettes:
        axes.text(
            0.5, 0.5, "too few or too equal\nelites to divide", ha="center", va="center", transform=axes.transAxes
        )
        axes.set(xticks=[], yticks=[])
        return
    counts, values = list(modes.silhouettes), list(modes.silhouettes.values())
    axes.plot(counts, values, color="#0072b2", marker="o", label="of each number")
    chosen = len(modes.modes)
    style = {"markersize": 15, "markerfacecolor": "none", "color": "#d55e00", "markeredgewidth": 2}
    axes.plot(chosen, modes.silhouettes[chosen], "o", label="taken", **style)
    axes.axhline(max(values) - TOLERANCE, color="0.4", linestyle="--", label=f"best less {TOLERANCE}")
    axes.set_xticks(counts)
    axes.set_ylim(bottom=min(0.0, *values))
    axes.grid(alpha=0.3)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.2), frameon=False, fontsize=9)
