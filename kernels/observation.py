"""The observation row of the target controller (legged_gym's layout) and its action, on the device.

Columns, for J joints and S scan points: base linear velocity (3, base frame, x 2), base angular velocity (3, base
frame, x 0.25), projected gravity (3), command vx, vy, yaw rate (3, x 2, 2, 0.25), joint positions minus default (J),
joint rates (J, x 0.05), last action (J), height scan (S): clip(base height - 0.5 m - ground height, -1, 1) x 5. Then
what a robot's ``senses`` name: base position, world-local [m], and quaternion wxyz (7); size of the contact force on
each foot geom [N] (x 0.01); joint torques of the last physics step [N m] (J, x 0.01).
"""

from typing import Any

import warp as wp

from kernels.heightfield import Terrain, height_at
from kernels.launch import kernel_over, launch_grid
from kernels.state import RobotStep, base_ang_vel_b, base_heading, base_lin_vel_b, projected_gravity

NUM_BASE_COLUMNS = 12
LIN_VEL_SCALE = wp.constant(2.0)
ANG_VEL_SCALE = wp.constant(0.25)
JOINT_VEL_SCALE = wp.constant(0.05)
SCAN_SCALE = wp.constant(5.0)
SCAN_OFFSET = wp.constant(0.5)
FORCE_SCALE = wp.constant(0.01)
ACTION_LIMIT = wp.constant(100.0)
OBSERVATION_LIMIT = wp.constant(100.0)
_COLUMNS = 4  # that a thread of a GPU writes; a CPU's writes all


@wp.struct
class Sensors:
    """What the observation of one robot type is made of."""

    default_joint_pos: wp.array[float]
    """Joint angles of the default pose [rad], shape (num_joints,)."""
    scan_x: wp.array[float]
    """Scan points ahead of the base in its yaw frame [m], shape (num_scan_points,)."""
    scan_y: wp.array[float]
    """Scan points left of the base in its yaw frame [m], shape (num_scan_points,)."""
    num_pose: int
    """Columns of the base's pose, 7 or 0."""
    foot_columns: wp.array[int]
    """Columns in ``geom_force`` of the feet whose contact is observed, shape (num_feet,) or (0,)."""
    torque_columns: wp.array[int]
    """Columns in ``joint_torque`` of the joints whose torque is observed, shape (num_joints,) or (0,)."""


@wp.func
def _base_column(step: RobotStep, env: int, k: int) -> float:
    if k < 3:
        return base_lin_vel_b(step, env)[k] * LIN_VEL_SCALE
    if k < 6:
        return base_ang_vel_b(step.joint_q, step.joint_qd, env)[k - 3] * ANG_VEL_SCALE
    if k < 9:
        return projected_gravity(step.joint_q, env)[k - 6]
    if k < 11:
        return step.command[env, k - 9] * LIN_VEL_SCALE
    return step.command[env, 2] * ANG_VEL_SCALE


@wp.func
def _scan_column(
    joint_q: wp.array2d[float], heading: wp.vec2, terrain: Terrain, t: int, sensors: Sensors, env: int, k: int
) -> float:
    x = joint_q[env, 0] + heading[0] * sensors.scan_x[k] - heading[1] * sensors.scan_y[k]
    y = joint_q[env, 1] + heading[1] * sensors.scan_x[k] + heading[0] * sensors.scan_y[k]
    return wp.clamp(joint_q[env, 2] - SCAN_OFFSET - height_at(terrain, t, x, y), -1.0, 1.0) * SCAN_SCALE


@wp.func
def _sense_column(step: RobotStep, sensors: Sensors, env: int, k: int) -> float:
    if k < sensors.num_pose:
        return step.joint_q[env, wp.where(k < 3, k, 3 + k % 4)]  # from xyzw: column 3 is w, 4 to 6 are xyz
    foot = k - sensors.num_pose
    num_feet = sensors.foot_columns.shape[0]
    if foot < num_feet:
        return wp.length(step.geom_force[env, sensors.foot_columns[foot]]) * FORCE_SCALE
    return step.joint_torque[env, sensors.torque_columns[foot - num_feet]] * FORCE_SCALE


@wp.kernel
def _write_observation_kernel(
    step: RobotStep,
    terrain_of_env: wp.array[int],
    terrain: Terrain,
    sensors: Sensors,
    is_misled: wp.array[int],
    noise: wp.array[float],
    noise_seed: wp.array[int],
    threads: int,
    observation_out: wp.array2d[float],
):
    """Grid (num_envs, threads)."""
    env, thread = wp.tid()
    num_joints = step.action.shape[1]
    size = observation_out.shape[1]
    t = terrain_of_env[env]
    heading = base_heading(step.joint_q, env)
    for k in range(thread, size, threads):
        column = float(0.0)
        joint = k - NUM_BASE_COLUMNS
        if joint < 0:
            column = _base_column(step, env, k)
        elif joint < num_joints:
            column = step.joint_q[env, 7 + joint] - sensors.default_joint_pos[joint]
        elif joint < 2 * num_joints:
            column = step.joint_qd[env, 6 + joint - num_joints] * JOINT_VEL_SCALE
        elif joint < 3 * num_joints:
            column = step.action[env, joint - 2 * num_joints]
        elif joint < 3 * num_joints + sensors.scan_x.shape[0]:
            if is_misled.shape[0] == 0 or is_misled[env] == 0:
                column = _scan_column(step.joint_q, heading, terrain, t, sensors, env, joint - 3 * num_joints)
        else:
            column = _sense_column(step, sensors, env, joint - 3 * num_joints - sensors.scan_x.shape[0])
        if k < noise.shape[0]:
            state = wp.rand_init(noise_seed[0], env * size + k)
            column += noise[k] * wp.randf(state, -1.0, 1.0)
        observation_out[env, k] = wp.clamp(column, -OBSERVATION_LIMIT, OBSERVATION_LIMIT)


def write_observation(
    step: RobotStep,
    terrain_of_env: Any,
    terrain: Terrain,
    sensors: Sensors,
    is_misled: Any,
    noise: Any,
    noise_seed: Any,
    observation_out: Any,
) -> None:
    """Write one row an environment, (num_envs, observation_size) (columns: module docstring).

    The command is in the base's yaw frame; where ``is_misled``, (num_envs,) or None, the scan is 0, for a condition to
    add what a wrong map shows; ``noise`` are half widths of uniform noise, (observation_size,), or None; ``noise_seed``
    is one integer that the caller advances, shape (1,).
    """
    device, (num_envs, size) = observation_out.device, observation_out.shape
    threads = 1 if device.is_cpu else -(-size // _COLUMNS)
    inputs = [step, terrain_of_env, terrain, sensors, is_misled, noise, noise_seed, threads, observation_out]
    launch_grid(_write_observation_kernel, (num_envs, threads), inputs, device)


@kernel_over("action")
def apply_action(
    action: wp.array2d[float],
    sensors: Sensors,
    scale: float,
    last_action_out: wp.array2d[float],
    targets_out: wp.array2d[float],
):
    """Grid (num_envs, num_joints): turn actions into targets [rad], default pose + ``scale`` * clip(action, -100, 100).

    One that is not finite becomes NaN, and its episode invalid. ``last_action_out`` is the clipped action.
    """
    env, joint = wp.tid()
    clipped = wp.clamp(action[env, joint], -ACTION_LIMIT, ACTION_LIMIT)
    if not wp.isfinite(action[env, joint]):  # of which clamp would make a limit: a wild action, but a valid one
        clipped = wp.nan
    last_action_out[env, joint] = clipped
    targets_out[env, 7 + joint] = sensors.default_joint_pos[joint] + scale * clipped
