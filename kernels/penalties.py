"""The raw penalties of one physics step (the paper's section III-B), on the device.

A penalty is one Warp function with its record, ``@penalty``. Robots choose it by its name.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from kernels.launch import launch_grid
from kernels.state import RobotStep, base_ang_vel_b, base_lin_vel_b

BASE = 1
FOOT = 2
LIMB = 4
"""Role bits of a geom: its touch ends the episode; it walks; its touch is penalised."""

STUMBLE_RATIO = wp.constant(5.0)
COLLISION_FORCE = wp.constant(0.1)


@wp.func
def max_base_force(step: RobotStep, env: int) -> float:
    """Largest contact force on a base geom [N]."""
    largest = float(0.0)
    for g in range(step.geom_role.shape[0]):
        if (step.geom_role[g] & BASE) != 0:
            largest = wp.max(largest, wp.length(step.geom_force[env, g]))
    return largest


@dataclass(frozen=True, kw_only=True)
class PlainStep:
    """The same for N robots in float64 NumPy, in the terms of the penalties."""

    velocity: NDArray[np.float64]
    """Of the base link's origin, base frame [m/s], shape (N, 3)."""
    ang_vel: NDArray[np.float64]
    """Of the base, base frame [rad/s], shape (N, 3)."""
    command: NDArray[np.float64]
    """Shape (N, 3)."""
    forces: NDArray[np.float64]
    """Contact force on each geom, world frame [N], shape (N, num_geoms, 3)."""
    feet: NDArray[np.bool_]
    """Which geoms are feet, shape (num_geoms,); the others are base and limbs."""
    force_limit: float


@dataclass(frozen=True, kw_only=True)
class Penalty:
    """What a robot may be penalised for in each physics step."""

    name: str
    """In robots' settings, archives and tables."""
    function: Any
    """Warp function of a :class:`kernels.state.RobotStep` and an environment; its value is multiplied by the step."""
    plain: Callable[[PlainStep], NDArray[Any]]
    """The same in NumPy, shape (N,), by which crossings in MuJoCo C are penalised and the Warp function is tested."""
    label: str
    """On one line."""
    unit: str
    """Of the sum over a crossing."""
    color: str
    """In figures; one of Okabe and Ito's."""
    needs_limbs: bool = False
    """Only for robots with limb geoms."""
    default: bool = True
    """Whether a user's robot has it if its settings name no penalties."""


PENALTIES: dict[str, Penalty] = {}
"""Columns of the penalty sums, by name."""


def penalty(name: str, **details: Any) -> Callable[[Callable[..., Any]], Any]:
    """Register a Warp function as a :class:`Penalty`, before robots are simulated; ``details`` are its fields."""

    def register(function: Callable[..., Any]) -> Any:
        PENALTIES[name] = Penalty(name=name, function=wp.func(function), **details)
        return PENALTIES[name].function

    return register


def penalty_columns(names: Iterable[str]) -> list[int]:
    """Columns of the penalties in the penalty sums."""
    columns = list(PENALTIES)
    return [columns.index(name) for name in names]


def _norms(vectors: NDArray[Any]) -> NDArray[Any]:
    return np.linalg.norm(vectors, axis=-1)


def _plain_stumble(step: PlainStep) -> NDArray[Any]:
    feet = step.forces[:, step.feet]
    return (_norms(feet[..., :2]) > 5.0 * np.abs(feet[..., 2])).any(axis=1)


@wp.func
def _squared_velocity_error(step: RobotStep, env: int, axis: int) -> float:
    velocity = base_lin_vel_b(step, env)
    error = velocity[axis] - step.command[env, axis]
    return error * error


@penalty(
    "yaw_rate",
    plain=lambda step: (step.ang_vel[:, 2] - step.command[:, 2]) ** 2,
    label="yaw-rate error",
    unit="(rad/s)^2 s",
    color="#cc79a7",
)
def _yaw_rate(step: RobotStep, env: int) -> float:
    """Squared error of the yaw rate [(rad/s)^2], base frame."""
    error = base_ang_vel_b(step.joint_q, step.joint_qd, env)[2] - step.command[env, 2]
    return error * error


@penalty(
    "vel_x",
    plain=lambda step: (step.velocity[:, 0] - step.command[:, 0]) ** 2,
    label="forward-velocity error",
    unit="(m/s)^2 s",
    color="#0072b2",
)
def _vel_x(step: RobotStep, env: int) -> float:
    """Squared error of the forward velocity of the base link [(m/s)^2], base frame."""
    return _squared_velocity_error(step, env, 0)


@penalty(
    "vel_y",
    plain=lambda step: (step.velocity[:, 1] - step.command[:, 1]) ** 2,
    label="sideways-velocity error",
    unit="(m/s)^2 s",
    color="#56b4e9",
)
def _vel_y(step: RobotStep, env: int) -> float:
    """Squared error of the sideways velocity of the base link [(m/s)^2], base frame."""
    return _squared_velocity_error(step, env, 1)


@penalty(
    "contact_force",
    plain=lambda step: np.maximum(0.0, _norms(step.forces[:, step.feet]) - step.force_limit).sum(axis=1),
    label="high contact force",
    unit="N s",
    color="#000000",
)
def excess_contact_force(step: RobotStep, env: int) -> float:
    """Sum over the feet of the contact force beyond the limit [N]."""
    excess = float(0.0)
    for g in range(step.geom_role.shape[0]):
        if (step.geom_role[g] & FOOT) != 0:
            excess += wp.max(0.0, wp.length(step.geom_force[env, g]) - step.force_limit)
    return excess


@penalty("stumble", plain=_plain_stumble, label="stumble", unit="s", color="#e69f00")
def is_stumbling(step: RobotStep, env: int) -> float:
    """1 if the contact force of any foot is more horizontal than 5 to 1 (it hits a vertical surface), else 0."""
    stumbling = float(0.0)
    for g in range(step.geom_role.shape[0]):
        force = step.geom_force[env, g]
        sideways = wp.length(wp.vec2(force[0], force[1]))
        if (step.geom_role[g] & FOOT) != 0 and sideways > STUMBLE_RATIO * wp.abs(force[2]):
            stumbling = 1.0
    return stumbling


@penalty(
    "collision",
    plain=lambda step: (_norms(step.forces[:, ~step.feet]) > 0.1).sum(axis=1),
    label="collisions of base and legs",
    unit="s",
    color="#d55e00",
    needs_limbs=True,
)
def _collision(step: RobotStep, env: int) -> float:
    """Number of base and limb geoms touched with more than 0.1 N."""
    count = float(0.0)
    for g in range(step.geom_role.shape[0]):
        touched = wp.length(step.geom_force[env, g]) > COLLISION_FORCE
        if (step.geom_role[g] & (BASE | LIMB)) != 0 and touched:
            count += 1.0
    return count


@cache
def _make_kernel(functions: tuple[Any, ...]) -> Any:
    count = len(functions)
    options = {"max_unroll": max(16, count)}  # the loop calls another function each time

    @wp.kernel(module="unique", module_options=options)
    def add_penalties(step: RobotStep, dt: float, counted: wp.array[int], sums_out: wp.array2d[float]):
        """Grid (num_penalties, num_envs)."""
        column, env = wp.tid()
        if counted[env] != 0:
            for k in range(wp.static(count)):
                if k == column:
                    sums_out[env, k] += dt * wp.static(functions[k])(step, env)

    return add_penalties


def add_penalties(step: RobotStep, dt: float, counted: Any, sums_out: Any) -> None:
    """Add one physics step's raw penalties times ``dt`` [s] to the sums, columns :data:`PENALTIES`.

    Where the int ``counted`` (num_envs,) is 0, nothing is added.
    """
    kernel = _make_kernel(tuple(entry.function for entry in PENALTIES.values()))
    launch_grid(kernel, sums_out.shape[::-1], [step, dt, counted, sums_out], sums_out.device)
