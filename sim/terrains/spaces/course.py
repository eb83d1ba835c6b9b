"""Courses: up to six man-made elements across the way, in sizes around those of building codes and outdoor works."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from kernels import course
from kernels.course import GENES, GENES_PER_ELEMENT, MAX_ELEMENTS, PARAMETERS, SPACING, Kind
from sim.device import host_device
from sim.terrains.spaces.base import Seed, ShippedSpace, clipped

_KIND, _LENGTH = GENES.index("kind"), GENES.index("length")
_SIZE = _FIRST_PARAMETER = GENES.index("size")


@dataclass(frozen=True, kw_only=True)
class Course(ShippedSpace):
    """Kerbs, steps, stairs, ramps, ditches and the like between x = 4 m and x = 12 m, over the full width.

    An element has six genes (:data:`kernels.course.GENES`): its kind, the flat ground before it, and four parameters
    (:data:`kernels.course.PARAMETERS`). docs/terrains.md says which standards their ranges come from.
    """

    base_name: ClassVar[str] = "course"
    num_genes: ClassVar[int] = MAX_ELEMENTS * GENES_PER_ELEMENT
    """Six genes an element, in the order of :data:`kernels.course.GENES`, element after element."""
    sigma0: ClassVar[float] = 0.5
    """A quarter of the genes' range: a wider start asks for the first and the last kind alone."""
    genes_per_part: ClassVar[int] = GENES_PER_ELEMENT

    def rasterise(self, genes: Any, spacing: float, heights_out: Any) -> None:
        """Turns genes into heights on the device (:func:`kernels.course.rasterise`)."""
        course.rasterise(genes, spacing, heights_out, self.height_share)

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Kinds drawn evenly, every parameter that makes an element hard at its hard end, the others uniform."""
        genes = self.uniform_random(count, seed)
        rows = genes.reshape(-1, GENES_PER_ELEMENT)
        kinds = np.minimum((rows[:, _KIND] + 1.0) / 2.0 * len(Kind), len(Kind) - 1).astype(int)
        for kind, ranges in PARAMETERS.items():
            for column, limits in enumerate(ranges, _FIRST_PARAMETER):
                of_kind = kinds == kind
                if limits.hard == "either":
                    rows[of_kind, column] = np.where(rows[of_kind, column] < 0.0, -1.0, 1.0)
                elif limits.hard:
                    rows[of_kind, column] = {"low": -1.0, "high": 1.0}[limits.hard]
        return genes

    def elements(self, genes: ArrayLike) -> NDArray[Any]:
        """The elements of genes as they lie, records of :class:`kernels.course.Element`, shape (num_terrains, 6)."""
        with wp.ScopedDevice(host_device()):
            records: Any = course.lay_out(wp.array(self.validate(genes), dtype=float)).numpy()
        return records.copy()

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """Each element in words, six of them."""
        return tuple(map(_in_words, self._scaled_elements(genes)))

    def _scaled_elements(self, genes: ArrayLike) -> NDArray[Any]:
        """The elements of one row of genes with their heights as they are, also of ramps, whose size is the slope."""
        (elements,) = self.elements(np.asarray(genes)[None])
        elements["size"] *= self.height_share
        return elements

    def without(self, genes: ArrayLike, parts: Sequence[int]) -> NDArray[np.float32]:
        """Genes with flat ground as long as some elements in their place; the others stay where they are."""
        changed = self.validate(genes).copy()
        cells = self.elements(changed)["cells"]
        (_, flat, *_) = PARAMETERS[Kind.FLAT]
        rows = changed.reshape(len(changed), MAX_ELEMENTS, GENES_PER_ELEMENT)
        for part in parts:
            rows[:, part, _KIND] = _middle_of(Kind.FLAT, len(Kind))
            rows[:, part, _LENGTH] = _middle_of(cells[:, part] - flat.low, flat.high - flat.low + 1)
        return clipped(changed)

    def scaled(self, genes: ArrayLike, scale: float) -> NDArray[np.float32]:
        """Genes with the size of every element times ``scale``, or the least that its kind has."""
        changed = clipped(self.validate(genes))
        kinds = self.elements(changed)["kind"]
        rows = changed.reshape(len(changed), MAX_ELEMENTS, GENES_PER_ELEMENT)
        for kind, (size, *_) in PARAMETERS.items():
            of_kind = kinds == kind
            if size.high > size.low:
                metres = size.low + (rows[of_kind, _SIZE] + 1.0) / 2.0 * (size.high - size.low)
                share = (np.maximum(metres * scale, size.low) - size.low) / (size.high - size.low)
                rows[of_kind, _SIZE] = 2.0 * share - 1.0
        return changed

    def describe(self, genes: ArrayLike) -> str:
        """The elements in words, in the order of the way, without flat ground."""
        return ", ".join(words for words, _, _ in self.spans(genes)) or "flat ground"

    def spans(self, genes: ArrayLike) -> tuple[tuple[str, float, float], ...]:
        """Each element but flat ground in words, with where it begins and ends [m]."""
        return tuple(
            (_in_words(element), SPACING * element["first"], SPACING * (element["first"] + element["cells"]))
            for element in self._scaled_elements(genes)
            if element["kind"] != Kind.FLAT
        )


def _middle_of(number: Any, count: float) -> Any:
    """Gene in the middle of the share of one of ``count`` whole numbers, counted from 0."""
    return (2.0 * number + 1.0) / count - 1.0


def _in_words(element: Any) -> str:
    kind = Kind(element["kind"])
    if kind is Kind.FLAT:
        return f"flat ground of {_m(element['cells'])}" if element["cells"] else "nothing"
    return _WORDS[kind](element)


def _m(cells: float) -> str:
    return f"{cells * SPACING:.2f} m"


def _way(element: Any) -> str:
    return "up" if element["turn"] >= 0.0 else "down"


def _pallet(element: Any) -> str:
    count = round(float(element["detail"]))
    what = "pallet" if count == 1 else f"{count} pallets,"
    return f"{what} {count * element['size']:.2f} m high and {_m(element['length'])} long"


def _ditch(element: Any) -> str:
    return f"ditch {_m(element['cells'])} wide and {element['size']:.2f} m deep"


def _beam(element: Any) -> str:
    off = round(float(element["turn"]))
    side = f", {_m(abs(off))} {'left' if off > 0 else 'right'} of the way" if off else ""
    return f"beam {_m(element['detail'])} wide over a {_ditch(element)}{side}"


_WORDS: dict[Kind, Callable[[Any], str]] = {
    Kind.RAMP: lambda e: f"ramp of 1:{1 / e['size']:.1f} {_way(e)}, {_m(e['cells'])} long",
    Kind.CROSS_SLOPE: lambda e: (
        f"cross slope of 1:{1 / e['size']:.1f} {'left' if e['turn'] >= 0.0 else 'right'} side up, {_m(e['cells'])} long"
    ),
    Kind.SILL: lambda e: f"sill {e['size']:.3f} m high and {_m(e['length'])} wide",
    Kind.RAIL: lambda e: f"rail {e['size']:.3f} m high" + (f" and {_m(e['length'])} wide" if e["length"] else ""),
    Kind.KERB: lambda e: f"kerb {e['size']:.2f} m {_way(e)}",
    Kind.STEP: lambda e: f"step {e['size']:.2f} m {_way(e)}",
    Kind.STAIRS: lambda e: f"{e['detail']:.0f} stairs of {e['size']:.2f} x {e['length']:.2f} m {_way(e)}",
    Kind.PALLET: _pallet,
    Kind.DITCH: _ditch,
    Kind.BRIDGE: _beam,
    Kind.STONES: lambda e: f"stones of {_m(e['detail'])}, {_m(e['turn'])} apart, in a {_ditch(e)}",
    Kind.RUBBLE: lambda e: f"rubble of blocks of {_m(e['detail'])} up to {e['size']:.2f} m high, {_m(e['cells'])} long",
}

COURSE = Course()
