"""Witnesses: ways by which a controller crosses a terrain that stops it under the plain command.

A way says by segment how fast a robot goes, how far beside the straight line, and where it faces
(:data:`kernels.episode.STEERING`). A cross-entropy search (Rubinstein 1999) finds one for each terrain, by the episodes
of the controller alone. Fresh episodes, and the plain command on the same seeds, say whether it is a witness.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.stats import false_discovery_control

from kernels.episode import SEGMENTS, STEERING
from qd.faults.numbers import EPISODES, MAX_FALSE_DISCOVERIES, fisher_p
from qd.search.archive import Witnesses, no_witnesses
from qd.search.fitness import FAILING_GOAL_RATE
from qd.search.progress import Bar
from qd.workers.crosser import Crosser
from sim.controllers.described import read_speed_limits
from sim.crossing import CrossingCfg, find_highest_command
from sim.rates import MAX_INVALID_SHARE
from sim.robots.robot import RobotCfg
from sim.rollout import RolloutResult
from sim.terrains.terrains import Terrains

LINE_M, BESIDE_M = 0.5, 1.0  # on the line, and beside it, a robot is never further from the straight line [m]
_LINE_EPISODES = 5  # of a terrain, to see how far plain crossings are from the line


@dataclass(frozen=True, kw_only=True)
class SteerCfg:
    """Settings of the search of ways, one episode a sample."""

    generations: int = 12
    samples: int = EPISODES
    best: int = 5  # samples that the next generation is drawn near
    step: float = 0.7  # how far the distribution moves toward that of the best samples, as a share
    speed_std: float = 0.3  # of the first generation [m/s]
    offset_std: float = 0.4  # [m]; four times as much where no limit holds
    heading_std: float = 0.5  # [rad]
    least_std: float = 0.05  # of any generation, of all three
    common: float = 0.5  # share of the variance that all segments of a sample have in common
    smooth: float = 1.5  # reach of the correlation of the rest [segments]
    margin_m: float = 0.05  # by which ways stay within the limit [m]
    beyond_cost: float = 20.0  # of a metre beyond that, where a metre that is missing to the goal costs 1

    @property
    def seeds(self) -> int:
        """Seeds of a terrain that :func:`seek_witnesses` needs for each walker."""
        return 2 * self.generations + 2


def seek_witnesses(
    crosser: Crosser, walkers: Mapping[str, str], terrains: Terrains, seeds: NDArray[np.uint32], limit_m: float, *,
    rng: np.random.Generator, cfg: SteerCfg, label: str = "",
) -> Witnesses:  # fmt: skip
    """Witnesses of T terrains: each of the walkers, controllers by name, tries those that have none on the line yet.

    A walker first looks for a way on the line, then for any. ``seeds`` have the shape (T, walkers * cfg.seeds).
    """
    count, generations = len(terrains), cfg.generations
    best = no_witnesses(count, limit_m)
    for index, (name, policy) in enumerate(walkers.items()):
        rows = np.flatnonzero(~best.on_line)
        drawn = seeds[rows, index * cfg.seeds : (index + 1) * cfg.seeds]
        some, words, how = terrains[rows], f"{label}{name}", dict[str, Any](rng=rng, cfg=cfg)
        on_line = f"{words} on the line"
        ways = find_ways(crosser, policy, some, drawn[:, :generations], limit_m=limit_m, label=on_line, **how)
        plain = np.full_like(ways, np.nan)
        counts = np.zeros((len(rows), 2, 2, 4), np.int64)
        for column, tried in enumerate((plain, ways)):
            counts[:, 0, column] = try_ways(crosser, policy, some, tried, drawn[:, -2], limit_m, label=words)
        off = np.flatnonzero(~cross_half(counts[:, 0, 1])[:, 0])
        others = drawn[off, generations:-2]
        ways[off] = find_ways(crosser, policy, some[off], others, limit_m=None, label=f"{words} around", **how)
        counts[off, 0, 1] = try_ways(crosser, policy, some[off], ways[off], drawn[off, -2], limit_m, label=words)
        cross = np.flatnonzero(cross_half(counts[:, 0, 1])[:, -1])
        for column, tried in enumerate((plain, ways)):
            again, fine = (some[cross], tried[cross], drawn[cross, -1]), f"{words}, contact resolved"
            counts[cross, 1, column] = try_ways(crosser, policy, *again, limit_m, label=fine, engine="resolved")
        kind = find_kinds(counts)
        tried = Witnesses(walker=np.full(len(rows), name), kind=kind, way=ways, counts=counts, limit_m=limit_m)
        better = np.flatnonzero((kind > best.kind[rows]) | (best.walker[rows] == ""))
        best = best.updated(rows[better], tried.rows(better))
    return best


def find_ways(
    crosser: Crosser, policy: str, terrains: Terrains, seeds: NDArray[np.uint32], *, limit_m: float | None,
    rng: np.random.Generator, label: str, cfg: SteerCfg,
) -> NDArray[np.float32]:  # fmt: skip
    """The best way on each terrain, (T, SEGMENTS, 3), within ``limit_m`` of the line; seeds are (T, generations)."""
    mean, std, limits = first_ways(len(terrains), crosser.robot, policy, limit_m, cfg)
    with Bar(label, cfg.generations) as bar:
        for generation in range(cfg.generations):
            ways = draw_ways(mean, std, limits, rng, cfg)
            drawn, move = seeds[:, generation], bar.within(generation, 1.0)
            result = cross_ways(crosser, policy, terrains, ways, drawn, label=label, progress=move)
            score = score_ways(result, crosser.robot.max_duration_s, limit_m, cfg)
            mean, std = move_to_best(mean, std, ways, score, cfg)
    return mean.astype(np.float32)


def first_ways(
    count: int, robot: RobotCfg, policy: str, limit_m: float | None, cfg: SteerCfg
) -> tuple[NDArray[np.floating], NDArray[np.floating], NDArray[np.floating]]:
    """Mean and deviation of the first ways on so many terrains, (count, SEGMENTS, 3), and limits of ways, (2, 3)."""
    shape = (count, SEGMENTS, len(STEERING))
    mean = np.zeros(shape)
    offset_std = cfg.offset_std if limit_m is not None else 4.0 * cfg.offset_std
    std = np.broadcast_to([cfg.speed_std, offset_std, cfg.heading_std], shape).copy()
    offset = limit_m or CrossingCfg.goal[1]
    speeds = CrossingCfg.lowest_command[0], find_highest_command(CrossingCfg(), robot)[0]
    slowest, fastest = np.clip(speeds, *read_speed_limits(policy))  # what its description limits it is not told
    mean[..., 0] = np.clip(robot.speed, slowest, fastest)
    return mean, std, np.array([[slowest, -offset, -np.pi / 2], [fastest, offset, np.pi / 2]])


def draw_ways(
    mean: NDArray[np.floating], std: NDArray[np.floating], limits: NDArray[np.floating], rng: np.random.Generator,
    cfg: SteerCfg,
) -> NDArray[np.floating]:  # fmt: skip
    """Samples of a generation on T terrains, shape (T, samples, SEGMENTS, 3), by the columns of :func:`first_ways`."""
    noise = rng.standard_normal((len(mean), cfg.samples, *mean.shape[1:]))
    mixed = np.einsum("kl,tslc->tskc", mix_segments(SEGMENTS, cfg), noise)
    return np.clip(mean[:, None] + std[:, None] * mixed, *limits)


def mix_segments(count: int, cfg: SteerCfg) -> NDArray[np.floating]:
    """What makes independent noise of segments correlated noise, shape (count, count)."""
    apart = np.subtract.outer(np.arange(count), np.arange(count))
    covariance = cfg.common + (1.0 - cfg.common) * np.exp(-0.5 * (apart / cfg.smooth) ** 2)
    return np.linalg.cholesky(covariance + 1e-6 * np.eye(count))


def move_to_best(
    mean: NDArray[np.floating], std: NDArray[np.floating], samples: NDArray[np.floating], score: NDArray[np.floating],
    cfg: SteerCfg,
) -> tuple[NDArray[np.floating], NDArray[np.floating]]:  # fmt: skip
    """Mean and deviation of the next generation, (T, ...): moved to the best samples (T, S, ...) by scores (T, S)."""
    order = np.argsort(-score, axis=1, kind="stable")[:, : cfg.best]
    best = np.take_along_axis(samples, order.reshape(*order.shape, *[1] * (mean.ndim - 1)), axis=1)
    arrives = (score.max(axis=1) > 0.0).reshape(-1, *[1] * (mean.ndim - 1))  # else it is drawn as widely
    narrower = np.where(arrives, std + cfg.step * (best.std(axis=1) - std), std)
    return mean + cfg.step * (best.mean(axis=1) - mean), np.maximum(narrower, cfg.least_std)


def score_ways(result: RolloutResult, longest_s: float, limit_m: float | None, cfg: SteerCfg) -> NDArray[np.float64]:
    """How good each way is, (T, R): over 0 at the goal, best soon; else far ahead; less where beyond the limit."""
    missing = np.abs(CrossingCfg.goal[0] - result.final_position[..., 0])  # ahead: to go aside costs nothing
    soon = 10.0 - 2.0 * result.duration_s / longest_s
    score = np.where(result.reached_goal, soon, -missing - result.base_collision)
    if limit_m is not None:
        score = score - cfg.beyond_cost * np.maximum(result.deviation - (limit_m - cfg.margin_m), 0.0)
    return np.where(result.invalid, -np.inf, score)


def cross_ways(
    crosser: Crosser, policy: str, terrains: Terrains, ways: NDArray[np.floating], seeds: NDArray[np.uint32],
    **how: Any,
) -> RolloutResult:  # fmt: skip
    """Crossings of T terrains, an episode for each way, shape (T, R, SEGMENTS, 3); ``how`` is of Crosser.cross."""
    steered = replace(terrains, seeds=seeds, steering=ways.astype(np.float32))
    return crosser.cross(policy, steered, replicas=ways.shape[1], invalid_ok=True, **how)


def try_ways(
    crosser: Crosser, policy: str, terrains: Terrains, ways: NDArray[np.float32], seeds: NDArray[np.uint32],
    limit_m: float, **how: Any,
) -> NDArray[np.int64]:  # fmt: skip
    """20 episodes by each of T ways, or under the plain command where it is NaN: (T, 4), as ``Witnesses.counts``."""
    result = cross_ways(crosser, policy, terrains, np.repeat(ways[:, None], EPISODES, axis=1), seeds, **how)
    return count_goals(result, limit_m)


def count_goals(result: RolloutResult, limit_m: float) -> NDArray[np.int64]:
    """Episodes of T terrains that reach the goal on the line, beside it, and at all, and valid ones, shape (T, 4)."""
    limits = (limit_m, max(limit_m, BESIDE_M), np.inf)
    reached = [(result.reached_goal & (result.deviation <= limit)).sum(axis=1) for limit in limits]
    return np.stack([*reached, (~result.invalid).sum(axis=1)], axis=1)


def cross_half(counts: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Whether at least half of the episodes reach the goal on the line, beside it, and at all; counts are (..., 4)."""
    return (counts[..., 3:] > 0) & (counts[..., :3] >= FAILING_GOAL_RATE * counts[..., 3:])


def find_kinds(counts: NDArray[np.int64]) -> NDArray[np.int64]:
    """The kind of witness that each of T ways is, as its index in :data:`WITNESSES`, shape (T,).

    A way is a witness if it leads at least half of the episodes to the goal, and more than the plain command does, with
    both physics (Fisher's exact test; Benjamini and Hochberg 1995). Too many invalid episodes say nothing.
    """
    kinds = np.zeros(len(counts), np.int64)
    goals_plain, valid_plain = counts[:, :, 0, 2], counts[:, :, 0, 3]
    valid, crossed = counts[:, :, 1, 3], cross_half(counts[:, :, 1])
    known = (counts[..., 3] >= (1.0 - MAX_INVALID_SHARE) * EPISODES).all(axis=(1, 2))
    for kind, column in ((1, 2), (2, 1), (3, 0)):
        p = fisher_p(counts[:, :, 1, column], valid, goals_plain, valid_plain).max(axis=1)
        crosses = known & crossed[..., column].all(axis=1)
        lucky = false_discovery_control(np.clip(p, 0.0, 1.0)) > MAX_FALSE_DISCOVERIES
        kinds[crosses & ~lucky] = kind
    return kinds


def measure_line(crosser: Crosser, policy: str, terrains: Terrains, label: str = "") -> float:
    """Largest distance from the line of a way on it [m]: :data:`LINE_M`, or the 95th percentile of plain crossings."""
    label = f"{label}how far from the straight line it goes unsteered"
    result = crosser.cross(policy, terrains, replicas=_LINE_EPISODES, invalid_ok=True, label=label)
    distances = result.deviation[result.reached_goal]
    return max(LINE_M, float(np.quantile(distances, 0.95)) if len(distances) else 0.0)
