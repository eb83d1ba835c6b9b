"""Rewards of the command-following task: legged_gym's terms and names, plus the paper's stumble and foot force.

One ``@wp.func`` a term, each the unweighted rate of reward in one control step. A term is added by its function, a
field of :class:`RewardWeights`, its name in :data:`REWARDS` and its line in :func:`_weighted_terms`.
"""

from typing import Any

import warp as wp

from kernels.base_state import base_ang_vel_b, base_lin_vel_b
from kernels.penalties import COLLISION_FORCE, FOOT, LIMB, excess_contact_force, is_stumbling

REWARDS = (
    "tracking_lin_vel", "tracking_ang_vel", "lin_vel_z", "ang_vel_xy", "torques", "dof_acc",
    "feet_air_time", "collision", "action_rate", "stumble", "feet_contact_forces",
)  # fmt: skip
"""Terms in the order of the columns of ``terms_out``."""

TRACKING_VARIANCE = wp.constant(0.25)
TOUCH_FORCE = wp.constant(1.0)
MIN_AIR_TIME_S = wp.constant(0.5)
MIN_COMMANDED_SPEED = wp.constant(0.1)

_NUM_TERMS = wp.constant(len(REWARDS))
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


@wp.struct
class Motion:
    """What a control step ended in; one row an environment."""

    joint_q: wp.array2d[float]
    """Joint coordinates (:mod:`kernels.base_state`)."""
    joint_qd: wp.array2d[float]
    joint_torque: wp.array2d[float]
    """Actuator torques [N m] in columns 6 and up."""
    geom_force: wp.array2d[wp.vec3]
    """Contact force on each geom, world frame [N]."""
    geom_role: wp.array[int]
    """Role bits of :mod:`kernels.penalties`, one a geom."""
    command: wp.array2d[float]
    """Command the action answered: vx, vy [m/s], yaw rate [rad/s]."""
    action: wp.array2d[float]
    previous_action: wp.array2d[float]
    previous_joint_vel: wp.array2d[float]
    """Joint rates at the end of the step before [rad/s]."""
    base_com: wp.vec3
    """Mass centre of the base in its frame [m]."""
    force_limit: float
    """Foot contact force beyond which it is penalised [N]."""
    dt: float
    """Control step [s]."""


@wp.struct
class Feet:
    """Memory of the feet's contacts, shape (num_envs, num_geoms); columns of other geoms stay 0."""

    air_time: wp.array2d[float]
    """Time since the foot last touched the ground [s]."""
    touched: wp.array2d[int]
    """1 if the foot touched the ground at the end of the step before."""


@wp.func
def tracking_lin_vel(lin_vel_b: wp.vec3, command: wp.vec3) -> float:
    """``exp(-|v_xy - v_xy,cmd|^2 / 0.25)``, base frame."""
    error = wp.vec2(command[0] - lin_vel_b[0], command[1] - lin_vel_b[1])
    return wp.exp(-wp.length_sq(error) / TRACKING_VARIANCE)


@wp.func
def tracking_ang_vel(ang_vel_b: wp.vec3, command: wp.vec3) -> float:
    """``exp(-(w_z - w_z,cmd)^2 / 0.25)``, base frame."""
    error = command[2] - ang_vel_b[2]
    return wp.exp(-error * error / TRACKING_VARIANCE)


@wp.func
def lin_vel_z(lin_vel_b: wp.vec3) -> float:
    """Square of the base's velocity along its own z axis [m^2/s^2]."""
    return lin_vel_b[2] * lin_vel_b[2]


@wp.func
def ang_vel_xy(ang_vel_b: wp.vec3) -> float:
    """Square of the base's roll and pitch rates [rad^2/s^2]."""
    return ang_vel_b[0] * ang_vel_b[0] + ang_vel_b[1] * ang_vel_b[1]


@wp.func
def torques(motion: Motion, env: int) -> float:
    """Sum over the joints of the squared torque [N^2 m^2]."""
    total = float(0.0)
    for j in range(motion.action.shape[1]):
        total += motion.joint_torque[env, 6 + j] * motion.joint_torque[env, 6 + j]
    return total


@wp.func
def dof_acc(motion: Motion, env: int) -> float:
    """Sum over the joints of the squared mean acceleration over the control step [rad^2/s^4]."""
    total = float(0.0)
    for j in range(motion.action.shape[1]):
        acceleration = (motion.joint_qd[env, 6 + j] - motion.previous_joint_vel[env, j]) / motion.dt
        total += acceleration * acceleration
    return total


@wp.func
def action_rate(motion: Motion, env: int) -> float:
    """Sum over the joints of the squared change of the action."""
    total = float(0.0)
    for j in range(motion.action.shape[1]):
        change = motion.action[env, j] - motion.previous_action[env, j]
        total += change * change
    return total


@wp.func
def collision(motion: Motion, env: int) -> float:
    """Number of limb geoms touched with more than 0.1 N."""
    count = float(0.0)
    for g in range(motion.geom_role.shape[0]):
        if (motion.geom_role[g] & LIMB) != 0 and wp.length(motion.geom_force[env, g]) > COLLISION_FORCE:
            count += 1.0
    return count


@wp.func
def feet_air_time(motion: Motion, feet: Feet, env: int) -> float:
    """Sum over the feet that land of their time in the air less 0.5 s; 0 when told to stand. Updates ``feet``.

    A foot is on the ground if it touches now or did in the step before: one missed step is no take-off.
    """
    total = float(0.0)
    for g in range(motion.geom_role.shape[0]):
        if (motion.geom_role[g] & FOOT) != 0:
            touching = int(0)
            if motion.geom_force[env, g][2] > TOUCH_FORCE:
                touching = 1
            air_time = feet.air_time[env, g]
            if touching == 1 or feet.touched[env, g] == 1:
                if air_time > 0.0:
                    total += air_time + motion.dt - MIN_AIR_TIME_S
                feet.air_time[env, g] = 0.0
            else:
                feet.air_time[env, g] = air_time + motion.dt
            feet.touched[env, g] = touching
    if wp.length(wp.vec2(motion.command[env, 0], motion.command[env, 1])) <= MIN_COMMANDED_SPEED:
        total = 0.0
    return total


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
    reward_out[env] = 0.0
    if valid[env] == 0:
        return
    terms = _weighted_terms(motion, weights, feet_out, env)
    reward = float(0.0)
    for k in range(_NUM_TERMS):
        reward += terms[k]
        terms_out[env, k] += motion.dt * terms[k]
    if only_positive != 0:
        reward = wp.max(reward, 0.0)
    reward_out[env] = motion.dt * reward


def reward_steps(
    motion: Motion, weights: RewardWeights, *, only_positive: bool, valid: Any, feet_out: Feet, reward_out: Any,
    terms_out: Any,
) -> None:  # fmt: skip
    """Reward one control step: the weighted sum of all terms times the control step, where ``valid`` is not 0.

    Args:
        motion: What the step ended in.
        weights: Weight of each term per second.
        only_positive: Clip the sum at 0, so that ending early never pays.
        valid: 0 where the state is not to be trusted: no reward, no terms; shape (num_envs,).
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


def make_feet(num_envs: int, num_geoms: int, device: str) -> Feet:
    """Contact memory of robots that were just put down."""
    feet = Feet()
    feet.air_time = wp.zeros((num_envs, num_geoms), dtype=float, device=device)
    feet.touched = wp.zeros((num_envs, num_geoms), dtype=int, device=device)
    return feet
