"""How well two simulators agree on what becomes of a controller."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Outcome
from sim.files.intervals import bootstrap_interval, wilson_interval


@dataclass(frozen=True, kw_only=True)
class Pair:
    """Crossings of one terrain in both simulators."""

    index: int
    """Where the terrain stands in its pool."""
    first: float | None
    """Success rate of the set of episodes by which the terrain was chosen; None if it was named."""
    ours: NDArray[np.uint8]
    """:class:`kernels.episode.Outcome` of the parallel simulation, shape (num_episodes,)."""
    plain: NDArray[np.uint8]
    """The same of plain MuJoCo, shape (num_plain_episodes,)."""


def _hits(outcome: NDArray[np.uint8], kind: str) -> tuple[int, int]:
    """Episodes that count as a hit, and valid ones."""
    valid = outcome[outcome != Outcome.INVALID]
    hit = valid != Outcome.BASE_COLLISION if kind == "success" else valid == Outcome.GOAL
    return int(hit.sum()), len(valid)


def _compare(pair: Pair, kind: str) -> dict[str, Any]:
    hits, count = _hits(pair.ours, kind)
    plain_hits, plain_count = _hits(pair.plain, kind)
    low, high = wilson_interval(hits, count)
    plain_rate = plain_hits / plain_count
    return {
        "ours": hits / count,
        "interval": [low, high],
        "mujoco_c": plain_rate,
        "mujoco_c_interval": list(wilson_interval(plain_hits, plain_count)),
        "inside": low <= plain_rate <= high,
    }


def summarise(pairs: Sequence[Pair], seed: int) -> dict[str, Any]:
    """Rates side by side, a row a terrain, and the bias of the mean: MuJoCo C's rate minus ours.

    Args:
        pairs: One a terrain.
        seed: Of the bootstrap over terrains.

    Raises:
        ValueError: If no terrain has a valid episode in both; one that has none is left out and named.
    """
    left_out = [pair.index for pair in pairs if not _hits(pair.ours, "goal")[1] or not _hits(pair.plain, "goal")[1]]
    invalid = {
        "ours": int(sum((pair.ours == Outcome.INVALID).sum() for pair in pairs)),
        "mujoco_c": int(sum((pair.plain == Outcome.INVALID).sum() for pair in pairs)),
    }
    pairs = [pair for pair in pairs if pair.index not in left_out]
    if not pairs:
        raise ValueError("no terrain has a valid episode in both simulators: nothing to compare")
    rows = [
        {
            "index": pair.index,
            "first_success": pair.first,
            "episodes": [len(pair.ours), len(pair.plain)],
            "success": _compare(pair, "success"),
            "goal": _compare(pair, "goal"),
        }
        for pair in pairs
    ]
    totals = {}
    for kind in ("success", "goal"):
        ours = np.array([row[kind]["ours"] for row in rows])
        plain = np.array([row[kind]["mujoco_c"] for row in rows])
        totals[kind] = {
            "inside": int(sum(row[kind]["inside"] for row in rows)),
            "ours": float(ours.mean()),
            "mujoco_c": float(plain.mean()),
            "bias": float((plain - ours).mean()),
            "bias_interval": bootstrap_interval(plain - ours, np.random.default_rng(seed)),
        }
    return {**totals, "invalid": invalid, "left_out": left_out, "terrains": rows}
