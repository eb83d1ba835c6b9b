"""Arms that do something else than the controller thinks: they are held elsewhere, swing, or carry a load.

The arms are the robot's ``arm_joints``. Targets are shifted before the drives act, so that gains, limits of torques and
the file's ranges of targets hold as always; a shift grows from 0 in the first second.
"""

from typing import Any, ClassVar

import numpy as np
import warp as wp

from kernels.conditions import BASE, ForcedStep, push_body
from sim.terrains.conditions.kinds import CONDITIONS, GROUPS, Array, Condition, Gene
from sim.terrains.quantities import Sweep

RISE_S = wp.constant(1.0)
"""Time in which a shift grows [s]."""
TURN = wp.constant(0.618)
"""Periods by which the phase of each joint is ahead of that of the joint before it, so that none are alike."""


@wp.func
def _shift_arms(step: ForcedStep, env: int, size: float, periods: float, time_s: float):
    grown = size * wp.min(1.0, time_s / RISE_S)
    for k in range(step.arm_actuators.shape[0]):
        step.ctrl[env, step.arm_actuators[k]] += grown * wp.sin(2.0 * wp.PI * (periods + TURN * float(k)))


@wp.func
def _drive_hold(step: ForcedStep, row: wp.array[float], first: int, env: int):
    if row[first] != 0.0:
        _shift_arms(step, env, row[first], row[first + 1], float(step.memory.steps[env]) * step.dt)


@wp.func
def _drive_wander(step: ForcedStep, row: wp.array[float], first: int, env: int):
    if row[first] != 0.0:
        time_s = float(step.memory.steps[env]) * step.dt
        _shift_arms(step, env, row[first], time_s / row[first + 1], time_s)


class ArmsHold(Condition):
    """How far at most the arm joints are held from where the controller holds them [rad], and in which pattern.

    Joint k is held off by ``size * sin(2 pi (pattern + 0.618 k))``.
    """

    name, cause = "arms_hold", "arms elsewhere"
    genes = (
        Gene(name="arms_hold", low=0.0, middle=0.4, high=0.8, absent=-1.0, unit="rad", limits=(0.0, 10.0)),
        Gene(name="arms_pattern", low=0.0, middle=0.5, high=1.0, hard_at_limits=False),
    )
    form, least = "arms held up to {:.2f} rad elsewhere in pattern {:.2f}", 0.005
    dose = Sweep("arms_hold", (0.0, 0.2, 0.4, 0.6, 0.8), title="arms held elsewhere")
    needs_arms = True
    drive = _drive_hold
    swings: ClassVar[bool] = False

    def drive_plain(self, episodes: Any, values: Array, targets: Array, step: int) -> Array:
        """Shifts the targets of the arms."""
        from sim.robots.compiled import number_arm_actuators

        if values[0]:
            time_s = step * episodes.robot.physics_dt
            arms = number_arm_actuators(episodes.robot, episodes.model.actuator_trnid[:, 0] - 1)
            periods = (time_s / values[1] if self.swings else values[1]) + float(TURN) * np.arange(len(arms))
            targets[:, arms] += values[0] * min(1.0, time_s / float(RISE_S)) * np.sin(2.0 * np.pi * periods)
        return targets


class ArmsWander(ArmsHold):
    """How far the arm joints swing about where the controller holds them [rad], and the period [s].

    Each swings as a sine, joint k 0.618 k of a period ahead of the first.
    """

    name, cause = "arms_wander", "swinging arms"
    genes = (
        Gene(name="arms_wander", low=0.0, middle=0.25, high=0.5, absent=-1.0, unit="rad", limits=(0.0, 10.0)),
        Gene(name="arms_period", low=0.5, middle=1.0, high=4.0, unit="s", limits=(0.01, 100.0)),
    )
    form = "arms swinging by {:.2f} rad every {:.1f} s"
    dose = Sweep("arms_wander", (0.0, 0.1, 0.2, 0.3, 0.4, 0.5), title="swinging arms")
    drive = _drive_wander
    swings = True


@wp.func
def _force_load(step: ForcedStep, row: wp.array[float], first: int, env: int):
    if row[first] != 0.0:
        weight = row[first] * step.body_subtreemass[env, BASE] * step.gravity[env % step.gravity.shape[0]]
        for k in range(step.arm_ends.shape[0]):
            push_body(step, env, step.arm_ends[k], weight)


class ArmsLoad(Condition):
    """Weight on each arm over that of the robot, at the mass centre of the arm's outermost link.

    It is a force downward in the world. The inertia of the load is left out.
    """

    name, cause = "arms_load", "loaded arms"
    genes = (Gene(name="arms_load", low=0.0, middle=0.05, high=0.1, absent=-1.0, limits=(0.0, 10.0)),)
    form, least = "{:.1%} of the robot's weight on each arm", 0.0005
    dose = Sweep("arms_load", (0.0, 0.02, 0.04, 0.06, 0.08, 0.1), title="weight on each arm over the robot's")
    needs_arms = True
    force = _force_load

    def force_plain(self, episodes: Any, values: Array, running: Any, step: int) -> None:
        """Applies the weight to the links."""
        from sim.robots.compiled import number_arm_ends

        weight = values[0] * episodes.model.body_subtreemass[1] * episodes.model.opt.gravity
        for k in running if values[0] else ():
            episodes.data[k].xfrc_applied[number_arm_ends(episodes.robot), :3] += weight


_KINDS = (ArmsHold, ArmsWander, ArmsLoad)
GROUPS["arms"] = tuple(kind.name for kind in _KINDS)
CONDITIONS.update((kind.name, kind()) for kind in _KINDS)
