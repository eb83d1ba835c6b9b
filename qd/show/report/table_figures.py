"""The evaluation's tables as a figure."""

from typing import TYPE_CHECKING, Any

import numpy as np

from qd.show.figures import new_figure
from qd.show.report.tables import LABELS, MEASURES

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

# Okabe and Ito's colours, apart for every kind of colour blindness; markers tell them apart in grey too.
_LOOKS = (("#000000", "o"), ("#0072b2", "s"), ("#e69f00", "^"), ("#009e73", "v"), ("#cc79a7", "P"), ("#56b4e9", "X"),
          ("#d55e00", "D"))  # fmt: skip


def draw_tables(tables: dict[str, Any]) -> "Figure":
    """Success, goal rate and reward of every controller by set, with 95 % intervals over terrains.

    Args:
        tables: As :func:`qd.show.report.tables.by_kind` gives them.
    """
    figure = new_figure(13.0, 4.4)
    for axes, (measure, label) in zip(figure.subplots(1, 3), MEASURES.items(), strict=True):
        _draw_measure(axes, tables, measure)
        axes.set_ylabel(f"{label}\n{'[sum over 20 s]' if measure == 'reward' else '[% of episodes]'}")
    figure.legend(*figure.axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=7, frameon=False)
    return figure


def _draw_measure(axes: "Axes", tables: dict[str, Any], measure: str) -> None:
    names: list[str] = list(tables[measure])
    controllers = list(tables["controllers"])
    factor = 1.0 if measure == "reward" else 100.0
    step = min(0.16, 0.7 / len(controllers))
    for index, who in enumerate(controllers):
        there = [place for place, name in enumerate(names) if tables[measure][name][who] is not None]
        values = factor * np.array([tables[measure][names[place]][who] for place in there])
        rows = [tables["intervals"][measure][names[place]][who] for place in there]
        limits = np.array([row or 2 * [value] for row, value in zip(rows, values / factor, strict=True)]).reshape(-1, 2)
        limits *= factor
        lengths = np.maximum([values - limits[:, 0], limits[:, 1] - values], 0.0)  # equal limits may be off by rounding
        shift = step * (index - (len(controllers) - 1) / 2)
        colour, marker = _LOOKS[index % len(_LOOKS)]
        style = {"linestyle": "", "marker": marker, "color": colour, "capsize": 3, "label": who}
        axes.errorbar(np.array(there) + shift, values, lengths, **style)
    labels = [LABELS.get(name, name).replace(", ", ",\n").replace("-", "-\n") for name in names]
    axes.set_xticks(range(len(names)), labels)
    axes.set_xlim(-0.5, len(names) - 0.5)
    axes.grid(axis="y", alpha=0.3)
