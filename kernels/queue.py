"""The queue of episodes: a robot whose episode has ended stores its result, takes the next one and starts anew.

Any number of episodes runs through a fixed number of robots, on the device, without the host. Which robot takes which
episode changes nothing: a start depends on the terrain's seed and the number of the replica alone.

The terrains are a ring of slots. New terrains take the slots behind the former ones: episode number ``n`` since the
ring was empty is replica ``n % num_replicas`` of slot ``n // num_replicas % num_slots``.

In training, too, a robot restarts at a randomised start without memory of the episode before.
"""

from typing import Any

import warp as wp

from kernels.episode import SEGMENTS, STEERING, Episodes, Outcome, begin_episode
from kernels.heightfield import Terrain, node_height
from kernels.launch import kernel_over, launch_grid, make_zeros
from kernels.observation import Sensors
from kernels.rewards import Rewards
from kernels.state import RobotStep, velocity_beside

_CLEARING_THREADS = 64  # a row


@wp.struct
class EpisodeQueue:
    """Waiting episodes, the robots of running ones, and the results of ended ones."""

    num_replicas: int
    """Episodes of a terrain."""
    taken: wp.array[int]
    """Episodes taken since the ring was empty, less whole rounds of it; shape (1,)."""
    ready: wp.array[int]
    """Episodes that may be taken, counted likewise; shape (1,)."""
    seed: wp.array[wp.uint32]
    """Seed of each slot's terrain, shape (num_slots,)."""
    num_ended: wp.array[int]
    """Episodes that have ended on each slot's terrain, shape (num_slots,)."""
    episode_of_env: wp.array[int]
    """Row of the results of each robot's episode, -1 where it waits; shape (num_envs,)."""
    begins: wp.array[int]
    """1 where a robot has just taken an episode, shape (num_envs,)."""
    busy: wp.array[int]
    """Control steps that each robot made for an episode since the host set it to zero, shape (num_envs,)."""
    outcome: wp.array[int]
    """Results, shape (num_slots * num_replicas,): :class:`kernels.episode.Outcome`."""
    invalidity: wp.array[int]
    """:class:`kernels.episode.Invalidity`."""
    steps: wp.array[int]
    """Physics steps up to the end."""
    final_pose: wp.array[wp.transform]
    """Base pose at the end, world-local frame."""
    deviation: wp.array[float]
    """Largest distance from the straight line [m]."""
    penalty_sums: wp.array2d[float]
    """Columns :data:`kernels.penalties.PENALTIES`, times the physics step."""
    reward: wp.array[float]
    """Reward of the whole time; empty where nothing is rewarded."""
    steering: wp.array3d[float]
    """Way of each episode, shape (num_slots * num_replicas, SEGMENTS, 3); empty where none is steered."""


def make_queue(
    num_envs: int, num_slots: int, num_replicas: int, num_penalties: int, *, rewarded: bool, steered: bool, device: str
) -> EpisodeQueue:
    """Allocate an empty queue for ``num_slots`` terrains at once; ``rewarded`` queues keep rewards too."""
    rows = num_slots * num_replicas
    shapes = {"taken": 1, "ready": 1, "penalty_sums": (rows, num_penalties), "reward": rows if rewarded else 0}
    shapes["steering"] = (rows if steered else 0, SEGMENTS, len(STEERING))
    shapes |= dict.fromkeys(("seed", "num_ended"), num_slots)
    shapes |= dict.fromkeys(("episode_of_env", "begins", "busy"), num_envs)
    shapes |= dict.fromkeys(("outcome", "invalidity", "steps", "final_pose", "deviation"), rows)
    queue = make_zeros(EpisodeQueue, device, **shapes)
    queue.num_replicas = num_replicas
    queue.episode_of_env.fill_(-1)
    return queue


def ring_slices(first: int, count: int, size: int) -> tuple[slice, ...]:
    """``count`` slots from ``first`` on, of a ring of ``size``."""
    whole = slice(first, min(first + count, size))
    rest = first + count - size
    return (whole, slice(0, rest)) if rest > 0 else (whole,)


@kernel_over("stepped")
def turn_over(
    stepped: wp.array[int],
    rewards: Rewards,
    episodes_out: Episodes,
    penalty_sums_out: wp.array2d[float],
    terrain_of_env_out: wp.array[int],
    queue_out: EpisodeQueue,
):
    """Grid (num_envs,): store the results of the episodes that ended, and let their robots take the next ones.

    It moves no robot: :func:`restart_episodes` does, where ``begins`` is 1.

    ``stepped`` is the outcome that ends a robot's stepping; it differs from ``episodes_out.outcome`` where a robot goes
    on after its crossing has ended. Where an episode begins, ``rng`` and terrain are written and penalty sums are zero.
    """
    env = wp.tid()
    queue_out.begins[env] = 0
    row = int(queue_out.episode_of_env[env])
    if row >= 0:
        queue_out.busy[env] += 1
    if stepped[env] == Outcome.RUNNING:
        return
    if row >= 0:
        queue_out.outcome[row] = episodes_out.outcome[env]
        queue_out.invalidity[row] = episodes_out.invalidity[env]
        queue_out.steps[row] = episodes_out.steps[env]
        queue_out.final_pose[row] = episodes_out.final_pose[env]
        queue_out.deviation[row] = episodes_out.deviation[env]
        for k in range(penalty_sums_out.shape[1]):
            queue_out.penalty_sums[row, k] = penalty_sums_out[env, k]
        if queue_out.reward.shape[0] > 0:
            queue_out.reward[row] = rewards.total[env]
        wp.atomic_add(queue_out.num_ended, row // queue_out.num_replicas, 1)
        row = -1
    ready = queue_out.ready[0]
    if queue_out.taken[0] < ready:  # waiting robots must not increment it for ever
        number = wp.atomic_add(queue_out.taken, 0, 1)
        if number < ready:
            row = number % (queue_out.seed.shape[0] * queue_out.num_replicas)
    queue_out.episode_of_env[env] = row
    if row < 0:
        return
    slot = row // queue_out.num_replicas
    # The stream depends on the terrain's seed and the replica alone: neither robot nor slot changes an episode.
    episodes_out.rng[env] = wp.rand_init(int(queue_out.seed[slot]), row % queue_out.num_replicas)
    terrain_of_env_out[env] = slot
    queue_out.begins[env] = 1
    for k in range(penalty_sums_out.shape[1]):
        penalty_sums_out[env, k] = 0.0


@kernel_over("queue_out.ready")
def make_ready(count: int, queue_out: EpisodeQueue):
    """Grid (1,): let robots take ``count`` more episodes."""
    ready = queue_out.ready[0]
    taken = wp.min(queue_out.taken[0], ready)  # robots that found none have incremented it
    # Whole rounds change no row; left in, they would outgrow an int in a search of many days.
    size = queue_out.seed.shape[0] * queue_out.num_replicas
    rounds = taken // size * size
    queue_out.taken[0] = taken - rounds
    queue_out.ready[0] = ready - rounds + count


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


@kernel_over("mask")
def restart_episodes(
    mask: wp.array[int],
    terrain_of_env: wp.array[int],
    terrain: Terrain,
    ranges: StartRanges,
    sensors: Sensors,
    step_out: RobotStep,
    episodes_out: Episodes,
    rewards_out: Rewards,
):
    """Grid (num_envs,): put robots at a new randomised start where the mask is not 0, and clear their memory.

    Starts are drawn from ``rng`` of the episodes, which run from then on; base velocities are those of the link's
    origin. ``rewards_out`` is empty where nothing is rewarded.
    """
    env = wp.tid()
    if mask[env] == 0:
        return
    rng = wp.uint32(episodes_out.rng[env])
    x = ranges.position[0] + ranges.position_range * wp.randf(rng, -1.0, 1.0)
    if ranges.ahead > 0.0:  # else no number is drawn, and starts are those of a crossing
        x += ranges.ahead * wp.randf(rng)
    y = ranges.position[1] + ranges.position_range * wp.randf(rng, -1.0, 1.0)
    half_yaw = 0.5 * ranges.yaw_range * wp.randf(rng, -1.0, 1.0)
    rotation = wp.quat(0.0, 0.0, wp.sin(half_yaw), wp.cos(half_yaw))
    ground = highest_ground(terrain, terrain_of_env[env], wp.vec2(x, y), ranges.footprint)
    episodes_out.start[env] = wp.vec2(x, y)
    step_out.joint_q[env, 0] = x
    step_out.joint_q[env, 1] = y
    step_out.joint_q[env, 2] = ranges.base_height + ground
    for k in range(4):
        step_out.joint_q[env, 3 + k] = rotation[k]
    for j in range(sensors.default_joint_pos.shape[0]):
        scale = 1.0 + ranges.joint_scale_range * wp.randf(rng, -1.0, 1.0)
        step_out.joint_q[env, 7 + j] = sensors.default_joint_pos[j] * scale
        step_out.joint_qd[env, 6 + j] = 0.0
        step_out.action[env, j] = 0.0
    v = ranges.velocity_range
    lin_vel = wp.vec3(wp.randf(rng, -v, v), wp.randf(rng, -v, v), wp.randf(rng, -v, v))
    ang_vel = wp.vec3(wp.randf(rng, -v, v), wp.randf(rng, -v, v), wp.randf(rng, -v, v))
    com_velocity = velocity_beside(lin_vel, ang_vel, rotation, step_out.base_com)
    for k in range(3):
        step_out.joint_qd[env, k] = com_velocity[k]
        step_out.joint_qd[env, 3 + k] = ang_vel[k]
    begin_episode(env, episodes_out)
    for g in range(step_out.geom_force.shape[1]):
        step_out.geom_force[env, g] = wp.vec3(0.0)
    for j in range(step_out.joint_torque.shape[1]):
        step_out.joint_torque[env, j] = 0.0
    if rewards_out.total.shape[0] == 0:
        return
    rewards_out.running[env] = 1
    rewards_out.total[env] = 0.0
    for g in range(rewards_out.air_time.shape[1]):
        rewards_out.air_time[env, g] = 0.0
        rewards_out.touched[env, g] = 0


@wp.kernel
def _clear_rows_kernel(mask: wp.array[int], stride: int, rows_out: wp.array2d[float]):
    """Grid (num_envs, stride); rows are long and seldom cleared: a thread for each number would mostly read masks."""
    env, first = wp.tid()
    if mask[env] != 0:
        for k in range(first, rows_out.shape[1], stride):
            rows_out[env, k] = 0.0


def clear_rows(mask: Any, rows_out: Any) -> None:
    """Set the rows of ``rows_out`` (num_envs, num_columns) to zero where the int ``mask`` (num_envs,) is not 0."""
    stride = min(_CLEARING_THREADS, rows_out.shape[1])
    launch_grid(_clear_rows_kernel, (len(mask), stride), [mask, stride, rows_out], rows_out.device)
