"""How far rates of terrains lie from those of other settings, or of another simulator."""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Outcome
from sim.files.intervals import bootstrap_interval

KINDS = ("success", "goal")
"""The two rates: episodes without base collision, and episodes that reached the goal."""


def count_hits(outcome: NDArray[np.uint8], kind: str) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Valid episodes that count as a hit, and all valid ones.

    Args:
        outcome: :class:`kernels.episode.Outcome`, shape (..., num_episodes); one that still runs is not counted.
        kind: One of :data:`KINDS`.

    Returns:
        Both of shape (...).
    """
    valid = (outcome != Outcome.INVALID) & (outcome != Outcome.RUNNING)
    hit = outcome != Outcome.BASE_COLLISION if kind == "success" else outcome == Outcome.GOAL
    return (hit & valid).sum(axis=-1), valid.sum(axis=-1)


def crossing_rates(outcome: NDArray[np.uint8], kind: str) -> NDArray[np.float64]:
    """Share of hits among the valid episodes of each terrain, shape (...), NaN where there are none; as above."""
    hits, count = count_hits(outcome, kind)
    return np.where(count > 0, hits / np.maximum(count, 1), np.nan)


def agreement(ours: NDArray[np.uint8], theirs: NDArray[np.uint8], seed: int) -> dict[str, Any]:
    """How far rates of terrains lie from those of other crossings of the same terrains.

    Args:
        ours: Outcomes, shape (num_terrains, num_episodes).
        theirs: Outcomes of the other crossings, shape (num_terrains, any number of episodes).
        seed: Draws the resamples.

    Returns:
        ``terrains``, those that have a valid episode in both; of each kind the mean of our rate minus theirs
        (``success_bias``) with its 95 % bootstrap interval over terrains (``success_bias_interval``), and the mean of
        its size (``success_difference``), None without terrains.
    """
    found: dict[str, Any] = {}
    for kind in KINDS:
        apart = crossing_rates(ours, kind) - crossing_rates(theirs, kind)
        apart = apart[np.isfinite(apart)]
        found |= {
            "terrains": len(apart),
            f"{kind}_bias": float(apart.mean()) if len(apart) else None,
            f"{kind}_bias_interval": bootstrap_interval(apart, seed),
            f"{kind}_difference": float(np.abs(apart).mean()) if len(apart) else None,
        }
    return found
