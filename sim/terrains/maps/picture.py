"""A height map as a picture."""

from typing import Any

import numpy as np
from matplotlib.axes import Axes
from matplotlib.colors import LinearSegmentedColormap
from numpy.typing import NDArray

from kernels.episode import Kind
from kernels.ground import MAX_TIME_CONSTANT_S, MIN_FRICTION, MIN_TIME_CONSTANT_S, PATCHES
from sim.crossing import CrossingCfg
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.terrains import GroundMaps, asked_of, patch_index

LENGTH, WIDTH = 16.0, 8.0
"""Of a terrain [m]."""
_WHITE: dict[str, Any] = {"color": "white", "markeredgecolor": "black", "linestyle": "", "zorder": 4}
MARKS: dict[str, dict[str, Any]] = {
    "start": {"marker": ">", "markersize": 11, "label": "start", **_WHITE},
    "goal": {"marker": "*", "markersize": 16, "label": "goal", **_WHITE},
}
"""How :func:`places` are marked."""
_PALE = 0.6  # opacity of a map

HEIGHTS = LinearSegmentedColormap.from_list("heights", [(0.36, 0.50, 0.66), (0.80, 0.79, 0.74), (0.70, 0.44, 0.27)])
"""Blue below the level of the start, brown above."""
_LEAST_RANGE = 0.3  # [m]: lower ground is not painted as if it were mountains

SLIPPERY, SOFT = (0.0, 0.55, 0.60), (0.55, 0.25, 0.75)
"""RGB (0 to 1) of the lines over slippery and over soft patches."""
_LINES_EVERY, _LINE = 8, 2  # nodes from line to line, and of a line
_FAINT, _STRONG, _WASH = 0.3, 0.75, 0.1  # opacity of lines over nearly usual and over the worst ground, and between


def height_colors(heights: NDArray[np.floating]) -> NDArray[np.float64]:
    """RGB (0 to 1) of heights [m], the strongest at the one farthest from 0; a last axis of 3 more than theirs."""
    return HEIGHTS(0.5 + 0.5 * heights / _range_of(heights))[..., :3]


def _range_of(heights: NDArray[np.floating]) -> float:
    return max(float(np.abs(heights).max()), _LEAST_RANGE)


def ground_lines(ground: GroundMaps, rows: int, columns: int, margin: int = 0) -> NDArray[np.float64]:
    """Diagonal lines over slippery patches, lines along y over soft ones: RGBA of nodes or cells, (rows, columns, 4).

    They are the stronger the more slippery or soft a patch is, and leave its height to be seen. ``margin`` nodes on
    each side are not of the terrain.
    """
    patch_row, patch_column = (
        patch_index(np.arange(count) - margin, nodes - 1, patches)
        for count, patches, nodes in zip((rows, columns), PATCHES, (NUM_ROWS, NUM_COLS), strict=True)
    )
    slippery = (1.0 - ground.friction[0].astype(np.float64)) / (1.0 - MIN_FRICTION)
    tau = np.maximum(ground.time_constant_s[0].astype(np.float64), MIN_TIME_CONSTANT_S)
    soft = np.log(tau / MIN_TIME_CONSTANT_S) / np.log(MAX_TIME_CONSTANT_S / MIN_TIME_CONSTANT_S)
    strength = np.stack([slippery, soft], axis=-1)[patch_row[:, None], patch_column]
    row, column = np.ogrid[:rows, :columns]
    on_line = np.stack([(row + column) % _LINES_EVERY < _LINE, (0 * row + column) % _LINES_EVERY < _LINE], axis=-1)
    opacity = np.where(on_line, _FAINT + (_STRONG - _FAINT) * strength, _WASH) * (strength > 0.0)
    share = opacity / np.maximum(opacity.sum(axis=-1, keepdims=True), 1e-9)
    return np.concatenate([share @ np.array([SLIPPERY, SOFT]), opacity.max(axis=-1, keepdims=True)], axis=-1)


def tinted(colors: NDArray[np.float64], ground: GroundMaps, margin: int = 0) -> NDArray[np.float64]:
    """Colours of nodes or cells, RGB (0 to 1), shape (rows, columns, 3), under the lines of their ground."""
    lines = ground_lines(ground, colors.shape[0], colors.shape[1], margin)
    return colors + lines[..., 3:] * (lines[..., :3] - colors)


def places(asks: Kind) -> dict[str, tuple[float, float]]:
    """``start``, and ``goal`` where robots are asked for one, world-local x and y [m]."""
    return {"start": CrossingCfg.start} | ({"goal": CrossingCfg.goal} if asks == Kind.CROSS else {})


def draw_heights(axes: Axes, heights: NDArray[np.float32], ground: GroundMaps | None = None) -> Any:
    """Heights [m], shape (nrow, ncol), from above with :func:`places` and the lines of its ground; returns the image.

    Colours are those of the ground in other pictures, paler, so that paths are seen on them.
    """
    most = _range_of(heights)
    where: dict[str, Any] = {"origin": "lower", "extent": (0.0, LENGTH, 0.0, WIDTH)}
    image = axes.imshow(heights, cmap=HEIGHTS, vmin=-most, vmax=most, alpha=_PALE, **where)
    if ground is not None:
        axes.imshow(ground_lines(ground, heights.shape[0], heights.shape[1]), interpolation="nearest", **where)
    for name, place in places(asked_of(ground)).items():
        axes.plot(*place, **MARKS[name])
    axes.set_ylabel("y [m]")
    axes.set_aspect("equal")
    return image
