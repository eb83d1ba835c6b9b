"""Which terrain holds a cell when evaluations are noisy: not the one of the best draw, which would be the luckiest.

A few terrains a cell are crossed again, and it is held by the one that should add most to the QD score of fresh
episodes (Flageat and Cully 2023, "Uncertain Quality-Diversity").
"""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from qd.faults.numbers import FRESH_EPISODES
from qd.search.descriptors import Cells
from qd.search.fitness import BIT_EPISODES, FITNESS_FLOOR, Evaluation, FitnessCfg, join_evaluations, merge_evaluations

DEPTH = 3
"""Terrains that each cell has at most."""
_RATIO_SPREAD = 0.22
"""Standard deviation of a ratio r over episodes, divided by sqrt(r (1 - r)); it differs little between terrains."""
_MIN_VARIANCE = 1e-3  # of r (1 - r), where all episodes so far have a ratio of 0


def chance_to_stay(terrains: Evaluation, cells: Cells) -> NDArray[np.float64]:
    """The chance that 40 fresh episodes put a terrain into the cell that it has now, shape (T,).

    Ratios of its own episodes and of the fresh ones are independent and normal about the true ones.
    """
    counted = np.maximum(terrains.counted, 1)
    variance = _RATIO_SPREAD**2 * (terrains.ratios * (1.0 - terrains.ratios) + _MIN_VARIANCE)
    std = np.sqrt(variance * (1.0 / counted + 1.0 / FRESH_EPISODES)[:, None])
    collides, index = np.divmod(terrains.cell, len(cells.tuples))
    intervals = cells.tuples[index]
    lower = np.where(intervals > 0, intervals / cells.intervals, -np.inf)
    upper = np.where(intervals + 1 < cells.intervals, (intervals + 1) / cells.intervals, np.inf)
    chance = np.prod(ndtr((upper - terrains.ratios) / std) - ndtr((lower - terrains.ratios) / std), axis=1)
    if cells.collision_bit:
        rate = (terrains.collision_rate * counted + 0.5) / (counted + 1.0)
        none_collides = (1.0 - rate) ** BIT_EPISODES
        chance *= np.where(collides == 1, 1.0 - none_collides, none_collides)
    return chance


def expected_score(terrains: Evaluation, cells: Cells, cfg: FitnessCfg) -> NDArray[np.float64]:
    """What each terrain is expected to add to the QD score of fresh episodes, shape (T,); 0 of an invalid one.

    It is the chance to stay, times the fitness above the floor: as many episodes would show it, less a standard error.
    """
    spread = terrains.spread.sum(axis=1)
    fitness = terrains.fitness + cfg.alpha * (terrains.penalty_std.sum(axis=1) - spread)
    lower_bound = fitness - spread / np.sqrt(np.maximum(terrains.counted, 1))
    above = np.maximum(lower_bound - FITNESS_FLOOR, 0.0)
    return np.where(terrains.valid, chance_to_stay(terrains, cells) * above, 0.0)


class Pool:
    """The terrains that hold a cell, or may come to.

    Attributes:
        terrains: What is known of N terrains, by all of their episodes; None before the first.
        solutions: Their unclipped genes, shape (N, num_genes).
        iteration: When each was found, shape (N,).
        number: By which each is known, ascending, shape (N,).
        share: Share of its worth that each keeps, less where nobody may cross it, or it is unlikely, shape (N,).
        holds: Whether each held a cell when the cells were settled last, shape (N,).
        labelled: Whether others have tried to cross each, shape (N,).
    """

    def __init__(self, num_genes: int, cells: Cells, fitness: FitnessCfg) -> None:
        self.cells, self.fitness = cells, fitness
        self.terrains: Evaluation | None = None
        self.solutions = np.zeros((0, num_genes), np.float32)
        self.iteration, self.number = np.zeros(0, np.int64), np.zeros(0, np.int64)
        self._next_number = 0
        self._crossings = np.zeros(0, np.int64)
        self.share = np.zeros(0)
        self.holds, self.labelled = np.zeros(0, bool), np.zeros(0, bool)

    def __len__(self) -> int:
        return len(self.number)

    def tell(
        self, solutions: NDArray[np.float32], number: NDArray[np.int64], crossed: Evaluation, iteration: int
    ) -> Evaluation:
        """Takes in what crossings of T terrains showed, and returns what is known of these now.

        Solutions are unclipped genes, (T, num_genes); ``number`` is -1 of new ones, else theirs, even repeated, (T,).
        """
        merged = crossed.rows(np.arange(len(number)))
        new, again = np.flatnonzero(number < 0), np.flatnonzero(number >= 0)
        repeat = _rank(number[again], again)
        for k in range(repeat.max(initial=-1) + 1):
            assert self.terrains is not None
            chosen = again[repeat == k]
            rows = np.searchsorted(self.number, number[chosen])
            before, after = self.terrains.rows(rows), crossed.rows(chosen)
            for name, values in vars(merge_evaluations(before, after, self.cells, self.fitness)).items():
                getattr(self.terrains, name)[rows] = getattr(merged, name)[chosen] = values
            self._crossings[rows] += 1
        first, count = crossed.rows(new), len(new)
        self.terrains = first if self.terrains is None else join_evaluations([self.terrains, first])
        columns = {"solutions": solutions[new], "iteration": np.full(count, iteration)}
        columns |= {"number": self._next_number + np.arange(count), "_crossings": np.ones(count, np.int64)}
        columns |= {"share": np.ones(count), "holds": np.zeros(count, bool), "labelled": np.zeros(count, bool)}
        for name, values in columns.items():
            setattr(self, name, np.concatenate([getattr(self, name), values]))
        self._next_number += count
        return merged

    def least_known(self, count: int, pending: NDArray[np.int64]) -> NDArray[np.int64]:
        """Numbers of ``count`` terrains to cross again, those with the fewest crossings; none of an empty pool.

        Crossings that are ``pending`` count, by numbers of their terrains. Of few terrains some come several times.
        """
        if self.terrains is None or not len(self):
            return self.number[:0]
        best_first = np.argsort(-self._find_score(self.terrains), kind="stable")
        rows, times = np.unique(np.searchsorted(self.number, pending), return_counts=True)
        crossings = self._crossings.copy()
        crossings[rows] += times
        further = np.arange(-(-count // len(self)) + crossings.max() - crossings.min())
        order = np.argsort((crossings[best_first, None] + further).ravel(), kind="stable")[:count]
        return self.number[best_first[order // len(further)]]

    def settle(self, pending: NDArray[np.int64]) -> NDArray[np.int64]:
        """Leaves each cell its best terrains, and those ``pending``; rows of the ones that hold a cell."""
        assert self.terrains is not None
        score = self._find_score(self.terrains)
        rank = _rank(self.terrains.cell, -score)
        self.holds = (rank == 0) & (score > 0.0) & (self.terrains.fitness > FITNESS_FLOOR)
        stays = ((rank < DEPTH) & (score > 0.0)) | np.isin(self.number, pending)
        self.terrains = self.terrains.rows(stays)
        for name in ("solutions", "iteration", "number", "_crossings", "share", "holds", "labelled"):
            setattr(self, name, getattr(self, name)[stays])
        return np.flatnonzero(self.holds)

    def _find_score(self, terrains: Evaluation) -> NDArray[np.float64]:
        """The share that each keeps of what it is expected to add to the QD score."""
        return expected_score(terrains, self.cells, self.fitness) * self.share


def _rank(group: NDArray[np.int64], key: NDArray[np.float64] | NDArray[np.int64]) -> NDArray[np.int64]:
    """How many of the same group have a smaller key, shape (N,); among equals the first is the smaller."""
    order = np.lexsort((key, group))
    rank = np.empty(len(group), np.int64)
    rank[order] = np.arange(len(group)) - np.searchsorted(group[order], group[order])
    return rank
