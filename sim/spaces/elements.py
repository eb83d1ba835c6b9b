"""Courses each element of which has a friction of its own, a softness, or both."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from kernels.course import GENES_PER_ELEMENT, MAX_ELEMENTS, Kind, lay_out, spread
from kernels.ground import STRIPS, Ground
from sim.ground import joined_name
from sim.spaces.base import Seed, TerrainSpace, clipped
from sim.spaces.course import Course
from sim.spaces.ground import ABSENT, decode, ground_words, values_of


@dataclass(frozen=True, kw_only=True)
class OnElements(TerrainSpace):
    """Courses whose elements have ground of their own: a wet metal plate, a mossy kerb.

    The genes of an element are the six of the course, then one of each map. Its ground lies over the whole width, from
    0.1 m before it to 0.1 m behind it (:data:`kernels.course.GROUND_CELLS`); all other ground is as always. A part is
    an element with its ground.
    """

    inner: Course
    """Whose heights it has."""
    names: tuple[str, ...]
    """Some of :data:`sim.ground.ELEMENT_KINDS`, in their order."""

    @property
    def name(self) -> str:
        """What files and command lines call the space: ``course+element-friction``."""
        return joined_name(self.inner.name, self.names)

    @property
    def num_genes(self) -> int:
        """Seven or eight genes an element, element after element."""
        return MAX_ELEMENTS * self.genes_per_part

    @property
    def sigma0(self) -> float:
        """That of the course."""
        return self.inner.sigma0

    @property
    def genes_per_part(self) -> int:
        """Those of an element, its ground included."""
        return GENES_PER_ELEMENT + len(self.names)

    @property
    def ground(self) -> tuple[str, ...]:
        """What its terrains have maps of."""
        return tuple(name.removeprefix("element-") for name in self.names)

    @property
    def ground_shape(self) -> tuple[int, int]:
        """Strips across the way, as long as a cell of the height grid, so that they end where elements do."""
        return STRIPS

    def rasterise(self, genes: Any, spacing: float, heights_out: Any) -> None:
        """Turns genes into heights on the device, by the course."""
        self.inner.rasterise(self._course_of(genes), spacing, heights_out)

    def lay_ground(self, genes: Any, ground_out: Ground) -> None:
        """Turns genes into maps on the device (:func:`kernels.course.spread`)."""
        elements, rows = lay_out(self._course_of(genes)), self._rows(genes)
        columns: Any = wp.empty((genes.shape[0], STRIPS[1]), dtype=float, device=genes.device)
        for place, kind in enumerate(self.ground, GENES_PER_ELEMENT):
            spread(elements, rows[:, :, place].contiguous(), ABSENT[kind], columns)
            decode(kind, columns, ground_out)

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Hard-random courses; the ground of every element as it always is, or as slippery or soft as can be."""
        rng = np.random.default_rng(seed)
        heights = self.inner.hard_random(count, rng)
        own = rng.choice([-1.0, 1.0], (count, MAX_ELEMENTS, len(self.names)))
        return self._joined(heights, own.astype(np.float32))

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """Each element in words with its ground, six of them."""
        return tuple(words for words, _ in self._told(genes))

    def without(self, genes: ArrayLike, parts: Sequence[int]) -> NDArray[np.float32]:
        """Genes with flat ground as long as some elements in their place, whose ground is as always."""
        heights, own = self._split(self.validate(genes))
        own[:, list(parts)] = [ABSENT[kind] for kind in self.ground]
        return self._joined(self.inner.without(heights, parts), own)

    def scaled(self, genes: ArrayLike, scale: float) -> NDArray[np.float32]:
        """Genes with the size of every element scaled by the course; the ground stays as it is."""
        heights, own = self._split(self.validate(genes))
        return self._joined(self.inner.scaled(heights, scale), own)

    def describe(self, genes: ArrayLike) -> str:
        """The elements in words, in the order of the way, without flat ground that is as always.

        An element has its ground behind it: ``kerb 0.15 m up (friction 0.25)``.
        """
        return ", ".join(words for words, differs in self._told(genes) if differs) or "flat ground"

    def _told(self, genes: ArrayLike) -> list[tuple[str, bool]]:
        """Each element in words, and whether it is anything but flat ground as always."""
        heights, own = self._split(clipped(genes)[None])
        found = []
        words = zip(self.inner.parts(heights[0]), self.inner.elements(heights)[0], own[0], strict=True)
        for told, element, ground_genes in words:
            values = {kind: values_of(kind, gene[None]) for kind, gene in zip(self.ground, ground_genes, strict=True)}
            ground = ground_words(values) if element["cells"] else ""
            found.append((told + ground, bool(ground) or element["kind"] != Kind.FLAT))
        return found

    def _rows(self, genes: Any) -> Any:
        """Genes on the device element by element, shape (num_terrains, 6, genes_per_part)."""
        return genes.reshape((genes.shape[0], MAX_ELEMENTS, self.genes_per_part))

    def _course_of(self, genes: Any) -> Any:
        """The genes of the course on the device."""
        own = self._rows(genes)[:, :, :GENES_PER_ELEMENT].contiguous()
        return own.reshape((genes.shape[0], self.inner.num_genes))

    def _split(self, genes: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Copies of the genes of the course, and of those of the ground, clipped, shape (num_terrains, 6, maps)."""
        rows = genes.reshape(len(genes), MAX_ELEMENTS, self.genes_per_part)
        heights = rows[..., :GENES_PER_ELEMENT].reshape(len(genes), self.inner.num_genes)
        return heights.copy(), clipped(rows[..., GENES_PER_ELEMENT:])

    def _joined(self, heights: NDArray[np.float32], own: NDArray[np.float32]) -> NDArray[np.float32]:
        rows = heights.reshape(len(heights), MAX_ELEMENTS, GENES_PER_ELEMENT)
        return np.concatenate([rows, own], axis=2).reshape(len(heights), self.num_genes)
