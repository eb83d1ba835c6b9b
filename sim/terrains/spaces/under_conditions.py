"""Any terrain space, and some genes more for the conditions under which robots cross."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kernels.conditions import Condition
from kernels.ground import Ground
from sim.terrains.conditions import KINDS, genes_of, rows_of, words_of
from sim.terrains.ground import joined_name, split_name
from sim.terrains.spaces.base import Seed, TerrainSpace, WiderSpace, clipped


class UnderConditions(WiderSpace):
    """The terrains of a space, crossed under conditions (:mod:`sim.terrains.conditions`).

    The genes of the space come first, then those of each kind of condition. A kind is a part.
    """

    def __init__(self, inner: TerrainSpace, kinds: tuple[str, ...]) -> None:
        """``kinds`` are some of :data:`sim.terrains.conditions.KINDS`, in their order."""
        super().__init__(inner, kinds)
        self.conditions, self.num_genes = kinds, inner.num_genes + len(genes_of(kinds))
        self.ground, self.genes_per_part = inner.ground, inner.genes_per_part

    def _split(self, genes: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Clipped genes of terrains and of conditions."""
        rows = clipped(genes)
        return rows[..., : self.inner.num_genes], rows[..., self.inner.num_genes :]

    def conditions_of(self, genes: ArrayLike) -> NDArray[np.float32]:
        """Rows of conditions, shape (num_terrains, 12)."""
        return rows_of(self._split(genes)[1], self.conditions)

    def lay_ground(self, genes: Any, ground_out: Ground) -> None:
        """Turns genes into maps on the device, by the space."""
        self.inner.lay_ground(genes[:, : self.inner.num_genes].contiguous(), ground_out)

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Hard-random terrains of the space, each condition at one of its limits; pushes come at any time."""
        rng, genes = np.random.default_rng(seed), genes_of(self.conditions)
        terrains = self.inner.hard_random(count, rng)
        limits = rng.choice([-1.0, 1.0], (count, len(genes)))
        times = [gene.condition == Condition.PUSH_TIME for gene in genes]
        conditions = np.where(times, rng.uniform(-1.0, 1.0, limits.shape), limits)
        return np.concatenate([terrains, conditions.astype(np.float32)], axis=1)

    def _words(self, genes: ArrayLike) -> list[str]:
        row = self.conditions_of(np.asarray(genes)[None])[0]
        return [words_of(kind, row) for kind in self.conditions]

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """Those of the space, then each kind of condition in words."""
        words = [word or f"no {kind}" for kind, word in zip(self.conditions, self._words(genes), strict=True)]
        return (*self.inner.parts(self._split(genes)[0]), *words)

    def absent(self, part: int) -> tuple[slice, Any]:
        """A condition that changes nothing."""
        first = self.inner.num_genes + len(genes_of(self.conditions[:part]))
        values = [gene.absent for gene in KINDS[self.conditions[part]]]
        return slice(first, first + len(values)), values

    def describe(self, genes: ArrayLike) -> str:
        """The terrain of the space in words, and the conditions in a line behind it."""
        return "\n".join([self.inner.describe(self._split(genes)[0]), self.condition_words(genes)])

    def condition_words(self, genes: ArrayLike) -> str:
        """Those that are not nominal, in words."""
        return ", ".join(filter(None, self._words(genes))) or "nominal conditions"

    def spans(self, genes: ArrayLike) -> tuple[tuple[str, float, float], ...]:
        """Those of the space."""
        return self.inner.spans(self._split(genes)[0])


VARIED: dict[str, tuple[float, float]] = {
    "payload": (-0.01, 0.03), "motors": (0.9, 1.1), "delay": (0.0, 0.02), "noise": (1.0, 1.0), "grip": (0.7, 1.2),
}  # fmt: skip
"""Limits between which the first number of a kind is drawn, uniformly, for varied conditions; the others are nominal.

They are what controllers are usually trained for: a payload in the middle of the base over the robot's mass, factors of
torques and of friction, a delay of actions [s], and legged_gym's noise.
"""


def varied_name(space: TerrainSpace) -> str:
    """The name of the space whose terrains are those of another one under varied conditions."""
    base, kinds = split_name(space.name)
    ground = [kind for kind in kinds if kind not in KINDS]
    return joined_name(base, [*ground, *(kind for kind in KINDS if kind in kinds or kind in VARIED)])


def varied_genes(space: TerrainSpace, genes: NDArray[np.float32], seeds: NDArray[np.uint32]) -> NDArray[np.float32]:
    """Genes of a terrain, (num_genes,), under conditions drawn by each seed, for the space of :func:`varied_name`.

    Conditions that the space has genes of stay as they are. Shape (number of seeds, its num_genes).
    """
    first = space.num_genes - len(genes_of(space.conditions))
    ends = np.cumsum([len(KINDS[kind]) for kind in space.conditions], dtype=int)
    own = dict(zip(space.conditions, np.split(genes[first:], ends[:-1]), strict=False))  # without any, one empty part
    rows = []
    for seed in seeds.tolist():
        rng, parts = np.random.default_rng(seed), [genes[:first]]
        for kind in KINDS:
            if kind in own:
                parts.append(own[kind])
            elif kind in VARIED:
                drawn, *others = KINDS[kind]
                value = float(drawn.gene(np.array(rng.uniform(*VARIED[kind]))))
                parts.append(np.array([value, *(other.absent for other in others)], np.float32))
        rows.append(np.concatenate(parts))
    return np.stack(rows)
