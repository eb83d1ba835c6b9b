"""Terrain by terrain, what one controller can do that another cannot.

A controller *fails* a terrain if fewer than half of its valid episodes there reach the goal; whoever has a base
collision does not reach it, so that both ways to fail are in this. Of two controllers, a terrain is then *mended* (the
first fails, the second does not), *still failing* (both), *newly broken* (the second alone) or fine with both. A
terrain that is a matter of luck to either falls on one side by chance: *clear* are those changes where the two goal
rates' own 95 % intervals (Wilson) do not overlap.
"""

from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from sim.files.intervals import paired_interval, wilson_interval
from train.evaluate.measures import MEASURES, Measured

FAILING_BELOW = 0.5
"""Goal rate below which a controller fails a terrain."""
KINDS = ("mended", "still_failing", "newly_broken", "fine")
"""What may have become of a terrain."""


def difference(before: Measured, after: Measured, numbers: NDArray[np.int64], seed: int) -> dict[str, Any]:
    """What became of each terrain from one controller to another, and what the second gains in the mean.

    Args:
        before: What the first made of T terrains.
        after: What the second made of the same.
        numbers: Number of each terrain, shape (T,).
        seed: Of the bootstrap over terrains.

    Returns:
        As JSON values: ``compared`` terrains (valid for both); for each of :data:`KINDS` their ``count``, ``share``,
        the 95 % ``interval`` of the share, their numbers as ``terrains``, and of those mended or newly broken
        how many are ``clear``; and ``gain``: measure -> mean difference with its interval, terrain by terrain.
    """
    both = before.valid & after.valid
    fails = [np.where(both, one.values["goal"] < FAILING_BELOW, False) for one in (before, after)]
    members = {
        "mended": fails[0] & ~fails[1],
        "still_failing": fails[0] & fails[1],
        "newly_broken": ~fails[0] & fails[1],
        "fine": ~fails[0] & ~fails[1] & both,
    }
    apart = _goal_rates_apart(before, after)
    found: dict[str, Any] = {"compared": int(both.sum())}
    for kind, member in members.items():
        found[kind] = _counted(member, both, numbers, seed)
        if kind in ("mended", "newly_broken"):
            found[kind]["clear"] = int((member & apart).sum())
    gains = {name: (after.values[name] - before.values[name])[both] for name in MEASURES}
    found["gain"] = {
        name: {"mean": _mean(gain), "interval": paired_interval(gain, seed)} for name, gain in gains.items()
    }
    return found


def differences(crossed: dict[str, Measured], numbers: NDArray[np.int64], seed: int) -> dict[str, Any]:
    """:func:`difference` of every two controllers, the earlier named one first, under ``first -> second``.

    Args:
        crossed: What each controller made of the same T terrains.
        numbers: Number of each terrain, shape (T,).
        seed: Of the bootstrap over terrains.
    """
    return {
        f"{first} -> {second}": difference(crossed[first], crossed[second], numbers, seed)
        for first, second in combinations(crossed, 2)
    }


def _counted(
    member: NDArray[np.bool_], among: NDArray[np.bool_], numbers: NDArray[np.int64], seed: int
) -> dict[str, Any]:
    shares = member[among].astype(float)
    return {
        "count": int(member.sum()),
        "share": _mean(shares),
        "interval": paired_interval(shares, seed),
        "terrains": np.sort(numbers[member]).tolist(),
    }


def _goal_rates_apart(before: Measured, after: Measured) -> NDArray[np.bool_]:
    """Whether the Wilson intervals of two controllers' goal rates on a terrain do not overlap, shape (T,)."""
    limits = [_wilson_limits(one) for one in (before, after)]
    return (limits[0][:, 1] < limits[1][:, 0]) | (limits[1][:, 1] < limits[0][:, 0])


def _wilson_limits(one: Measured) -> NDArray[np.float64]:
    """Interval of the goal rate on each terrain, shape (T, 2); anything possible on an invalid one."""
    counts = zip(one.goals.tolist(), one.episodes.tolist(), strict=True)
    return np.array([wilson_interval(goals, episodes) if episodes else (0.0, 1.0) for goals, episodes in counts])


def _mean(values: NDArray[np.float64]) -> float | None:
    return float(values.mean()) if len(values) else None
