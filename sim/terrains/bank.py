"""The terrains of a simulation, on the device."""

from typing import Any

import numpy as np
import warp as wp

from kernels.ground import Ground, make_ground
from kernels.heightfield import Terrain, ceiling_shape, max_blocks
from kernels.launch import make_struct, make_zeros
from sim.device import host_device
from sim.terrains.conditions.kinds import nominal_row
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import GroundMaps, Terrains

_ALL = slice(None)


class TerrainBank:
    """Height grids on the device; an environment stands on the grid its terrain index names.

    Terrains are replaced in place, so that captured graphs go on reading them.

    Attributes:
        heights: Node heights [m], shape (num_terrains, NUM_ROWS, NUM_COLS).
        terrain: The same with their ceilings, as contacts take them.
        ground: Friction and softness; None where no terrain has any.
        conditions: Under which each is crossed, (:mod:`sim.terrains.conditions`), shape (num_terrains, number of
            values); None where all are nominal.
    """

    def __init__(
        self, num_terrains: int, *, device: str, with_ground: bool = False, with_conditions: bool = False
    ) -> None:
        """Make flat terrains; with ``with_ground`` they have maps of friction and softness, which contacts pay for.

        With ``with_conditions`` they have these maps too, since friction is one of them.
        """
        if num_terrains < 1:
            raise ValueError(f"a bank needs at least 1 terrain, got {num_terrains}")
        shape = num_terrains, NUM_ROWS, NUM_COLS
        self.terrain = make_zeros(Terrain, device, heights=shape, ceilings=ceiling_shape(*shape))
        self.terrain.spacing = SPACING
        self.heights = self.terrain.heights
        self.ground: Ground | None = make_ground(num_terrains, device) if with_ground or with_conditions else None
        nominal = np.tile(nominal_row(), (num_terrains, 1))
        self.conditions: Any = wp.array(nominal, dtype=float, device=device) if with_conditions else None
        self.device = device
        self.num_terrains = num_terrains

    def set_heights(self, heights: np.ndarray, slots: slice = _ALL, *, ground: GroundMaps | None = None) -> None:
        """Replace the terrains of some slots by height grids [m], shape (number of slots, nrow, ncol)."""
        self.set(Terrains(heights=heights, seeds=np.zeros(len(heights), np.uint32), ground=ground), slots)

    def set(self, terrains: Terrains, slots: slice = _ALL) -> None:
        """Replace the terrains of some slots; without ground their friction and softness change nothing."""
        replaced, space = self.heights[slots], terrains.space
        ground = terrains.ground or GroundMaps.plain(len(terrains))
        if terrains.has_ground and self.ground is None:
            raise ValueError("terrains have friction or softness, got a bank without maps: give with_ground=True")
        if terrains.has_conditions and self.conditions is None:
            raise ValueError("terrains have conditions, got a bank without: give with_conditions=True")
        genes: Any = None
        if terrains.heights is None:
            valid = space.validate(terrains.values)
            if len(valid) != len(replaced):
                raise ValueError(f"genes must be of {len(replaced)} terrains, one row each, got {len(valid)} rows")
            genes = wp.array(valid, dtype=float, device=self.device)
            rows = space.condition_rows(valid)
            space.rasterise(genes, SPACING, replaced)
        else:
            heights, expected = terrains.heights, tuple(replaced.shape)
            if heights.shape != expected:
                raise ValueError(f"heights must have shape {expected} [terrain, row, col], got {heights.shape}")
            if not np.isfinite(heights).all():
                raise ValueError(f"heights must be finite, got {np.count_nonzero(~np.isfinite(heights))} that are not")
            rows = ground.rows
            replaced.assign(heights.astype(np.float32))
        max_blocks(replaced, self.terrain.ceilings[slots])
        if self.ground is not None:
            maps = make_struct(
                Ground, friction=self.ground.friction[slots], time_constant=self.ground.time_constant[slots]
            )
            maps.friction.assign(np.float32(ground.friction))
            maps.time_constant.assign(np.float32(ground.time_constant_s))
            if genes is not None:
                space.lay_ground(genes, maps)
        if self.conditions is not None:
            self.conditions[slots].assign(np.float32(rows))

    def ground_maps(self) -> GroundMaps | None:
        """The maps of all terrains on the host; None of a bank without any."""
        if self.ground is None:
            return None
        friction = self.ground.friction.numpy().copy()
        time_constant_s = self.ground.time_constant.numpy().copy()
        conditions = None if self.conditions is None else self.conditions.numpy().copy()
        return GroundMaps(friction=friction, time_constant_s=time_constant_s, conditions=conditions)


def make_heights(genes: np.ndarray, space: TerrainSpace = SUPER_GAUSSIAN, *, every: int = 1) -> np.ndarray:
    """Height grids [m] of genes, shape (num_terrains, num_genes), as a simulation has them, on the host.

    Float32, shape (num_terrains, NUM_ROWS, NUM_COLS); of rows and columns only ``every`` so many from the first on, a
    divisor of the cells of both.
    """
    if every == 1 or not space.any_spacing:
        return make_terrains(genes, space)[0][:, ::every, ::every]
    shape = len(genes), (NUM_ROWS - 1) // every + 1, (NUM_COLS - 1) // every + 1
    with wp.ScopedDevice(host_device()):  # the nodes in between are not worked out
        heights: Any = wp.empty(shape, dtype=float)
        space.rasterise(wp.array(space.validate(genes), dtype=float), every * SPACING, heights)
        return np.array(heights.numpy())


def make_terrains(
    genes: np.ndarray, space: TerrainSpace = SUPER_GAUSSIAN, *, device: str | None = None
) -> tuple[np.ndarray, GroundMaps | None]:
    """Height grids [m] of genes, shape (num_terrains, num_genes), and their ground, if the space has any.

    Grids are float32, shape (num_terrains, NUM_ROWS, NUM_COLS); ``device`` is a Warp device, :func:`host_device` if
    None.
    """
    device = device or host_device()
    terrains = Terrains(genes=genes, seeds=np.zeros(len(genes), np.uint32), space=space)
    maps = {"with_ground": terrains.has_ground, "with_conditions": terrains.has_conditions}
    bank = TerrainBank(len(genes), device=device, **maps)
    with wp.ScopedDevice(device):
        bank.set(terrains)
        return np.array(bank.heights.numpy()), bank.ground_maps()
