"""A height map as a picture."""

from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from sim.crossing import CrossingCfg

if TYPE_CHECKING:
    from matplotlib.axes import Axes

LENGTH, WIDTH = 16.0, 8.0
"""Of a terrain [m]."""
_WHITE: dict[str, Any] = {"color": "white", "markeredgecolor": "black", "linestyle": "", "zorder": 4}
START: dict[str, Any] = {"marker": ">", "markersize": 11, "label": "start", **_WHITE}
GOAL: dict[str, Any] = {"marker": "*", "markersize": 16, "label": "goal", **_WHITE}
"""How start and goal are marked."""


def draw_heights(axes: "Axes", heights: NDArray[np.float32], limits: tuple[float, float] | None = None) -> Any:
    """A height map from above with start and goal; returns the image.

    Args:
        axes: Where.
        heights: Of a terrain [m], shape (nrow, ncol).
        limits: Heights of the darkest and the lightest grey [m]; those of the terrain.
    """
    from matplotlib.colors import LinearSegmentedColormap

    low, high = limits or (float(heights.min()), float(heights.max()))
    greys = LinearSegmentedColormap.from_list("greys", ["0.45", "1.0"])  # light enough for every colour of a path
    image = axes.imshow(
        heights, origin="lower", extent=(0.0, LENGTH, 0.0, WIDTH), cmap=greys, vmin=low, vmax=max(high, low + 0.05)
    )
    for place, look in ((CrossingCfg.start, START), (CrossingCfg.goal, GOAL)):
        axes.plot(*place, **look)
    axes.set_ylabel("y [m]")
    axes.set_aspect("equal")
    return image
