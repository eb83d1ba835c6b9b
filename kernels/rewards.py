"""Rewards of the command-following task: the terms of :mod:`kernels.reward_terms`, weighed and added.

A term is added by its function there, and here by a field of :class:`RewardWeights`, its name in :data:`REWARDS` and
its line in :func:`_weighted_terms`.
"""

from typing import Any

import warp as wp

from kernels.penalties import excess_contact_force, is_stumbling
from kernels.reward_terms import (
    Feet,
    Motion,
    action_rate,
    ang_vel_xy,
    collision,
    dof_acc,
    dof_pos_limits,
    feet_air_time,
    joint_deviation,
    lin_vel_z,
    no_fly,
    orientation,
    termination,
    torques,
    tracking_ang_vel,
    tracking_lin_vel,
)
from kernels.state import base_ang_vel_b, base_lin_vel_b

REWARDS = (
    "tracking_lin_vel", "tracking_ang_vel", "lin_vel_z", "ang_vel_xy", "torques", "dof_acc",
    "feet_air_time", "collision", "action_rate", "stumble", "feet_contact_forces",
    "dof_pos_limits", "no_fly", "orientation", "joint_deviation", "termination",
)  # fmt: skip
"""Terms in the order of the columns of ``terms_out``."""

_NUM_TERMS = wp.constant(len(REWARDS))
_TERMINATION = wp.constant(REWARDS.index("termination"))
_Terms = wp.types.vector(len(REWARDS), float)


@wp.struct
class RewardWeights:
    """Weight of each term per second, fields named as in :data:`REWARDS`."""

    tracking_lin_vel: float
    tracking_ang_vel: float
    lin_vel_z: float
    ang_vel_xy: float
    torques: float
    dof_acc: float
    feet_air_time: float
    collision: float
    action_rate: float
    stumble: float
    feet_contact_forces: float
    dof_pos_limits: float
    no_fly: float
    orientation: float
    joint_deviation: float
    termination: float


@wp.func
def _weighted_terms(motion: Motion, weights: RewardWeights, feet: Feet, env: int) -> _Terms:
    command = wp.vec3(motion.command[env, 0], motion.command[env, 1], motion.command[env, 2])
    lin_vel = base_lin_vel_b(motion.joint_q, motion.joint_qd, motion.base_com, env)
    ang_vel = base_ang_vel_b(motion.joint_q, motion.joint_qd, env)
    terms = _Terms()
    terms[0] = weights.tracking_lin_vel * tracking_lin_vel(lin_vel, command)
    terms[1] = weights.tracking_ang_vel * tracking_ang_vel(ang_vel, command)
    terms[2] = weights.lin_vel_z * lin_vel_z(lin_vel)
    terms[3] = weights.ang_vel_xy * ang_vel_xy(ang_vel)
    terms[4] = weights.torques * torques(motion, env)
    terms[5] = weights.dof_acc * dof_acc(motion, env)
    terms[6] = weights.feet_air_time * feet_air_time(motion, feet, env)
    terms[7] = weights.collision * collision(motion, env)
    terms[8] = weights.action_rate * action_rate(motion, env)
    terms[9] = weights.stumble * is_stumbling(motion.geom_force, motion.geom_role, env)
    terms[10] = weights.feet_contact_forces * excess_contact_force(
        motion.geom_force, motion.geom_role, motion.force_limit, env
    )
    terms[11] = weights.dof_pos_limits * dof_pos_limits(motion, env)
    terms[12] = weights.no_fly * no_fly(motion, env)
    terms[13] = weights.orientation * orientation(motion, env)
    terms[14] = weights.joint_deviation * joint_deviation(motion, env)
    terms[15] = weights.termination * termination(motion, env)
    return terms


@wp.kernel
def _reward_steps_kernel(
    motion: Motion,
    weights: RewardWeights,
    only_positive: int,
    valid: wp.array[int],
    feet_out: Feet,
    reward_out: wp.array[float],
    terms_out: wp.array2d[float],
):
    """Grid (num_envs,)."""
    env = wp.tid()
    if valid[env] == 0:
        fall = weights.termination * termination(motion, env)
        reward_out[env] = motion.dt * fall
        terms_out[env, _TERMINATION] += motion.dt * fall
        return
    terms = _weighted_terms(motion, weights, feet_out, env)
    reward = float(0.0)
    for k in range(_NUM_TERMS):
        if k != _TERMINATION:
            reward += terms[k]
        terms_out[env, k] += motion.dt * terms[k]
    if only_positive != 0:
        reward = wp.max(reward, 0.0)
    reward_out[env] = motion.dt * (reward + terms[_TERMINATION])  # a fall is not clipped


def reward_steps(
    motion: Motion, weights: RewardWeights, *, only_positive: bool, valid: Any, feet_out: Feet, reward_out: Any,
    terms_out: Any,
) -> None:  # fmt: skip
    """Reward one control step: the weighted sum of all terms times the control step, where ``valid`` is not 0.

    Args:
        motion: What the step ended in.
        weights: Weight of each term per second.
        only_positive: Clip the sum of all terms but ``termination`` at 0, so that ending early never pays.
        valid: 0 where the state is not to be trusted: nothing but ``termination`` counts; shape (num_envs,).
        feet_out: Contact memory of the feet; updated.
        reward_out: Reward of the step, shape (num_envs,).
        terms_out: Each weighted term is added to it, columns :data:`REWARDS`; shape (num_envs, len(REWARDS)).

    Raises:
        ValueError: If ``terms_out`` has not one column a term.
    """
    expected = (valid.shape[0], len(REWARDS))
    if tuple(terms_out.shape) != expected:
        raise ValueError(
            f"terms_out must have shape {expected}, got {tuple(terms_out.shape)}: one column for each of "
            f"{', '.join(REWARDS)}"
        )
    wp.launch(
        _reward_steps_kernel,
        dim=valid.shape[0],
        inputs=[motion, weights, int(only_positive), valid],
        outputs=[feet_out, reward_out, terms_out],
        device=reward_out.device,
    )


def make_feet(num_envs: int, num_geoms: int, device: str, *, min_air_time_s: float = 0.5) -> Feet:
    """Contact memory of robots that were just put down."""
    feet = Feet()
    feet.min_air_time_s = min_air_time_s
    feet.air_time = wp.zeros((num_envs, num_geoms), dtype=float, device=device)
    feet.touched = wp.zeros((num_envs, num_geoms), dtype=int, device=device)
    return feet
