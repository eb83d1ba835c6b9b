"""Elites again with fresh episodes: what they are worth, free of the luck that made them elites.

An elite is the best of many noisy evaluations and flatters itself; its 40 fresh episodes do not. Which episodes those
are follows from the run's seed and from what names an elite, its cell and the iteration that found it, so that on the
CPU they give the same numbers whenever they are run.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.descriptors import Cells
from qd.fitness import FITNESS_FLOOR, Evaluation, FitnessCfg, evaluation_of
from qd.shards import taken
from qd.workers import Evaluate
from sim.intervals import bootstrap_interval

FRESH_EPISODES = 40
_BIT_EPISODES = 20  # the collision bit is "any collision", which more episodes than the search's would bias

_FRESH_STREAM = 1
_DRAW_STREAM = 3


@dataclass(frozen=True, kw_only=True)
class Reevaluation:
    """What 40 fresh episodes say of N elites."""

    fresh: Evaluation
    """The episodes' own fitness, ratios, cell and rates; a collision bit is taken over the first 20."""
    reproduced: NDArray[np.bool_]
    """Whether an elite lands in its cell or a neighbour of it, shape (N,)."""

    def std(self) -> NDArray[np.float64]:
        """Sum over penalties of the standard deviation over the episodes, of the valid elites, shape (num_valid,)."""
        return self.fresh.penalty_std[self.fresh.valid].sum(axis=1)

    def corrected_elites(self) -> NDArray[np.int64]:
        """The archive that fresh episodes alone would make: of each cell that an elite lands in, its fittest.

        Returns:
            Indices into the elites, one a filled cell (the "corrected archive" of Flageat and Cully 2023).
        """
        fresh, valid = self.fresh, np.flatnonzero(self.fresh.valid & (self.fresh.fitness > FITNESS_FLOOR))
        order = valid[np.lexsort((-fresh.fitness[valid], fresh.cell[valid]))]
        return order[np.unique(fresh.cell[order], return_index=True)[1]]


def reevaluate(
    archives: Sequence[Archive],
    evaluate: Evaluate,
    fitness: FitnessCfg,
    *,
    num_replicas: int,
    seeds: Sequence[int],
    progress: Callable[[float], None] | None = None,
) -> list[Reevaluation]:
    """Evaluates every elite of some archives again with 40 fresh episodes, all of them together.

    Args:
        archives: The elites.
        evaluate: Crosses terrains.
        fitness: Weights of the fitness, with the archives' penalties.
        num_replicas: Episodes a terrain that ``evaluate`` gives; terrains are crossed as often as makes 40.
        seeds: The search's seed, one an archive; the episodes are drawn apart from the search's own.
        progress: Called with the share done.

    Returns:
        One an archive.

    Raises:
        ValueError: If ``evaluate`` gives another number of episodes.
    """
    times = -(-FRESH_EPISODES // num_replicas)
    counts = [len(archive) for archive in archives]
    if not sum(counts):
        return [_nothing(archive.cells) for archive in archives]
    genes = np.concatenate([archive.genes for archive in archives]).repeat(times, axis=0)
    drawn = [_elite_seeds(archive, seed, times) for archive, seed in zip(archives, seeds, strict=True)]
    result = evaluate(genes, np.concatenate(drawn), progress)
    if result.base_collision.shape[1] != num_replicas:
        raise ValueError(f"evaluate must give {num_replicas} episodes, got {result.base_collision.shape[1]}")
    found, first = [], 0
    for archive, count in zip(archives, counts, strict=True):
        own = _regrouped(taken(result, count * times, first=first * times), times) if count else None
        found.append(_nothing(archive.cells) if own is None else _held_against(archive, own, fitness))
        first += count
    return found


def _elite_seeds(archive: Archive, seed: int, times: int) -> NDArray[np.uint32]:
    names = zip(archive.iteration.tolist(), archive.cell.tolist(), strict=True)
    rows = [np.random.SeedSequence([seed, *name], spawn_key=(_FRESH_STREAM,)).generate_state(times) for name in names]
    return np.concatenate([np.zeros(0, np.uint32), *rows]).astype(np.uint32)


def _regrouped(result: Any, times: int) -> Any:
    """A result whose terrains come ``times`` times in succession as one of 40 episodes a terrain."""
    arrays = {}
    for name, value in vars(result).items():
        if isinstance(value, np.ndarray):
            grouped = value.reshape(-1, times * value.shape[1], *value.shape[2:])
            arrays[name] = grouped[:, :FRESH_EPISODES]
    return replace(result, **arrays)


def _held_against(archive: Archive, result: Any, fitness: FitnessCfg) -> Reevaluation:
    cells = archive.cells
    fresh = evaluation_of(result, cells, fitness)
    collided = (result.base_collision & ~result.invalid)[:, :_BIT_EPISODES].any(axis=1)
    fresh = replace(fresh, cell=cells.cell_of(fresh.ratios, collided))
    return Reevaluation(fresh=fresh, reproduced=fresh.valid & cells.are_neighbours(archive.cell, fresh.cell))


def _nothing(cells: Cells) -> Reevaluation:
    rates, counts, columns = np.zeros(0), np.zeros(0, np.int64), np.zeros((0, cells.num_ratios))
    fresh = Evaluation(
        fitness=rates, ratios=columns, cell=counts, penalty_mean=columns, penalty_std=columns, collision_rate=rates,
        goal_rate=rates, fallen_rate=rates, invalid_episodes=counts, episodes=counts,
    )  # fmt: skip
    return Reevaluation(fresh=fresh, reproduced=np.zeros(0, dtype=bool))


def drawn_elites(archive: Archive, most: int, seed: int) -> Archive:
    """An archive of some elites, drawn at random without replacement; all of them where there are no more than wanted.

    Args:
        archive: The elites.
        most: How many to draw.
        seed: The search's seed; the iterations done are drawn with too.
    """
    if len(archive) <= most:
        return archive
    rng = np.random.default_rng(np.random.SeedSequence([seed, archive.iterations], spawn_key=(_DRAW_STREAM,)))
    return archive.rows(np.sort(rng.choice(len(archive), most, replace=False)))


def numbers_of(again: Reevaluation, cells: Cells, *, sampled: bool = False) -> dict[str, Any]:
    """The numbers of a re-evaluation, as metrics and reports have them.

    Args:
        again: The re-evaluation.
        cells: The archive's cells.
        sampled: Whether it is of some elites only: what sums over all of them is left out then.
    """
    std = again.std()
    numbers = {
        "reevaluated": len(again.reproduced),
        "reproduced": int(again.reproduced.sum()),
        "mean_std": float(std.mean()) if len(std) else None,
        "mean_std_interval": bootstrap_interval(std, np.random.default_rng(0)),
        "corrected_mean_fitness": float(again.fresh.fitness[again.fresh.valid].mean()) if len(std) else None,
    }
    if sampled:
        return numbers
    kept = again.corrected_elites()
    return numbers | {
        "corrected_elites": len(kept),
        "corrected_coverage": len(kept) / cells.num_cells,
        "corrected_qd_score": float((again.fresh.fitness[kept] - FITNESS_FLOOR).sum()),
    }
