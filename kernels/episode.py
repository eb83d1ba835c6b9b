"""A crossing on the device: randomised start, goal command, and the latch that ends an episode once and for all."""

from enum import IntEnum
from typing import Any

import warp as wp

from kernels.goal import Task, goal_command, is_at_goal, is_out
from kernels.heightfield import Terrain
from kernels.penalties import max_base_force
from kernels.start import StartRanges, place_robot
from kernels.state import base_position, base_yaw, state_is_invalid


class Outcome(IntEnum):
    """How an episode ended."""

    RUNNING = 0
    GOAL = 1
    BASE_COLLISION = 2
    TIME_OUT = 3
    OUT = 4
    INVALID = 5


_RUNNING = wp.constant(int(Outcome.RUNNING))
_GOAL = wp.constant(int(Outcome.GOAL))
_BASE_COLLISION = wp.constant(int(Outcome.BASE_COLLISION))
_TIME_OUT = wp.constant(int(Outcome.TIME_OUT))
_OUT = wp.constant(int(Outcome.OUT))
_INVALID = wp.constant(int(Outcome.INVALID))

PARKING_HEIGHT = wp.constant(50.0)
"""Height at which robots whose episodes have ended are kept [m]."""


@wp.struct
class EpisodeState:
    """Progress of each environment's episode, shape (num_envs,) each."""

    outcome: wp.array[int]
    steps: wp.array[int]
    """Physics steps made up to the end."""
    counted: wp.array[int]
    """1 if the step just made counts for the penalties."""
    final_pose: wp.array[wp.transform]
    """Base pose at the end, world-local frame."""
    num_running: wp.array[int]
    """Episodes not yet ended, shape (1,)."""


@wp.kernel
def _start_episodes_kernel(
    seed_of_terrain: wp.array[wp.uint32],
    terrain_of_env: wp.array[int],
    num_replicas: int,
    terrain: Terrain,
    ranges: StartRanges,
    base_com: wp.vec3,
    default_joint_pos: wp.array[float],
    joint_q_out: wp.array2d[float],
    joint_qd_out: wp.array2d[float],
    episode_out: EpisodeState,
):
    """Grid (num_envs,)."""
    env = wp.tid()
    t = terrain_of_env[env]
    # The stream depends on the terrain's seed and the replica alone: sharding terrains changes no episode.
    rng = wp.rand_init(int(seed_of_terrain[t]), env % num_replicas)
    place_robot(rng, terrain, t, ranges, base_com, default_joint_pos, env, joint_q_out, joint_qd_out)
    episode_out.outcome[env] = _RUNNING
    episode_out.steps[env] = 0
    episode_out.counted[env] = 0
    episode_out.final_pose[env] = wp.transform_identity()
    wp.atomic_add(episode_out.num_running, 0, 1)


def start_episodes(
    seed_of_terrain: Any, terrain_of_env: Any, num_replicas: int, terrain: Terrain, ranges: StartRanges,
    base_com: wp.vec3, default_joint_pos: Any, joint_q_out: Any, joint_qd_out: Any, episode_out: EpisodeState,
) -> None:  # fmt: skip
    """Put every robot at its randomised start; replica r of terrain t draws from the stream (seed of t, r).

    Args:
        seed_of_terrain: uint32 seeds, shape (num_terrains,).
        terrain_of_env: Terrain of each environment, shape (num_envs,).
        num_replicas: Episodes a terrain; the replica of an environment is ``env % num_replicas``.
        terrain: Height grids.
        ranges: Nominal start and ranges.
        base_com: Mass centre of the base in its frame [m].
        default_joint_pos: Default pose [rad], shape (num_joints,).
        joint_q_out: Shape (num_envs, 7 + num_joints).
        joint_qd_out: Shape (num_envs, 6 + num_joints).
        episode_out: Set to running, zero steps.
    """
    episode_out.num_running.zero_()
    wp.launch(
        _start_episodes_kernel,
        dim=terrain_of_env.shape[0],
        inputs=[seed_of_terrain, terrain_of_env, num_replicas, terrain, ranges, base_com, default_joint_pos],
        outputs=[joint_q_out, joint_qd_out, episode_out],
        device=joint_q_out.device,
    )


@wp.kernel
def _command_goal_kernel(
    joint_q: wp.array2d[float], outcome: wp.array[int], task: Task, command_out: wp.array2d[float]
):
    """Grid (num_envs,)."""
    env = wp.tid()
    command = wp.vec3(0.0)
    if outcome[env] == _RUNNING:
        command = goal_command(wp.vec2(joint_q[env, 0], joint_q[env, 1]), base_yaw(joint_q, env), task)
    for k in range(3):
        command_out[env, k] = command[k]


def command_goal(joint_q: Any, outcome: Any, task: Task, command_out: Any) -> None:
    """Write each environment's command, zero once its episode has ended; shape (num_envs, 3)."""
    wp.launch(
        _command_goal_kernel,
        dim=outcome.shape[0],
        inputs=[joint_q, outcome, task],
        outputs=[command_out],
        device=joint_q.device,
    )


@wp.func
def judge_step(
    joint_q: wp.array2d[float], joint_qd: wp.array2d[float], base_force: float, overflow: int, steps: int,
    task: Task, env: int,
) -> int:  # fmt: skip
    """Outcome of an episode after its ``steps``-th physics step; the gravest of several wins."""
    if (overflow & task.overflow_mask) != 0 or state_is_invalid(joint_q, joint_qd, env, task.max_speed):
        return _INVALID
    if base_force > task.base_force:
        return _BASE_COLLISION
    position = base_position(joint_q, env)
    if is_at_goal(position, task):
        return _GOAL
    if is_out(position, task):
        return _OUT
    if steps >= task.max_steps:
        return _TIME_OUT
    return _RUNNING


@wp.kernel
def _park_ended_kernel(
    outcome: wp.array[int],
    default_joint_pos: wp.array[float],
    joint_q_out: wp.array2d[float],
    joint_qd_out: wp.array2d[float],
    targets_out: wp.array2d[float],
    body_q_out: wp.array2d[wp.transform],
):
    """Grid (num_envs,)."""
    env = wp.tid()
    if outcome[env] == _RUNNING:
        return
    for k in range(joint_qd_out.shape[1]):
        joint_qd_out[env, k] = 0.0
    for k in range(6):
        joint_q_out[env, k] = 0.0
    joint_q_out[env, 2] = PARKING_HEIGHT
    joint_q_out[env, 6] = 1.0
    for j in range(default_joint_pos.shape[0]):
        joint_q_out[env, 7 + j] = default_joint_pos[j]
        targets_out[env, 7 + j] = default_joint_pos[j]
    for b in range(body_q_out.shape[1]):  # or the next contacts would be those of where it was
        body_q_out[env, b] = wp.transform(wp.vec3(0.0, 0.0, PARKING_HEIGHT), wp.quat_identity())


def park_ended(
    outcome: Any, default_joint_pos: Any, joint_q_out: Any, joint_qd_out: Any, targets_out: Any, body_q_out: Any
) -> None:
    """Hold the robots whose episodes have ended at rest, high above the ground, where they touch nothing.

    Left to walk on they would cost as much as the others, and robots on their backs more than that. To be called every
    control step: in between they fall by millimetres.

    Args:
        outcome: Shape (num_envs,).
        default_joint_pos: Default pose [rad], shape (num_joints,).
        joint_q_out: Shape (num_envs, 7 + num_joints).
        joint_qd_out: Shape (num_envs, 6 + num_joints).
        targets_out: Joint targets in columns 7 and up, shape (num_envs, 7 + num_joints).
        body_q_out: Body poses, shape (num_envs, num_bodies).
    """
    wp.launch(
        _park_ended_kernel,
        dim=outcome.shape[0],
        inputs=[outcome, default_joint_pos],
        outputs=[joint_q_out, joint_qd_out, targets_out, body_q_out],
        device=outcome.device,
    )


@wp.kernel
def _latch_outcomes_kernel(
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
    geom_force: wp.array2d[wp.vec3],
    geom_role: wp.array[int],
    overflow: wp.array[int],
    contact_count: wp.array[int],
    contact_capacity: int,
    task: Task,
    episode_out: EpisodeState,
):
    """Grid (num_envs,)."""
    env = wp.tid()
    episode_out.counted[env] = 0
    if episode_out.outcome[env] != _RUNNING:
        return
    steps = episode_out.steps[env] + 1
    bits = overflow[env]
    if contact_count[0] > contact_capacity:
        bits = task.overflow_mask  # nobody knows whose contacts were dropped, so nobody's episode is trusted
    outcome = judge_step(joint_q, joint_qd, max_base_force(geom_force, geom_role, env), bits, steps, task, env)
    episode_out.steps[env] = steps
    if outcome != _INVALID and steps >= task.first_counted_step:
        episode_out.counted[env] = 1
    if outcome != _RUNNING:
        episode_out.outcome[env] = outcome
        episode_out.final_pose[env] = wp.transform(
            base_position(joint_q, env), wp.quat(joint_q[env, 3], joint_q[env, 4], joint_q[env, 5], joint_q[env, 6])
        )
        wp.atomic_sub(episode_out.num_running, 0, 1)


def latch_outcomes(
    joint_q: Any, joint_qd: Any, geom_force: Any, geom_role: Any, overflow: Any, contact_count: Any,
    contact_capacity: int, task: Task, episode_out: EpisodeState,
) -> None:  # fmt: skip
    """Judge every running episode after a physics step and latch its end.

    Args:
        joint_q: Joint coordinates after the step, shape (num_envs, 7 + num_joints).
        joint_qd: Joint velocities after the step, shape (num_envs, 6 + num_joints).
        geom_force: Contact forces, world frame [N], shape (num_envs, num_geoms).
        geom_role: Role bits of :mod:`kernels.penalties`, shape (num_geoms,).
        overflow: Solver overflow bits of the step, shape (num_envs,).
        contact_count: Terrain contacts found in the step, shape (1,).
        contact_capacity: Contacts that fit.
        task: Goal and limits.
        episode_out: Updated in place.
    """
    wp.launch(
        _latch_outcomes_kernel,
        dim=overflow.shape[0],
        inputs=[joint_q, joint_qd, geom_force, geom_role, overflow, contact_count, contact_capacity, task],
        outputs=[episode_out],
        device=joint_q.device,
    )
