"""The paper's terrains: sums of rotated Super-Gaussian bumps."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kernels import super_gaussian
from kernels.super_gaussian import GENES_PER_BUMP, LOWER, PARAMETERS, UPPER
from sim.terrains.spaces.base import Seed, ShippedSpace, clipped

_HEIGHT = PARAMETERS.index("w")


@dataclass(frozen=True, kw_only=True)
class SuperGaussian(ShippedSpace):
    """Eq. 1, with genes rescaled by Table I: eight bumps of eight genes, :data:`kernels.super_gaussian.PARAMETERS`."""

    base_name: ClassVar[str] = "super_gaussian"
    num_genes: ClassVar[int] = 8 * GENES_PER_BUMP
    any_spacing: ClassVar[bool] = True
    genes_per_part: ClassVar[int] = GENES_PER_BUMP

    def rasterise(self, genes: Any, spacing: float, heights_out: Any, *origin: float) -> None:
        """Turns genes into heights on the device (:func:`kernels.super_gaussian.rasterise`)."""
        super_gaussian.rasterise(genes, spacing, heights_out, self.height_share, *origin)

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """Uniform genes, but every bump at its lowest or highest height: the paper's hard-random terrains."""
        genes = self.uniform_random(count, seed)
        heights = genes[:, _HEIGHT::GENES_PER_BUMP]
        heights[:] = np.where(heights < 0.0, -1.0, 1.0)
        return genes

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """Each bump."""
        values = LOWER + (clipped(genes).reshape(-1, GENES_PER_BUMP) + 1.0) / 2.0 * (UPPER - LOWER)
        values[:, _HEIGHT] *= self.height_share
        return tuple(map(_format_bump, values))

    def without(self, genes: ArrayLike, parts: Sequence[int]) -> NDArray[np.float32]:
        """Genes with the heights of some bumps at zero."""
        flattened = self.validate(genes).copy()
        flattened[:, np.asarray(parts, dtype=int) * GENES_PER_BUMP + _HEIGHT] = 0.0  # the middle of -0.25 m to 0.25 m
        return flattened

    def scaled(self, genes: ArrayLike, scale: float) -> NDArray[np.float32]:
        """Genes with the height of every bump times ``scale``."""
        lower = clipped(self.validate(genes))
        lower[:, _HEIGHT::GENES_PER_BUMP] *= scale  # 0 is the height in the middle of its range
        return lower


def _format_bump(bump: NDArray[np.float64]) -> str:
    x, y, sigma_x, sigma_y, _, _, theta, height = bump
    kind = "bump" if height >= 0.0 else "hollow"
    return (
        f"{kind} of {abs(height):.2f} m at ({x:.1f}, {y:.1f}) m, half widths {sigma_x:.1f} m and {sigma_y:.1f} m, "
        f"turned by {90 - (90 - round(np.rad2deg(theta))) % 180} degrees"  # half a turn changes nothing
    )


SUPER_GAUSSIAN = SuperGaussian()
