"""Terrain spaces: what a row of genes in [-1, 1] means. Another space is one more class and its line in ``SPACES``."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kernels import super_gaussian
from kernels.super_gaussian import GENES_PER_BUMP, LOWER, PARAMETERS, UPPER

Seed = int | np.random.Generator
"""What random terrains are drawn from. A Generator gives other terrains on each call, an int the same ones."""


class TerrainSpace(Protocol):
    """What a search needs of its terrains."""

    @property
    def name(self) -> str:
        """What files and command lines call the space."""
        ...

    @property
    def num_genes(self) -> int:
        """Length of one row of genes."""
        ...

    def rasterise(self, genes: Any, spacing: float, heights_out: Any) -> None:
        """Turns genes into heights on the device.

        Args:
            genes: Warp array of floats, shape (num_terrains, num_genes); clipped to [-1, 1].
            spacing: Distance of neighbouring nodes [m].
            heights_out: Warp array of heights [m], shape (num_terrains, nrow, ncol); row is y, col is x.
        """
        ...

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Genes of random terrains that are as hard as the space allows, shape (count, num_genes)."""
        ...

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """The parts of a terrain that can be taken away, each in words.

        Args:
            genes: One row, shape (num_genes,).
        """
        ...

    def without(self, genes: ArrayLike, parts: Sequence[int]) -> NDArray[np.float32]:
        """Genes of the same terrains without some of their parts, shape (num_terrains, num_genes).

        Args:
            genes: Shape (num_terrains, num_genes).
            parts: Indices into :meth:`parts`.
        """
        ...

    def describe(self, genes: ArrayLike) -> str:
        """A terrain in words, one part a line.

        Args:
            genes: One row, shape (num_genes,).
        """
        return "\n".join(self.parts(genes))

    def uniform_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Genes drawn uniformly from [-1, 1], shape (count, num_genes).

        Raises:
            ValueError: If ``count`` is not positive.
        """
        if count < 1:
            raise ValueError(f"count must be at least 1, got {count}")
        return np.random.default_rng(seed).uniform(-1.0, 1.0, (count, self.num_genes)).astype(np.float32)

    def validate(self, genes: ArrayLike) -> NDArray[np.float32]:
        """Genes as float32, shape (num_terrains, num_genes), not clipped.

        Raises:
            ValueError: If the shape differs or a gene is not finite.
        """
        array = np.asarray(genes, dtype=np.float32)
        if array.ndim != 2 or array.shape[1] != self.num_genes:
            raise ValueError(
                f"genes must have shape (num_terrains, {self.num_genes}), got {array.shape}: the space is {self.name}"
            )
        finite = np.isfinite(array).all(axis=1)
        if not finite.all():
            raise ValueError(f"genes must be finite, got NaN or infinity in row {int(np.argmin(finite))}")
        return array


def clipped(genes: ArrayLike) -> NDArray[np.float32]:
    """Genes as every space has them: a copy clipped to [-1, 1]; the search itself is unbounded."""
    return np.clip(np.asarray(genes, dtype=np.float32), -1.0, 1.0)


_HEIGHT = PARAMETERS.index("w")


@dataclass(frozen=True, kw_only=True)
class SuperGaussian(TerrainSpace):
    """The paper's terrains: sums of rotated Super-Gaussian bumps (eq. 1; genes rescaled by Table I)."""

    num_bumps: int = 8

    def __post_init__(self) -> None:
        if self.num_bumps < 1:
            raise ValueError(f"num_bumps must be at least 1, got {self.num_bumps}")

    @property
    def name(self) -> str:
        """What files and command lines call the space."""
        return "super_gaussian"

    @property
    def num_genes(self) -> int:
        """Eight genes a bump, in the order of :data:`kernels.super_gaussian.PARAMETERS`, bump after bump."""
        return self.num_bumps * GENES_PER_BUMP

    def rasterise(self, genes: Any, spacing: float, heights_out: Any) -> None:
        """Turns genes into heights on the device (:func:`kernels.super_gaussian.rasterise`)."""
        super_gaussian.rasterise(genes, spacing, heights_out)

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Uniform genes, but every bump at its lowest or highest height: the paper's hard-random terrains."""
        genes = self.uniform_random(count, seed)
        heights = genes[:, _HEIGHT::GENES_PER_BUMP]
        heights[:] = np.where(heights < 0.0, -1.0, 1.0)
        return genes

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """Each bump in words."""
        bumps = clipped(genes).reshape(self.num_bumps, GENES_PER_BUMP)
        return tuple(map(_in_words, LOWER + (bumps + 1.0) / 2.0 * (UPPER - LOWER)))

    def without(self, genes: ArrayLike, parts: Sequence[int]) -> NDArray[np.float32]:
        """Genes with the heights of some bumps at zero."""
        found = self.validate(genes).copy()
        found[:, np.asarray(parts, dtype=int) * GENES_PER_BUMP + _HEIGHT] = 0.0  # the middle of -0.25 m to 0.25 m
        return found


def _in_words(bump: NDArray[np.float64]) -> str:
    x, y, sigma_x, sigma_y, _, _, theta, height = bump
    kind = "bump" if height >= 0.0 else "hollow"
    return (
        f"{kind} of {abs(height):.2f} m at ({x:.1f}, {y:.1f}) m, half widths {sigma_x:.1f} m and {sigma_y:.1f} m, "
        f"turned by {np.rad2deg(theta):.0f} degrees"
    )


SUPER_GAUSSIAN = SuperGaussian()
SPACES: dict[str, TerrainSpace] = {space.name: space for space in (SUPER_GAUSSIAN,)}
"""Every space by its name."""


def get_space(name: str) -> TerrainSpace:
    """A terrain space by its name.

    Raises:
        ValueError: If there is none of that name.
    """
    if name not in SPACES:
        raise ValueError(f"unknown terrain space '{name}': expected one of {', '.join(SPACES)}")
    return SPACES[name]


def read_pool(path: Path) -> tuple[NDArray[np.float32], TerrainSpace]:
    """Genes of a pool, shape (num_terrains, num_genes), and the space that its file names, the paper's if none.

    Raises:
        ValueError: If the file holds no genes of a known space.
    """
    try:
        with np.load(path, allow_pickle=False) as content:
            genes = content["genes"]
            space = get_space(str(content["space"])) if "space" in content else SUPER_GAUSSIAN
    except Exception as error:  # a damaged zip archive can fail with anything
        raise ValueError(f"--genes {path}: expected an .npz file with an array 'genes', got: {error}") from error
    try:
        if not len(genes) or genes.dtype.kind != "f":
            raise ValueError(f"they must be floats, one row a terrain, got {genes.dtype} of shape {genes.shape}")
        with np.errstate(over="ignore"):
            return space.validate(genes.astype(np.float32)), space
    except (ValueError, TypeError) as error:
        raise ValueError(f"--genes {path}: 'genes': {error}") from None
