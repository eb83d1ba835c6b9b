"""The raw penalties of one physics step (the paper's section III-B), on the device.

A penalty is one ``@_penalty`` function here, under whose name robots choose it. Its NumPy counterpart, by which MuJoCo
C is compared, stands in :func:`sim.mujoco_c.model.step_penalties`; its label and colour in :mod:`qd.show.figures`.
"""

from collections.abc import Callable
from typing import Any

import warp as wp

from kernels.state import base_ang_vel_b, base_lin_vel_b

BASE = 1
FOOT = 2
LIMB = 4
"""Role bits of a geom: its touch ends the episode; it walks; its touch is penalised."""

STUMBLE_RATIO = wp.constant(5.0)
COLLISION_FORCE = wp.constant(0.1)


@wp.func
def excess_contact_force(geom_force: wp.array2d[wp.vec3], geom_role: wp.array[int], limit: float, env: int) -> float:
    """Sum over the feet of the contact force beyond ``limit`` [N]."""
    excess = float(0.0)
    for g in range(geom_role.shape[0]):
        if (geom_role[g] & FOOT) != 0:
            excess += wp.max(0.0, wp.length(geom_force[env, g]) - limit)
    return excess


@wp.func
def is_stumbling(geom_force: wp.array2d[wp.vec3], geom_role: wp.array[int], env: int) -> float:
    """1 if the contact force of any foot is more horizontal than 5 to 1 (it hits a vertical surface), else 0."""
    stumbling = float(0.0)
    for g in range(geom_role.shape[0]):
        force = geom_force[env, g]
        if (geom_role[g] & FOOT) != 0 and wp.length(wp.vec2(force[0], force[1])) > STUMBLE_RATIO * wp.abs(force[2]):
            stumbling = 1.0
    return stumbling


@wp.func
def max_base_force(geom_force: wp.array2d[wp.vec3], geom_role: wp.array[int], env: int) -> float:
    """Largest contact force on a base geom [N]."""
    largest = float(0.0)
    for g in range(geom_role.shape[0]):
        if (geom_role[g] & BASE) != 0:
            largest = wp.max(largest, wp.length(geom_force[env, g]))
    return largest


@wp.struct
class PenaltyStep:
    """What a physics step ended in; one row an environment. Shapes are those of :func:`add_penalties`."""

    joint_q: wp.array2d[float]
    joint_qd: wp.array2d[float]
    base_com: wp.vec3
    command: wp.array2d[float]
    geom_force: wp.array2d[wp.vec3]
    geom_role: wp.array[int]
    force_limit: float


_FUNCTIONS: dict[str, Any] = {}


def _penalty(function: Callable[..., Any]) -> Any:
    """Make a Warp function of a penalty, and its name a column of the sums."""
    _FUNCTIONS[function.__name__] = wp.func(function)
    return _FUNCTIONS[function.__name__]


@wp.func
def _squared_velocity_error(step: PenaltyStep, env: int, axis: int) -> float:
    velocity = base_lin_vel_b(step.joint_q, step.joint_qd, step.base_com, env)
    error = velocity[axis] - step.command[env, axis]
    return error * error


@_penalty
def yaw_rate(step: PenaltyStep, env: int) -> float:
    """Squared error of the yaw rate [(rad/s)^2], base frame."""
    error = base_ang_vel_b(step.joint_q, step.joint_qd, env)[2] - step.command[env, 2]
    return error * error


@_penalty
def vel_x(step: PenaltyStep, env: int) -> float:
    """Squared error of the forward velocity of the base link [(m/s)^2], base frame."""
    return _squared_velocity_error(step, env, 0)


@_penalty
def vel_y(step: PenaltyStep, env: int) -> float:
    """Squared error of the sideways velocity of the base link [(m/s)^2], base frame."""
    return _squared_velocity_error(step, env, 1)


@_penalty
def contact_force(step: PenaltyStep, env: int) -> float:
    """Sum over the feet of the contact force beyond what costs nothing [N]."""
    return excess_contact_force(step.geom_force, step.geom_role, step.force_limit, env)


@_penalty
def stumble(step: PenaltyStep, env: int) -> float:
    """1 if any foot hits a vertical surface, else 0."""
    return is_stumbling(step.geom_force, step.geom_role, env)


@_penalty
def collision(step: PenaltyStep, env: int) -> float:
    """Number of base and limb geoms touched with more than 0.1 N."""
    count = float(0.0)
    for g in range(step.geom_role.shape[0]):
        touched = wp.length(step.geom_force[env, g]) > COLLISION_FORCE
        if (step.geom_role[g] & (BASE | LIMB)) != 0 and touched:
            count += 1.0
    return count


PENALTIES = tuple(_FUNCTIONS)
"""Columns of the penalty sums."""
_IN_ORDER = tuple(_FUNCTIONS.values())
_NUM_PENALTIES = wp.constant(len(PENALTIES))
wp.set_module_options({"max_unroll": max(16, len(PENALTIES))})  # the loop calls another function each time


@wp.kernel
def _add_penalties_kernel(step: PenaltyStep, dt: float, counted: wp.array[int], sums_out: wp.array2d[float]):
    """Grid (num_envs,)."""
    env = wp.tid()
    if counted[env] != 0:
        for k in range(_NUM_PENALTIES):
            sums_out[env, k] += dt * wp.static(_IN_ORDER[k])(step, env)


def add_penalties(
    joint_q: Any, joint_qd: Any, base_com: wp.vec3, command: Any, geom_force: Any, geom_role: Any,
    force_limit: float, dt: float, counted: Any, sums_out: Any,
) -> None:  # fmt: skip
    """Add one physics step's raw penalties times ``dt`` to the sums, columns :data:`PENALTIES`.

    Where the int ``counted`` (num_envs,) is 0, nothing is added. Foot forces up to ``force_limit`` [N] cost nothing.
    """
    if tuple(sums_out.shape) != (counted.shape[0], len(PENALTIES)):
        raise ValueError(
            f"sums_out must have shape ({counted.shape[0]}, {len(PENALTIES)}), got {tuple(sums_out.shape)}: "
            f"one column for each of {', '.join(PENALTIES)}"
        )
    step = PenaltyStep()
    step.joint_q, step.joint_qd, step.base_com, step.command = joint_q, joint_qd, base_com, command
    step.geom_force, step.geom_role, step.force_limit = geom_force, geom_role, force_limit
    inputs = [step, dt, counted]
    wp.launch(_add_penalties_kernel, counted.shape[0], inputs, outputs=[sums_out], device=sums_out.device)
