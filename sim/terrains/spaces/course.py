"""Courses: up to six man-made elements across the way, in sizes around those of building codes and outdoor works."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from kernels import course
from kernels.course import GENES, GENES_PER_ELEMENT, MAX_ELEMENTS, SPACING
from sim.device import host_device
from sim.terrains.elements.kinds import ELEMENTS, KINDS, CourseElement, all_elements
from sim.terrains.spaces.base import Seed, ShippedSpace, clipped

_KIND, _SIZE, _LENGTH = map(GENES.index, ("kind", "size", "length"))


@dataclass(frozen=True, kw_only=True)
class Course(ShippedSpace):
    """Kerbs, steps, stairs, ramps, ditches and the like between x = 4 m and x = 12 m, over the full width.

    An element has six genes (:data:`kernels.course.GENES`): its kind, the flat ground before it, and four parameters
    (:mod:`sim.terrains.elements`). docs/terrains.md says which standards their ranges come from.
    """

    base_name: ClassVar[str] = "course"
    kinds: ClassVar[tuple[str, ...]] = tuple(kind.name for kind in KINDS)
    """Elements on equal shares of the gene; neighbours are alike, so a small change of the gene is a small change.
    The first is flat ground."""
    num_genes: ClassVar[int] = MAX_ELEMENTS * GENES_PER_ELEMENT
    """Six genes an element, in the order of :data:`kernels.course.GENES`, element after element."""
    sigma0: ClassVar[float] = 0.5
    """A quarter of the genes' range: a wider start asks for the first and the last kind alone."""
    genes_per_part: ClassVar[int] = GENES_PER_ELEMENT

    @property
    def _kinds(self) -> tuple[CourseElement, ...]:
        return tuple(ELEMENTS[name] for name in self.kinds)

    def rasterise(self, genes: Any, spacing: float, heights_out: Any) -> None:
        """Turns genes into heights on the device (:mod:`kernels.course`)."""
        if spacing != SPACING:
            raise ValueError(f"spacing must be {SPACING} m, got {spacing}: elements have whole numbers of such cells")
        elements = course.lay_out(genes, all_elements(), self._kinds)
        course.rasterise_elements(elements, all_elements(), heights_out, self.height_share)

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Kinds drawn evenly, every parameter that makes an element hard at its hard end, the others uniform."""
        genes = self.uniform_random(count, seed)
        rows, num_kinds = genes.reshape(-1, GENES_PER_ELEMENT), len(self.kinds)
        numbers = np.minimum((rows[:, _KIND] + 1.0) / 2.0 * num_kinds, num_kinds - 1).astype(int)
        for number, kind in enumerate(self._kinds):
            mask = numbers == number
            for column, limits in enumerate(kind.ranges, _SIZE):
                drawn = rows[mask, column]
                ends = {"": drawn, "low": -1.0, "high": 1.0, "either": np.where(drawn < 0.0, -1.0, 1.0)}
                rows[mask, column] = ends[limits.hard]
        return genes

    def elements(self, genes: ArrayLike) -> NDArray[Any]:
        """The elements of genes as they lie, records of :class:`kernels.course.Element`, shape (num_terrains, 6).

        Their ``kind`` counts :func:`sim.terrains.elements.kinds.all_elements`.
        """
        with wp.ScopedDevice(host_device()):
            rows: Any = wp.array(self.validate(genes), dtype=float)
            records: Any = course.lay_out(rows, all_elements(), self._kinds).numpy()
        return records.copy()

    def _laid(self, genes: ArrayLike) -> list[tuple[CourseElement, Any]]:
        """Each element of one row of genes with its record, with its heights as they are."""
        (elements,) = self.elements(np.asarray(genes)[None])
        elements["size"] *= self.height_share  # of a ramp the slope
        return [(all_elements()[record["kind"]], record) for record in elements]

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """Each element, six of them."""
        return tuple(kind.text(record) for kind, record in self._laid(genes))

    def without(self, genes: ArrayLike, parts: Sequence[int]) -> NDArray[np.float32]:
        """Genes with flat ground as long as some elements in their place; the others stay where they are."""
        changed = self.validate(genes).copy()
        cells, flat = self.elements(changed)["cells"], self._kinds[0].length
        rows = changed.reshape(len(changed), MAX_ELEMENTS, GENES_PER_ELEMENT)
        for part in parts:
            rows[:, part, _KIND] = _middle_gene(0, len(self.kinds))
            rows[:, part, _LENGTH] = _middle_gene(cells[:, part] - flat.low, flat.high - flat.low + 1)
        return clipped(changed)

    def scaled(self, genes: ArrayLike, scale: float) -> NDArray[np.float32]:
        """Genes with the size of every element times ``scale``, or the least that its kind has."""
        changed = clipped(self.validate(genes))
        numbers = self.elements(changed)["kind"]
        rows = changed.reshape(len(changed), MAX_ELEMENTS, GENES_PER_ELEMENT)
        for kind in self._kinds:
            mask, size = numbers == all_elements().index(kind), kind.size
            if size.high > size.low:
                metres = size.low + (rows[mask, _SIZE] + 1.0) / 2.0 * (size.high - size.low)
                share = (np.maximum(metres * scale, size.low) - size.low) / (size.high - size.low)
                rows[mask, _SIZE] = 2.0 * share - 1.0
        return changed

    def describe(self, genes: ArrayLike) -> str:
        """The elements in the order of the way, without flat ground."""
        return ", ".join(text for text, _, _ in self.spans(genes)) or "flat ground"

    def spans(self, genes: ArrayLike) -> tuple[tuple[str, float, float], ...]:
        """Each element but flat ground, with where it begins and ends [m]."""
        laid = [(kind.text(element), element) for kind, element in self._laid(genes) if element["kind"]]
        return tuple((text, SPACING * e["first"], SPACING * (e["first"] + e["cells"])) for text, e in laid)


def _middle_gene(number: Any, count: float) -> Any:
    """Gene in the middle of the share of one of ``count`` whole numbers, counted from 0."""
    return (2.0 * number + 1.0) / count - 1.0


COURSE = Course()
