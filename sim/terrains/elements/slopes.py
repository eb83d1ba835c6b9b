"""Flat ground, ramps and cross slopes."""

from typing import Any

import numpy as np
import warp as wp

from kernels.course import CENTRE_ROW, DIRECTION, SPACING, Element, direction_sign
from sim.terrains.elements.base import (
    LENGTH,
    CourseElement,
    ElementDose,
    Quantity,
    both_ways,
    cells,
    hard,
    metres,
    up_or_down,
    whole,
)

SLOPE_ROWS = 40
"""Rows to each side of the way in which a cross slope is inclined: 2 m; beyond, it stays level."""
_SLOPES = (0.10, 0.20, 0.30, 0.40, 0.50, 0.60, 0.70, 0.80, 1.00)
_SLOPE = Quantity(parameter="size", low=0.01, high=2.0, unit="m/m")


@wp.func
def _flat_relief(element: Element, s: int, row: int) -> float:
    return 0.0


@wp.func
def _ramp_rise(element: Element) -> float:
    return direction_sign(element) * element.size * float(element.cells) * SPACING


@wp.func
def _ramp_relief(element: Element, s: int, row: int) -> float:
    return element.rise * float(s) / float(element.cells)


@wp.func
def _cross_slope_relief(element: Element, s: int, row: int) -> float:
    # Grows over a third of its length, and goes back over another.
    tilt = wp.min(1.0, 3.0 * float(wp.min(s, element.cells - s)) / float(element.cells))
    offset = float(wp.clamp(row - CENTRE_ROW, -SLOPE_ROWS, SLOPE_ROWS)) * SPACING
    return direction_sign(element) * element.size * tilt * offset


def _slope_text(name: str, element: Any, direction: str) -> str:
    return f"{name} of 1:{1 / element['size']:.1f} {direction}, {metres(element['cells'])} long"


FLAT = CourseElement(
    name="flat",
    length=whole(0, 60, "low"),
    relief=_flat_relief,
    text=lambda e: f"flat ground of {metres(e['cells'])}" if e["cells"] else "nothing",
)
RAMP = CourseElement(
    name="ramp",
    size=hard(1 / 12, 1 / 3),
    length=whole(16, 48, "high"),
    turn=DIRECTION,
    rise=_ramp_rise,
    relief=_ramp_relief,
    text=lambda e: _slope_text("ramp", e, up_or_down(e)),
    quantities={"slope": _SLOPE, "length": LENGTH},
    doses=both_ways("ramp", "slope", _SLOPES, length=2.0),
)
CROSS_SLOPE = CourseElement(
    name="cross_slope",
    size=hard(1 / 48, 1 / 3),
    length=whole(30, 60, "high"),
    turn=DIRECTION,
    relief=_cross_slope_relief,
    text=lambda e: _slope_text("cross slope", e, f"{'left' if e['turn'] >= 0.0 else 'right'} side up"),
    quantities={"slope": _SLOPE, "length": cells("length", 0.60, 4.0)},
    doses={"cross_slope": ElementDose("slope", _SLOPES, others={"length": 3.0})},
    draw_turns=lambda count, rng: rng.permutation(np.resize([-1.0, 1.0], count)),
)
