"""Rates, reward and scaled penalties of a controller on each terrain, by terrain type and by level."""

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

VELOCITY_FROM_S = 2.0  # the velocity error counts from this time of an episode on [s]: before it the robot gets going


@dataclass(frozen=True, kw_only=True)
class Performance:
    """A controller's numbers on each of T terrains, by valid episodes; NaN where over a quarter of them are invalid."""

    values: dict[str, NDArray[np.float64]]  # mean of each of qd.evaluate.labels.MEASURES on each terrain, shape (T,)
    penalties: dict[str, NDArray[np.float64]]  # mean of each scaled penalty on each terrain, shape (T,)
    goals: NDArray[np.int64]  # valid episodes that reached the goal, shape (T,)
    episodes: NDArray[np.int64]  # valid episodes, shape (T,); 0 on an invalid terrain


def valid_mean(values: NDArray[np.float64]) -> float | None:
    """Mean over terrains, shape (T,), without the invalid ones, which are NaN; None without any."""
    valid = values[~np.isnan(values)]
    return float(valid.mean()) if len(valid) else None


def valid_interval(
    values: NDArray[np.float64], seed: int, families: NDArray[np.int64] | None, bounds: tuple[float, float] | None
) -> list[float] | None:
    """95 % interval of :func:`valid_mean`: bootstrap over terrains, or over their families."""
    valid = ~np.isnan(values)
    families = None if families is None else families[valid]
    return bootstrap_interval(values[valid], seed, families=families, bounds=bounds)


def measure_bounds(measure: str, *, differences: bool = False) -> tuple[float, float] | None:
    """Least and largest value of a measure, or of differences of it; None if it has no bounds."""
    return (DIFFERENCES if differences else RATES) if CERTIFIED.get(measure, measure) in RATE_MEASURES else None


def kind_mean(
    values: Sequence[NDArray[np.float64]], families: NDArray[np.int64] | None, seed: int, measure: str = "goal"
) -> dict[str, Any] | None:
    """The mean of a measure for one kind of controller, or the difference of two kinds, the first minus the second.

    ``values`` has the measure for each kind, shape (num_trainings, num_terrains). Returns ``mean``, its 95 %
    ``interval`` and the number of trainings (``seeds``) of each kind; None without a terrain that is valid for all. The
    variance is that over families, by the bootstrap, and that over trainings; the interval is Student's with
    Satterthwaite's degrees of freedom (1946), no narrower than the bootstrap's. One training says nothing of others.
    """
    valid = np.logical_and.reduce([np.isfinite(kind).all(axis=0) for kind in values])
    if not valid.any():
        return None
    kinds = [sign * kind[:, valid] for sign, kind in zip((1.0, -1.0), values, strict=False)]
    by_terrain = np.sum([kind.mean(axis=0) for kind in kinds], axis=0)
    bounds = measure_bounds(measure, differences=len(kinds) > 1)
    bootstrap = valid_interval(by_terrain, seed, None if families is None else families[valid], bounds)
    variances = [(kind.mean(axis=1).var(ddof=1) / len(kind), len(kind) - 1) for kind in kinds if len(kind) > 1]
    variance = sum(value for value, _ in variances)
    if bootstrap is not None:
        variance = ((bootstrap[1] - bootstrap[0]) / (2.0 * stdtrit(np.inf, 0.975))) ** 2 + variance
    spread = sum(value**2 / freedom for value, freedom in variances)
    freedom = variance**2 / spread if spread > 0.0 else np.inf
    mean = float(by_terrain.mean())
    interval = bootstrap
    if variances:
        half = float(stdtrit(freedom, 0.975) * np.sqrt(variance))
        low, high = bootstrap or (mean, mean)
        interval = [min(mean - half, low), max(mean + half, high)]
    if interval and bounds:
        interval = np.clip(interval, *bounds).tolist()
    return {"mean": mean, "interval": interval, "seeds": [len(kind) for kind in kinds]}


def terrain_rates(result: RolloutResult) -> dict[str, NDArray[np.float64]]:
    """``success`` (no base collision), ``goal`` and ``fallen`` rate of each terrain, shape (T,); NaN if invalid."""
    counted = counted_episodes(result.invalid)
    hits = {"success": ~result.base_collision, "goal": result.reached_goal, "fallen": result.fallen}
    return {name: terrain_means(hit, counted) for name, hit in hits.items()}


def measure(result: RolloutResult, scales: Sequence[float]) -> Performance:
    """A controller's numbers from its crossings with their reward; ``scales`` has each penalty's scale, in order."""
    if result.reward is None:
        raise ValueError("crossings must come with their reward, got none: ask the evaluator for it (reward=True)")
    counted = counted_episodes(result.invalid)
    return Performance(
        values={**terrain_rates(result), "reward": terrain_means(result.reward, counted)},
        penalties={
            name: terrain_means(result.penalties[..., column] / scale, counted)
            for column, (name, scale) in enumerate(zip(result.penalty_names, scales, strict=True))
        },
        goals=(result.reached_goal & counted).sum(axis=1),
        episodes=counted.sum(axis=1),
    )


def summarise_crossings(
    result: RolloutResult, seed: int, *, types: np.ndarray | None = None, levels: np.ndarray | None = None
) -> dict[str, Any]:
    """Rates over a set of terrains, with 95 % intervals and, where known, by type and level."""
    rates = {f"{name}_rate": values for name, values in terrain_rates(result).items()}

    def summarise(mask: NDArray[np.bool_]) -> dict[str, Any]:
        return {"terrains": int(mask.sum())} | {name: valid_mean(values[mask]) for name, values in rates.items()}

    by_type = by_level = None
    if types is not None:
        by_type = {CROSSING_TYPES[k]: summarise(types == k) for k in np.unique(types)}
    if levels is not None:
        by_level = {str(level): summarise(levels == level) for level in np.unique(levels)}
    counts = {outcome: int((result.outcome == outcome).sum()) for outcome in Outcome}
    return {
        **summarise(np.ones(len(result.outcome), bool)),
        **{f"{name}_interval": valid_interval(values, seed, None, RATES) for name, values in rates.items()},
        "episodes": int(result.outcome.size),
        "outcomes": {end.name.lower(): count for end, count in counts.items() if count or end < Outcome.TILT},
        "invalid_terrains": int(np.isnan(rates["success_rate"]).sum()),
        "by_type": by_type,
        "by_level": by_level,
    }


def velocity_error(result: RolloutResult, seed: int) -> dict[str, Any]:
    """Error of v_x in valid episodes, of penalties from :data:`VELOCITY_FROM_S` on: root of its mean square [m/s]."""
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
