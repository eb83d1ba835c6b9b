"""A cheap, deterministic stand-in for the simulation: genes and seeds in, results shaped like a rollout's out."""

import os
import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from kernels.episode import Outcome
from qd.workers.compute import Compute
from qd.workers.pipeline import Pipeline, PipelineCfg
from sim.rollout import RolloutResult

PENALTIES = ("yaw_rate", "vel_x", "vel_y", "contact_force", "stumble", "collision")
SCALES = (1.0, 2.0, 1.0, 4.0, 1.0, 1.0)
GOAL, HIT, LATE, OUT, BAD = Outcome.GOAL, Outcome.BASE_COLLISION, Outcome.TIME_OUT, Outcome.OUT, Outcome.INVALID


def make_result(penalties, *, base_collision=None, invalid=None, late=None, names=PENALTIES) -> RolloutResult:
    """A result with given penalties, shape (T, R, P); all others reach the goal unless they are late."""
    penalties = np.asarray(penalties, dtype=np.float64)
    never = np.zeros(penalties.shape[:2], dtype=bool)
    cases = [never if case is None else np.asarray(case, dtype=bool) for case in (invalid, base_collision, late)]
    return RolloutResult(
        penalties=penalties,
        penalty_names=tuple(names[: penalties.shape[2]]),
        outcome=np.select(cases, [BAD, HIT, LATE], GOAL).astype(np.uint8),
        invalidity=np.where(cases[0], np.uint8(2), np.uint8(0)),  # Invalidity.STATE
        fallen=never,
        duration_s=np.full(never.shape, 15.0, dtype=np.float32),
        deviation=np.zeros(never.shape, dtype=np.float32),
        final_position=np.zeros((*never.shape, 3), dtype=np.float32),
        # In proportion, so that a search among others or in groups comes to the same.
        physics_steps=400 * len(penalties),
        robot_steps=400 * len(penalties),
        busy_steps=300 * len(penalties),
        wall_s=0.5 * len(penalties),
    )


def result_of(outcomes, *, names=PENALTIES[:2], vel_x=0.0, reward=None, **given) -> RolloutResult:
    """Episodes of 12 s that ended so, shape (T, R), without penalties but for ``vel_x``; nobody fell unless given."""
    outcome = np.array(outcomes, np.uint8)
    invalid = outcome == BAD
    penalties = np.zeros((*outcome.shape, len(names)))
    penalties[..., 1] = vel_x
    penalties[invalid] = np.nan
    given = {"duration_s": np.full(outcome.shape, 12.0, np.float32)} | given
    if reward is not None:
        given["reward"] = np.where(invalid, np.nan, reward)
    given = {name: np.array(values) for name, values in given.items()}
    return replace(make_result(penalties, invalid=invalid, names=names), outcome=outcome, **given)


def evaluate(genes: np.ndarray, seeds: np.ndarray, replicas: int = 4) -> RolloutResult:
    """Penalties that differ between terrains by their genes and between replicas by their seed; none on heights."""
    if genes.ndim == 3:  # level ground, which is crossed at 0.7 m/s
        result = make_result(np.zeros((len(genes), replicas, len(PENALTIES))))
        end = np.broadcast_to(np.array([12.5, 4.0, 0.3], np.float32), result.final_position.shape)
        return replace(result, final_position=end.copy())
    genes = np.asarray(genes, dtype=np.float64)
    hardness = np.stack([np.abs(genes[:, k::6]).mean(axis=1) for k in range(6)], axis=1)
    noise = np.stack([np.random.default_rng(int(seed)).uniform(0.9, 1.1, size=(replicas, 6)) for seed in seeds])
    penalties = 4.0 * hardness[:, None] ** 3 * noise * SCALES
    collides = (genes[:, 7] > 0.3)[:, None] & (noise[:, :, 0] > 0.95)
    return make_result(penalties, base_collision=collides)


def assert_same(result: RolloutResult, expected: RolloutResult) -> None:
    assert result.penalty_names == expected.penalty_names
    for name, values in vars(expected).items():
        if isinstance(values, np.ndarray):
            np.testing.assert_array_equal(getattr(result, name), values, err_msg=name, strict=True)


class Stub(Pipeline):
    """Crosses lots by a function of terrains and seeds, each when it is waited for."""

    def __init__(self, evaluate) -> None:
        super().__init__(num_terrains=1_000_000)
        self.evaluate, self.lots, self.most_lots = evaluate, [], 0

    def put(self, terrains):
        self.lots.append(terrains)
        self.most_lots = max(self.most_lots, len(self.lots))

    def take(self, progress=None):
        terrains = self.lots.pop(0)
        return self.evaluate(terrains.values, terrains.seeds)

    def clear(self):
        self.lots.clear()


@contextmanager
def open_stand_in(cfg: PipelineCfg) -> Iterator:
    """Opened like the real evaluator."""
    yield Stub(lambda genes, seeds: evaluate(genes, seeds, cfg.replicas))


def compute_by(opener, compute: Compute = Compute(workers="1")) -> Compute:  # noqa: B008 - frozen
    """Where terrains are crossed by what this opens."""
    return StandInCompute(**vars(compute), opener=opener)


@dataclass(frozen=True)
class StandInCompute(Compute):
    """Where terrains are crossed by what ``opener`` opens; tests/conftest.py has pipelines opened by it."""

    opener: Any = None


class Crosser(Stub):
    """Crosses by the stand-in."""

    def __init__(self, cfg, num_terrains: int) -> None:
        super().__init__(lambda genes, seeds: evaluate(genes, seeds, cfg.replicas))
        self.cfg, self.num_terrains = cfg, num_terrains

    def put(self, terrains):
        super().put(terrains)
        assert sum(map(len, self.lots)) <= self.num_terrains

    def take(self, progress=None):
        if progress is not None:
            progress(0.5)
            progress(1.0)
        return super().take()


class Failing(Crosser):
    """Fails as the policy's name says: ``<how>:<folder>:<times>``, so often in all, counted by files in the folder."""

    def __init__(self, cfg, num_terrains: int) -> None:
        super().__init__(cfg, num_terrains)
        self.how, self.folder, self.times = cfg.policy.split(":")
        if self.how == "build":
            raise ValueError("policy 'x' does not fit:\nuse another")

    def take(self, progress=None):
        result = super().take(progress)
        for number in range(int(self.times)):
            try:
                (Path(self.folder) / str(number)).touch(exist_ok=False)
            except FileExistsError:
                continue
            self.fail(result)
            break
        return result

    def fail(self, result):
        match self.how:
            case "die":
                os.kill(os.getpid(), signal.SIGKILL)
            case "raise":
                raise RuntimeError("the solver is broken")
            case "refuse":
                raise ValueError("terrains of another kind")
            case "sleep":
                time.sleep(60)
        result.penalties[0, 0, 0] = np.nan
