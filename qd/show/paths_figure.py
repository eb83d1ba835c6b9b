"""A terrain from above with the paths of the robots that crossed it."""

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from qd.show.figures import new_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sim.rollout import RolloutResult

_LENGTH, _WIDTH = 16.0, 8.0  # of a terrain [m]


def draw_paths(heights: NDArray[np.float32], result: "RolloutResult", title: str) -> "Figure":
    """The height map of a terrain with the robots' paths, and marks where they ended, by how.

    Args:
        heights: [m], shape (nrow, ncol).
        result: Crossings of that terrain alone; without paths, their ends are drawn.
        title: Over the figure.
    """
    figure = new_figure(11.0, 6.2)
    axes = figure.subplots()
    image = axes.imshow(heights, origin="lower", extent=(0.0, _LENGTH, 0.0, _WIDTH), cmap="gray", alpha=0.9)
    figure.colorbar(image, ax=axes, label="height [m]", shrink=0.7)
    paths = result.paths
    ends = _ends(result)
    for label, (color, marker, chosen) in ends.items():
        for k in np.flatnonzero(chosen):
            if paths is not None:
                axes.plot(paths[0, k, :, 0], paths[0, k, :, 1], color=color, linewidth=0.9, alpha=0.8)
        end = result.final_position[0, chosen]
        label = f"{label} ({len(end)})"
        axes.scatter(end[:, 0], end[:, 1], color=color, marker=marker, s=55, edgecolors="white", label=label, zorder=3)
    axes.plot(2.0, 4.0, marker=">", color="white", markeredgecolor="black", markersize=11, linestyle="", label="start")
    axes.plot(14.0, 4.0, marker="*", color="white", markeredgecolor="black", markersize=16, linestyle="", label="goal")
    axes.set_title(title)
    axes.set_xlabel("x [m]")
    axes.set_ylabel("y [m]")
    axes.set_xlim(min(0.0, axes.get_xlim()[0]), max(_LENGTH, axes.get_xlim()[1]))
    axes.set_aspect("equal")
    figure.legend(loc="outside lower center", ncols=6, frameon=False)
    return figure


def _ends(result: "RolloutResult") -> dict[str, tuple[str, str, NDArray[np.bool_]]]:
    """Label, colour, marker and episodes of each way to end that happened."""
    from qd.show.endings import ENDINGS  # with Warp, which takes a moment

    chosen = {ending: result.outcome[0] == outcome for outcome, ending in ENDINGS.items()}
    return {ending.words: (ending.color, ending.marker, mask) for ending, mask in chosen.items() if mask.any()}
