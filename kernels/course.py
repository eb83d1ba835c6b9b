"""Genes to heights: courses of man-made elements, one behind the other across the way, rasterised on the device.

A course is flat up to x = 4 m and from x = 12 m on. Between lie up to six elements over the full width. Where one
begins and ends is a whole number of cells, so its edges lie on nodes: a vertical face is the slope between two
neighbouring nodes, 0.05 m wide. An element that is longer than what is left before x = 12 m is cut to fit, and left
out where its shortest form does not fit.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any, NamedTuple

import warp as wp

from kernels.launch import kernel_over, launch_grid

SPACING = 0.05
"""Distance of neighbouring nodes [m], for which courses are made."""
FIRST_COL = 80
"""Column of the node behind which elements lie: x = 4 m."""
LAST_COL = 240
"""Column of the node before which they end: x = 12 m."""
CENTRE_ROW = 80
"""Row of the nodes on the way: y = 4 m."""
MAX_ELEMENTS = 6
GENES = ("kind", "lead", "size", "length", "detail", "turn")
"""Genes of one element in order: kind, flat ground before it, and four parameters of the kind."""
GENES_PER_ELEMENT = len(GENES)


class Range(NamedTuple):
    """Values of a parameter over its gene from -1 to 1."""

    low: float
    high: float
    whole: bool = False
    """Whether it takes whole numbers, each on an equal share of the gene."""
    hard: str = ""
    """Which end makes it hard: low, high, or either; none if empty."""


NONE = Range(0.0, 0.0)
"""Of a parameter that a kind does not have."""
DIRECTION = Range(-1.0, 1.0, hard="either")
"""Up or left where it is not negative, else down or right."""
LEAD = Range(4, 16, whole=True)
"""Flat ground before an element [cells]."""


@wp.struct
class Element:
    """One element as it lies: its parameters, where it begins, and the ground around it."""

    kind: int
    """Number of its kind among those of the kernels; 0, flat ground, where it was left out."""
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
    shortest: float
    """Least length of its kind."""


@wp.func
def direction_sign(element: Element) -> float:
    """1 for up (or left), -1 for down."""
    return wp.where(element.turn >= 0.0, 1.0, -1.0)


@wp.func
def _fit_faces(element: Element, room: int, faces: int) -> Element:
    element.length = wp.min(element.length, float(room - faces))
    element.cells = int(element.length) + faces
    if element.length < element.shortest:
        element.cells = room + 1
    return element


@wp.func
def fit_length(element: Element, room: int) -> Element:
    """Cut the length [cells] to the room."""
    return _fit_faces(element, room, 0)


@wp.func
def fit_top(element: Element, room: int) -> Element:
    """Cut the length of the top, which stands between two faces of a cell each."""
    return _fit_faces(element, room, 2)


@wp.func
def fit_face(element: Element, room: int) -> Element:
    """Take one cell, a vertical face."""
    element.cells = 1
    return element


@wp.func
def rise_nothing(element: Element) -> float:
    """Leave the ground as high as before."""
    return 0.0


@wp.func
def raise_size(element: Element, s: int, row: int) -> float:
    """As high as the size everywhere [m]."""
    return element.size


@dataclass(frozen=True, kw_only=True, eq=False)
class ElementKind:
    """A kind of element: ranges of its parameters, and Warp functions that lay it."""

    name: str
    size: Range = NONE
    """[m]; of slopes a gradient."""
    length: Range = NONE
    """[cells]; of stairs the tread [m]."""
    detail: Range = NONE
    turn: Range = NONE
    fit: Any = fit_length
    """``fit(element, room) -> element`` with its ``cells``, cut to so many if it can be."""
    rise: Any = rise_nothing
    """``rise(element)``: height of the ground behind it over that before it [m]."""
    relief: Any = raise_size
    """``relief(element, s, row)``: height over the ground before it [m], at the node s cells in; 0 < s < its cells."""

    @property
    def ranges(self) -> tuple[Range, Range, Range, Range]:
        """Ranges of the four parameters, in the order of their genes."""
        return self.size, self.length, self.detail, self.turn


Kinds = tuple[ElementKind, ...]


@wp.func
def _decode(gene: float, low: float, high: float, whole: float) -> float:
    share = (wp.clamp(gene, -1.0, 1.0) + 1.0) * 0.5
    if whole > 0.0:
        return low + wp.min(wp.floor(share * (high - low + 1.0)), high - low)
    return low + share * (high - low)


@kernel_over("elements_out")
def _decode_elements(
    genes: wp.array2d[float],
    numbers: wp.array[int],
    ranges: wp.array2d[wp.vec3],
    lead: wp.vec3,
    elements_out: wp.array2d[Element],
):
    """Grid (num_terrains, 6)."""
    t, e = wp.tid()
    g = e * GENES_PER_ELEMENT
    k = int(_decode(genes[t, g], 0.0, float(numbers.shape[0] - 1), 1.0))
    element = Element()
    element.kind = numbers[k]
    element.first = int(_decode(genes[t, g + 1], lead[0], lead[1], lead[2]))
    element.size = _decode(genes[t, g + 2], ranges[k, 0][0], ranges[k, 0][1], ranges[k, 0][2])
    element.length = _decode(genes[t, g + 3], ranges[k, 1][0], ranges[k, 1][1], ranges[k, 1][2])
    element.detail = _decode(genes[t, g + 4], ranges[k, 2][0], ranges[k, 2][1], ranges[k, 2][2])
    element.turn = _decode(genes[t, g + 5], ranges[k, 3][0], ranges[k, 3][1], ranges[k, 3][2])
    element.shortest = ranges[k, 1][0]
    elements_out[t, e] = element


@cache
def _make_kernels(kinds: Kinds) -> tuple[Any, Any]:
    """Kernels that lay and rasterise elements of these kinds."""
    count = len(kinds)
    fits, rises, reliefs = ([getattr(kind, name) for kind in kinds] for name in ("fit", "rise", "relief"))

    @wp.kernel(module="unique", enable_backward=False)
    def lay_kernel(first_col: int, elements: wp.array2d[Element]):
        """Grid (num_terrains,)."""
        t = wp.tid()
        col = int(first_col)
        ground = float(0.0)
        for e in range(elements.shape[1]):
            element = elements[t, e]
            col = wp.min(col + element.first, LAST_COL)
            for k in range(count):
                if element.kind == k:
                    element = wp.static(fits[k])(element, LAST_COL - col)
            if element.cells > LAST_COL - col:
                element.kind = 0
                element.cells = 0
                element.length = 0.0
            element.first = col
            element.ground = ground
            for k in range(count):
                if element.kind == k:
                    element.rise = wp.static(rises[k])(element)
            elements[t, e] = element
            col += element.cells
            ground += element.rise

    @kernel_over("heights_out", module="unique")
    def rasterise(elements: wp.array2d[Element], factor: float, heights_out: wp.array3d[float]):
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
                for k in range(count):
                    if element.kind == k:
                        height = element.ground + wp.static(reliefs[k])(element, s, row)
        heights_out[t, row, col] = factor * height

    return lay_kernel, rasterise


@cache
def _make_tables(all_kinds: Kinds, kinds: Kinds, device: str) -> tuple[Any, Any]:
    """Numbers of some kinds among all, and the ranges of their parameters (low, high, whether whole)."""
    ranges = [[wp.vec3(*map(float, limits[:3])) for limits in kind.ranges] for kind in kinds]
    numbers = [all_kinds.index(kind) for kind in kinds]
    return wp.array(numbers, dtype=int, device=device), wp.array(ranges, dtype=wp.vec3, device=device)


def lay_out(genes: Any, all_kinds: Kinds, kinds: Sequence[ElementKind]) -> Any:
    """The elements of courses, in order: an array of :class:`Element`, shape (num_terrains, 6).

    Genes, shape (num_terrains, 36), are clipped to [-1, 1], six an element in the order of :data:`GENES`. Elements are
    of ``kinds``, which are among ``all_kinds``; the first of both is flat ground.
    """
    num_genes = MAX_ELEMENTS * GENES_PER_ELEMENT
    if genes.ndim != 2 or genes.shape[1] != num_genes:
        raise ValueError(f"genes must have shape (num_terrains, {num_genes}), got {tuple(genes.shape)}")
    elements = wp.empty((genes.shape[0], MAX_ELEMENTS), dtype=Element, device=genes.device)
    tables = _make_tables(all_kinds, tuple(kinds), str(genes.device))
    _decode_elements(genes, *tables, wp.vec3(*map(float, LEAD[:3])), elements)
    lay_elements(elements, all_kinds, FIRST_COL)
    return elements


def lay_elements(elements: Any, all_kinds: Kinds, first_col: int = 0) -> None:
    """Lay elements one behind the other, in place, each ``first`` cells behind the one before, or ``first_col``.

    Of :class:`Element`, shape (num_terrains, num_elements), they have kind, first, size, length, detail and turn. One
    that does not fit before x = 12 m is cut, or becomes flat.
    """
    launch_grid(_make_kernels(all_kinds)[0], (len(elements),), [first_col, elements], elements.device)


def rasterise_elements(elements: Any, all_kinds: Kinds, heights_out: Any, factor: float = 1.0) -> None:
    """Rasterise elements that were laid, shape (num_terrains, num_elements), one course a terrain.

    Nodes are 0.05 m apart. Heights [m] have shape (num_terrains, nrow, ncol), row along y, column along x, and are
    times ``factor``.
    """
    if heights_out.ndim != 3 or heights_out.shape[0] != elements.shape[0]:
        raise ValueError(f"heights_out must have shape ({len(elements)}, nrow, ncol), got {tuple(heights_out.shape)}")
    _make_kernels(all_kinds)[1](elements, factor, heights_out)
