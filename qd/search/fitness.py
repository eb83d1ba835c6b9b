"""Fitness: how hard, and how reliably hard, a terrain is for the controller (the paper's fitness equation)."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Self

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Outcome
from qd.search.descriptors import Cells, terrain_ratios
from sim.files.settings import NonNegativeFloat, PositiveFloat, Share, check_settings
from sim.rates import MAX_INVALID_SHARE, typical_outcome
from sim.rollout import RolloutResult
from sim.terrains.conditions.likely import Disturbance
from sim.terrains.terrains import Terrains

FITNESS_FLOOR = -20.0
"""Fitness of an invalid terrain; an elite's is above it, so that every elite adds to the QD score."""
BIT_EPISODES = 20
"""Episodes over which the collision bit is "any collision", as in the paper; more episodes would bias it."""
USUAL_SPREAD = 0.4
"""Standard deviation of a penalty over its mean, where nothing else is known."""
FAILING_GOAL_RATE = 0.5
"""A controller fails a terrain on which it reaches the goal less often."""
_MEANS = ("ratios", "penalty_mean", "collision_rate", "goal_rate", "fallen_rate")


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
    crossed: Share = 0.0
    """How much less what nobody crosses is worth in the search, a share (:func:`find_worth`)."""
    likely: NonNegativeFloat = 0.0
    """How much less what is unlikely is worth in the search: the power of the likelihood that it is multiplied by."""
    disturbances: dict[str, Disturbance] = field(default_factory=dict)
    """How the conditions of the space are distributed, by their names; empty where it is not known."""

    def __post_init__(self) -> None:
        check_settings(self)
        if len(self.scales) != len(self.penalties):
            raise ValueError(f"scales must be one for each of {', '.join(self.penalties)}, got {self.scales}")
        if self.likely and not self.disturbances:
            raise ValueError(f"likely must be 0 where no condition has a distribution, got {self.likely:g}")

    def with_penalties(self, names: Sequence[str]) -> "FitnessCfg":
        """The same of some of the penalties alone, which must be at least 2: a single ratio is always 1."""
        scales = dict(zip(self.penalties, self.scales, strict=True))
        if not scales.keys() >= {*names} or len(names) < 2:
            raise ValueError(f"penalties must be at least 2 of {', '.join(self.penalties)}, got {', '.join(names)}")
        return replace(self, penalties=tuple(names), scales=tuple(scales[name] for name in names))


@dataclass(frozen=True, kw_only=True)
class ColumnTable:
    """Columns of equally many rows: arrays, terrains, and tables of further columns."""

    def rows(self, chosen: NDArray[Any]) -> Self:
        """Some of the rows alone, in the order given; arrays are copied."""
        columns = {name: value for name, value in vars(self).items() if isinstance(value, np.ndarray | Terrains)}
        tables: dict[str, Any] = {name: v.rows(chosen) for name, v in vars(self).items() if isinstance(v, ColumnTable)}
        return replace(self, **{name: column[chosen] for name, column in columns.items()}, **tables)


@dataclass(frozen=True, kw_only=True)
class Evaluation(ColumnTable):
    """Evaluations of T terrains; statistics are over valid episodes, penalties are scaled.

    Shapes are (T, P) for what each of P penalties has, ratios, means and standard deviations, and else (T,).
    """

    fitness: NDArray[np.float64]
    ratios: NDArray[np.float64]
    """Each row sums to 1."""
    cell: NDArray[np.int64]
    """Reachable cell of the ratios."""
    penalty_mean: NDArray[np.float64]
    penalty_std: NDArray[np.float64]  # ddof 0
    collision_rate: NDArray[np.float64]
    """Share of episodes with a base collision."""
    goal_rate: NDArray[np.float64]
    """Share of episodes that succeeded."""
    fallen_rate: NDArray[np.float64]
    """Share of episodes that ended tilted by more than 60 degrees."""
    end_position: NDArray[np.float32]
    """Where the typical episode ended (:func:`typical_ends`), world-local x and y [m], shape (T, 2)."""
    invalid_episodes: NDArray[np.int64]
    """Episodes left out."""
    episodes: NDArray[np.int64]
    """Episodes run, the invalid ones included."""

    @property
    def counted(self) -> NDArray[np.int64]:
        """Valid episodes, shape (T,)."""
        return self.episodes - self.invalid_episodes

    @property
    def other_rate(self) -> NDArray[np.float64]:
        """Share that neither succeeded nor collided, shape (T,)."""
        return np.clip(1.0 - self.goal_rate - self.collision_rate, 0.0, 1.0)

    @property
    def spread(self) -> NDArray[np.float64]:
        """Standard deviations as many episodes would show them, (T, P): one episode of the usual spread is added."""
        added = (USUAL_SPREAD * self.penalty_mean) ** 2 / np.maximum(self.counted, 1)[:, None]
        return np.sqrt(self.penalty_std**2 + added)

    @property
    def collides(self) -> NDArray[np.bool_]:
        """The collision bit, shape (T,): whether 20 episodes sooner have a base collision than not.

        With up to 29 episodes, it says whether any of them has one.
        """
        return self.collision_rate > 1.0 - 0.5 ** (1.0 / BIT_EPISODES)

    @property
    def valid(self) -> NDArray[np.bool_]:
        """Whether a terrain's numbers mean anything, shape (T,)."""
        return self.invalid_episodes <= MAX_INVALID_SHARE * self.episodes


def join_evaluations(evaluations: Sequence[Evaluation]) -> Evaluation:
    """Evaluations of terrains one after the other."""
    tables = [vars(evaluation) for evaluation in evaluations]
    return Evaluation(**{name: np.concatenate([table[name] for table in tables]) for name in tables[0]})


def evaluate_rollout(result: RolloutResult, cells: Cells, cfg: FitnessCfg) -> Evaluation:
    """Fitness, ratios, cells and rates of the terrains of a rollout; ``cells`` have one ratio a penalty of ``cfg``.

    The fitness is the paper's: sum of means - alpha * sum of standard deviations - lambda * u. u is the share of
    episodes without a base collision, and 0 where no episode has one. An invalid terrain has fitness -20, and the
    statistics of its valid episodes. Without any there are equal ratios, no end position (NaN) and otherwise zeros.
    """
    columns = [result.penalty_names.index(name) for name in cfg.penalties]
    penalties = np.asarray(result.penalties, dtype=np.float64)[:, :, columns] / np.asarray(cfg.scales)
    invalid = np.asarray(result.invalid, dtype=bool) | ~np.isfinite(penalties).all(axis=2)
    counted = ~invalid
    mean = _mean(penalties, counted)
    std = np.sqrt(_mean((penalties - mean[:, None]) ** 2, counted))
    flags = (result.base_collision, result.reached_goal, result.fallen)
    collision_rate, goal_rate, fallen_rate = (_mean(flag, counted) for flag in flags)
    return _with_fitness(
        cells, cfg, ratios=terrain_ratios(penalties, counted), penalty_mean=mean, penalty_std=std,
        collision_rate=collision_rate, goal_rate=goal_rate, fallen_rate=fallen_rate,
        end_position=typical_ends(result, counted), invalid_episodes=invalid.sum(axis=1),
        episodes=np.full(len(invalid), invalid.shape[1]),
    )  # fmt: skip


def merge_evaluations(first: Evaluation, second: Evaluation, cells: Cells, cfg: FitnessCfg) -> Evaluation:
    """The evaluation by all episodes of two evaluations of the same terrains; ends are the second's, if it has any."""
    share = second.counted / np.maximum(first.counted + second.counted, 1)

    def weigh(before: NDArray[np.float64], after: NDArray[np.float64]) -> NDArray[np.float64]:
        shares = share if before.ndim == 1 else share[:, None]
        return (1.0 - shares) * before + shares * after

    between = (share * (1.0 - share))[:, None] * (first.penalty_mean - second.penalty_mean) ** 2
    means = {name: weigh(getattr(first, name), getattr(second, name)) for name in _MEANS}
    std = np.sqrt(weigh(first.penalty_std**2, second.penalty_std**2) + between)
    ends = np.where(np.isfinite(second.end_position), second.end_position, first.end_position)
    sums = {name: getattr(first, name) + getattr(second, name) for name in ("invalid_episodes", "episodes")}
    return _with_fitness(cells, cfg, penalty_std=std, end_position=ends, **means, **sums)


def _with_fitness(cells: Cells, cfg: FitnessCfg, **statistics: NDArray[Any]) -> Evaluation:
    """Adds what follows from the statistics, fitness and cell."""
    evaluation = Evaluation(fitness=np.zeros(0), cell=np.zeros(0, np.int64), **statistics)
    inconsistency = np.where(evaluation.collision_rate > 0.0, 1.0 - evaluation.collision_rate, 0.0)
    mean, std = (values.sum(axis=1) for values in (evaluation.penalty_mean, evaluation.penalty_std))
    fitness = np.where(evaluation.valid, mean - cfg.alpha * std - cfg.lam * inconsistency, FITNESS_FLOOR)
    return replace(evaluation, fitness=fitness, cell=cells.find_cells(evaluation.ratios, evaluation.collides))


def find_worth(fitness: Any, share: Any) -> Any:
    """What terrains are worth in the search: their ``share`` of the fitness above the floor, or all of it if None."""
    return fitness if share is None else FITNESS_FLOOR + (fitness - FITNESS_FLOOR) * share


def typical_ends(result: RolloutResult, counted: NDArray[np.bool_]) -> NDArray[np.float32]:
    """Where the typical episode of each terrain ended: the median, by coordinate, over episodes of its typical outcome.

    ``counted`` says which episodes count, shape (T, R). World-local x and y [m], shape (T, 2); NaN where none does.
    """
    outcome = np.where(counted, result.outcome, Outcome.INVALID)
    alike = counted & (outcome == typical_outcome(outcome)[:, None])
    positions = np.sort(np.where(alike[..., None], result.final_position[..., :2], np.inf), axis=1)
    count = alike.sum(axis=1)
    rows = np.arange(len(alike))
    ends = (positions[rows, np.maximum(count - 1, 0) // 2] + positions[rows, count // 2]) / 2
    return np.where(count[:, None] > 0, ends, np.nan).astype(np.float32)


def _mean(values: NDArray[Any], valid: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Mean over the valid episodes of values of shape (T, R, ...); zeros where there are none."""
    valid = valid.reshape(*valid.shape, *[1] * (values.ndim - 2))
    return np.where(valid, values, 0.0).sum(axis=1) / np.maximum(valid.sum(axis=1), 1)
