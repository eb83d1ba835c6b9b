"""The randomised start of an episode: one robot over the highest ground under it."""

import warp as wp

from kernels.heightfield import Terrain, node_height


@wp.struct
class StartRanges:
    """Randomised start of an episode: half widths round the nominal start, uniform."""

    position: wp.vec2
    """Nominal start, world-local x, y [m]."""
    position_range: float
    yaw_range: float
    joint_scale_range: float
    """Joint angles are the default pose times 1 +- this."""
    velocity_range: float
    """Each component of the base's linear [m/s] and angular [rad/s] velocity, world frame."""
    base_height: float
    """Base height over the highest ground under the robot [m]."""
    footprint: wp.vec2
    """Half length and half width of the ground looked at [m]."""


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
def place_robot(
    rng: wp.uint32, terrain: Terrain, t: int, ranges: StartRanges, base_com: wp.vec3,
    default_joint_pos: wp.array[float], env: int, joint_q_out: wp.array2d[float], joint_qd_out: wp.array2d[float],
):  # fmt: skip
    """Write the joint coordinates and velocities of a start drawn from ``rng`` (base velocity: at the link origin)."""
    x = ranges.position[0] + ranges.position_range * wp.randf(rng, -1.0, 1.0)
    y = ranges.position[1] + ranges.position_range * wp.randf(rng, -1.0, 1.0)
    half_yaw = 0.5 * ranges.yaw_range * wp.randf(rng, -1.0, 1.0)
    rotation = wp.quat(0.0, 0.0, wp.sin(half_yaw), wp.cos(half_yaw))
    joint_q_out[env, 0] = x
    joint_q_out[env, 1] = y
    joint_q_out[env, 2] = ranges.base_height + highest_ground(terrain, t, wp.vec2(x, y), ranges.footprint)
    for k in range(4):
        joint_q_out[env, 3 + k] = rotation[k]
    for j in range(default_joint_pos.shape[0]):
        joint_q_out[env, 7 + j] = default_joint_pos[j] * (1.0 + ranges.joint_scale_range * wp.randf(rng, -1.0, 1.0))
        joint_qd_out[env, 6 + j] = 0.0
    v = ranges.velocity_range
    lin_vel = wp.vec3(wp.randf(rng, -v, v), wp.randf(rng, -v, v), wp.randf(rng, -v, v))
    ang_vel = wp.vec3(wp.randf(rng, -v, v), wp.randf(rng, -v, v), wp.randf(rng, -v, v))
    of_com = lin_vel + wp.cross(ang_vel, wp.quat_rotate(rotation, base_com))
    for k in range(3):
        joint_qd_out[env, k] = of_com[k]
        joint_qd_out[env, 3 + k] = ang_vel[k]
