"""The figure of minimal terrains: how many parts a failure takes, and a gallery."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from numpy.typing import NDArray

from sim.bank import terrains_of
from sim.files.figures import new_figure
from sim.maps.picture import draw_heights
from sim.spaces.base import TerrainSpace

_SHOWN = 12  # terrains of the gallery
_COLUMNS = 3
_COLORS = ("#0072b2", "#e69f00", "#009e73", "#cc79a7", "#56b4e9", "#d55e00", "#f0e442", "#999999")


def draw_minimal(
    robot: str, numbers: dict[str, Any], genes: Mapping[int, NDArray[np.float32]], space: TerrainSpace
) -> Figure:
    """How many parts failures take, by the kind of the cause, and some minimal terrains from above.

    Of every kind of cause the gallery has one terrain before it has a second of another.

    ``numbers`` has at least one terrain, as ``minimal.json`` has them; ``genes`` of each, shape (num_genes,), by the
    number of the elite.
    """
    entries = numbers["elites"]
    shown = _gallery(entries)[:_SHOWN]
    rows = -(-len(shown) // _COLUMNS)
    figure = new_figure(13.0, 3.2 + 2.3 * rows)
    figure.suptitle(f"{robot}: {len(entries):,} minimal terrains")
    grid = figure.add_gridspec(rows + 1, _COLUMNS, height_ratios=(1.3, *[1.0] * rows))
    _draw_histogram(figure.add_subplot(grid[0, :]), numbers)
    heights, maps = terrains_of(np.array([genes[entry["elite"]] for entry in shown]), space)
    most = float(np.abs(heights).max())
    panels = [figure.add_subplot(grid[1 + place // _COLUMNS, place % _COLUMNS]) for place in range(len(shown))]
    for place, (axes, entry) in enumerate(zip(panels, shown, strict=True)):
        image = draw_heights(axes, heights[place], most, None if maps is None else maps[place : place + 1])
        kind = entry["cause"]["kind"] if entry["cause"] else "no part"
        parts = f"{len(entry['bumps'])} of {entry['of']} parts"
        axes.set_title(f"elite {entry['elite']}: {parts}, {kind}, {entry['goal_rate']:.0%} arrive", fontsize=9)
    figure.colorbar(image, ax=panels, label="height [m]", shrink=0.8, pad=0.01)
    return figure


def _gallery(entries: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """The entries, the first of each kind of cause first."""
    seen, turns = Counter(), []
    for entry in entries:
        kind = entry["cause"]["kind"] if entry["cause"] else ""
        seen[kind] += 1
        turns.append(seen[kind])
    return [entries[place] for place in np.argsort(turns, kind="stable")]


def _draw_histogram(axes: Axes, numbers: dict[str, Any]) -> None:
    """Terrains by the number of their parts, stacked by the kind of the cause."""
    entries = numbers["elites"]
    sizes = np.arange(max(len(entry["bumps"]) for entry in entries) + 1)
    bottom = np.zeros(len(sizes))
    kinds = [kind for kind, _ in Counter((entry["cause"] or {}).get("kind") for entry in entries).most_common()]
    for place, kind in enumerate(kinds):
        of_kind = [len(entry["bumps"]) for entry in entries if (entry["cause"] or {}).get("kind") == kind]
        counts = np.bincount(of_kind, minlength=len(sizes))
        color, hatch = _COLORS[place % len(_COLORS)], "//" * (place // len(_COLORS))
        label = f"{kind or 'no part'} ({len(of_kind)})"
        axes.bar(sizes, counts, bottom=bottom, label=label, color=color, hatch=hatch, edgecolor="white")
        bottom += counts
    axes.set_xticks(sizes)
    axes.set_xlabel("parts that a failure takes")
    axes.set_ylabel("terrains")
    locator: Any = axes.yaxis.get_major_locator()
    locator.set_params(integer=True)
    axes.set_xlim(-0.6, 1.3 * len(sizes))  # with room for the legend
    axes.legend(title="cause", frameon=False, loc="center right")
    axes.grid(axis="y", alpha=0.3)
    axes.set_axisbelow(True)
