"""Less or more friction everywhere."""

from typing import Any

import warp as wp

from kernels.conditions import VariedRobots
from sim.terrains.conditions.base import Array, Condition, Gene


@wp.func
def _begin_grip(robots: VariedRobots, row: wp.array[float], first: int, terrain: int, env: int):
    robots.friction[terrain] = row[first]


class Grip(Condition):
    """Factor of the friction of all contacts."""

    name, cause = "grip", "little grip"
    genes = (Gene(name="friction", low=0.2, middle=1.0, high=1.2, limits=(1e-3, 10.0)),)
    varied = (0.7, 1.2)
    begin = _begin_grip

    def text(self, values: Array) -> str:
        """The factor."""
        return f"friction times {values[0]:.2f}" if abs(values[0] - 1.0) >= 0.005 else ""

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Scales the friction of all geoms of the model."""
        episodes.model.geom_friction[:, 0] *= values[0]
