"""Height grids as MuJoCo's heightfields.

MuJoCo cuts every cell from its (low x, low y) to its (high x, high y) corner, for contacts as for rays; ours are cut
from (low x, high y) to (high x, low y) (:mod:`kernels.heightfield`). On a grid that is turned by a quarter the one cut
is the other, so our grids are handed over on their side, their columns along MuJoCo's rows: then both have the same
surface, between the nodes too.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim.terrain import SPACING

_QUARTER_TURN = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
_FLAT_EXTENT = 1e-3  # of flat ground, where data are all 0: a size may not be


@dataclass(frozen=True, kw_only=True)
class Hfield:
    """What an ``hfield`` asset and the ``geom`` that shows it need; world axes are those of the height grid."""

    data: NDArray[np.float64]
    """0 to 1, as in ``MjModel.hfield_data``; an asset's ``elevation`` has its rows in reverse."""
    size: tuple[float, float, float, float]
    """Half lengths along the asset's x and y, height of data 1, thickness below data 0 [m]."""
    position: tuple[float, float, float]
    """Of the geom [m]."""
    quaternion: tuple[float, float, float, float] = _QUARTER_TURN
    """Of the geom, w x y z: its x axis is the grid's y, its y axis the grid's -x."""


def as_hfield(heights: NDArray[np.floating], *, margin: int = 0, thickness: float = 1.0) -> Hfield:
    """A height grid as a heightfield with the same surface.

    Args:
        heights: [m], shape (nrow, ncol), at :data:`sim.terrain.SPACING`; node (0, 0) stands at x = y = 0.
        margin: Nodes of edge height to add on every side.
        thickness: Of the ground below its lowest point [m].
    """
    grid = np.pad(np.asarray(heights, dtype=np.float64), margin, mode="edge")
    lowest, extent = float(grid.min()), float(np.ptp(grid)) or _FLAT_EXTENT
    half_y, half_x = (0.5 * SPACING * (count - 1) for count in grid.shape)
    centre_y, centre_x = (0.5 * SPACING * (count - 1) for count in heights.shape)
    return Hfield(
        data=((grid - lowest) / extent).T[::-1],
        size=(half_y, half_x, extent, thickness),
        position=(centre_x, centre_y, lowest),
    )
