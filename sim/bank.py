"""The terrains of a simulation, on the device."""

import numpy as np
import warp as wp

from kernels.heightfield import Terrain, ceiling_shape, max_blocks
from sim.space import SUPER_GAUSSIAN, TerrainSpace
from sim.terrain import NUM_COLS, NUM_ROWS, SPACING

_ALL = slice(None)


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
            raise ValueError(f"a bank needs at least 1 terrain of 2 x 2 nodes, got {num_terrains} of {nrow} x {ncol}")
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

    def set_heights(self, heights: np.ndarray, slots: slice = _ALL) -> None:
        """Replace terrains by height grids [m].

        Args:
            heights: Shape (number of slots, nrow, ncol).
            slots: Which are replaced; all if left out.

        Raises:
            ValueError: If the shape differs or a height is not finite.
        """
        replaced = self.heights[slots]
        expected = tuple(replaced.shape)
        if heights.shape != expected:
            raise ValueError(f"heights must have shape {expected} [terrain, row, col], got {heights.shape}")
        if not np.isfinite(heights).all():
            raise ValueError(f"heights must be finite, got {np.count_nonzero(~np.isfinite(heights))} that are not")
        replaced.assign(heights.astype(np.float32))
        max_blocks(replaced, self.terrain.ceilings[slots])

    def set_genes(self, genes: np.ndarray, space: TerrainSpace = SUPER_GAUSSIAN, slots: slice = _ALL) -> None:
        """Replace terrains by those of genes of a space.

        Args:
            genes: Shape (number of slots, num_genes).
            space: What the genes mean.
            slots: Which are replaced; all if left out.

        Raises:
            ValueError: If the shape differs or a gene is not finite.
        """
        valid, replaced = space.validate(genes), self.heights[slots]
        if len(valid) != len(replaced):
            raise ValueError(f"genes must be of {len(replaced)} terrains, one row each, got {len(valid)} rows")
        space.rasterise(wp.array(valid, dtype=float, device=self.device), SPACING, replaced)
        max_blocks(replaced, self.terrain.ceilings[slots])


def host_device() -> str:
    """Warp device of small work for the host: the CPU, or the default device where Warp has no compiler for the CPU."""
    return "cpu" if wp.is_cpu_available() else str(wp.get_device())


def heights_of(genes: np.ndarray, space: TerrainSpace = SUPER_GAUSSIAN, *, device: str | None = None) -> np.ndarray:
    """Height grids [m] of genes as a simulation has them, on the host.

    Args:
        genes: Shape (num_terrains, num_genes), at least one terrain.
        space: What the genes mean.
        device: Warp device name; :func:`host_device` if None.

    Returns:
        Float32, shape (num_terrains, NUM_ROWS, NUM_COLS).

    Raises:
        ValueError: If the shape differs or a gene is not finite.
    """
    device = device or host_device()
    bank = TerrainBank(len(genes), device=device)
    with wp.ScopedDevice(device):
        bank.set_genes(genes, space)
        return np.array(bank.heights.numpy())
