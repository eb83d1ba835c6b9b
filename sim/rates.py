"""Rates of terrains: the episodes that count, the typical outcome, and what robots did in words."""

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Kind, Outcome

SUCCESS = {Kind.CROSS: "reaches the goal", Kind.ROUTE: "follows its route", Kind.STAND: "stays standing"}
"""What a robot does that does what it is asked for; it passes a terrain where it does so half of the time."""
_FAILURES = {
    Outcome.BASE_COLLISION: "hits the ground",
    Outcome.TIME_OUT: "gets stuck",
    Outcome.OUT: "leaves the terrain",
    Outcome.TILT: "topples",
    Outcome.STRAYED: "strays",
    Outcome.INVALID: "breaks the simulation",
}


def rate_labels(asks: Kind) -> dict[str, str]:
    """What the rates of a :class:`qd.search.fitness.Evaluation` count, by their names."""
    collided = {"collision_rate": "base collision", "other_rate": "other failure"}
    return {"goal_rate": SUCCESS[asks], **collided, "fallen_rate": "fallen"}


def way_to_end(outcome: int, asks: Kind, *, fallen: bool = False) -> str:
    """How an episode ended, as one says of a robot: ``topples`` of one that has failed and fallen."""
    if outcome == Outcome.GOAL:
        return SUCCESS[asks]
    return "topples" if fallen and outcome != Outcome.INVALID else _FAILURES[Outcome(outcome)]


MAX_INVALID_SHARE = 0.25
"""A terrain with more than this share of invalid episodes is invalid."""


def counted_episodes(invalid: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Episodes that count: the valid ones of terrains that are not invalid; shapes (..., num_episodes)."""
    usable = invalid.sum(axis=-1, keepdims=True) <= MAX_INVALID_SHARE * invalid.shape[-1]
    return ~invalid & usable


def terrain_means(values: NDArray, counted: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Mean of values (..., num_episodes) over the episodes that count, shape (...); NaN where there are none."""
    sums = np.where(counted, values, 0.0).sum(axis=-1)
    counts = counted.sum(axis=-1)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def typical_outcome(outcome: NDArray[np.integer]) -> NDArray[np.int64]:
    """The commonest outcome of valid episodes (..., num_episodes), GOAL only if at least half reach it.

    Shape (...); ``INVALID`` where no episode is valid.
    """
    counts = (outcome[..., None] == np.arange(max(Outcome) + 1)).sum(axis=-2)
    valid = outcome.shape[-1] - counts[..., Outcome.INVALID]
    counts[..., Outcome.INVALID] *= valid == 0
    counts[..., Outcome.GOAL] *= 2 * counts[..., Outcome.GOAL] >= valid
    return counts.argmax(axis=-1)
