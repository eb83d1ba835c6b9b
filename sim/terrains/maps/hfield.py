"""A height grid as triangles, and as a heightfield of MuJoCo's with the same surface.

MuJoCo cuts every cell of a heightfield from its (low x, low y) to its (high x, high y) corner, for contacts as for
rays; ours are cut from (low x, high y) to (high x, low y) (:mod:`kernels.heightfield`). On a grid that is turned by a
quarter the one cut is the other, so our grids are handed over on their side, their columns along MuJoCo's rows: then
both have the same surface, between the nodes too.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.terrains.hand_crafted import SPACING

LEAST_EXTENT = 1e-3
"""Of flat ground, whose range is 0 where a size or scale may not be [m]."""
_THICKNESS = 1.0  # of the ground below its lowest point [m]
QUARTER_TURN = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
"""Of the geom, quaternion w x y z: its x axis is the grid's y, its y axis the grid's -x."""


@dataclass(frozen=True, kw_only=True)
class Hfield:
    """What an ``hfield`` asset and the ``geom`` that shows it need beside :data:`QUARTER_TURN`; axes are the grid's."""

    data: NDArray[np.float64]
    """0 to 1, as in ``MjModel.hfield_data``; an asset's ``elevation`` has its rows in reverse."""
    size: tuple[float, float, float, float]
    """Half lengths along the asset's x and y, height of data 1, thickness below data 0 [m]."""
    position: tuple[float, float, float]
    """Of the geom [m]."""


Margins = tuple[tuple[int, int], tuple[int, int]]
"""Nodes to add at low y and high y, and at low x and high x."""


def as_hfield(heights: NDArray[np.floating], *, margin: int | Margins = 0) -> Hfield:
    """A height grid as a heightfield with the same surface, with ``margin`` nodes of edge height more.

    Heights [m] have shape (nrow, ncol), at :data:`sim.terrains.hand_crafted.SPACING`; node (0, 0) stands at x = y = 0.
    """
    margins = ((margin, margin),) * 2 if isinstance(margin, int) else margin
    grid = np.pad(np.asarray(heights, dtype=np.float64), margins, mode="edge")
    lowest, extent = float(grid.min()), float(np.ptp(grid)) or LEAST_EXTENT
    half_y, half_x = (0.5 * SPACING * (count - 1) for count in grid.shape)
    (low_y, _), (low_x, _) = margins
    return Hfield(
        data=((grid - lowest) / extent).T[::-1],
        size=(half_y, half_x, extent, _THICKNESS),
        position=(half_x - SPACING * low_x, half_y - SPACING * low_y, lowest),
    )


def surface_of(heights: NDArray[np.floating], margin: int = 0) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The ground that robots walk on: vertices [m], row by row, and two triangles a cell, cut as the physics cuts it.

    Heights [m] have shape (nrow, ncol), node (0, 0) at x = y = 0; ``margin`` more nodes continue each edge.
    """
    grid = np.pad(heights, margin, mode="edge")
    nrow, ncol = grid.shape
    y, x = (SPACING * (np.arange(count) - margin) for count in grid.shape)
    vertices = np.stack([*np.meshgrid(x, y), grid], axis=-1).reshape(-1, 3)
    low = (np.arange(nrow - 1)[:, None] * ncol + np.arange(ncol - 1)).ravel()
    # Each cell is cut from its (low x, high y) to its (high x, low y) corner.
    faces = np.stack([low, low + 1, low + ncol, low + 1, low + ncol + 1, low + ncol], axis=1)
    return vertices.astype(np.float64), faces.reshape(-1, 3)
