"""Rates of terrains: which episodes count, and how far rates lie from those of other settings or simulators."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.files.intervals import bootstrap_interval

KINDS = ("success", "goal")
"""The two rates: episodes without base collision, and episodes that reached the goal."""
MAX_INVALID_SHARE = 0.25
"""A terrain with more than this share of invalid episodes is invalid."""


def counted_episodes(invalid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Episodes that count: the valid ones of terrains that are not invalid; shapes (..., num_episodes)."""
    usable = invalid.sum(axis=-1, keepdims=True) <= MAX_INVALID_SHARE * invalid.shape[-1]
    return ~invalid & usable


def terrain_means(values: NDArray, counted: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Mean of values (..., num_episodes) over the episodes that count, shape (...); NaN where there are none."""
    sums, counts = np.where(counted, values, 0.0).sum(axis=-1), counted.sum(axis=-1)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def typical_outcome(outcome: NDArray[np.integer]) -> int:
    """How most valid episodes end, shape (E,); where under half reach the goal, how most of the others end."""
    from kernels.episode import Outcome

    counts = np.bincount(outcome, minlength=max(Outcome) + 1)
    if valid := len(outcome) - counts[Outcome.INVALID]:
        counts[Outcome.INVALID] = 0
        counts[Outcome.GOAL] *= 2 * counts[Outcome.GOAL] >= valid
    return int(counts.argmax())


def hits_of(outcome: NDArray[np.uint8], kind: str) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Which episodes count as a hit of one of :data:`KINDS`, and which count at all; one that still runs does not.

    Both of the shape of the outcomes (:class:`kernels.episode.Outcome`), (..., num_episodes).
    """
    from kernels.episode import Outcome  # which imports Warp: not for `--help`

    counted = counted_episodes((outcome == Outcome.INVALID) | (outcome == Outcome.RUNNING))
    hit = outcome != Outcome.BASE_COLLISION if kind == "success" else outcome == Outcome.GOAL
    return hit & counted, counted


def crossing_rates(outcome: NDArray[np.uint8], kind: str) -> NDArray[np.float64]:
    """Rate of each terrain, shape (...), NaN on an invalid one; arguments as of :func:`hits_of`."""
    return terrain_means(*hits_of(outcome, kind))


def agreement(
    ours: NDArray[np.uint8], theirs: NDArray[np.uint8], seed: int, families: NDArray[np.int64] | None = None
) -> dict[str, Any]:
    """How far rates of terrains lie from those of other crossings of the same terrains.

    Args:
        ours: Outcomes, shape (num_terrains, num_episodes).
        theirs: Outcomes of the other crossings, shape (num_terrains, any number of episodes).
        seed: Draws the resamples.
        families: Of terrains that are not independent, shape (num_terrains,).

    Returns:
        ``terrains``, those that are valid in both; of each kind the mean of our rate minus theirs
        (``success_bias``) with its 95 % bootstrap interval over terrains (``success_bias_interval``), and the mean of
        its size (``success_difference``), None without terrains.
    """
    numbers: dict[str, Any] = {}
    for kind in KINDS:
        apart = crossing_rates(ours, kind) - crossing_rates(theirs, kind)
        known = np.isfinite(apart)
        apart, kin = apart[known], None if families is None else families[known]
        numbers |= {
            "terrains": len(apart),
            f"{kind}_bias": float(apart.mean()) if len(apart) else None,
            f"{kind}_bias_interval": bootstrap_interval(apart, seed, families=kin),
            f"{kind}_difference": float(np.abs(apart).mean()) if len(apart) else None,
        }
    return numbers
