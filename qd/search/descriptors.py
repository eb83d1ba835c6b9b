"""Descriptors: in which proportions a controller is penalised, and the archive's cell of these ratios.

The ratios of a terrain sum to 1, so most tuples of intervals can never occur. Cells are numbered over the reachable
tuples alone: those that hold more than single points of the plane sum(ratios) = 1.
"""

import math
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

_MAX_CELLS = 500_000  # an archive holds all of its cells in memory
_SUM_TOLERANCE = 1e-9  # a mean over 20 episodes of ratios that sum to 1 is off by about 1e-16


def terrain_ratios(penalties: ArrayLike, valid: ArrayLike) -> NDArray[np.float64]:
    """Mean over a terrain's valid episodes of each penalty's share in the sum of an episode's penalties.

    Scaled penalties are not negative, shape (T, R, P), but anything in episodes that are not ``valid``, shape (T, R).
    Ratios have shape (T, P), each row sums to 1. They are equal in an episode without any, and where none is valid.
    """
    valid = np.asarray(valid, dtype=bool)[..., None]
    penalties = np.where(valid, np.asarray(penalties, dtype=np.float64), 0.0)
    sums = penalties.sum(axis=-1, keepdims=True)
    ratios = np.divide(penalties, sums, out=np.full_like(penalties, 1.0 / penalties.shape[-1]), where=sums > 0.0)
    count = valid.sum(axis=1)
    total = np.where(valid, ratios, 0.0).sum(axis=1)
    return np.divide(total, count, out=np.full_like(total, 1.0 / penalties.shape[-1]), where=count > 0)


class Cells:
    """The reachable cells of an archive, numbered from 0, and the mapping of ratios to them.

    A tuple of interval indices i_1 .. i_n (each in 0 .. intervals - 1, where 1.0 belongs to the last interval) spans a
    box whose lower corner sums to sum(i) / intervals and whose upper corner to (sum(i) + n) / intervals. The plane
    sum(ratios) = 1 passes through the inside of the box exactly when sum(i) < intervals < sum(i) + n; a tuple does not
    count if the plane only touches a corner of its box. With a ``collision_bit``, which says whether there is a base
    collision in any of 20 episodes (:attr:`qd.search.fitness.Evaluation.collides`), every tuple is two cells, the one
    with a collision in the upper half of the numbers.
    """

    def __init__(self, num_ratios: int, intervals: int = 10, *, collision_bit: bool = False) -> None:
        if num_ratios < 2:
            raise ValueError(f"num_ratios must be at least 2, got {num_ratios}: a single ratio is always 1")
        if math.comb(intervals + num_ratios - 1, intervals) > _MAX_CELLS:
            limit = f"fewer than {_MAX_CELLS:,} cells for {num_ratios} penalties"
            raise ValueError(f"intervals must leave {limit}, got {intervals}: take fewer")
        self.num_ratios = num_ratios
        self.intervals = intervals
        self.collision_bit = collision_bit

    @property
    def num_cells(self) -> int:
        """Number of reachable cells."""
        return len(self.tuples) * (2 if self.collision_bit else 1)

    @cached_property
    def tuples(self) -> NDArray[np.int64]:
        """The reachable interval tuples in lexicographic order, shape (num_tuples, num_ratios)."""
        tuples = np.zeros((1, 0), dtype=np.int64)
        for _ in range(self.num_ratios):
            tuples = np.vstack([np.insert(tuples, 0, index, axis=1) for index in range(self.intervals)])
            tuples = tuples[tuples.sum(axis=1) < self.intervals]
        return tuples[tuples.sum(axis=1) + self.num_ratios > self.intervals]

    @cached_property
    def codes(self) -> NDArray[np.int64]:
        """One number a reachable tuple, with its indices as digits, ascending, shape (num_tuples,)."""
        return self._code(self.tuples)

    def _code(self, tuples: NDArray[np.int64]) -> NDArray[np.int64]:
        """One number a tuple, with its indices as digits to the base of the intervals."""
        return np.asarray(np.ravel_multi_index(tuple(tuples.T), (self.intervals,) * self.num_ratios), dtype=np.int64)

    def find_cells(self, ratios: ArrayLike, collided: ArrayLike | None = None) -> NDArray[np.int64]:
        """Index of the reachable cell of each row of ratios, shape (batch,).

        Rows of the float64 ratios, (batch, num_ratios), sum to 1; ``collided`` is the collision bit, if there is one.
        """
        ratios = np.asarray(ratios, dtype=np.float64)
        if ratios.ndim != 2 or ratios.shape[1] != self.num_ratios:
            raise ValueError(f"ratios must have shape (batch, {self.num_ratios}), got {ratios.shape}")
        good = (ratios >= 0.0).all(axis=1) & (np.abs(ratios.sum(axis=1) - 1.0) < _SUM_TOLERANCE)
        if not good.all():
            row = int(np.argmin(good))
            raise ValueError(f"ratios must not be negative and must sum to 1, got {ratios[row].tolist()} in row {row}")
        # By the edges themselves: floor(ratio * intervals) puts some, 1/49 of 49 for one, a whole interval too low.
        edges = np.arange(self.intervals + 1) / self.intervals
        tuples = np.clip(np.searchsorted(edges, ratios, side="right") - 1, 0, self.intervals - 1)
        # Where the plane only touches a corner of the box, its tuple moves to a reachable neighbour.
        total = tuples.sum(axis=1)
        rows = np.flatnonzero(total >= self.intervals)  # every ratio on its lower edge: .2, .2, .2, .2, .2
        tuples[rows, ratios[rows].argmax(axis=1)] -= 1
        rows = np.flatnonzero(total + self.num_ratios <= self.intervals)  # every ratio just below its upper edge
        gap = (tuples[rows] + 1) / self.intervals - ratios[rows]
        tuples[rows, gap.argmin(axis=1)] += 1
        cells = np.searchsorted(self.codes, self._code(tuples))
        if not self.collision_bit:
            return cells
        if collided is None:
            raise ValueError("collided must be given, got None: the cells of this robot have a collision bit")
        return cells + len(self.tuples) * np.asarray(collided, dtype=bool)

    def are_neighbours(self, first: ArrayLike, second: ArrayLike) -> NDArray[np.bool_]:
        """Whether cells agree in their collision bits, and in their intervals up to 1, by their indices (batch,)."""
        bit_a, tuple_a = np.divmod(np.asarray(first), len(self.tuples))
        bit_b, tuple_b = np.divmod(np.asarray(second), len(self.tuples))
        return (np.abs(self.tuples[tuple_a] - self.tuples[tuple_b]) <= 1).all(axis=1) & (bit_a == bit_b)

    def describe(self, cell: int) -> str:
        """A cell as text, for example ``0-0.1 0.3-0.4 0.5-0.6 with collision``."""
        bit, index = divmod(cell, len(self.tuples))
        ranges = [f"{low / self.intervals:.3g}-{(low + 1) / self.intervals:.3g}" for low in self.tuples[index]]
        return " ".join(ranges + (["with" if bit else "without", "collision"] if self.collision_bit else []))
