"""The elites of an archive as a report takes them: what is known best of each, and which are worth a look."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive

FAILING_BELOW = 0.5
"""Goal rate below which a controller fails a terrain, as in the evaluation tables."""


@dataclass(frozen=True, kw_only=True)
class Elites:
    """N elites by what fresh episodes say of them, where there are such, else as they were found.

    An elite whose fresh episodes are invalid is left out. Penalties are scaled.
    """

    penalties: tuple[str, ...]
    """Names of the P penalties."""
    fresh: bool
    """Whether the values are of fresh episodes."""
    numbers: NDArray[np.int64]
    """Number of each elite in the archive, shape (N,), ascending."""
    cell: NDArray[np.int64]
    """Cell that these episodes fall into, shape (N,); elites whose luck put them apart may share one."""
    fitness: NDArray[np.float64]
    """Shape (N,)."""
    ratios: NDArray[np.float64]
    """Shape (N, P)."""
    variation: NDArray[np.float64]
    """Standard deviation of the penalties over the episodes, summed, as a share of their mean, shape (N,)."""
    counted: NDArray[np.int64]
    """Valid episodes, shape (N,)."""
    goal_rate: NDArray[np.float64]
    """Share of them that reached the goal, shape (N,)."""
    collision_rate: NDArray[np.float64]
    """Share that ended in a base collision, shape (N,)."""
    fallen_rate: NDArray[np.float64]
    """Share that ended tilted by more than 60 degrees, shape (N,)."""
    reproduced: NDArray[np.bool_]
    """Whether fresh episodes landed in its cell or a neighbour; True where nobody looked; shape (N,)."""

    def __len__(self) -> int:
        """N."""
        return len(self.numbers)

    @property
    def failing(self) -> NDArray[np.bool_]:
        """Whether under half of the robots reach the goal, shape (N,)."""
        return self.goal_rate < FAILING_BELOW

    @property
    def failing_cells(self) -> int:
        """Different ways to fail: cells that the failing elites fall into."""
        return len(np.unique(self.cell[self.failing]))

    @property
    def other_rate(self) -> NDArray[np.float64]:
        """Share that neither arrived nor collided: out of time or off the terrain, shape (N,)."""
        return np.clip(1.0 - self.goal_rate - self.collision_rate, 0.0, 1.0)

    def place_of(self, number: int) -> int:
        """Row of an elite by its number in the archive."""
        return int(np.searchsorted(self.numbers, number))


def elites_of(archive: Archive) -> Elites:
    """The elites of an archive, in its order."""
    fresh = archive.fresh
    values = archive if fresh is None else fresh
    kept = np.flatnonzero(np.ones(len(archive), bool) if fresh is None else fresh.valid)
    means, stds = (getattr(values, name)[kept].sum(axis=1) for name in ("penalty_mean", "penalty_std"))
    rates = {name: getattr(values, name)[kept] for name in ("goal_rate", "collision_rate", "fallen_rate")}
    return Elites(
        penalties=archive.penalties,
        fresh=fresh is not None,
        numbers=kept.astype(np.int64),
        cell=values.cell[kept],
        fitness=values.fitness[kept],
        ratios=values.ratios[kept],
        variation=stds / np.maximum(means, np.finfo(float).tiny),
        counted=(values.episodes - values.invalid_episodes)[kept],
        reproduced=np.ones(len(kept), bool) if fresh is None else fresh.reproduced[kept],
        **rates,
    )


def worst(elites: Elites, count: int) -> list[int]:
    """Numbers of the failed terrains with the highest fitness, the highest first; if fewer fail, of others after them.

    An elite may have the highest fitness of all and be crossed by every robot, with trouble.
    """
    order = np.lexsort((-elites.fitness, ~elites.failing))
    return elites.numbers[order[:count]].tolist()


def most_reproducible(elites: Elites, count: int) -> list[int]:
    """Numbers of the failed terrains whose penalties vary least between episodes, for their size; the steadiest first.

    A terrain on which the controller fails comes before one that it crosses, and one whose fresh episodes landed in its
    cell or beside it before one where they did not.
    """
    order = np.lexsort((elites.variation, ~elites.reproduced, ~elites.failing))
    return elites.numbers[order[:count]].tolist()
