"""The elites of an archive by what is known best of each."""

from dataclasses import dataclass, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.faults import verdicts_of
from qd.fitness import FAILING_GOAL_RATE


@dataclass(frozen=True, kw_only=True)
class Elites:
    """N elites by what fresh episodes say of each where it has valid ones, else as they were found.

    Penalties are scaled. Lower numbers have a higher fitness.
    """

    penalties: tuple[str, ...]
    """Names of the P penalties."""
    numbers: NDArray[np.int64]
    """Number of each elite in the archive, shape (N,), ascending."""
    fresh: NDArray[np.bool_]
    """Whether the values are of fresh episodes, shape (N,)."""
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
    """Whether fresh episodes landed in its cell or a neighbour; True where there are none; shape (N,)."""
    verdict: NDArray[np.int64]
    """Place in :data:`qd.faults.VERDICTS` of what is known of it, shape (N,). Where there are no fresh episodes those
    that found it say whether it fails."""

    def __len__(self) -> int:
        """N."""
        return len(self.numbers)

    @property
    def failing(self) -> NDArray[np.bool_]:
        """Whether under half of the robots reach the goal, shape (N,)."""
        return self.goal_rate < FAILING_GOAL_RATE

    @property
    def failing_cells(self) -> int:
        """Different ways to fail: cells that the failing elites fall into."""
        return len(np.unique(self.cell[self.failing]))

    @property
    def other_rate(self) -> NDArray[np.float64]:
        """Share that neither arrived nor collided: out of time or off the terrain, shape (N,)."""
        return np.clip(1.0 - self.goal_rate - self.collision_rate, 0.0, 1.0)

    def rows(self, chosen: NDArray[np.int64]) -> "Elites":
        """The elites in some rows, in their order."""
        values: dict[str, Any] = {one.name: getattr(self, one.name) for one in fields(self)}
        return replace(self, **{name: v[chosen] for name, v in values.items() if isinstance(v, np.ndarray)})

    def place_of(self, number: int) -> int:
        """Row of an elite by its number in the archive."""
        return int(np.searchsorted(self.numbers, number))

    def hits(self, rate: str, place: int) -> int:
        """Episodes of the elite in a row that a rate counts."""
        return round(float(getattr(self, rate)[place]) * int(self.counted[place]))

    def by_severity(self) -> NDArray[np.int64]:
        """Rows by how badly the robot fares, shape (N,), the worst first.

        Faults come before certified, confirmed, failing and other elites, of these the ones with the lowest goal rate,
        the most base collisions, the most falls and the highest fitness. Fitness alone does not order by failure: it
        prizes trouble that is the same in every episode.
        """
        return np.lexsort((-self.fitness, -self.fallen_rate, -self.collision_rate, self.goal_rate, -self.verdict))

    def most_reproducible(self, count: int) -> list[int]:
        """Numbers of the terrains whose penalties vary least between episodes, for their size; the steadiest first.

        A terrain on which the controller fails comes before one that it crosses, and one whose fresh episodes landed in
        its cell or beside it before one where they did not.
        """
        order = np.lexsort((self.variation, ~self.reproduced, ~self.failing))
        return self.numbers[order[:count]].tolist()


_RATES = ("goal_rate", "collision_rate", "fallen_rate")


def elites_of(archive: Archive, *, judged: bool = False) -> Elites:
    """The elites of an archive, in its order.

    Args:
        archive: The archive.
        judged: Leaves out elites whose fresh episodes are invalid.
    """
    names = ("cell", "fitness", "ratios", "penalty_mean", "penalty_std", "episodes", "invalid_episodes", *_RATES)
    found = {name: np.asarray(getattr(archive, name)) for name in names}
    fresh, reproduced = np.zeros(len(archive), bool), np.ones(len(archive), bool)
    if (again := archive.fresh) is not None:
        fresh, reproduced = again.valid, again.reproduced | ~again.valid
        found = {
            name: np.where(fresh.reshape(-1, *[1] * (values.ndim - 1)), getattr(again, name), values)
            for name, values in found.items()
        }
    kept = np.flatnonzero(fresh) if judged and again is not None else np.arange(len(archive))
    found = {name: values[kept] for name, values in found.items()}
    means, stds = (found[name].sum(axis=1) for name in ("penalty_mean", "penalty_std"))
    return Elites(
        penalties=archive.penalties,
        numbers=kept.astype(np.int64),
        fresh=fresh[kept],
        variation=stds / np.maximum(means, np.finfo(float).tiny),
        counted=found["episodes"] - found["invalid_episodes"],
        reproduced=reproduced[kept],
        verdict=np.maximum(verdicts_of(archive)[kept], found["goal_rate"] < FAILING_GOAL_RATE),
        **{name: found[name] for name in ("cell", "fitness", "ratios", *_RATES)},
    )
