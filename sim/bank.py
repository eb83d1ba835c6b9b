"""The terrains of a simulation, on the device."""

import numpy as np
import warp as wp

from kernels.heightfield import Terrain, ceiling_shape, max_blocks
from kernels.super_gaussian import GENES_PER_BUMP, rasterise
from sim.terrain import NUM_COLS, NUM_ROWS, SPACING


class TerrainBank:
    """Height grids on the device; an environment stands on the grid its terrain index names.

    Terrains are replaced in place, so that captured graphs go on reading them.
    """

    def __init__(self, num_terrains: int, *, device: str, nrow: int = NUM_ROWS, ncol: int = NUM_COLS) -> None:
        """Make flat terrains.

        Args:
            num_terrains: Number of grids.
            device: Warp device name.
            nrow: Nodes along y.
            ncol: Nodes along x.

        Raises:
            ValueError: If there is no terrain or a grid has no cell.
        """
        if num_terrains < 1 or nrow < 2 or ncol < 2:
            raise ValueError(
                f"a bank needs at least 1 terrain of 2 x 2 nodes, got {num_terrains} of {nrow} x {ncol}"
            )
        self.terrain = Terrain()
        self.terrain.heights = wp.zeros((num_terrains, nrow, ncol), dtype=float, device=device)
        self.terrain.ceilings = wp.zeros(ceiling_shape(num_terrains, nrow, ncol), dtype=float, device=device)
        self.terrain.spacing = SPACING
        self.device = device

    @property
    def num_terrains(self) -> int:
        """Number of grids."""
        return self.terrain.heights.shape[0]

    @property
    def heights(self) -> wp.array:
        """Node heights [m] on the device, shape (num_terrains, nrow, ncol)."""
        return self.terrain.heights

    def set_heights(self, heights: np.ndarray) -> None:
        """Replace all terrains by height grids [m], shape (num_terrains, nrow, ncol).

        Raises:
            ValueError: If the shape differs or a height is not finite.
        """
        expected = tuple(self.heights.shape)
        if heights.shape != expected:
            raise ValueError(f"heights must have shape {expected} [terrain, row, col], got {heights.shape}")
        if not np.isfinite(heights).all():
            raise ValueError(f"heights must be finite, got {np.count_nonzero(~np.isfinite(heights))} that are not")
        self.heights.assign(heights.astype(np.float32))
        max_blocks(self.terrain.heights, self.terrain.ceilings)

    def set_genes(self, genes: np.ndarray) -> None:
        """Replace all terrains by the Super-Gaussian mixtures of ``genes``, shape (num_terrains, 8 * num_bumps).

        Raises:
            ValueError: If the shape differs or a gene is not finite.
        """
        if genes.ndim != 2 or genes.shape[1] == 0 or genes.shape[1] % GENES_PER_BUMP or len(genes) != self.num_terrains:
            raise ValueError(
                f"genes must have shape ({self.num_terrains}, 64), got {genes.shape}: one row is 8 bumps x 8"
            )
        if not np.isfinite(genes).all():
            raise ValueError(f"genes must be finite, got {np.count_nonzero(~np.isfinite(genes))} that are not")
        on_device = wp.array(genes.astype(np.float32), dtype=float, device=self.device)
        rasterise(on_device, SPACING, self.terrain.heights)
        max_blocks(self.terrain.heights, self.terrain.ceilings)


def heights_of(genes: np.ndarray, *, device: str = "cpu") -> np.ndarray:
    """Height grids [m] of genes as a simulation has them, on the host.

    Args:
        genes: Shape (num_terrains, 8 * num_bumps), at least one terrain.
        device: Warp device name.

    Returns:
        Float32, shape (num_terrains, NUM_ROWS, NUM_COLS).

    Raises:
        ValueError: If the shape is another one or a gene is not finite.
    """
    bank = TerrainBank(len(genes), device=device)
    with wp.ScopedDevice(device):
        bank.set_genes(genes)
        return np.array(bank.heights.numpy())
