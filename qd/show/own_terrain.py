"""A heightmap of a user's own, as the command line names it."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from qd.workers.evaluator import episode_seeds
from sim.files.command import split_words

_STREAM = 4  # of the seeds: no other episodes are drawn from it


class Mapped(Protocol):
    """The arguments that say what heightmap is meant."""

    @property
    def size(self) -> tuple[str, ...]:
        """Of the map along x and y [m], two words, or one that holds both as make hands them over; or none."""
        ...

    @property
    def scale(self) -> float | None:
        """Metres a gray level."""

    @property
    def offset(self) -> float | None:
        """Height of gray level 0 [m]."""


@dataclass(frozen=True, kw_only=True)
class OwnTerrain:
    """A terrain from a file."""

    heights: NDArray[np.float32]
    """[m], shape (NUM_ROWS, NUM_COLS)."""
    label: str
    """The file's name."""
    fitted: str
    """What became of the map, in words."""


def read_own_terrain(path: Path, args: Mapped) -> OwnTerrain:
    """The terrain that a heightmap becomes, by the rules of :mod:`sim.maps.heightmap`.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it is no heightmap, or a number is missing or out of range.
    """
    from sim.maps.heightmap import as_terrain, fitted, read_heightmap

    heightmap = read_heightmap(path, size_m=_size_of(args.size), scale_m=args.scale, offset_m=args.offset)
    return OwnTerrain(heights=as_terrain(heightmap), label=path.name, fitted=fitted(heightmap))


def _size_of(words: Sequence[str]) -> tuple[float, ...] | None:
    sides = split_words(words)
    try:
        return tuple(float(side) for side in sides) or None
    except ValueError:
        raise ValueError(f"size must be two lengths in metres such as 16 8, got {' '.join(words)}") from None


def own_seeds(seed: int) -> NDArray[np.uint32]:
    """The seed of the episodes on a user's own terrain, shape (1,); the same for its numbers and its film."""
    return episode_seeds(seed, 0, 1, stream=_STREAM)
