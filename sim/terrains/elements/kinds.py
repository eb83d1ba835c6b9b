"""What an element of a course is, and all of them: slopes, what lies on the ground or lifts it, ditches and rubble."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from kernels import course
from kernels.course import CENTRE_ROW, DIRECTION, SPACING, Element, ElementKind, Range, direction_sign
from sim.device import host_device
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.quantities import Quantity, Sweep

FIRST_COL = 100
"""An element alone on flat ground begins at x = 5 m, or at one of the next nodes."""
NUM_STARTS = 20
"""Nodes at which it may begin: over 1 m, more than a stride."""
SLOPE_ROWS = 40
"""Rows to each side of the way in which a cross slope is inclined: 2 m; beyond, it stays level."""
_MAX_STEPS = 8
_CELLS_PER_M = 20.0
_HALF = 0.501  # rounds to the nearest node; not at .5 exactly, where round numbers lie and devices may differ

_SLOPES = (0.10, 0.20, 0.30, 0.40, 0.50, 0.60, 0.70, 0.80, 1.00)
_LOW = (0.05, 0.08, 0.10, 0.12, 0.15, 0.18, 0.20, 0.25, 0.30)
_STEPS = (0.05, 0.10, 0.15, 0.20, 0.25, 0.30, 0.35, 0.40, 0.50)
_RISES = (0.05, 0.10, 0.14, 0.17, 0.20, 0.22, 0.24, 0.26, 0.28, 0.30, 0.35)
_WIDTHS = (0.10, 0.20, 0.30, 0.40, 0.50, 0.60, 0.70, 0.80, 1.00)
_SLOPE = Quantity(name="size", low=0.01, high=2.0, unit="m/m")
_HEIGHT = Quantity(name="size", low=0.01, high=1.0, unit="m")
_DEPTH = Quantity(name="size", low=0.05, high=2.0, unit="m")


def cells(name: str, low: float, high: float, every: int = 1) -> Quantity:
    """A length [m] that is a multiple of ``every`` cells."""
    return Quantity(name=name, low=low, high=high, unit="m", step=every * SPACING)


LENGTH = cells("length", 0.20, 4.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class CourseElement(ElementKind):
    """A kind of element with its text and its doses."""

    text: Callable[[Any], str]
    """Of a record of :class:`kernels.course.Element`."""
    quantities: Mapping[str, Quantity] = field(default_factory=dict)
    """What doses can set."""
    doses: Mapping[str, Sweep] = field(default_factory=dict)
    """Doses by name."""
    draw_turns: Callable[[int, np.random.Generator], NDArray[Any]] | None = None
    """Draws the turns of an element of a dose, one for each node where it begins."""

    def lay_alone(
        self, turn: float, quantities: Mapping[str, Any], count: int, rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """Elements alone on flat ground before x = 12 m, of quantities of which one has several values.

        They begin at ``count`` nodes that are spread evenly over 1 m. Returns heights [m], shape (count * num_values,
        NUM_ROWS, NUM_COLS): first one of each value, then the next of each.
        """
        record: Any = course.Element  # Warp makes its dtype
        laid: Any = np.zeros((count, max(map(np.size, quantities.values()))), record.numpy_dtype())
        laid["kind"] = all_elements().index(self)
        laid["detail"] = 1.0  # pallets
        laid["first"] = (FIRST_COL + np.arange(count) * NUM_STARTS // count)[:, None]
        laid["turn"] = turn if self.draw_turns is None else self.draw_turns(count, rng)[:, None]
        for name, values in quantities.items():
            quantity = self.quantities[name]
            in_cells = quantity.step and quantity.unit == "m"
            laid[quantity.name] = np.rint(np.asarray(values) / SPACING) if in_cells else values
        with wp.ScopedDevice(host_device()):
            elements: Any = wp.array(laid.reshape(-1, 1), dtype=course.Element)
            course.lay_elements(elements, all_elements())
            heights: Any = wp.empty((len(elements), NUM_ROWS, NUM_COLS), dtype=float)
            course.rasterise_elements(elements, all_elements(), heights)
            return np.array(heights.numpy(), np.float32)


ELEMENTS: dict[str, CourseElement] = {}
"""All elements by name; flat ground is the first, and what is left where another is taken away.

Courses of the shipped space have those that spaces/course.py names.
"""


def all_elements() -> tuple[CourseElement, ...]:
    """All elements, in the order of their numbers in kernels."""
    return tuple(ELEMENTS.values())


def _both_ways(name: str, parameter: str, values: tuple[float, ...], **others: float) -> dict[str, Sweep]:
    return {f"{name}_{way}": Sweep(parameter, values, others, turn=turn) for way, turn in (("up", 1.0), ("down", -1.0))}


def _up_or_down(element: Any) -> str:
    return "up" if element["turn"] >= 0.0 else "down"


def _metres(num_cells: float) -> str:
    return f"{num_cells * SPACING:.2f} m"


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
    return f"{name} of 1:{1 / element['size']:.1f} {direction}, {_metres(element['cells'])} long"


FLAT = CourseElement(
    name="flat",
    length=Range(0, 60, whole=True, hard="low"),
    text=lambda e: f"flat ground of {_metres(e['cells'])}" if e["cells"] else "nothing",
)
RAMP = CourseElement(
    name="ramp",
    size=Range(1 / 12, 1 / 3, hard="high"),
    length=Range(16, 48, whole=True, hard="high"),
    turn=DIRECTION,
    rise=_ramp_rise,
    relief=_ramp_relief,
    text=lambda e: _slope_text("ramp", e, _up_or_down(e)),
    quantities={"slope": _SLOPE, "length": LENGTH},
    doses=_both_ways("ramp", "slope", _SLOPES, length=2.0),
)
CROSS_SLOPE = CourseElement(
    name="cross_slope",
    size=Range(1 / 48, 1 / 3, hard="high"),
    length=Range(30, 60, whole=True, hard="high"),
    turn=DIRECTION,
    relief=_cross_slope_relief,
    text=lambda e: _slope_text("cross slope", e, f"{'left' if e['turn'] >= 0.0 else 'right'} side up"),
    quantities={"slope": _SLOPE, "length": cells("length", 0.60, 4.0)},
    doses={"cross_slope": Sweep("slope", _SLOPES, {"length": 3.0})},
    draw_turns=lambda count, rng: rng.permutation(np.resize([-1.0, 1.0], count)),
)


@wp.func
def _face_rise(element: Element) -> float:
    return direction_sign(element) * element.size


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
def _pallet_relief(element: Element, s: int, row: int) -> float:
    return element.size * element.detail


def _pallet_text(element: Any) -> str:
    count = round(float(element["detail"]))
    name = "pallet" if count == 1 else f"{count} pallets,"
    return f"{name} {count * element['size']:.2f} m high and {_metres(element['length'])} long"


SILL = CourseElement(
    name="sill",
    size=Range(0.013, 0.15, hard="high"),
    length=Range(1, 3, whole=True),
    fit=course.fit_top,
    text=lambda e: f"sill {e['size']:.3f} m high and {_metres(e['length'])} wide",
    quantities={"height": _HEIGHT, "width": cells("length", 0.05, 0.50)},
    doses={"sill": Sweep("height", _LOW, {"width": 0.10})},
)
RAIL = CourseElement(
    name="rail",
    size=Range(0.02, 0.172, hard="high"),
    length=Range(0, 1, whole=True),
    fit=course.fit_top,
    text=lambda e: f"rail {e['size']:.3f} m high" + (f" and {_metres(e['length'])} wide" if e["length"] else ""),
    quantities={"height": _HEIGHT},
    doses={"rail": Sweep("height", _LOW)},
)
KERB = CourseElement(
    name="kerb",
    size=Range(0.03, 0.25, hard="high"),
    turn=DIRECTION,
    fit=course.fit_face,
    rise=_face_rise,
    text=lambda e: f"kerb {e['size']:.2f} m {_up_or_down(e)}",
)
STEP = CourseElement(
    name="step",
    size=Range(0.10, 0.40, hard="high"),
    turn=DIRECTION,
    fit=course.fit_face,
    rise=_face_rise,
    text=lambda e: f"step {e['size']:.2f} m {_up_or_down(e)}",
    quantities={"height": _HEIGHT},
    doses=_both_ways("step", "height", _STEPS),
)
STAIRS = CourseElement(
    name="stairs",
    size=Range(0.12, 0.22, hard="high"),
    length=Range(0.22, 0.35, hard="low"),
    detail=Range(2, _MAX_STEPS, whole=True, hard="high"),  # steps
    turn=DIRECTION,
    fit=_fit_stairs,
    rise=_stairs_rise,
    relief=_stairs_relief,
    text=lambda e: f"{e['detail']:.0f} stairs of {e['size']:.2f} x {e['length']:.2f} m {_up_or_down(e)}",
    quantities={
        "rise": Quantity(name="size", low=0.01, high=0.50, unit="m"),
        "tread": Quantity(name="length", low=0.10, high=0.60, unit="m"),
        "flight": Quantity(name="detail", low=2, high=_MAX_STEPS, unit="steps", step=1.0),
    },
    doses=_both_ways("stairs", "rise", _RISES, tread=0.30, flight=5.0),
)
PALLET = CourseElement(
    name="pallet",
    size=Range(0.10, 0.16, hard="high"),
    length=Range(16, 24, whole=True),
    detail=Range(1, 2, whole=True, hard="high"),  # how many lie on each other
    fit=course.fit_top,
    relief=_pallet_relief,
    text=_pallet_text,
    quantities={"height": _HEIGHT, "length": LENGTH},
    doses={"pallet": Sweep("height", _STEPS, {"length": 1.0})},
)


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
    return f"ditch {_metres(element['cells'])} wide and {element['size']:.2f} m deep"


def _bridge_text(element: Any) -> str:
    offset = round(float(element["turn"]))
    side = f", {_metres(abs(offset))} {'left' if offset > 0 else 'right'} of the way" if offset else ""
    return f"beam {_metres(element['detail'])} wide over a {_ditch_text(element)}{side}"


DITCH = CourseElement(
    name="ditch",
    size=Range(0.05, 0.80, hard="high"),
    length=Range(2, 16, whole=True, hard="high"),
    relief=_ditch_relief,
    text=_ditch_text,
    quantities={"depth": _DEPTH, "width": cells("length", 0.10, 4.0)},
    doses={"ditch": Sweep("width", _WIDTHS, {"depth": 0.50})},
)
BRIDGE = CourseElement(
    name="bridge",
    size=Range(0.20, 0.80, hard="high"),
    length=Range(16, 40, whole=True, hard="high"),
    detail=Range(6, 20, whole=True, hard="low"),  # width of the beam [cells]
    turn=Range(-10, 10, whole=True),  # how far left of the way its middle lies [cells]
    relief=_bridge_relief,
    text=_bridge_text,
    quantities={"depth": _DEPTH, "length": LENGTH, "width": cells("detail", 0.10, 4.0, every=2)},
    doses={"beam": Sweep("width", _WIDTHS[::-1], {"depth": 0.50, "length": 1.50})},
)
STONES = CourseElement(
    name="stones",
    size=Range(0.20, 0.60, hard="high"),
    length=Range(20, 48, whole=True, hard="high"),
    detail=Range(4, 8, whole=True, hard="low"),  # side of a stone [cells]
    turn=Range(2, 6, whole=True, hard="high"),  # gap between two [cells]
    relief=_stones_relief,
    text=lambda e: f"stones of {_metres(e['detail'])}, {_metres(e['turn'])} apart, in a {_ditch_text(e)}",
    quantities={"depth": _DEPTH, "length": LENGTH, "side": cells("detail", 0.1, 1.0), "gap": cells("turn", 0.1, 1.0)},
    doses={"stones": Sweep("gap", (0.10, 0.15, 0.20, 0.25, 0.30, 0.40), {"side": 0.30, "depth": 0.40, "length": 2.00})},
)
RUBBLE = CourseElement(
    name="rubble",
    size=Range(0.03, 0.20, hard="high"),
    length=Range(16, 48, whole=True, hard="high"),
    detail=Range(2, 8, whole=True),  # side of a block [cells]
    turn=Range(-0.5, 0.5),  # which of all rubbles: a phase in turns that -1 and 1 share
    relief=_rubble_relief,
    text=lambda e: (
        f"rubble of blocks of {_metres(e['detail'])} up to {e['size']:.2f} m high, {_metres(e['cells'])} long"
    ),
    quantities={"height": _HEIGHT, "length": LENGTH, "side": cells("detail", 0.05, 1.0)},
    doses={"rubble": Sweep("height", _LOW, {"side": 0.20, "length": 2.00})},
    draw_turns=lambda count, rng: rng.uniform(-0.5, 0.5, count),
)

KINDS = (FLAT, RAMP, CROSS_SLOPE, SILL, RAIL, KERB, STEP, STAIRS, PALLET, DITCH, BRIDGE, STONES, RUBBLE)
"""Neighbours are alike."""
ELEMENTS.update((kind.name, kind) for kind in KINDS)
