"""Fitness: how hard, and how reliably hard, a terrain is for the controller (the paper's fitness equation)."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from qd.descriptors import Cells, terrain_ratios
from sim.files.settings import PositiveFloat, check
from sim.rates import MAX_INVALID_SHARE, counted_episodes, typical_outcome

if TYPE_CHECKING:
    from sim.rollout import RolloutResult

FITNESS_FLOOR = -20.0
"""Fitness an invalid terrain is told with; an elite's is above it, so that every elite adds to the QD score."""
FAILING_GOAL_RATE = 0.5
"""A controller fails a terrain on which it reaches the goal less often."""


@dataclass(frozen=True, kw_only=True)
class FitnessCfg:
    """Weights of the fitness, and the penalties that count."""

    penalties: tuple[str, ...]
    """Names of the penalties, in the order of the ratios."""
    scales: tuple[PositiveFloat, ...]
    """Scale of each penalty: raw sums are divided by it."""
    alpha: float = 1.0
    """Weight of the standard deviations."""
    lam: float = 2.0
    """Weight of u, the share of episodes without a base collision; u is 0 if none collided."""

    def __post_init__(self) -> None:
        check(self)
        if len(self.scales) != len(self.penalties):
            raise ValueError(f"scales must be one for each of {', '.join(self.penalties)}, got {self.scales}")

    def of_penalties(self, names: Sequence[str]) -> "FitnessCfg":
        """The same of some of the penalties alone, which must be at least 2: a single ratio is always 1."""
        scales = dict(zip(self.penalties, self.scales, strict=True))
        if not scales.keys() >= {*names} or len(names) < 2:
            raise ValueError(f"penalties must be at least 2 of {', '.join(self.penalties)}, got {', '.join(names)}")
        return replace(self, penalties=tuple(names), scales=tuple(scales[name] for name in names))


@dataclass(frozen=True, kw_only=True)
class Evaluation:
    """What a search knows of T evaluated terrains; statistics are over valid episodes, penalties are scaled."""

    fitness: NDArray[np.float64]
    """Shape (T,)."""
    ratios: NDArray[np.float64]
    """Shape (T, P); each row sums to 1."""
    cell: NDArray[np.int64]
    """Reachable cell of the ratios, shape (T,)."""
    penalty_mean: NDArray[np.float64]
    """Shape (T, P)."""
    penalty_std: NDArray[np.float64]
    """Shape (T, P), ddof 0."""
    collision_rate: NDArray[np.float64]
    """Share of episodes with a base collision, shape (T,)."""
    goal_rate: NDArray[np.float64]
    """Share of episodes that reached the goal, shape (T,)."""
    fallen_rate: NDArray[np.float64]
    """Share of episodes that ended tilted by more than 60 degrees, shape (T,)."""
    end_position: NDArray[np.float32]
    """Where the typical episode ended (:func:`typical_ends`), world-local x and y [m], shape (T, 2)."""
    invalid_episodes: NDArray[np.int64]
    """Episodes left out, shape (T,)."""
    episodes: NDArray[np.int64]
    """Episodes run, the invalid ones included, shape (T,)."""

    @property
    def counted(self) -> NDArray[np.int64]:
        """Valid episodes, shape (T,)."""
        return self.episodes - self.invalid_episodes

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether a terrain's numbers mean anything, shape (T,)."""
        return self.invalid_episodes <= MAX_INVALID_SHARE * self.episodes


def join_evaluations(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Evaluations of terrains one after the other."""
    names = [field.name for field in fields(Evaluation)]
    return Evaluation(**{name: np.concatenate([getattr(part, name) for part in evaluations]) for name in names})


def evaluation_of(result: "RolloutResult", cells: Cells, cfg: FitnessCfg) -> Evaluation:
    """Fitness, ratios, cells and rates of the terrains of a rollout; ``cells`` have one ratio a penalty of ``cfg``.

    The fitness is the paper's: sum of means - alpha * sum of standard deviations - lambda * u. u is the share of
    episodes without a base collision, and 0 where no episode has one. An invalid terrain has fitness -20, equal ratios,
    no end position (NaN) and otherwise zeros.
    """
    penalties = _scaled_penalties(result, cfg)
    invalid = np.asarray(result.invalid, dtype=bool) | ~np.isfinite(penalties).all(axis=2)
    counted = counted_episodes(invalid)
    mean = _mean(penalties, counted)
    std = np.sqrt(_mean((penalties - mean[:, None]) ** 2, counted))
    collision_rate = _rate(result.base_collision, counted)
    ratios = terrain_ratios(penalties, counted)
    inconsistency = np.where(collision_rate > 0.0, 1.0 - collision_rate, 0.0)
    fitness = mean.sum(axis=1) - cfg.alpha * std.sum(axis=1) - cfg.lam * inconsistency
    return Evaluation(
        fitness=np.where(counted.any(axis=1), fitness, FITNESS_FLOOR),
        ratios=ratios,
        cell=cells.cell_of(ratios, collision_rate > 0.0),
        penalty_mean=mean,
        penalty_std=std,
        collision_rate=collision_rate,
        goal_rate=_rate(result.reached_goal, counted),
        fallen_rate=_rate(result.fallen, counted),
        end_position=typical_ends(result, counted),
        invalid_episodes=invalid.sum(axis=1),
        episodes=np.full(len(invalid), invalid.shape[1]),
    )


def typical_ends(result: "RolloutResult", counted: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Where the typical episode of each terrain ended: the median, by coordinate, of those that ended alike.

    Those are the episodes at the goal where at least half reach it. Else they are those that ended in the commonest of
    the other ways, which are a base collision, the end of the time, and leaving the terrain. ``counted`` says which
    episodes count, shape (T, R). World-local x and y [m], shape (T, 2); NaN where none does.
    """
    ends = np.full((len(counted), 2), np.nan, np.float32)
    for row in np.flatnonzero(counted.any(axis=1)).tolist():
        outcome = result.outcome[row]
        alike = counted[row] & (outcome == typical_outcome(outcome[counted[row]]))
        ends[row] = np.median(result.final_position[row, alike, :2], axis=0)
    return ends


def _scaled_penalties(result: "RolloutResult", cfg: FitnessCfg) -> NDArray[np.float64]:
    """Penalties of ``cfg`` divided by their scales, shape (T, R, P)."""
    columns = [result.penalty_names.index(name) for name in cfg.penalties]
    return np.asarray(result.penalties, dtype=np.float64)[:, :, columns] / np.asarray(cfg.scales)


def _mean(values: NDArray[np.float64], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Mean over the valid episodes of values of shape (T, R, P); zeros where there are none."""
    counted = np.where(valid[:, :, None], values, 0.0)
    return counted.sum(axis=1) / np.maximum(valid.sum(axis=1), 1)[:, None]


def _rate(flags: NDArray[np.bool_], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Share of the valid episodes, shape (T, R), that have a flag; zeros where there are none."""
    return (np.asarray(flags, dtype=bool) & valid).sum(axis=1) / np.maximum(valid.sum(axis=1), 1)
