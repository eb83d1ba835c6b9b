"""The restart of an episode, in crossings and in training: a randomised start without memory of the episode before."""

from typing import Any

import warp as wp

from kernels.episode import Episodes, begin_episode
from kernels.heightfield import Terrain, node_height
from kernels.observation import Sensors
from kernels.rewards import Rewards
from kernels.state import velocity_beside

_CLEARING_THREADS = 64  # a row


@wp.struct
class StartRanges:
    """Randomised start of an episode: half widths round the nominal start, uniform."""

    position: wp.vec2
    """Nominal start, world-local x, y [m]."""
    position_range: float
    ahead: float
    """Starts are up to this further along x, uniform [m]."""
    yaw_range: float
    joint_scale_range: float
    """Joint angles are the default pose times 1 +- this."""
    velocity_range: float
    """Each component of the base's linear [m/s] and angular [rad/s] velocity, world frame."""
    base_height: float
    """Base height over the highest ground under the robot [m]."""
    footprint: wp.vec2
    """Half length and half width of the ground under the robot [m]."""


@wp.func
def highest_ground(terrain: Terrain, t: int, centre: wp.vec2, half: wp.vec2) -> float:
    """Highest node [m] of the world-local rectangle ``centre`` +- ``half`` [m]."""
    col0 = int(wp.floor((centre[0] - half[0]) / terrain.spacing))
    col1 = int(wp.ceil((centre[0] + half[0]) / terrain.spacing))
    row0 = int(wp.floor((centre[1] - half[1]) / terrain.spacing))
    row1 = int(wp.ceil((centre[1] + half[1]) / terrain.spacing))
    highest = node_height(terrain, t, row0, col0)
    for row in range(row0, row1 + 1):
        for col in range(col0, col1 + 1):
            highest = wp.max(highest, node_height(terrain, t, row, col))
    return highest


@wp.func
def _write_start(
    rng: wp.uint32, terrain: Terrain, t: int, ranges: StartRanges, sensors: Sensors, env: int,
    joint_q_out: wp.array2d[float], joint_qd_out: wp.array2d[float],
):  # fmt: skip
    """Write the joint coordinates and velocities of a start drawn from ``rng`` (base velocity: at the link origin)."""
    x = ranges.position[0] + ranges.position_range * wp.randf(rng, -1.0, 1.0)
    if ranges.ahead > 0.0:  # else no number is drawn, and starts are those of a crossing
        x += ranges.ahead * wp.randf(rng)
    y = ranges.position[1] + ranges.position_range * wp.randf(rng, -1.0, 1.0)
    half_yaw = 0.5 * ranges.yaw_range * wp.randf(rng, -1.0, 1.0)
    rotation = wp.quat(0.0, 0.0, wp.sin(half_yaw), wp.cos(half_yaw))
    joint_q_out[env, 0] = x
    joint_q_out[env, 1] = y
    joint_q_out[env, 2] = ranges.base_height + highest_ground(terrain, t, wp.vec2(x, y), ranges.footprint)
    for k in range(4):
        joint_q_out[env, 3 + k] = rotation[k]
    for j in range(sensors.default_joint_pos.shape[0]):
        scale = 1.0 + ranges.joint_scale_range * wp.randf(rng, -1.0, 1.0)
        joint_q_out[env, 7 + j] = sensors.default_joint_pos[j] * scale
        joint_qd_out[env, 6 + j] = 0.0
    v = ranges.velocity_range
    lin_vel = wp.vec3(wp.randf(rng, -v, v), wp.randf(rng, -v, v), wp.randf(rng, -v, v))
    ang_vel = wp.vec3(wp.randf(rng, -v, v), wp.randf(rng, -v, v), wp.randf(rng, -v, v))
    com_velocity = velocity_beside(lin_vel, ang_vel, rotation, sensors.base_com)
    for k in range(3):
        joint_qd_out[env, k] = com_velocity[k]
        joint_qd_out[env, 3 + k] = ang_vel[k]


@wp.kernel
def _restart_episodes_kernel(
    mask: wp.array[int],
    terrain_of_env: wp.array[int],
    terrain: Terrain,
    ranges: StartRanges,
    sensors: Sensors,
    joint_q_out: wp.array2d[float],
    joint_qd_out: wp.array2d[float],
    last_action_out: wp.array2d[float],
    episodes_out: Episodes,
    rewards_out: Rewards,
):
    """Grid (num_envs,)."""
    env = wp.tid()
    if mask[env] == 0:
        return
    _write_start(episodes_out.rng[env], terrain, terrain_of_env[env], ranges, sensors, env, joint_q_out, joint_qd_out)
    episodes_out.start[env] = wp.vec2(joint_q_out[env, 0], joint_q_out[env, 1])
    begin_episode(env, episodes_out)
    for j in range(last_action_out.shape[1]):
        last_action_out[env, j] = 0.0
    if rewards_out.total.shape[0] == 0:
        return
    rewards_out.running[env] = 1
    rewards_out.total[env] = 0.0
    for g in range(rewards_out.air_time.shape[1]):
        rewards_out.air_time[env, g] = 0.0
        rewards_out.touched[env, g] = 0


def restart_episodes(
    mask: Any, terrain_of_env: Any, terrain: Terrain, ranges: StartRanges, sensors: Sensors, joint_q_out: Any,
    joint_qd_out: Any, last_action_out: Any, episodes_out: Episodes, rewards_out: Rewards,
) -> None:  # fmt: skip
    """Put robots at a new randomised start where the int ``mask`` (num_envs,) is not 0, and clear their memory.

    Starts are drawn from ``rng`` of the episodes, which run from then on. ``rewards_out`` is empty where nothing is
    rewarded.
    """
    inputs = [mask, terrain_of_env, terrain, ranges, sensors]
    outputs = [joint_q_out, joint_qd_out, last_action_out, episodes_out, rewards_out]
    wp.launch(_restart_episodes_kernel, terrain_of_env.shape[0], inputs, outputs=outputs, device=joint_q_out.device)


@wp.kernel
def _clear_rows_kernel(mask: wp.array[int], stride: int, rows_out: wp.array2d[float]):
    """Grid (num_envs, stride); rows are long and seldom cleared: a thread for each number would mostly read masks."""
    env, first = wp.tid()
    if mask[env] != 0:
        for k in range(first, rows_out.shape[1], stride):
            rows_out[env, k] = 0.0


def clear_rows(mask: Any, rows_out: Any) -> None:
    """Set the rows of ``rows_out`` (num_envs, num_columns) to zero where the int ``mask`` (num_envs,) is not 0."""
    if mask.shape[0] != rows_out.shape[0]:
        raise ValueError(f"mask must have shape ({rows_out.shape[0]},), got {tuple(mask.shape)}")
    stride = min(_CLEARING_THREADS, rows_out.shape[1])
    size = (rows_out.shape[0], stride)
    wp.launch(_clear_rows_kernel, dim=size, inputs=[mask, stride], outputs=[rows_out], device=rows_out.device)
