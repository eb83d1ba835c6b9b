"""Hand-made crossings."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np

from kernels.episode import Outcome
from sim.rollout import RolloutResult
from tests.qd.stand_in import make_result

GOAL, HIT, LATE, OUT, BAD = Outcome.GOAL, Outcome.BASE_COLLISION, Outcome.TIME_OUT, Outcome.OUT, Outcome.INVALID
NAMES = ("yaw_rate", "vel_x")


def result_of(
    outcomes: Sequence[Sequence[int]], *, names: tuple[str, ...] = NAMES, reward: Any = None, vel_x: Any = None,
    fallen: Any = None, duration_s: Any = None,
) -> RolloutResult:  # fmt: skip
    """Crossings that ended so; penalties are 0 but for what is given, times 12 s, nobody fell unless said."""
    outcome = np.array(outcomes, np.uint8)
    penalties = np.zeros((*outcome.shape, len(names)))
    if vel_x is not None:
        penalties[..., 1] = vel_x
    rewards = None if reward is None else np.array(reward, float)
    for values in (penalties, rewards):
        if values is not None:
            values[outcome == Outcome.INVALID] = np.nan
    result = make_result(penalties, invalid=outcome == Outcome.INVALID, names=names)
    return replace(
        result,
        outcome=outcome,
        fallen=result.fallen if fallen is None else np.array(fallen, bool),
        duration_s=np.full(outcome.shape, 12.0, np.float32) if duration_s is None else np.array(duration_s),
        reward=rewards,
    )
