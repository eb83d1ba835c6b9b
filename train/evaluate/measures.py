"""What crossings say of a controller, terrain by terrain: rates, reward and scaled penalties."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Outcome
from sim.rollout import RolloutResult

MEASURES = ("success", "goal", "fallen", "reward")
"""Names of the measures beside the penalties: three rates as fractions, and the reward in 20 s."""
_MAX_INVALID_SHARE = 0.25


@dataclass(frozen=True, kw_only=True)
class Measured:
    """What one controller made of T terrains; NaN on an invalid terrain, of which over a quarter of the episodes are.

    Statistics are over the valid episodes of a terrain.
    """

    values: dict[str, NDArray[np.float64]]
    """Mean of each of :data:`MEASURES` on each terrain, shape (T,)."""
    penalties: dict[str, NDArray[np.float64]]
    """Mean of each scaled penalty on each terrain, shape (T,)."""
    goals: NDArray[np.int64]
    """Valid episodes that reached the goal, shape (T,)."""
    episodes: NDArray[np.int64]
    """Valid episodes, shape (T,); 0 on an invalid terrain."""
    outcomes: dict[str, int]
    """Episodes by how they ended."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether a terrain's numbers mean anything, shape (T,)."""
        return self.episodes > 0


def invalid_lines(outcomes: Mapping[str, Mapping[str, int]]) -> list[str]:
    """What to say of invalid episodes, one line for each crossing of a set that has some.

    A falling robot may leave the valid states before it touches the ground: what is left out may be failures.

    Args:
        outcomes: Episodes by how they ended (:class:`kernels.episode.Outcome`, lower case), by what crossed.
    """
    lines = []
    for what, counts in outcomes.items():
        count, total = counts["invalid"], sum(counts.values())
        if count:
            goal = counts["goal"] / total
            success = 1.0 - (counts["base_collision"] + count) / total
            lines.append(
                f"{what}: {count} of {total} episodes are invalid ({count / total:.1%}) and left out; counted as "
                f"failures, success would be {success:.3f}, goal {goal:.3f}"
            )
    return lines


def valid_episodes(result: RolloutResult) -> NDArray[np.bool_]:
    """Episodes that count, shape (T, R): not invalid, and not on a terrain more than a quarter of whose are."""
    valid = ~result.invalid
    usable = valid.sum(axis=1) >= (1.0 - _MAX_INVALID_SHARE) * valid.shape[1]
    return valid & usable[:, None]


def terrain_means(values: NDArray, counted: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Mean over the episodes that count, shape (T,); NaN where there are none.

    Args:
        values: Of each episode, shape (T, R).
        counted: Which episodes count, shape (T, R).
    """
    sums = np.where(counted, values, 0.0).sum(axis=1)
    counts = counted.sum(axis=1)
    return np.where(counts > 0, sums / np.maximum(counts, 1), np.nan)


def terrain_rates(result: RolloutResult) -> dict[str, NDArray[np.float64]]:
    """``success`` (no base collision), ``goal`` and ``fallen`` rate of each terrain, shape (T,); NaN if invalid."""
    counted = valid_episodes(result)
    hits = {"success": ~result.base_collision, "goal": result.reached_goal, "fallen": result.fallen}
    return {name: terrain_means(hit, counted) for name, hit in hits.items()}


def count_outcomes(result: RolloutResult) -> dict[str, int]:
    """Episodes by how they ended."""
    return {
        outcome.name.lower(): int((result.outcome == outcome).sum()) for outcome in Outcome if outcome != Outcome.TILT
    }


def measure(result: RolloutResult, scales: Sequence[float]) -> Measured:
    """Everything that the tables say of crossings.

    Args:
        result: Crossings of T terrains, with their reward.
        scales: Scale of each penalty, in the result's order.

    Raises:
        ValueError: If the reward was not summed, or there is not one scale a penalty.
    """
    if result.reward is None:
        raise ValueError("crossings must come with their reward, got none: ask the evaluator for it (reward=True)")
    if len(scales) != len(result.penalty_names):
        raise ValueError(f"scales must be one a penalty {result.penalty_names}, got {len(scales)}")
    counted = valid_episodes(result)
    names = zip(result.penalty_names, scales, strict=True)
    return Measured(
        values={**terrain_rates(result), "reward": terrain_means(result.reward, counted)},
        penalties={
            name: terrain_means(result.penalties[..., column] / scale, counted)
            for column, (name, scale) in enumerate(names)
        },
        goals=(result.reached_goal & counted).sum(axis=1),
        episodes=counted.sum(axis=1),
        outcomes=count_outcomes(result),
    )
