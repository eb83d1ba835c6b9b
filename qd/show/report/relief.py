"""Small pictures of terrains from above, one for every elite of a page."""

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sim.bank import terrains_of
from sim.crossing import CrossingCfg
from sim.ground import GroundMaps
from sim.maps.picture import tinted
from sim.recording.scene import height_colors
from sim.spaces.base import TerrainSpace
from sim.terrain import SPACING

_AT_ONCE = 50  # height maps that are made at once
_FEW = 1_000  # terrains, up to which pictures are large
_WIDTHS = (256, 160)  # of pictures of few terrains and of many [pixels]
_QUALITY = 72  # of the JPEG
_SUN = np.array([-0.45, 0.35])  # where the light comes from: how much slopes along x and y gain by it
_MARK = 3  # half side of the marks of start and goal [nodes]
_START, _GOAL = (240, 200, 60), (0, 158, 115)


def reliefs_of(genes: NDArray[np.float32], space: TerrainSpace) -> list[bytes]:
    """A picture of each terrain, as JPEG: blue below the start's level, brown above, slopes lit from one side.

    Slippery and soft patches are tinted.
    """
    width = _WIDTHS[len(genes) > _FEW]
    lots = (genes[first : first + _AT_ONCE] for first in range(0, len(genes), _AT_ONCE))
    pictures = []
    for lot in lots:
        grids, maps = terrains_of(lot, space)
        grounds = [None if maps is None else maps[place : place + 1] for place in range(len(lot))]
        pictures += [relief(heights, width, ground) for heights, ground in zip(grids, grounds, strict=True)]
    return pictures


def relief(heights: NDArray[np.floating], width: int = _WIDTHS[0], ground: GroundMaps | None = None) -> bytes:
    """A picture of a terrain, with the start yellow and the goal green.

    Args:
        heights: [m], shape (nrow, ncol).
        width: Of the picture [pixels].
        ground: Its friction and softness, which tint it.
    """
    rise_y, rise_x = np.gradient(heights, SPACING)
    light = np.clip(1.0 + _SUN[0] * rise_x + _SUN[1] * rise_y, 0.45, 1.25)
    colors = height_colors(heights) if ground is None else tinted(height_colors(heights), ground)
    pixels = np.clip(255.0 * colors * light[..., None], 0.0, 255.0).astype(np.uint8)
    for (x, y), color in ((CrossingCfg.start, _START), (CrossingCfg.goal, _GOAL)):
        row, column = round(y / SPACING), round(x / SPACING)
        pixels[row - _MARK : row + _MARK + 1, column - _MARK : column + _MARK + 1] = color
    nrow, ncol = heights.shape
    image = Image.fromarray(pixels[::-1]).resize((width, round(width * nrow / ncol)), Image.Resampling.LANCZOS)
    content = io.BytesIO()
    image.save(content, "JPEG", quality=_QUALITY)
    return content.getvalue()
