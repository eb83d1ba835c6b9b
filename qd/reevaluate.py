"""Elites again with fresh episodes: how many of them are what they were found to be."""

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.fitness import FitnessCfg, evaluation_of
from qd.workers import Evaluate, episode_seeds

FRESH_EPISODES = 40
_BIT_EPISODES = 20  # the collision bit is "any collision", which more episodes than the search's would bias

_FRESH_STREAM = 1


def reproduced(
    archive: Archive, evaluate: Evaluate, *, seed: int, progress: Callable[[float], None] | None = None
) -> NDArray[np.bool_]:
    """Which elites land in their cell or a neighbour of it when evaluated again with 40 fresh episodes.

    Args:
        archive: The elites.
        evaluate: Evaluates with 40 replicas.
        seed: The search's seed; the episodes are drawn apart from the search's own.
        progress: Called with the share done.

    Returns:
        Shape (num_elites,).

    Raises:
        ValueError: If ``evaluate`` gives another number of episodes.
    """
    if not len(archive):
        return np.zeros(0, dtype=bool)
    seeds = episode_seeds(seed, archive.iterations, len(archive), stream=_FRESH_STREAM)
    result = evaluate(archive.genes, seeds, progress)
    if result.base_collision.shape[1] != FRESH_EPISODES:
        raise ValueError(f"evaluate must give {FRESH_EPISODES} episodes, got {result.base_collision.shape[1]}")
    cells = archive.cells
    cfg = FitnessCfg(penalties=archive.penalties, scales=archive.scales)
    fresh = evaluation_of(result, cells, cfg)
    collided = (result.base_collision & ~result.invalid)[:, :_BIT_EPISODES].any(axis=1)
    return fresh.valid & cells.are_neighbours(archive.cell, cells.cell_of(fresh.ratios, collided))
