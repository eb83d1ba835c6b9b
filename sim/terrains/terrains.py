"""Terrains to cross, as one value: what they are made of, and the seeds of their episodes."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.terrains.ground import GroundMaps
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN

Rows = slice | NDArray[Any]


@dataclass(frozen=True, kw_only=True, eq=False)
class Terrains:
    """T terrains, either by genes of a space or by heights. Episodes depend on the terrain and its seed."""

    seeds: NDArray[np.integer]
    """Seed of each terrain's episodes, 0 to 2^32 - 1, shape (T,)."""
    genes: NDArray[np.float32] | None = None
    """Genes of :attr:`space`, shape (T, num_genes)."""
    heights: NDArray[np.float32] | None = None
    """Height grids [m], shape (T, NUM_ROWS, NUM_COLS), row along y, column along x."""
    space: TerrainSpace = SUPER_GAUSSIAN
    """What genes mean: heights, ground and conditions."""
    ground: GroundMaps | None = None
    """Friction, softness and conditions of heights; None where they change nothing, and beside genes."""

    def __post_init__(self) -> None:
        if (self.genes is None) == (self.heights is None):
            raise ValueError("terrains must have either genes or heights, got both or none")
        if self.seeds.shape != (len(self.values),):
            raise ValueError(f"seeds must have shape ({len(self.values)},), one a terrain, got {self.seeds.shape}")
        if self.ground is not None and (self.heights is None or len(self.ground) != len(self.heights)):
            raise ValueError(f"ground must belong to as many heights, got ground of {len(self.ground)} terrains")

    @property
    def values(self) -> NDArray[np.float32]:
        """Genes or heights, whichever there are; one row a terrain."""
        values = self.heights if self.genes is None else self.genes
        assert values is not None
        return values

    @property
    def has_ground(self) -> bool:
        """Whether they have maps of friction or softness."""
        return bool(self.space.ground) if self.ground is None else True

    @property
    def has_conditions(self) -> bool:
        """Whether they are crossed under conditions."""
        return bool(self.space.conditions) if self.ground is None else self.ground.conditions is not None

    def __len__(self) -> int:
        return len(self.seeds)

    def __getitem__(self, rows: Rows) -> "Terrains":
        chosen: dict[str, Any] = {
            name: value[rows] for name, value in vars(self).items() if isinstance(value, np.ndarray | GroundMaps)
        }
        return replace(self, **chosen)

    @staticmethod
    def join(parts: Sequence["Terrains"]) -> "Terrains":
        """The terrains of all parts in their order; the parts are of one space and of one kind."""
        grounds = [part.ground for part in parts if part.ground is not None]
        arrays: dict[str, Any] = {
            name: np.concatenate([getattr(part, name) for part in parts])
            for name in ("seeds", "genes", "heights")
            if getattr(parts[0], name) is not None
        }
        return replace(parts[0], **arrays, ground=reduce(GroundMaps.joined, grounds) if grounds else None)

    def digests(self) -> list[bytes]:
        """SHA-256 of each terrain and its seed, but for its space."""
        values = np.ascontiguousarray(self.values, np.float32)
        shape = str(values.shape[1:]).encode()
        maps: list[bytes] = [b""] * len(self)
        if self.ground is not None:
            rows = (self.ground.friction, self.ground.time_constant_s, self.ground.rows)
            maps = [b"".join(np.float32(array[k]).tobytes() for array in rows) for k in range(len(self))]
        return [
            hashlib.sha256(shape + row.tobytes() + ground + int(seed).to_bytes(4, "little")).digest()
            for row, ground, seed in zip(values, maps, self.seeds, strict=True)
        ]
