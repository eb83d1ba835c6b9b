"""Any terrain space, and some genes more for the conditions under which robots cross."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kernels.ground import Ground
from sim.terrains.conditions.base import CONDITIONS, condition_column, condition_genes, condition_texts, nominal_row
from sim.terrains.spaces.base import Seed, TerrainSpace, WiderSpace, clipped


class UnderConditions(WiderSpace):
    """The terrains of a space, crossed under conditions (:mod:`sim.terrains.conditions`).

    The genes of the space come first, then those of each condition. A condition is a part.
    """

    def __init__(self, inner: TerrainSpace, kinds: tuple[str, ...]) -> None:
        """``kinds`` are names of conditions, in the order of :data:`sim.terrains.conditions.base.CONDITIONS`."""
        super().__init__(inner, kinds)
        self.conditions, self.num_genes = kinds, inner.num_genes + len(condition_genes(kinds))
        self.ground, self.genes_per_part = inner.ground, inner.genes_per_part

    def _split(self, genes: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Clipped genes of terrains and of conditions."""
        rows = clipped(genes)
        return rows[..., : self.inner.num_genes], rows[..., self.inner.num_genes :]

    def condition_rows(self, genes: ArrayLike) -> NDArray[np.float32]:
        """Rows of conditions, shape (num_terrains, number of values)."""
        values = self._split(genes)[1]
        rows = np.tile(nominal_row(), (len(values), 1))
        for column, gene in enumerate(condition_genes(self.conditions)):
            rows[:, condition_column(gene.name)] = gene.to_value(values[:, column])
        return rows

    def lay_ground(self, genes: Any, ground_out: Ground) -> None:
        """Turns genes into maps on the device, by the space."""
        self.inner.lay_ground(genes[:, : self.inner.num_genes].contiguous(), ground_out)

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Hard-random terrains of the space, each condition at one of its limits; pushes come at any time."""
        rng = np.random.default_rng(seed)
        hard = [gene.hard_at_limits for gene in condition_genes(self.conditions)]
        terrains = self.inner.hard_random(count, rng)
        limits = rng.choice([-1.0, 1.0], (count, len(hard)))
        conditions = np.where(hard, limits, rng.uniform(-1.0, 1.0, limits.shape))
        return np.concatenate([terrains, conditions.astype(np.float32)], axis=1)

    def _texts(self, genes: ArrayLike) -> list[str]:
        return condition_texts(self.condition_rows(np.asarray(genes)[None])[0], self.conditions)

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """Those of the space, then each condition."""
        texts = [text or f"no {name}" for name, text in zip(self.conditions, self._texts(genes), strict=True)]
        return (*self.inner.parts(self._split(genes)[0]), *texts)

    def absent(self, part: int) -> tuple[slice, Any]:
        """A condition that changes nothing."""
        first = self.inner.num_genes + len(condition_genes(self.conditions[:part]))
        values = [gene.absent for gene in CONDITIONS[self.conditions[part]].genes]
        return slice(first, first + len(values)), values

    def describe(self, genes: ArrayLike) -> str:
        """The terrain of the space, and the conditions in a line below it."""
        return "\n".join([self.inner.describe(self._split(genes)[0]), self.condition_text(genes)])

    def condition_text(self, genes: ArrayLike) -> str:
        """The conditions that are not nominal."""
        return ", ".join(filter(None, self._texts(genes))) or "nominal conditions"

    def spans(self, genes: ArrayLike) -> tuple[tuple[str, float, float], ...]:
        """Those of the space."""
        return self.inner.spans(self._split(genes)[0])


def varied_space(space: TerrainSpace) -> TerrainSpace:
    """The space whose terrains are those of another one under varied conditions."""
    names = tuple(name for name in CONDITIONS if name in space.conditions or CONDITIONS[name].varied)
    return UnderConditions(space.inner if isinstance(space, UnderConditions) else space, names)


def varied_genes(space: TerrainSpace, genes: NDArray[np.float32], seeds: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Genes of a terrain, (num_genes,), under conditions drawn by each seed, for :func:`varied_space`.

    The first value of a condition is drawn uniformly from its ``varied`` limits, what controllers are usually trained
    for; others are nominal. Conditions that the space has genes of stay as they are. Shape (number of seeds, its
    num_genes).
    """
    end, kept = space.num_genes - len(condition_genes(space.conditions)), dict[str, NDArray[np.float32]]()
    terrain = genes[:end]
    for name in space.conditions:
        first, end = end, end + len(CONDITIONS[name].genes)
        kept[name] = genes[first:end]
    rows = []
    for seed in seeds.tolist():
        rng, row = np.random.default_rng(seed), [terrain]
        for name, condition in CONDITIONS.items():
            if name in kept:
                row.append(kept[name])
            elif condition.varied:
                drawn = rng.uniform(*condition.varied)
                row.append(condition.to_genes({condition.genes[0].name: drawn}).astype(np.float32))
        rows.append(np.concatenate(row))
    return np.stack(rows)
