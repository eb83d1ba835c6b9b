"""A height map as a picture."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from numpy.typing import NDArray

from sim.crossing import CrossingCfg
from sim.ground import LEAST_FRICTION, LEAST_TIME_CONSTANT_S, MOST_TIME_CONSTANT_S, PATCHES, GroundMaps, patches_at
from sim.terrain import NUM_COLS, NUM_ROWS

LENGTH, WIDTH = 16.0, 8.0
"""Of a terrain [m]."""
_WHITE: dict[str, Any] = {"color": "white", "markeredgecolor": "black", "linestyle": "", "zorder": 4}
START: dict[str, Any] = {"marker": ">", "markersize": 11, "label": "start", **_WHITE}
GOAL: dict[str, Any] = {"marker": "*", "markersize": 16, "label": "goal", **_WHITE}
"""How start and goal are marked."""

SLIPPERY, SOFT = (0.0, 0.68, 0.68), (0.55, 0.25, 0.75)
"""RGB (0 to 1) that slippery and soft patches are tinted with."""
_TINT = 0.5  # share of the tint where a patch is as slippery or soft as can be


def _ground_tint(ground: GroundMaps) -> NDArray[np.float64]:
    """Tint of a terrain's patches, the stronger the more slippery or soft they are; RGBA, shape (rows, cols, 4)."""
    slippery = (1.0 - ground.friction[0].astype(np.float64)) / (1.0 - LEAST_FRICTION)
    tau = np.maximum(ground.time_constant_s[0].astype(np.float64), LEAST_TIME_CONSTANT_S)
    soft = np.log(tau / LEAST_TIME_CONSTANT_S) / np.log(MOST_TIME_CONSTANT_S / LEAST_TIME_CONSTANT_S)
    both = np.stack([slippery, soft], axis=-1)
    share = both / np.maximum(both.sum(axis=-1, keepdims=True), 1e-9)
    return np.concatenate([share @ np.array([SLIPPERY, SOFT]), _TINT * both.max(axis=-1, keepdims=True)], axis=-1)


def tinted(colors: NDArray[np.float64], ground: GroundMaps, margin: int = 0) -> NDArray[np.float64]:
    """Colours of a terrain's nodes or cells, RGB (0 to 1), shape (rows, columns, 3), with the tint of its ground.

    ``margin`` nodes of them on each side are not of the terrain.
    """
    row, col = (
        patches_at(np.arange(count) - margin, nodes - 1, patches)
        for count, patches, nodes in zip(colors.shape[:2], PATCHES, (NUM_ROWS, NUM_COLS), strict=True)
    )
    tint = _ground_tint(ground)[row[:, None], col]
    return colors + tint[..., 3:] * (tint[..., :3] - colors)


def draw_heights(
    axes: Axes,
    heights: NDArray[np.float32],
    limits: tuple[float, float] | None = None,
    ground: GroundMaps | None = None,
) -> Any:
    """Heights [m], shape (nrow, ncol), from above with start and goal, tinted by the ground; returns the image.

    The limits are the heights of the darkest and the lightest grey [m]; the terrain's if left out.
    """
    low, high = limits or (float(heights.min()), float(heights.max()))
    greys = LinearSegmentedColormap.from_list("greys", ["0.45", "1.0"])  # light enough for every colour of a path
    image = axes.imshow(
        heights, origin="lower", extent=(0.0, LENGTH, 0.0, WIDTH), cmap=greys, vmin=low, vmax=max(high, low + 0.05)
    )
    if ground is not None:
        axes.imshow(_ground_tint(ground), origin="lower", extent=(0.0, LENGTH, 0.0, WIDTH), interpolation="nearest")
    for place, look in ((CrossingCfg.start, START), (CrossingCfg.goal, GOAL)):
        axes.plot(*place, **look)
    axes.set_ylabel("y [m]")
    axes.set_aspect("equal")
    return image
