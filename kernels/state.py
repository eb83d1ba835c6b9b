"""Base pose and velocity of a robot, from the joint coordinates Newton keeps.

Row layout of ``joint_q``: base position (3), base quaternion xyzw (4), joints; of ``joint_qd``: velocity of the base's
centre of mass (3) and angular velocity (3), both in the world frame, joints.
"""

import warp as wp


@wp.struct
class RobotStep:
    """Robots at the end of a physics step, one row each; :mod:`kernels` has the arrays without a line."""

    joint_q: wp.array2d[float]
    joint_qd: wp.array2d[float]
    base_com: wp.vec3
    command: wp.array2d[float]
    action: wp.array2d[float]
    """As :func:`kernels.observation.apply_action` left it."""
    geom_force: wp.array2d[wp.vec3]
    geom_role: wp.array[int]
    joint_torque: wp.array2d[float]
    """Actuator torques [N m] in columns 6 and up, in the solver's order, shape (num_envs, 6 + num_joints)."""
    overflow: wp.array[int]
    """The solver's overflow bits of the step, shape (num_envs,)."""
    force_limit: float
    """Foot contact force beyond which it is penalised [N]."""


@wp.func
def base_rotation(joint_q: wp.array2d[float], env: int) -> wp.quat:
    """Rotation of the base link, base to world frame."""
    return wp.quat(joint_q[env, 3], joint_q[env, 4], joint_q[env, 5], joint_q[env, 6])


@wp.func
def base_pose(joint_q: wp.array2d[float], env: int) -> wp.transform:
    """Pose of the base link, world-local frame."""
    return wp.transform(wp.vec3(joint_q[env, 0], joint_q[env, 1], joint_q[env, 2]), base_rotation(joint_q, env))


@wp.func
def base_heading(joint_q: wp.array2d[float], env: int) -> wp.vec2:
    """Cosine and sine of the heading of the base's x axis in the world's horizontal plane; (1, 0) where it has none."""
    x = joint_q[env, 3]
    y = joint_q[env, 4]
    z = joint_q[env, 5]
    w = joint_q[env, 6]
    forward = wp.vec2(1.0 - 2.0 * (y * y + z * z), 2.0 * (w * z + x * y))
    length = wp.length(forward)
    if length == 0.0:
        return wp.vec2(1.0, 0.0)
    return forward / length


@wp.func
def base_yaw(joint_q: wp.array2d[float], env: int) -> float:
    """Heading of the base's x axis [rad]."""
    heading = base_heading(joint_q, env)
    return wp.atan2(heading[1], heading[0])


@wp.func
def base_ang_vel_b(joint_q: wp.array2d[float], joint_qd: wp.array2d[float], env: int) -> wp.vec3:
    """Angular velocity of the base in its own frame [rad/s]."""
    rate = wp.vec3(joint_qd[env, 3], joint_qd[env, 4], joint_qd[env, 5])
    return wp.quat_rotate_inv(base_rotation(joint_q, env), rate)


@wp.func
def base_lin_vel_b(step: RobotStep, env: int) -> wp.vec3:
    """Velocity of the base link's origin in the base frame [m/s]."""
    velocity = wp.vec3(step.joint_qd[env, 0], step.joint_qd[env, 1], step.joint_qd[env, 2])
    com_velocity = wp.quat_rotate_inv(base_rotation(step.joint_q, env), velocity)
    return com_velocity - wp.cross(base_ang_vel_b(step.joint_q, step.joint_qd, env), step.base_com)


@wp.func
def velocity_beside(velocity: wp.vec3, ang_vel: wp.vec3, rotation: wp.quat, offset: wp.vec3) -> wp.vec3:
    """World velocity [m/s] of the point of a body that lies ``offset`` [m, body frame] from one with ``velocity``."""
    return velocity + wp.cross(ang_vel, wp.quat_rotate(rotation, offset))


@wp.func
def projected_gravity(joint_q: wp.array2d[float], env: int) -> wp.vec3:
    """Unit vector of gravity in the base frame: (0, 0, -1) when upright."""
    return wp.quat_rotate_inv(base_rotation(joint_q, env), wp.vec3(0.0, 0.0, -1.0))


@wp.func
def wrap_angle(angle: float) -> float:
    """The angle in [-pi, pi] [rad]."""
    return wp.atan2(wp.sin(angle), wp.cos(angle))


@wp.func
def row_is_finite(rows: wp.array2d[float], env: int) -> bool:
    """Whether all numbers of an environment's row are finite."""
    finite = bool(True)
    for k in range(rows.shape[1]):
        if not wp.isfinite(rows[env, k]):
            finite = False
    return finite


@wp.func
def is_too_fast(joint_qd: wp.array2d[float], env: int, max_speed: float) -> bool:
    """Whether any velocity exceeds ``max_speed`` [m/s or rad/s]."""
    too_fast = bool(False)
    for k in range(joint_qd.shape[1]):
        if wp.abs(joint_qd[env, k]) > max_speed:
            too_fast = True
    return too_fast
