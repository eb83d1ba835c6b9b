"""Rewards of a control step: legged_gym's terms under its names where it has them, weighed, added, and summed.

A term is one ``@_term`` function here, and its weight is the field of that name in
:class:`sim.robots.training.RewardCfg`. It gives the unweighted rate of reward in one control step. Terms are added in
the order in which they stand here.
"""

from collections.abc import Callable, Collection
from typing import Any

import warp as wp

from kernels.episode import Outcome
from kernels.launch import kernel_over, make_struct, make_zeros
from kernels.penalties import COLLISION_FORCE, FOOT, LIMB, excess_contact_force, is_stumbling
from kernels.state import RobotStep, base_ang_vel_b, base_lin_vel_b, projected_gravity

TRACKING_VARIANCE = wp.constant(0.25)
TOUCH_FORCE = wp.constant(1.0)
MIN_COMMANDED_SPEED = wp.constant(0.1)


@wp.struct
class Motion:
    """Robots at the end of a control step."""

    step: RobotStep
    """Of its last physics step; the command is the one that the action followed."""
    dt: float
    """Control step [s]."""
    min_air_time_s: float
    """A longer flight of a foot earns a reward when it lands, a shorter one costs [s]."""
    joint_lower: wp.array[float]
    """Soft lower limit of each joint [rad], shape (num_joints,)."""
    joint_upper: wp.array[float]
    """Soft upper limit of each joint [rad], shape (num_joints,)."""
    default_joint_pos: wp.array[float]
    """Default pose [rad], shape (num_joints,)."""
    joint_is_steady: wp.array[int]
    """1 for a joint that is to keep near its default angle, shape (num_joints,)."""


@wp.struct
class Rewards:
    """Rewards of the episodes so far, and memory of the step before; shape (num_envs,) unless noted."""

    running: wp.array[int]
    """1 if the episode had not ended when the control step began."""
    step: wp.array[float]
    """Reward of the step just made."""
    total: wp.array[float]
    """Reward of the episode so far."""
    terms: wp.array2d[float]
    """Sums of the weighted terms since they were last cleared, shape (num_envs, len(REWARDS))."""
    previous_action: wp.array2d[float]
    """Clipped action of the step before, shape (num_envs, num_joints)."""
    previous_joint_vel: wp.array2d[float]
    """Joint rates at the end of the step before [rad/s], shape (num_envs, num_joints)."""
    air_time: wp.array2d[float]
    """Time since the foot last touched the ground [s], shape (num_envs, num_geoms); 0 for other geoms."""
    touched: wp.array2d[int]
    """1 if the foot touched the ground at the end of the step before, shape (num_envs, num_geoms)."""


_TERMS: dict[str, Any] = {}


def _term(function: Callable[..., Any]) -> Any:
    """Make a Warp function of a reward term, and its name a column of the rewards."""
    _TERMS[function.__name__] = wp.func(function)
    return _TERMS[function.__name__]


@wp.func
def _shall_stand(motion: Motion, env: int) -> bool:
    """Whether the commanded velocity is at most 0.1 m/s."""
    return wp.length(wp.vec2(motion.step.command[env, 0], motion.step.command[env, 1])) <= MIN_COMMANDED_SPEED


@_term
def tracking_lin_vel(motion: Motion, rewards: Rewards, env: int) -> float:
    """``exp(-|v_xy - v_xy,cmd|^2 / 0.25)``, base frame."""
    velocity = base_lin_vel_b(motion.step, env)
    error = wp.vec2(motion.step.command[env, 0] - velocity[0], motion.step.command[env, 1] - velocity[1])
    return wp.exp(-wp.length_sq(error) / TRACKING_VARIANCE)


@_term
def tracking_ang_vel(motion: Motion, rewards: Rewards, env: int) -> float:
    """``exp(-(w_z - w_z,cmd)^2 / 0.25)``, base frame."""
    error = motion.step.command[env, 2] - base_ang_vel_b(motion.step.joint_q, motion.step.joint_qd, env)[2]
    return wp.exp(-error * error / TRACKING_VARIANCE)


@_term
def lin_vel_z(motion: Motion, rewards: Rewards, env: int) -> float:
    """Square of the base's velocity along its own z axis [m^2/s^2]."""
    velocity = base_lin_vel_b(motion.step, env)
    return velocity[2] * velocity[2]


@_term
def ang_vel_xy(motion: Motion, rewards: Rewards, env: int) -> float:
    """Square of the base's roll and pitch rates [rad^2/s^2]."""
    rate = base_ang_vel_b(motion.step.joint_q, motion.step.joint_qd, env)
    return rate[0] * rate[0] + rate[1] * rate[1]


@_term
def torques(motion: Motion, rewards: Rewards, env: int) -> float:
    """Sum over the joints of the squared torque [N^2 m^2]."""
    total = float(0.0)
    for j in range(motion.step.action.shape[1]):
        total += motion.step.joint_torque[env, 6 + j] * motion.step.joint_torque[env, 6 + j]
    return total


@_term
def dof_acc(motion: Motion, rewards: Rewards, env: int) -> float:
    """Sum over the joints of the squared mean acceleration over the control step [rad^2/s^4]."""
    total = float(0.0)
    for j in range(motion.step.action.shape[1]):
        acceleration = (motion.step.joint_qd[env, 6 + j] - rewards.previous_joint_vel[env, j]) / motion.dt
        total += acceleration * acceleration
    return total


@_term
def feet_air_time(motion: Motion, rewards: Rewards, env: int) -> float:
    """Sum over landing feet of their time in the air less the minimum; 0 at a command to stand. Updates ``rewards``.

    A foot is on the ground if it touches now or did in the step before: one missed step is no take-off.
    """
    total = float(0.0)
    for g in range(motion.step.geom_role.shape[0]):
        if (motion.step.geom_role[g] & FOOT) != 0:
            touching = int(0)
            if motion.step.geom_force[env, g][2] > TOUCH_FORCE:
                touching = 1
            air_time = rewards.air_time[env, g]
            if touching == 1 or rewards.touched[env, g] == 1:
                if air_time > 0.0:
                    total += air_time + motion.dt - motion.min_air_time_s
                rewards.air_time[env, g] = 0.0
            else:
                rewards.air_time[env, g] = air_time + motion.dt
            rewards.touched[env, g] = touching
    if _shall_stand(motion, env):
        total = 0.0
    return total


@_term
def collision(motion: Motion, rewards: Rewards, env: int) -> float:
    """Number of limb geoms touched with more than 0.1 N."""
    count = float(0.0)
    for g in range(motion.step.geom_role.shape[0]):
        if (motion.step.geom_role[g] & LIMB) != 0 and wp.length(motion.step.geom_force[env, g]) > COLLISION_FORCE:
            count += 1.0
    return count


@_term
def action_rate(motion: Motion, rewards: Rewards, env: int) -> float:
    """Sum over the joints of the squared change of the action."""
    total = float(0.0)
    for j in range(motion.step.action.shape[1]):
        change = motion.step.action[env, j] - rewards.previous_action[env, j]
        total += change * change
    return total


@_term
def stumble(motion: Motion, rewards: Rewards, env: int) -> float:
    """1 if any foot hits a vertical surface (:func:`kernels.penalties.is_stumbling`), else 0."""
    return is_stumbling(motion.step, env)


@_term
def feet_contact_forces(motion: Motion, rewards: Rewards, env: int) -> float:
    """Sum over the feet of the contact force beyond the limit [N]."""
    return excess_contact_force(motion.step, env)


@_term
def dof_pos_limits(motion: Motion, rewards: Rewards, env: int) -> float:
    """Sum over the joints of how far they are beyond their soft limits [rad]."""
    total = float(0.0)
    for j in range(motion.joint_lower.shape[0]):
        angle = motion.step.joint_q[env, 7 + j]
        total += wp.max(motion.joint_lower[j] - angle, 0.0) + wp.max(angle - motion.joint_upper[j], 0.0)
    return total


@_term
def no_fly(motion: Motion, rewards: Rewards, env: int) -> float:
    """1 if exactly one foot is pushed up, by more than 0.1 N; 0 at a command to stand, unlike legged_gym's."""
    count = int(0)
    for g in range(motion.step.geom_role.shape[0]):
        if (motion.step.geom_role[g] & FOOT) != 0 and motion.step.geom_force[env, g][2] > COLLISION_FORCE:
            count += 1
    return wp.where(count == 1 and not _shall_stand(motion, env), 1.0, 0.0)


@_term
def orientation(motion: Motion, rewards: Rewards, env: int) -> float:
    """Square of the sine of the base's tilt."""
    gravity = projected_gravity(motion.step.joint_q, env)
    return gravity[0] * gravity[0] + gravity[1] * gravity[1]


@_term
def joint_deviation(motion: Motion, rewards: Rewards, env: int) -> float:
    """Sum over the steady joints of how far they are from their default angle [rad] (Isaac Lab's, for its Cassie)."""
    total = float(0.0)
    for j in range(motion.joint_is_steady.shape[0]):
        if motion.joint_is_steady[j] != 0:
            total += wp.abs(motion.step.joint_q[env, 7 + j] - motion.default_joint_pos[j])
    return total


_FUNCTIONS = tuple(_TERMS.values())
REWARDS = (*_TERMS, "termination")
"""Columns of the sums of terms, in their order; the last is the price of a fall."""

_NUM_TERMS = wp.constant(len(_TERMS))
_TermWeights = wp.types.vector(len(_TERMS), float)
wp.set_module_options({"max_unroll": len(_TERMS)})  # the loop over the terms calls another function each time


@wp.struct
class RewardWeights:
    """Weights of the terms; made by :func:`make_weights`."""

    terms: _TermWeights
    """Weight of each term per second, in the order of :data:`REWARDS`."""
    termination: float
    """Weight of a fall per second."""
    falls: int
    """Outcomes that count as a fall, bits ``1 << Outcome``."""
    only_positive: int
    """1: the sum of the terms is clipped at 0, so that ending early never pays."""


def make_weights(weights: dict[str, float], *, only_positive: bool, falls: Collection[Outcome]) -> RewardWeights:
    """A kernel argument of weights of :data:`REWARDS` per second by name; ``falls`` cost ``termination``, unclipped."""
    return make_struct(
        RewardWeights,
        terms=_TermWeights(*(weights[name] for name in _TERMS)),
        termination=weights["termination"],
        falls=sum(1 << outcome for outcome in falls),
        only_positive=int(only_positive),
    )


def make_rewards(num_envs: int, num_joints: int, num_geoms: int, device: str | None = None) -> Rewards:
    """Allocate the rewards of episodes that have not begun."""
    shapes = dict.fromkeys(("running", "step", "total"), num_envs) | {"terms": (num_envs, len(REWARDS))}
    shapes |= dict.fromkeys(("previous_action", "previous_joint_vel"), (num_envs, num_joints))
    rewards = make_zeros(Rewards, device, **shapes | dict.fromkeys(("air_time", "touched"), (num_envs, num_geoms)))
    rewards.running.fill_(1)
    return rewards


@kernel_over("outcome")
def reward_steps(motion: Motion, weights: RewardWeights, outcome: wp.array[int], rewards_out: Rewards):
    """Grid (num_envs,): reward one control step by the weighted sum of all terms times the control step.

    A step is paid if its episode had not ended before. A step that ends in an invalid state pays no term; one that ends
    in a fall pays its price too. ``outcome`` is that after the step.
    """
    env = wp.tid()
    ended = outcome[env]
    running = rewards_out.running[env]
    rewards_out.running[env] = wp.where(ended == Outcome.RUNNING, 1, 0)
    reward = float(0.0)
    if running == 1 and ended != Outcome.INVALID:
        for k in range(_NUM_TERMS):
            weighted = weights.terms[k] * wp.static(_FUNCTIONS[k])(motion, rewards_out, env)
            reward += weighted
            rewards_out.terms[env, k] += motion.dt * weighted
        if weights.only_positive != 0:
            reward = wp.max(reward, 0.0)
    if running == 1 and (weights.falls & (1 << ended)) != 0:
        reward += weights.termination
        rewards_out.terms[env, _NUM_TERMS] += motion.dt * weights.termination
    rewards_out.step[env] = motion.dt * reward
    rewards_out.total[env] += motion.dt * reward


@kernel_over("action")
def remember_steps(
    action: wp.array2d[float], joint_qd: wp.array2d[float], rewards_out: Rewards, counter_out: wp.array[int]
):
    """Grid (num_envs, num_joints): keep action and joint rates for the rewards of the next step, and count the step."""
    env, j = wp.tid()
    rewards_out.previous_action[env, j] = action[env, j]
    rewards_out.previous_joint_vel[env, j] = joint_qd[env, 6 + j]
    if env == 0 and j == 0:
        counter_out[0] = counter_out[0] + 1
