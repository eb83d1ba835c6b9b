"""The figure of minimal terrains: how many there are of each cause, and a gallery."""

from collections import Counter
from collections.abc import Mapping
from typing import Any

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

from qd.show.figures import relief
from sim.bank import terrains_of
from sim.files.figures import new_figure
from sim.files.intervals import value_words
from sim.maps.picture import LENGTH, WIDTH
from sim.spaces.base import TerrainSpace

_SHOWN = 12  # terrains of the gallery
_COLUMNS = 3


def draw_minimal(
    robot: str, numbers: dict[str, Any], genes: Mapping[int, NDArray[np.float32]], space: TerrainSpace
) -> Figure:
    """How many minimal terrains there are of each cause, and some from above, one of each cause first.

    ``numbers`` has at least one terrain, as ``minimal.json`` has them; ``genes`` of each, shape (num_genes,), by the
    number of the elite.
    """
    entries = numbers["elites"]
    causes = [entry["cause"]["kind"] if entry["cause"] else "unclear" for entry in entries]
    turns = [causes[:place].count(cause) for place, cause in enumerate(causes)]
    shown = np.argsort(turns, kind="stable")[:_SHOWN].tolist()
    rows, counts = -(-len(shown) // _COLUMNS), Counter(causes).most_common()
    figure = new_figure(13.0, 1.0 + 0.25 * len(counts) + 2.1 * rows)
    figure.suptitle(f"{robot}: {len(entries):,} minimal terrains; start yellow, goal green, blue low, brown high")
    parts_of_figure: Any = figure.subfigures(2, 1, height_ratios=(1.0 + 0.25 * len(counts), 2.1 * rows))
    bars, gallery = parts_of_figure
    axes = bars.subplots()
    drawn = axes.barh([cause for cause, _ in counts], [count for _, count in counts], color="#d55e00")
    axes.bar_label(drawn, padding=3)
    axes.invert_yaxis()
    axes.margins(x=0.08)
    axes.spines[["top", "right"]].set_visible(False)
    axes.set_xlabel("terrains by their cause")
    panels = gallery.subplots(rows, _COLUMNS, squeeze=False).ravel()
    grids, grounds = terrains_of(np.array([genes[entries[place]["elite"]] for place in shown]), space)
    for panel in panels[len(shown) :]:
        panel.set_axis_off()
    for k, (panel, place) in enumerate(zip(panels, shown, strict=False)):
        ground, entry = None if grounds is None else grounds[k : k + 1], entries[place]
        panel.imshow(relief(grids[k], ground), origin="lower", extent=(0.0, LENGTH, 0.0, WIDTH))
        parts = f"{len(entry['bumps'])} of {entry['of']} parts"
        arrive = value_words(entry["goal_rate"], None, ".0%")
        panel.set_title(f"elite {entry['elite']}: {causes[place]}, {parts}, {arrive} arrive", fontsize=9)
    return figure
