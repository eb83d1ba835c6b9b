"""A cheap, deterministic stand-in for the simulation: genes and seeds in, a result shaped like a rollout's out."""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import numpy as np

from kernels.episode import Outcome
from qd.workers.evaluator import EvaluatorCfg

PENALTIES = ("yaw_rate", "vel_x", "vel_y", "contact_force", "stumble", "collision")
SCALES = (1.0, 2.0, 1.0, 4.0, 1.0, 1.0)


@dataclass(frozen=True)
class Result:
    """The fields of a rollout's result that the search reads; leading axes (terrain, replica)."""

    penalties: np.ndarray
    penalty_names: tuple[str, ...]
    base_collision: np.ndarray
    reached_goal: np.ndarray
    fallen: np.ndarray
    invalid: np.ndarray
    invalidity: np.ndarray
    duration_s: np.ndarray
    physics_steps: int
    robot_steps: int
    busy_steps: int
    wall_s: float
    idle_share: float = 0.25
    reward: np.ndarray | None = None

    @property
    def outcome(self) -> np.ndarray:
        """Outcome of each episode, out of time where nothing else is said."""
        cases = [self.invalid, self.base_collision, self.reached_goal]
        kinds = [Outcome.INVALID, Outcome.BASE_COLLISION, Outcome.GOAL]
        return np.select(cases, kinds, Outcome.TIME_OUT).astype(np.uint8)


def make_result(penalties, *, base_collision=None, invalid=None, names=PENALTIES) -> Result:
    """A result with given penalties, shape (T, R, P); nothing else happened unless said."""
    penalties = np.asarray(penalties, dtype=np.float64)
    never = np.zeros(penalties.shape[:2], dtype=bool)
    collided = never if base_collision is None else np.asarray(base_collision, dtype=bool)
    excluded = never if invalid is None else np.asarray(invalid, dtype=bool)
    return Result(
        penalties=penalties,
        penalty_names=tuple(names[: penalties.shape[2]]),
        base_collision=collided,
        reached_goal=~collided & ~excluded,
        fallen=never,
        invalid=excluded,
        invalidity=np.where(excluded, np.uint8(2), np.uint8(0)),  # Invalidity.STATE
        duration_s=np.full(never.shape, 15.0, dtype=np.float32),
        # In proportion, so that a search among others or in groups comes to the same.
        physics_steps=400 * len(penalties),
        robot_steps=400 * len(penalties),
        busy_steps=300 * len(penalties),
        wall_s=0.5 * len(penalties),
    )


def evaluate(genes: np.ndarray, seeds: np.ndarray, num_replicas: int = 4) -> Result:
    """Penalties that differ between terrains by their genes and between replicas by their seed."""
    genes = np.asarray(genes, dtype=np.float64)
    hardness = np.stack([np.abs(genes[:, k::6]).mean(axis=1) for k in range(6)], axis=1)
    noise = np.stack([np.random.default_rng(int(seed)).uniform(0.9, 1.1, size=(num_replicas, 6)) for seed in seeds])
    penalties = 4.0 * hardness[:, None] ** 3 * noise * SCALES
    collides = (genes[:, 7] > 0.3)[:, None] & (noise[:, :, 0] > 0.95)
    return make_result(penalties, base_collision=collides)


@contextmanager
def open_stand_in(cfg: EvaluatorCfg) -> Iterator:
    """Opened like the real evaluator."""
    yield lambda genes, seeds, progress=None: evaluate(genes, seeds, cfg.num_replicas)
