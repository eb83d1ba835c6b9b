"""Which emitters of a pool ask: those whose terrains have become elites most often of late."""

import numpy as np
from numpy.typing import NDArray

ZETA = 0.05
"""Weight of what is not known of an emitter, as in pyribs' scheduler."""
MEMORY = 0.9
"""What is left of an emitter's counts each time its group is told: they are of its last ten iterations or so. Elites
become rarer as an archive fills, and an emitter that rests would be remembered by its best days."""


class Bandit:
    """Counts of each emitter, and UCB1 over them (Cully 2021, as in pyribs' ``BanditScheduler``).

    The counts are discounted (Garivier and Moulines 2011).

    Args:
        counts: Of each emitter the terrains that became elites and those that it asked for, shape (2, num_emitters).
        active: Emitters of all pools together that ask at a time.

    Raises:
        ValueError: If the counts are not of so many emitters for each that asks.
    """

    def __init__(self, counts: NDArray[np.float64], active: int) -> None:
        if not (isinstance(counts, np.ndarray) and counts.ndim == 2 and len(counts) == 2):
            raise ValueError("counts must have the shape (2, num_emitters)")
        if not (isinstance(active, int) and active >= 1 and counts.shape[1] % active == 0):
            raise ValueError(f"of {counts.shape[1]} emitters a whole part must be active, got {active}")
        self.counts, self.active = counts, active

    def best(self, pool: slice) -> list[int]:
        """Numbers of the emitters of a pool that ask next, ascending; the same ones until the pool is told.

        Args:
            pool: Numbers of its emitters, an equal part of which asks.
        """
        elites, asked = self.counts[:, pool]
        count = len(asked) * self.active // self.counts.shape[1]
        bound = np.full(len(asked), np.inf)  # who has never asked goes first
        known = asked > 0
        unknown = np.sqrt(np.log(max(asked.sum(), 1.0)) / asked[known])
        bound[known] = elites[known] / asked[known] + ZETA * unknown
        return sorted((pool.start + np.argsort(-bound, kind="stable")[:count]).tolist())

    def tell(self, pool: slice, emitters: list[int], became_elites: NDArray[np.bool_]) -> None:
        """What became of terrains that emitters of a pool have asked for.

        Args:
            pool: Numbers of its emitters.
            emitters: Those that asked.
            became_elites: Of each terrain, emitter after emitter, equally many each.
        """
        each = became_elites.reshape(len(emitters), -1)
        self.counts[:, pool] *= MEMORY
        self.counts[:, emitters] += each.sum(axis=1), np.full(len(emitters), each.shape[1])
