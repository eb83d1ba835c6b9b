"""Genes to heights: courses of man-made elements, one behind the other across the way, rasterised on the device.

A course is flat up to x = 4 m and from x = 12 m on. Between lie up to six elements over the full width. Where one
begins and ends is a whole number of cells, so its edges lie on nodes: a vertical face is the slope between two
neighbouring nodes, 0.05 m wide. An element that is longer than what is left before x = 12 m is cut to fit, and left
out where its shortest form does not fit.
"""

from enum import IntEnum
from typing import Any, NamedTuple

import warp as wp

SPACING = 0.05
"""Distance of neighbouring nodes [m], for which courses are made."""
FIRST_COL, LAST_COL = 80, 240
"""Columns of the nodes between which elements lie: x = 4 m and x = 12 m."""
CENTRE_ROW = 80
"""Row of the nodes on the way: y = 4 m."""
SLOPE_ROWS = 40
"""Rows to each side of the way in which a cross slope is inclined: 2 m; beyond, it stays level."""
MAX_ELEMENTS = 6
GENES = ("kind", "lead", "size", "length", "detail", "turn")
"""Genes of one element in order: kind, flat ground before it, and four parameters (:data:`PARAMETERS`)."""
GENES_PER_ELEMENT = len(GENES)


class Kind(IntEnum):
    """What an element is; neighbours are alike, so that a small change of the gene is a small change."""

    FLAT = 0
    RAMP = 1
    CROSS_SLOPE = 2
    SILL = 3
    RAIL = 4
    KERB = 5
    STEP = 6
    STAIRS = 7
    PALLET = 8
    DITCH = 9
    BRIDGE = 10
    STONES = 11
    RUBBLE = 12


class Range(NamedTuple):
    """Values of a parameter over its gene from -1 to 1."""

    low: float
    high: float
    whole: bool = False
    """Whether it takes whole numbers, each on an equal share of the gene."""
    hard: str = ""
    """Which end makes it hard: low, high, or either; none if empty."""


LEAD = Range(4, 16, whole=True)
"""Flat ground before an element [cells]."""


def _hard(low: float, high: float) -> Range:
    return Range(low, high, hard="high")


def _whole(low: int, high: int, hard: str = "") -> Range:
    return Range(low, high, whole=True, hard=hard)


_NONE = Range(0.0, 0.0)
_WAY = Range(-1.0, 1.0, hard="either")
PARAMETERS: dict[Kind, tuple[Range, Range, Range, Range]] = {
    # size [m], for a ramp and a cross slope a gradient; length [cells], for stairs the tread [m]; detail; turn
    Kind.FLAT: (_NONE, _whole(0, 60, "low"), _NONE, _NONE),
    Kind.RAMP: (_hard(1 / 12, 1 / 3), _whole(16, 48, "high"), _NONE, _WAY),
    Kind.CROSS_SLOPE: (_hard(1 / 48, 1 / 3), _whole(30, 60, "high"), _NONE, _WAY),
    Kind.SILL: (_hard(0.013, 0.15), _whole(1, 3), _NONE, _NONE),
    Kind.RAIL: (_hard(0.02, 0.172), _whole(0, 1), _NONE, _NONE),
    Kind.KERB: (_hard(0.03, 0.25), _NONE, _NONE, _WAY),
    Kind.STEP: (_hard(0.10, 0.40), _NONE, _NONE, _WAY),
    # detail: steps
    Kind.STAIRS: (_hard(0.12, 0.22), Range(0.22, 0.35, hard="low"), _whole(2, 8, "high"), _WAY),
    # detail: how many lie on each other
    Kind.PALLET: (_hard(0.10, 0.16), _whole(16, 24), _whole(1, 2, "high"), _NONE),
    Kind.DITCH: (_hard(0.05, 0.80), _whole(2, 16, "high"), _NONE, _NONE),
    # detail: width of the beam [cells]; turn: how far left of the way its middle lies [cells]
    Kind.BRIDGE: (_hard(0.20, 0.80), _whole(16, 40, "high"), _whole(6, 20, "low"), _whole(-10, 10)),
    # detail: side of a stone [cells]; turn: gap between two [cells]
    Kind.STONES: (_hard(0.20, 0.60), _whole(20, 48, "high"), _whole(4, 8, "low"), _whole(2, 6, "high")),
    # detail: side of a block [cells]; turn: which of all rubbles, a phase in turns that -1 and 1 share
    Kind.RUBBLE: (_hard(0.03, 0.20), _whole(16, 48, "high"), _whole(2, 8), Range(-0.5, 0.5)),
}
"""Ranges of an element's size, length, detail and turn, by its kind."""

_NUM_KINDS = len(Kind)
_NUM_PARAMETERS = GENES_PER_ELEMENT - 2
_Table = wp.types.matrix(shape=(_NUM_KINDS, _NUM_PARAMETERS), dtype=float)
_LOWS, _HIGHS, _WHOLE = (_Table(*(float(row[part]) for kind in Kind for row in PARAMETERS[kind])) for part in range(3))

_MAX_STEPS = int(PARAMETERS[Kind.STAIRS][2].high)
_LEAD_LOW, _LEAD_HIGH = float(LEAD.low), float(LEAD.high)
_CELLS_PER_M = 20.0
_HALF = 0.501  # rounds to the nearest node; not at .5 exactly, where round numbers lie and devices may differ


@wp.struct
class Element:
    """One element as it lies: its parameters, where it begins, and the ground around it."""

    kind: int
    """:class:`Kind`; FLAT where it was left out."""
    first: int
    """Column of the last node before it."""
    cells: int
    """Cells to the first node behind it."""
    ground: float
    """Height of the ground before it [m]."""
    rise: float
    """Height of the ground behind it over that before it [m]."""
    size: float
    length: float
    detail: float
    turn: float


@wp.func
def _decode(gene: float, low: float, high: float, whole: float) -> float:
    share = (wp.clamp(gene, -1.0, 1.0) + 1.0) * 0.5
    if whole > 0.0:
        return low + wp.min(wp.floor(share * (high - low + 1.0)), high - low)
    return low + share * (high - low)


@wp.func
def _sign(turn: float) -> float:
    """1 for up (or left), -1 for down."""
    return wp.where(turn >= 0.0, 1.0, -1.0)


@wp.func
def _riser(k: int, tread: float) -> int:
    """Cells from the first riser of stairs to riser k, counted from 0: the nearest node."""
    return int(wp.floor(float(k) * tread * _CELLS_PER_M + _HALF))


@wp.func
def _faces(kind: int) -> int:
    """Cells of what stands on the ground that are its two faces, beside those of its top."""
    if kind == Kind.SILL or kind == Kind.RAIL or kind == Kind.PALLET:
        return 2
    return 0


@wp.func
def _fitted(element: Element, shortest: float, room: int) -> Element:
    """The element with the cells that it takes, cut to those that are left; FLAT without cells if it does not fit."""
    if element.kind == Kind.KERB or element.kind == Kind.STEP:
        element.cells = 1
    elif element.kind == Kind.STAIRS:
        for _ in range(_MAX_STEPS):
            element.cells = _riser(int(element.detail) - 1, element.length) + 1
            if element.cells > room and element.detail > 2.0:
                element.detail -= 1.0
    else:
        element.length = wp.min(element.length, float(room - _faces(element.kind)))
        element.cells = int(element.length) + _faces(element.kind)
        if element.length < shortest:
            element.cells = room + 1
    if element.cells > room:
        element.kind = int(Kind.FLAT)
        element.cells = 0
        element.length = 0.0
    return element


@wp.func
def _rise_of(element: Element) -> float:
    if element.kind == Kind.RAMP:
        return _sign(element.turn) * element.size * float(element.cells) * SPACING
    if element.kind == Kind.KERB or element.kind == Kind.STEP:
        return _sign(element.turn) * element.size
    if element.kind == Kind.STAIRS:
        return _sign(element.turn) * element.size * element.detail
    return 0.0


@wp.func
def _placed(element: Element, shortest: float, first: int, ground: float) -> Element:
    """The element as it lies behind a node, on ground of a height."""
    element = _fitted(element, shortest, LAST_COL - first)
    element.first = first
    element.ground = ground
    element.rise = _rise_of(element)
    return element


@wp.kernel
def _place_kernel(elements: wp.array2d[Element]):
    """Grid (num_terrains, num_elements)."""
    t, e = wp.tid()
    elements[t, e] = _placed(elements[t, e], 0.0, elements[t, e].first, 0.0)


@wp.kernel
def _lay_out_kernel(
    genes: wp.array2d[float], lows: _Table, highs: _Table, whole: _Table, elements_out: wp.array2d[Element]
):
    """Grid (num_terrains,)."""
    t = wp.tid()
    col = int(FIRST_COL)
    ground = float(0.0)
    for e in range(MAX_ELEMENTS):
        g = e * GENES_PER_ELEMENT
        element = Element()
        element.kind = int(_decode(genes[t, g], 0.0, float(_NUM_KINDS - 1), 1.0))
        k = element.kind
        element.size = _decode(genes[t, g + 2], lows[k, 0], highs[k, 0], whole[k, 0])
        element.length = _decode(genes[t, g + 3], lows[k, 1], highs[k, 1], whole[k, 1])
        element.detail = _decode(genes[t, g + 4], lows[k, 2], highs[k, 2], whole[k, 2])
        element.turn = _decode(genes[t, g + 5], lows[k, 3], highs[k, 3], whole[k, 3])
        col = wp.min(col + int(_decode(genes[t, g + 1], _LEAD_LOW, _LEAD_HIGH, 1.0)), LAST_COL)
        element = _placed(element, lows[k, 1], col, ground)
        elements_out[t, e] = element
        col += element.cells
        ground += element.rise


@wp.func
def _scattered(i: int, j: int) -> float:
    """A number in [0, 1) that looks random, the same for the same i and j everywhere."""
    h = (wp.uint32(i) * wp.uint32(73856093)) ^ (wp.uint32(j) * wp.uint32(19349663))
    h = (h ^ (h >> wp.uint32(13))) * wp.uint32(1540483477)
    h = h ^ (h >> wp.uint32(15))
    return float(h & wp.uint32(16777215)) / 16777216.0


@wp.func
def _is_on_stone(element: Element, s: int, row: int) -> bool:
    """Whether a node stands on a stepping stone; every other row of stones is moved by half their distance."""
    side = int(element.detail)
    pitch = side + int(element.turn)
    along = s - int(element.turn)
    if along < 0:
        return False
    shift = ((along / pitch) % 2) * (pitch / 2)
    across = (row - CENTRE_ROW + side / 2 + shift + 1000 * pitch) % pitch  # one of the first lies on the way
    return along % pitch <= side and across <= side


@wp.func
def _relief(element: Element, s: int, row: int) -> float:
    """Height over the ground before an element [m], at the node s cells in; 0 < s < its cells."""
    if element.kind == Kind.RAMP:
        return element.rise * float(s) / float(element.cells)
    if element.kind == Kind.CROSS_SLOPE:  # grows over a third of its length, and goes back over another
        tilt = wp.min(1.0, 3.0 * float(wp.min(s, element.cells - s)) / float(element.cells))
        beside = float(wp.clamp(row - CENTRE_ROW, -SLOPE_ROWS, SLOPE_ROWS)) * SPACING
        return _sign(element.turn) * element.size * tilt * beside
    if element.kind == Kind.SILL or element.kind == Kind.RAIL:
        return element.size
    if element.kind == Kind.PALLET:
        return element.size * element.detail
    if element.kind == Kind.STAIRS:
        passed = float(0.0)
        for k in range(_MAX_STEPS):
            if k < int(element.detail) and s > _riser(k, element.length):
                passed += 1.0
        return _sign(element.turn) * element.size * passed
    if element.kind == Kind.BRIDGE:
        off = row - CENTRE_ROW - int(element.turn) + int(element.detail) / 2
        if off >= 0 and off <= int(element.detail):
            return 0.0
    if element.kind == Kind.STONES:
        on_stone = _is_on_stone(element, s, row)  # of another element its pitch may be 0
        if on_stone:
            return 0.0
    if element.kind == Kind.DITCH or element.kind == Kind.BRIDGE or element.kind == Kind.STONES:
        return -element.size
    if element.kind == Kind.FLAT:
        return 0.0
    block = int(element.detail)
    phase = _scattered((s - 1) / block, row / block) + element.turn + 1.0
    return element.size * wp.abs(2.0 * (phase - wp.floor(phase)) - 1.0)  # evenly spread, and continuous in the phase


@wp.kernel
def _rasterise_elements_kernel(elements: wp.array2d[Element], factor: float, heights_out: wp.array3d[float]):
    """Grid (num_terrains, nrow, ncol)."""
    t, row, col = wp.tid()
    height = float(0.0)
    for e in range(elements.shape[1]):
        element = elements[t, e]
        s = col - element.first
        if s >= element.cells:
            if s > 0:
                height = element.ground + element.rise
        elif s > 0:
            height = element.ground + _relief(element, s, row)
    heights_out[t, row, col] = factor * height


def lay_out(genes: Any) -> Any:
    """The elements of courses, in order: an array of :class:`Element`, shape (num_terrains, 6).

    Genes, shape (num_terrains, 36), are clipped to [-1, 1], six an element in the order of :data:`GENES`.
    """
    num_genes = MAX_ELEMENTS * GENES_PER_ELEMENT
    if genes.ndim != 2 or genes.shape[1] != num_genes:
        raise ValueError(
            f"genes must have shape (num_terrains, {num_genes}), got {tuple(genes.shape)}: one row is {MAX_ELEMENTS} "
            f"elements of {GENES_PER_ELEMENT}"
        )
    elements = wp.empty((genes.shape[0], MAX_ELEMENTS), dtype=Element, device=genes.device)
    inputs = [genes, _LOWS, _HIGHS, _WHOLE]
    wp.launch(_lay_out_kernel, genes.shape[0], inputs, outputs=[elements], device=genes.device)
    return elements


def place(elements: Any) -> None:
    """Lay single elements of any size behind the nodes that they name, each on a course of its own, in place.

    Of :class:`Element`, shape (num_terrains, 1), they have kind, first, size, length, detail and turn. One that does
    not fit before x = 12 m is cut, or becomes FLAT.
    """
    wp.launch(_place_kernel, elements.shape, [elements], device=elements.device)


def rasterise_elements(elements: Any, heights_out: Any, factor: float = 1.0) -> None:
    """Rasterise elements that :func:`lay_out` or :func:`place` laid, shape (num_terrains, num_elements)."""
    inputs, size = [elements, factor], heights_out.shape
    wp.launch(_rasterise_elements_kernel, size, inputs, outputs=[heights_out], device=elements.device)


def rasterise(genes: Any, spacing: float, heights_out: Any, factor: float = 1.0) -> None:
    """Rasterise one course a terrain, of genes as :func:`lay_out` takes them.

    Nodes are ``spacing`` [m] apart: 0.05, in which elements are measured. Heights [m] have shape (num_terrains, nrow,
    ncol), row along y, column along x, and are times ``factor``.
    """
    if spacing != SPACING:
        raise ValueError(f"spacing must be {SPACING} m, got {spacing}: elements have whole numbers of such cells")
    if heights_out.ndim != 3 or heights_out.shape[0] != genes.shape[0]:
        raise ValueError(
            f"heights_out must have shape ({genes.shape[0]}, nrow, ncol), got {tuple(heights_out.shape)}: "
            "one grid per row of genes"
        )
    rasterise_elements(lay_out(genes), heights_out, factor)
