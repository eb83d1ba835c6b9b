"""What stands on the ground or lifts it: sills, rails, kerbs, steps, stairs and pallets."""

from typing import Any

import warp as wp

from kernels.course import DIRECTION, Element, Range, direction_sign, fit_face, fit_top
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

_MAX_STEPS = 8
_CELLS_PER_M = 20.0
_HALF = 0.501  # rounds to the nearest node; not at .5 exactly, where round numbers lie and devices may differ
_LOW = (0.05, 0.08, 0.10, 0.12, 0.15, 0.18, 0.20, 0.25, 0.30)
_RISES = (0.05, 0.10, 0.14, 0.17, 0.20, 0.22, 0.24, 0.26, 0.28, 0.30, 0.35)
_STEPS = (0.05, 0.10, 0.15, 0.20, 0.25, 0.30, 0.35, 0.40, 0.50)
_HEIGHT = Quantity(parameter="size", low=0.01, high=1.0)


@wp.func
def _riser(k: int, tread: float) -> int:
    """Cells from the first riser of stairs to riser k, counted from 0: the nearest node."""
    return int(wp.floor(float(k) * tread * _CELLS_PER_M + _HALF))


@wp.func
def _fit_stairs(element: Element, room: int) -> Element:
    for _ in range(_MAX_STEPS):
        element.cells = _riser(int(element.detail) - 1, element.length) + 1
        if element.cells > room and element.detail > 2.0:
            element.detail -= 1.0
    return element


@wp.func
def _stairs_rise(element: Element) -> float:
    return direction_sign(element) * element.size * element.detail


@wp.func
def _stairs_relief(element: Element, s: int, row: int) -> float:
    passed = float(0.0)
    for k in range(_MAX_STEPS):
        if k < int(element.detail) and s > _riser(k, element.length):
            passed += 1.0
    return direction_sign(element) * element.size * passed


@wp.func
def _face_rise(element: Element) -> float:
    return direction_sign(element) * element.size


@wp.func
def _pallet_relief(element: Element, s: int, row: int) -> float:
    return element.size * element.detail


def _pallet_text(element: Any) -> str:
    count = round(float(element["detail"]))
    name = "pallet" if count == 1 else f"{count} pallets,"
    return f"{name} {count * element['size']:.2f} m high and {metres(element['length'])} long"


SILL = CourseElement(
    name="sill",
    size=hard(0.013, 0.15),
    length=whole(1, 3),
    fit=fit_top,
    text=lambda e: f"sill {e['size']:.3f} m high and {metres(e['length'])} wide",
    quantities={"height": _HEIGHT, "width": cells("length", 0.05, 0.50)},
    doses={"sill": ElementDose("height", _LOW, others={"width": 0.10})},
)
RAIL = CourseElement(
    name="rail",
    size=hard(0.02, 0.172),
    length=whole(0, 1),
    fit=fit_top,
    text=lambda e: f"rail {e['size']:.3f} m high" + (f" and {metres(e['length'])} wide" if e["length"] else ""),
    quantities={"height": _HEIGHT},
    doses={"rail": ElementDose("height", _LOW)},
)
KERB = CourseElement(
    name="kerb",
    size=hard(0.03, 0.25),
    turn=DIRECTION,
    fit=fit_face,
    rise=_face_rise,
    text=lambda e: f"kerb {e['size']:.2f} m {up_or_down(e)}",
)
STEP = CourseElement(
    name="step",
    size=hard(0.10, 0.40),
    turn=DIRECTION,
    fit=fit_face,
    rise=_face_rise,
    text=lambda e: f"step {e['size']:.2f} m {up_or_down(e)}",
    quantities={"height": _HEIGHT},
    doses=both_ways("step", "height", _STEPS),
)
STAIRS = CourseElement(
    name="stairs",
    size=hard(0.12, 0.22),
    length=Range(0.22, 0.35, hard="low"),
    detail=whole(2, _MAX_STEPS, "high"),  # steps
    turn=DIRECTION,
    fit=_fit_stairs,
    rise=_stairs_rise,
    relief=_stairs_relief,
    text=lambda e: f"{e['detail']:.0f} stairs of {e['size']:.2f} x {e['length']:.2f} m {up_or_down(e)}",
    quantities={
        "rise": Quantity(parameter="size", low=0.01, high=0.50),
        "tread": Quantity(parameter="length", low=0.10, high=0.60),
        "flight": Quantity(parameter="detail", low=2, high=_MAX_STEPS, unit="steps", step=1.0),
    },
    doses=both_ways("stairs", "rise", _RISES, tread=0.30, flight=5.0),
)
PALLET = CourseElement(
    name="pallet",
    size=hard(0.10, 0.16),
    length=whole(16, 24),
    detail=whole(1, 2, "high"),  # how many lie on each other
    fit=fit_top,
    relief=_pallet_relief,
    text=_pallet_text,
    quantities={"height": _HEIGHT, "length": LENGTH},
    doses={"pallet": ElementDose("height", _STEPS, others={"length": 1.0})},
)
