"""Reward terms of the command-following task, legged_gym's and its names where it has them: one ``@wp.func`` each.

Every term is the unweighted rate of reward in one control step; :mod:`kernels.rewards` weighs and adds them.
"""

import warp as wp

from kernels.penalties import COLLISION_FORCE, FOOT, LIMB
from kernels.state import projected_gravity

TRACKING_VARIANCE = wp.constant(0.25)
TOUCH_FORCE = wp.constant(1.0)
MIN_COMMANDED_SPEED = wp.constant(0.1)


@wp.struct
class Motion:
    """What a control step ended in; one row an environment."""

    joint_q: wp.array2d[float]
    """Joint coordinates (:mod:`kernels.state`)."""
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
    joint_lower: wp.array[float]
    """Soft lower limit of each joint [rad], shape (num_joints,)."""
    joint_upper: wp.array[float]
    """Soft upper limit of each joint [rad], shape (num_joints,)."""
    default_joint_pos: wp.array[float]
    """Default pose [rad], shape (num_joints,)."""
    joint_is_steady: wp.array[int]
    """1 for a joint that is to keep near its default angle, shape (num_joints,)."""
    fallen: wp.array[int]
    """1 where the step ended the episode by a fall, in training also in an invalid state, shape (num_envs,)."""


@wp.struct
class Feet:
    """Memory of the feet's contacts, shape (num_envs, num_geoms); columns of other geoms stay 0."""

    air_time: wp.array2d[float]
    """Time since the foot last touched the ground [s]."""
    touched: wp.array2d[int]
    """1 if the foot touched the ground at the end of the step before."""
    min_air_time_s: float
    """A foot in the air for longer earns a reward when it lands, for less long it costs one [s]."""


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
def is_told_to_stand(motion: Motion, env: int) -> bool:
    """Whether the commanded velocity is none, up to 0.1 m/s."""
    return wp.length(wp.vec2(motion.command[env, 0], motion.command[env, 1])) <= MIN_COMMANDED_SPEED


@wp.func
def feet_air_time(motion: Motion, feet: Feet, env: int) -> float:
    """Sum over the feet that land of their time in the air less the least; 0 when told to stand. Updates ``feet``.

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
                    total += air_time + motion.dt - feet.min_air_time_s
                feet.air_time[env, g] = 0.0
            else:
                feet.air_time[env, g] = air_time + motion.dt
            feet.touched[env, g] = touching
    if is_told_to_stand(motion, env):
        total = 0.0
    return total


@wp.func
def dof_pos_limits(motion: Motion, env: int) -> float:
    """Sum over the joints of how far they are beyond their soft limits [rad]."""
    total = float(0.0)
    for j in range(motion.joint_lower.shape[0]):
        angle = motion.joint_q[env, 7 + j]
        total += wp.max(motion.joint_lower[j] - angle, 0.0) + wp.max(angle - motion.joint_upper[j], 0.0)
    return total


@wp.func
def no_fly(motion: Motion, env: int) -> float:
    """1 if exactly one foot is pushed up, by more than 0.1 N; 0 when told to stand, where legged_gym pays it too."""
    count = int(0)
    for g in range(motion.geom_role.shape[0]):
        if (motion.geom_role[g] & FOOT) != 0 and motion.geom_force[env, g][2] > COLLISION_FORCE:
            count += 1
    return wp.where(count == 1 and not is_told_to_stand(motion, env), 1.0, 0.0)


@wp.func
def orientation(motion: Motion, env: int) -> float:
    """Square of the sine of the base's tilt."""
    gravity = projected_gravity(motion.joint_q, env)
    return gravity[0] * gravity[0] + gravity[1] * gravity[1]


@wp.func
def joint_deviation(motion: Motion, env: int) -> float:
    """Sum over the steady joints of how far they are from their default angle [rad] (Isaac Lab's, for its Cassie)."""
    total = float(0.0)
    for j in range(motion.joint_is_steady.shape[0]):
        if motion.joint_is_steady[j] != 0:
            total += wp.abs(motion.joint_q[env, 7 + j] - motion.default_joint_pos[j])
    return total


@wp.func
def termination(motion: Motion, env: int) -> float:
    """1 in the step that ends an episode by a fall, else 0."""
    return float(motion.fallen[env])
