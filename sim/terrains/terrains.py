"""Terrains to cross, as one value: genes or heights, ground and conditions, and the seeds of their episodes."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import reduce
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from kernels.episode import SEGMENTS, STEERING, Kind
from kernels.ground import FIRM, MAX_TIME_CONSTANT_S, MIN_FRICTION, MIN_TIME_CONSTANT_S, PATCHES
from sim.terrains.conditions.kinds import condition_genes, nominal_row
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN

Rows = slice | NDArray[Any]
GROUND_KINDS = ("friction", "softness")
"""What the ground may have maps of."""


@dataclass(frozen=True, kw_only=True, eq=False)
class GroundMaps:
    """Friction and softness of the patches of T terrains, and the conditions under which each is crossed."""

    friction: NDArray[np.float32]
    """Factor of the friction that contacts have on other ground, 0.15 to 1, shape (T, 4, 8), row along y."""
    time_constant_s: NDArray[np.float32]
    """Contact time constant [s], 0.01 to 0.06, or 0 of firm ground, of the same shape."""
    conditions: NDArray[np.float32] | None = None
    """Conditions (:mod:`sim.terrains.conditions`), shape (T, number of values); nominal ones if None."""

    def __post_init__(self) -> None:
        check_map("friction", self.friction)
        check_map("softness", self.time_constant_s)
        if len(self.friction) != len(self.time_constant_s):
            got = f"{len(self.friction)} of friction and {len(self.time_constant_s)} of softness"
            raise ValueError(f"maps must be of as many terrains, got {got}")
        genes, expected = condition_genes(), (len(self), len(nominal_row()))
        if self.rows.shape != expected:
            raise ValueError(f"conditions must have shape {expected}, got {self.rows.shape}")
        if not np.isin(self.rows[:, -1], [*Kind]).all():
            raise ValueError(f"what robots are asked for must be one of {[*map(int, Kind)]}, got {self.rows[:, -1]}")
        for gene, values in zip(genes, self.rows.T[:-1], strict=True):
            low, high = gene.limits
            wrong = ~((values >= low - 1e-6) & (values <= high + 1e-6))
            if wrong.any():
                raise ValueError(f"the condition {gene.name} must lie in {low:g} to {high:g}, got {values[wrong][0]:g}")

    @property
    def rows(self) -> NDArray[np.float32]:
        """Conditions of all, shape (T, number of values)."""
        return np.tile(nominal_row(), (len(self), 1)) if self.conditions is None else self.conditions

    def __len__(self) -> int:
        return len(self.friction)

    def __getitem__(self, rows: Rows) -> "GroundMaps":
        chosen: dict[str, Any] = {name: maps[rows] for name, maps in vars(self).items() if maps is not None}
        return GroundMaps(**chosen)

    @classmethod
    def plain(cls, num_terrains: int) -> "GroundMaps":
        """Maps of ground that changes nothing."""
        whole = num_terrains, *PATCHES
        return cls(friction=np.ones(whole, np.float32), time_constant_s=np.full(whole, FIRM, np.float32))

    def joined(self, other: "GroundMaps") -> "GroundMaps":
        """These terrains, and others behind them."""
        nominal = self.conditions is None and other.conditions is None
        return GroundMaps(
            friction=np.concatenate([self.friction, other.friction]),
            time_constant_s=np.concatenate([self.time_constant_s, other.time_constant_s]),
            conditions=None if nominal else np.concatenate([self.rows, other.rows]),
        )


def asked_of(ground: GroundMaps | None) -> Kind:
    """What robots are asked for on the first of the terrains of a ground; None asks for nothing special."""
    return Kind.CROSS if ground is None else Kind(int(ground.rows[0, -1]))


def patch_index(places: ArrayLike, length: float, count: int) -> NDArray[np.int64]:
    """Row or column of the patch at each place along an axis, which ``count`` patches divide evenly.

    Places and length are in nodes or metres, from the beginning of the axis. Patches at the edge go on beyond it.
    """
    return np.clip(np.asarray(places) * count // length, 0, count - 1).astype(np.int64)


def check_map(kind: str, values: NDArray[np.floating]) -> None:
    """That values are frictions or, of ``softness``, contact time constants [s] of the patches of terrains."""
    if values.ndim != 3 or values.shape[1:] != PATCHES:
        raise ValueError(f"a map of {kind} must have shape (terrains, {PATCHES[0]}, {PATCHES[1]}), got {values.shape}")
    if kind == "friction":
        allowed = (values >= MIN_FRICTION - 1e-6) & (values <= 1.0)
        words = f"{MIN_FRICTION} to 1"
    else:
        soft = (values >= MIN_TIME_CONSTANT_S - 1e-6) & (values <= MAX_TIME_CONSTANT_S + 1e-6)
        allowed = soft | (values == FIRM)
        words = f"{FIRM:g} (firm), or {MIN_TIME_CONSTANT_S} to {MAX_TIME_CONSTANT_S} s"
    if not allowed.all():
        raise ValueError(f"{kind} must be {words}, got {values[~allowed][0]:g} in one of the patches")


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
    steering: NDArray[np.float32] | None = None
    """Ways of the R episodes of each terrain: :data:`kernels.episode.STEERING` by segment, shape (T, R, SEGMENTS, 3).

    An episode with NaN has the plain command, and so have all without any."""

    def __post_init__(self) -> None:
        if (self.genes is None) == (self.heights is None):
            raise ValueError("terrains must have either genes or heights, got both or none")
        if self.seeds.shape != (len(self.values),):
            raise ValueError(f"seeds must have shape ({len(self.values)},), one a terrain, got {self.seeds.shape}")
        if self.ground is not None and (self.heights is None or len(self.ground) != len(self.heights)):
            raise ValueError(f"ground must belong to as many heights, got ground of {len(self.ground)} terrains")
        steering, way = self.steering, (SEGMENTS, len(STEERING))
        if steering is not None and (len(steering) != len(self) or steering.shape[2:] != way):
            raise ValueError(f"steering must have shape ({len(self)}, episodes, {way}), got {steering.shape}")

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
        return self.space.has_conditions if self.ground is None else self.ground.conditions is not None

    def __len__(self) -> int:
        return len(self.seeds)

    def __getitem__(self, rows: Rows) -> "Terrains":
        values = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray | GroundMaps)}
        return replace(self, **{name: value[rows] for name, value in values.items()})

    @staticmethod
    def join(parts: Sequence["Terrains"]) -> "Terrains":
        """The terrains of all parts in their order; the parts are of one space and of one kind."""
        grounds = [part.ground for part in parts if part.ground is not None]
        names = [name for name in ("seeds", "genes", "heights", "steering") if getattr(parts[0], name) is not None]
        arrays: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
        return replace(parts[0], **arrays, ground=reduce(GroundMaps.joined, grounds) if grounds else None)

    def digests(self) -> list[bytes]:
        """SHA-256 of each terrain and its seed, but for its space."""
        values = np.ascontiguousarray(self.values, np.float32)
        shape = str(values.shape[1:]).encode()
        ground = self.ground
        rows = () if ground is None else (ground.friction, ground.time_constant_s, ground.rows)
        rows += () if self.steering is None else (self.steering,)
        maps = [b"".join(np.float32(array[k]).tobytes() for array in rows) for k in range(len(self))]
        return [
            hashlib.sha256(shape + row.tobytes() + patches + int(seed).to_bytes(4, "little")).digest()
            for row, patches, seed in zip(values, maps, self.seeds, strict=True)
        ]
