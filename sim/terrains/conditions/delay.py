"""Actions that count late."""

from typing import Any

import warp as wp

from kernels.conditions import VariedRobots
from sim.terrains.conditions.base import Array, Condition, ConditionDose, Gene, round_steps

MAX_DELAY_S = 0.06
"""Longest delay, beside the robot's own [s]."""
_STEP_S = 0.005  # a physics step of the shipped robots


@wp.func
def _begin_delay(robots: VariedRobots, row: wp.array[float], first: int, terrain: int, env: int):
    robots.delay_steps[env] = robots.drive_delay + int(wp.round(row[first] / robots.physics_dt))


class ActionDelay(Condition):
    """Time after which an action counts, beside the robot's own [s]."""

    name, cause = "delay", "late actions"
    genes = (
        Gene(
            name="delay", low=0.0, middle=MAX_DELAY_S / 2, high=MAX_DELAY_S, absent=-1.0, step=_STEP_S, unit="s",
            limits=(0.0, MAX_DELAY_S),
        ),
    )  # fmt: skip
    dose = ConditionDose(title="delay of actions", values=(0.0, 0.01, 0.02, 0.03, 0.04, 0.05, 0.06))
    varied = (0.0, 0.02)
    begin = _begin_delay

    def text(self, values: Array) -> str:
        """The delay in milliseconds."""
        return f"actions {1000 * values[0]:.0f} ms late" if values[0] >= 0.0005 else ""

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Adds physics steps to the delay of the robot's drives."""
        episodes.delay_steps += round_steps(values[0], episodes.robot.physics_dt)
