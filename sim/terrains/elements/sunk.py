"""Ditches, beams and stepping stones over them, and rubble."""

from typing import Any

import warp as wp

from kernels.course import CENTRE_ROW, Element, Range
from sim.terrains.elements.base import LENGTH, CourseElement, ElementDose, Quantity, cells, hard, metres, whole

_LOW = (0.05, 0.08, 0.10, 0.12, 0.15, 0.18, 0.20, 0.25, 0.30)
_WIDTHS = (0.10, 0.20, 0.30, 0.40, 0.50, 0.60, 0.70, 0.80, 1.00)
_GAPS = (0.10, 0.15, 0.20, 0.25, 0.30, 0.40)
_DEPTH = Quantity(parameter="size", low=0.05, high=2.0)


@wp.func
def _ditch_relief(element: Element, s: int, row: int) -> float:
    return -element.size


@wp.func
def _bridge_relief(element: Element, s: int, row: int) -> float:
    offset = row - CENTRE_ROW - int(element.turn) + int(element.detail) / 2
    if offset >= 0 and offset <= int(element.detail):
        return 0.0
    return -element.size


@wp.func
def _stones_relief(element: Element, s: int, row: int) -> float:
    """Every other row of stones is moved by half their distance."""
    side = int(element.detail)
    pitch = side + int(element.turn)
    along = s - int(element.turn)
    if along < 0:
        return -element.size
    shift = ((along / pitch) % 2) * (pitch / 2)
    across = (row - CENTRE_ROW + side / 2 + shift + 1000 * pitch) % pitch  # one of the first lies on the way
    if along % pitch <= side and across <= side:
        return 0.0
    return -element.size


@wp.func
def _scatter(i: int, j: int) -> float:
    """A number in [0, 1) that looks random, the same for the same i and j everywhere."""
    h = (wp.uint32(i) * wp.uint32(73856093)) ^ (wp.uint32(j) * wp.uint32(19349663))
    h = (h ^ (h >> wp.uint32(13))) * wp.uint32(1540483477)
    h = h ^ (h >> wp.uint32(15))
    return float(h & wp.uint32(16777215)) / 16777216.0


@wp.func
def _rubble_relief(element: Element, s: int, row: int) -> float:
    block = int(element.detail)
    phase = _scatter((s - 1) / block, row / block) + element.turn + 1.0
    return element.size * wp.abs(2.0 * (phase - wp.floor(phase)) - 1.0)  # evenly spread, and continuous in the phase


def _ditch_text(element: Any) -> str:
    return f"ditch {metres(element['cells'])} wide and {element['size']:.2f} m deep"


def _bridge_text(element: Any) -> str:
    offset = round(float(element["turn"]))
    side = f", {metres(abs(offset))} {'left' if offset > 0 else 'right'} of the way" if offset else ""
    return f"beam {metres(element['detail'])} wide over a {_ditch_text(element)}{side}"


DITCH = CourseElement(
    name="ditch",
    size=hard(0.05, 0.80),
    length=whole(2, 16, "high"),
    relief=_ditch_relief,
    text=_ditch_text,
    quantities={"depth": _DEPTH, "width": cells("length", 0.10, 4.0)},
    doses={"ditch": ElementDose("width", _WIDTHS, others={"depth": 0.50})},
)
BRIDGE = CourseElement(
    name="bridge",
    size=hard(0.20, 0.80),
    length=whole(16, 40, "high"),
    detail=whole(6, 20, "low"),  # width of the beam [cells]
    turn=whole(-10, 10),  # how far left of the way its middle lies [cells]
    relief=_bridge_relief,
    text=_bridge_text,
    quantities={"depth": _DEPTH, "length": LENGTH, "width": cells("detail", 0.10, 4.0, every=2)},
    doses={"beam": ElementDose("width", _WIDTHS[::-1], others={"depth": 0.50, "length": 1.50})},
)
STONES = CourseElement(
    name="stones",
    size=hard(0.20, 0.60),
    length=whole(20, 48, "high"),
    detail=whole(4, 8, "low"),  # side of a stone [cells]
    turn=whole(2, 6, "high"),  # gap between two [cells]
    relief=_stones_relief,
    text=lambda e: f"stones of {metres(e['detail'])}, {metres(e['turn'])} apart, in a {_ditch_text(e)}",
    quantities={
        "depth": _DEPTH, "length": LENGTH, "side": cells("detail", 0.10, 1.0), "gap": cells("turn", 0.10, 1.0),
    },
    doses={
        "stones": ElementDose("gap", _GAPS, others={"side": 0.30, "depth": 0.40, "length": 2.00})
    },
)  # fmt: skip
RUBBLE = CourseElement(
    name="rubble",
    size=hard(0.03, 0.20),
    length=whole(16, 48, "high"),
    detail=whole(2, 8),  # side of a block [cells]
    turn=Range(-0.5, 0.5),  # which of all rubbles: a phase in turns that -1 and 1 share
    relief=_rubble_relief,
    text=lambda e: f"rubble of blocks of {metres(e['detail'])} up to {e['size']:.2f} m high, {metres(e['cells'])} long",
    quantities={
        "height": Quantity(parameter="size", low=0.01, high=1.0), "length": LENGTH, "side": cells("detail", 0.05, 1.0),
    },
    doses={
        "rubble": ElementDose("height", _LOW, others={"side": 0.20, "length": 2.00})
    },
    draw_turns=lambda count, rng: rng.uniform(-0.5, 0.5, count),
)  # fmt: skip
