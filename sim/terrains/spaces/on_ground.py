"""Any terrain space, and genes more for its ground: 32 for friction, 32 for softness, or both."""

from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kernels.ground import COLS, NUM_PATCHES, PATCH, ROWS, Ground, decode_friction, decode_softness
from sim.terrains.ground import MAX_TIME_CONSTANT_S, MIN_FRICTION, MIN_TIME_CONSTANT_S, patch_index
from sim.terrains.spaces.base import Seed, TerrainSpace, WiderSpace, clipped

ABSENT = {"friction": 1.0, "softness": -1.0}
"""The gene of ground that changes nothing."""
_ROWS_OF_THE_WAY = slice(ROWS // 2 - 1, ROWS // 2 + 1)  # rows of patches, the right one first
_MAX_SLIPPERY = 0.995  # rounded, what is above is 1.00


class OnGround(WiderSpace):
    """The terrains of a space on ground whose patches differ.

    The genes of the space come first, then those of each map, patch after patch (:mod:`kernels.ground`). A patch is a
    part; one that changes nothing counts as absent.
    """

    def __init__(self, inner: TerrainSpace, ground: tuple[str, ...]) -> None:
        """``ground`` are some of :data:`sim.terrains.ground.GROUND_KINDS`, in their order."""
        super().__init__(inner, ground)
        self.ground, self.num_genes = ground, inner.num_genes + NUM_PATCHES * len(ground)
        # Where maps divide by the parts of the space too: eight patches are a row along the way.
        per_part = inner.genes_per_part
        self.genes_per_part = per_part if per_part and NUM_PATCHES % per_part == 0 else None

    def lay_ground(self, genes: Any, ground_out: Ground) -> None:
        """Turns genes into maps on the device (:mod:`kernels.ground`)."""
        if "friction" in self.ground:
            decode_friction(genes[:, self._columns("friction")].contiguous(), ground_out.friction)
        if "softness" in self.ground:
            decode_softness(genes[:, self._columns("softness")].contiguous(), ground_out.time_constant)

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Hard-random terrains of the space; every patch as it always is, or as slippery or soft as can be."""
        rng = np.random.default_rng(seed)
        heights = self.inner.hard_random(count, rng)
        maps = rng.choice([-1.0, 1.0], (count, self.num_genes - self.inner.num_genes))
        return np.concatenate([heights, maps.astype(np.float32)], axis=1)

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """Those of the space, then each patch of each map."""
        row = clipped(genes)
        patches = [(kind, patch) for kind in self.ground for patch in enumerate(self._values(row, kind))]
        texts = [_patch_text(kind, value, patch) for kind, (patch, value) in patches]
        return (*self.inner.parts(row[: self.inner.num_genes]), *texts)

    def absent(self, part: int) -> tuple[slice, Any]:
        """The gene of a patch that changes nothing."""
        first = self.inner.num_genes + part
        return slice(first, first + 1), ABSENT[self.ground[part // NUM_PATCHES]]

    def describe(self, genes: ArrayLike) -> str:
        """The terrain of the space, and of each map the patches on both sides of the way, a line each.

        What lies across the way has its ground behind it: ``kerb 0.15 m up (friction 0.25)``.
        """
        row = clipped(genes)
        heights = row[: self.inner.num_genes]
        across = [text + self._ground_text(row, begin, end) for text, begin, end in self.inner.spans(heights)]
        lines = [", ".join(across) or self.inner.describe(heights)]
        for kind in self.ground:
            right, left = self._values(row, kind).reshape(ROWS, COLS)[_ROWS_OF_THE_WAY]
            lines.append(f"{_TITLES[kind]}: left of the way {_numbers(left)}, right of it {_numbers(right)}")
        return "\n".join(lines)

    def _ground_text(self, row: NDArray[np.float32], begin: float, end: float) -> str:
        """The worst ground on both sides of the way between two x [m], in brackets; empty if all is as always."""
        first, last = patch_index((begin, end), PATCH * COLS, COLS)
        texts = []
        for kind in self.ground:
            values = self._values(row, kind).reshape(ROWS, COLS)[_ROWS_OF_THE_WAY, first : last + 1]
            if kind == "friction" and values.min() < _MAX_SLIPPERY:
                texts.append(f"friction {values.min():.2f}")
            if kind == "softness" and values.max() > 0.0:
                texts.append(f"soft, {values.max():.3f} s")
        return f" ({', '.join(texts)})" if texts else ""

    def _columns(self, kind: str) -> slice:
        first = self.inner.num_genes + NUM_PATCHES * self.ground.index(kind)
        return slice(first, first + NUM_PATCHES)

    def _values(self, row: NDArray[np.float32], kind: str) -> NDArray[np.float64]:
        """Frictions, or time constants [s], of one terrain, shape (32,)."""
        share = (row[self._columns(kind)].astype(np.float64) + 1.0) / 2.0
        if kind == "friction":
            return 1.0 - (1.0 - share) * (1.0 - MIN_FRICTION)
        tau = MIN_TIME_CONSTANT_S * (MAX_TIME_CONSTANT_S / MIN_TIME_CONSTANT_S) ** share
        return np.where(share > 0.0, tau, 0.0)


def ground_genes(kind: str, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Genes of a map of one friction, or of one time constant [s] above the least; shape (num_values, 32)."""
    if kind == "friction":
        genes = 1.0 - 2.0 * (1.0 - values) / (1.0 - MIN_FRICTION)
    else:
        genes = 2.0 * np.log(values / MIN_TIME_CONSTANT_S) / np.log(MAX_TIME_CONSTANT_S / MIN_TIME_CONSTANT_S) - 1.0
    return np.repeat(genes[:, None], NUM_PATCHES, axis=1)


_TITLES = {
    "friction": "friction every 2 m along the way",
    "softness": "time constant of the ground [s] every 2 m along the way, 0 where it is firm",
}


def _numbers(values: NDArray[np.float64]) -> str:
    return " ".join(f"{value:.2f}" for value in values)


def _patch_text(kind: str, value: float, patch: int) -> str:
    row, col = divmod(patch, COLS)
    where = f"at x = {PATCH * col:.0f} to {PATCH * (col + 1):.0f} m, y = {PATCH * row:.0f} to {PATCH * (row + 1):.0f} m"
    if kind == "friction":
        return f"friction {value:.2f} {where}"
    return f"soft ground of {value:.3f} s {where}" if value else f"firm ground {where}"
