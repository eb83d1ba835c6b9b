"""What crossings say of a controller: rates, reward and scaled penalties by terrain, by terrain type and by level."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

from kernels.episode import Outcome
from qd.evaluate.labels import CERTIFIED
from qd.evaluate.labels import RATES as RATE_MEASURES
from sim.files.intervals import DIFFERENCES, RATES, bootstrap_interval
from sim.rates import counted_episodes, terrain_means
from sim.rollout import RolloutResult
from sim.terrains.hand_crafted import CROSSING_TYPES

VELOCITY_FROM_S = 2.0
"""The velocity error counts from this time of an episode on [s]: before it the robot gets going."""


@dataclass(frozen=True, kw_only=True)
class Performance:
    """What one controller made of T terrains; NaN on an invalid terrain, of which over a quarter of the episodes are.

    Statistics are over the valid episodes of a terrain.
    """

    values: dict[str, NDArray[np.float64]]
    """Mean of each of :data:`qd.evaluate.labels.MEASURES` on each terrain, shape (T,)."""
    penalties: dict[str, NDArray[np.float64]]
    """Mean of each scaled penalty on each terrain, shape (T,)."""
    goals: NDArray[np.int64]
    """Valid episodes that reached the goal, shape (T,)."""
    episodes: NDArray[np.int64]
    """Valid episodes, shape (T,); 0 on an invalid terrain."""

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether a terrain's numbers mean anything, shape (T,)."""
        return self.episodes > 0


Families = NDArray[np.int64] | None
"""Number of each terrain's family of kin, shape (T,); None of independent terrains."""


def valid_mean(values: NDArray[np.float64]) -> float | None:
    """Mean over terrains, shape (T,), without the invalid ones, which are NaN; None without any."""
    known = values[~np.isnan(values)]
    return float(known.mean()) if len(known) else None


def valid_interval(
    values: NDArray[np.float64], seed: int, families: Families, bounds: tuple[float, float] | None
) -> list[float] | None:
    """95 % interval of :func:`valid_mean`: bootstrap over terrains, or over their families."""
    known = ~np.isnan(values)
    return bootstrap_interval(values[known], seed, families=select_families(families, known), bounds=bounds)


def measure_bounds(measure: str, *, differences: bool = False) -> tuple[float, float] | None:
    """Where a measure lies, or differences of it; None of one without bounds."""
    return (DIFFERENCES if differences else RATES) if CERTIFIED.get(measure, measure) in RATE_MEASURES else None


def kind_mean(
    values: Sequence[NDArray[np.float64]], families: Families, seed: int, measure: str = "goal"
) -> dict[str, Any] | None:
    """What a measure is in the mean for one kind of controller, or how much more it is for the first of two kinds.

    Args:
        values: Of the trainings of one kind or of two on the terrains, each of shape (num_trainings, num_terrains).
        families: Of terrains that are not independent.
        seed: Of the bootstrap.
        measure: Which one of :data:`qd.evaluate.labels.MEASURES` or of the certified terrains.

    Returns:
        ``mean``, its 95 % ``interval`` and the number of trainings (``seeds``) of each kind; None without a terrain
        that is valid for all. The variance is that over families, by the bootstrap, and that over the trainings of each
        kind; the interval is Student's with Satterthwaite's degrees of freedom (1946), and no narrower than the
        bootstrap's. One training says nothing of others.
    """
    known = np.logical_and.reduce([np.isfinite(kind).all(axis=0) for kind in values])
    if not known.any():
        return None
    of_seeds = [sign * kind[:, known] for sign, kind in zip((1.0, -1.0), values, strict=False)]
    on_terrains = np.sum([kind.mean(axis=0) for kind in of_seeds], axis=0)
    bounds = measure_bounds(measure, differences=len(of_seeds) > 1)
    limits = valid_interval(on_terrains, seed, select_families(families, known), bounds)
    parts = [(kind.mean(axis=1).var(ddof=1) / len(kind), len(kind) - 1) for kind in of_seeds if len(kind) > 1]
    of_families = 0.0 if limits is None else ((limits[1] - limits[0]) / (2.0 * stdtrit(np.inf, 0.975))) ** 2
    variance = of_families + sum(part for part, _ in parts)
    spread = sum(part**2 / freedom for part, freedom in parts)
    freedom = variance**2 / spread if spread > 0.0 else np.inf
    mean, half = float(on_terrains.mean()), float(stdtrit(freedom, 0.975) * np.sqrt(variance))
    ends = [[mean - half, mean + half]] if parts else []
    ends += [] if limits is None else [limits]
    interval = [min(low for low, _ in ends), max(high for _, high in ends)] if ends else None
    if interval and bounds:
        interval = np.clip(interval, *bounds).tolist()
    return {"mean": mean, "interval": interval, "seeds": [len(kind) for kind in of_seeds]}


def select_families(families: Families, chosen: NDArray[np.bool_]) -> Families:
    """Families of some of the terrains."""
    return None if families is None else families[chosen]


def terrain_rates(result: RolloutResult) -> dict[str, NDArray[np.float64]]:
    """``success`` (no base collision), ``goal`` and ``fallen`` rate of each terrain, shape (T,); NaN if invalid."""
    counted = counted_episodes(result.invalid)
    hits = {"success": ~result.base_collision, "goal": result.reached_goal, "fallen": result.fallen}
    return {name: terrain_means(hit, counted) for name, hit in hits.items()}


def measure(result: RolloutResult, scales: Sequence[float]) -> Performance:
    """Everything that the tables say of crossings with their reward; ``scales`` are of the penalties in order."""
    if result.reward is None:
        raise ValueError("crossings must come with their reward, got none: ask the evaluator for it (reward=True)")
    counted = counted_episodes(result.invalid)
    names = zip(result.penalty_names, scales, strict=True)
    return Performance(
        values={**terrain_rates(result), "reward": terrain_means(result.reward, counted)},
        penalties={
            name: terrain_means(result.penalties[..., column] / scale, counted)
            for column, (name, scale) in enumerate(names)
        },
        goals=(result.reached_goal & counted).sum(axis=1),
        episodes=counted.sum(axis=1),
    )


def _group(rates: dict[str, np.ndarray], members: np.ndarray) -> dict[str, Any]:
    return {"terrains": int(members.sum())} | {name: valid_mean(values[members]) for name, values in rates.items()}


def summarise(
    result: RolloutResult, seed: int, *, types: np.ndarray | None = None, levels: np.ndarray | None = None
) -> dict[str, Any]:
    """Rates over a set of terrains, with 95 % intervals and, where known, by type and level."""
    rates = {f"{name}_rate": values for name, values in terrain_rates(result).items()}
    everywhere = np.ones(len(result.outcome), bool)
    summary = _group(rates, everywhere)
    summary |= {f"{name}_interval": valid_interval(values, seed, None, RATES) for name, values in rates.items()}
    summary["episodes"] = int(result.outcome.size)
    ends = [outcome for outcome in Outcome if outcome != Outcome.TILT]
    summary["outcomes"] = {outcome.name.lower(): int((result.outcome == outcome).sum()) for outcome in ends}
    summary["invalid_terrains"] = int(np.isnan(rates["success_rate"]).sum())
    summary["by_type"] = summary["by_level"] = None
    if types is not None:
        summary["by_type"] = {CROSSING_TYPES[k]: _group(rates, types == k) for k in np.unique(types)}
    if levels is not None:
        summary["by_level"] = {str(level): _group(rates, levels == level) for level in np.unique(levels)}
    return summary


def velocity_error(result: RolloutResult, seed: int) -> dict[str, Any]:
    """Error of v_x from 2 s to the end of each valid episode [m/s], base frame: the root of its mean square over time.

    ``vx_error_mean`` is the mean of the episodes' errors. Penalties must be summed from :data:`VELOCITY_FROM_S` on.
    """
    counted_s = result.duration_s - VELOCITY_FROM_S
    usable = ~result.invalid & (counted_s > 0.0)
    error = np.sqrt(result.penalties[..., result.penalty_names.index("vel_x")] / np.where(usable, counted_s, 1.0))
    per_terrain = np.array([row[use].mean() for row, use in zip(error, usable, strict=True) if use.any()])
    return {
        "vx_error_mean": float(error[usable].mean()) if usable.any() else None,
        "vx_error_interval": bootstrap_interval(per_terrain, seed),
        "episodes": int(usable.sum()),
        "goal_rate": float(result.reached_goal[~result.invalid].mean()) if not result.invalid.all() else None,
    }
