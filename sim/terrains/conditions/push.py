"""A push in the middle of a crossing."""

from typing import Any

import numpy as np
import warp as wp

from kernels.conditions import DisturbedStep
from kernels.episode import Outcome
from sim.terrains.conditions.base import Array, Condition, ConditionDose, Gene, direction_text, round_steps


@wp.func
def _disturb_push(step: DisturbedStep, row: wp.array[float], first: int, env: int, column: int):
    if column == 0 and step.episodes.outcome[env] == Outcome.RUNNING:
        due = int(wp.round(row[first + 2] / step.dt))
        steps = step.episodes.steps[env]
        if steps <= due and due < steps + step.every:
            step.joint_qd[env, 0] += row[first]
            step.joint_qd[env, 1] += row[first + 1]


class Push(Condition):
    """A kick of the base's velocity along the way and to its left [m/s], and when [s]; it is observed a step later."""

    name, cause = "push", "push"
    genes = (
        Gene(name="push_x", low=-2.0, middle=0.0, high=2.0, unit="m/s"),
        Gene(name="push_y", low=-2.0, middle=0.0, high=2.0, unit="m/s", mirrored=True),
        Gene(name="push_time", low=0.0, middle=6.0, high=12.0, unit="s", hard_at_limits=False),
    )
    dose = ConditionDose(title="push to the side", values=(0.0, 0.5, 1.0, 1.5, 2.0), gene=1, others=((2, 5.0),))
    disturb = _disturb_push

    def text(self, values: Array) -> str:
        """Its velocity and its time."""
        if np.abs(values[:2]).max() < 0.05:
            return ""
        directions = ("m/s ahead", "m/s back", "m/s to the left", "m/s to the right")
        return f"pushed by {direction_text(values[:2], '.1f', 0.05, directions)} after {values[2]:.0f} s"

    def disturb_plain(self, episodes: Any, values: Array, rows: Array, running: Any, step: int) -> Array:
        """Adds to the velocities of the bases of the running episodes."""
        if step <= round_steps(values[2], episodes.robot.physics_dt) < step + episodes.robot.decimation:
            for k in running:
                episodes.data[k].qvel[:2] += values[:2]
                episodes.qvel[k] = episodes.data[k].qvel
        return rows
