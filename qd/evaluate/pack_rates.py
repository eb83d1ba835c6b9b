"""What controllers make of the terrains of a pack: of each, over all, and by what is known of them."""

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from qd.evaluate.measures import terrain_rates
from qd.fitness import FAILING_GOAL_RATE
from sim.files.intervals import bootstrap_interval, wilson_interval
from sim.rates import counted_episodes
from sim.rollout import RolloutResult

GROUPS = ("verdict", "mode", "cause", "kind")
"""What terrains are grouped by."""
_RATES = ("goal_rate", "success_rate", "fallen_rate")
Row = dict[str, Any]
"""What a controller made of one terrain, as JSON values; rates are None on an invalid one."""


def rows_of(result: RolloutResult) -> list[Row]:
    """What crossings say of each terrain: rates, the goal rate with its interval (Wilson), and valid episodes."""
    counted, rates = counted_episodes(result.invalid), terrain_rates(result)
    hits, valid = (result.reached_goal & counted).sum(axis=1).tolist(), counted.sum(axis=1).tolist()
    return [
        {f"{name}_rate": None if np.isnan(values[place]) else float(values[place]) for name, values in rates.items()}
        | {"goal_interval": list(wilson_interval(hits[place], valid[place])), "valid_episodes": valid[place]}
        for place in range(len(valid))
    ]


def fails(row: Row) -> bool:
    """Whether a controller fails a terrain: under half of its valid episodes reach the goal."""
    return row["goal_rate"] is not None and row["goal_rate"] < FAILING_GOAL_RATE


def over_all(rows: Sequence[Row], abouts: Sequence[dict[str, Any]], seed: int) -> dict[str, Any]:
    """Means over terrains with 95 % intervals, bootstrap over families, as JSON values.

    Args:
        rows: What a controller made of each terrain.
        abouts: What is known of each.
        seed: Of the bootstrap.

    Returns:
        ``goal_rate``, ``success_rate`` and ``fallen_rate`` with ``goal_interval`` and so on; of the valid ``terrains``
        how many are ``failing``, and of their ``families`` in how many one is (``failing_families``).
    """
    valid = [place for place, row in enumerate(rows) if row["goal_rate"] is not None]
    families = np.array([abouts[place]["family"] for place in valid], np.int64)
    found: dict[str, Any] = {}
    for name in _RATES:
        values = np.array([rows[place][name] for place in valid], np.float64)
        found[name] = float(values.mean()) if valid else None
        found[name.replace("_rate", "_interval")] = bootstrap_interval(values, seed, families=families)
    failing = np.array([fails(rows[place]) for place in valid], bool)
    return found | {
        "failing": int(failing.sum()),
        "terrains": len(valid),
        "failing_families": len(np.unique(families[failing])),
        "families": len(np.unique(families)),
    }


def grouped(abouts: Sequence[dict[str, Any]], rows: Mapping[str, Sequence[Row]]) -> dict[str, list[dict[str, Any]]]:
    """How controllers fare by :data:`GROUPS`, and in the families: mean goal rates and how many terrains fail.

    Args:
        abouts: What is known of each terrain.
        rows: Controller -> what it made of each.

    Returns:
        Group -> its values, the most frequent first, each with ``terrains`` and, by controller, ``goal_rate`` (None
        without a valid terrain) and ``failing``.
    """
    return {group: _by(group, abouts, rows) for group in (*GROUPS, "family")}


def _by(group: str, abouts: Sequence[dict[str, Any]], rows: Mapping[str, Sequence[Row]]) -> list[dict[str, Any]]:
    members: dict[Any, list[int]] = {}
    for place, about in enumerate(abouts):
        members.setdefault(about[group], []).append(place)
    found = []
    for value, places in sorted(members.items(), key=lambda one: (-len(one[1]), str(one[0]))):
        own = {who: [row[place] for place in places] for who, row in rows.items()}
        known = {who: [row["goal_rate"] for row in some if row["goal_rate"] is not None] for who, some in own.items()}
        found.append(
            {
                group: value,
                "terrains": len(places),
                "goal_rate": {who: float(np.mean(rates)) if rates else None for who, rates in known.items()},
                "failing": {who: sum(map(fails, some)) for who, some in own.items()},
            }
        )
    return found
