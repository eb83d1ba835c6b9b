"""What follows the end of a training episode (curriculum, masked restart), and commands and pushes.

Random numbers come from the counter of :class:`kernels.training.Episodes` and the environment's number alone, so that a
run is repeatable on the CPU and nothing is drawn on the host.
"""

from typing import Any

import warp as wp

from kernels.goal import goal_command
from kernels.heightfield import Terrain
from kernels.rewards import Feet
from kernels.start import StartRanges, place_robot
from kernels.state import base_yaw, wrap_angle
from kernels.training import End, Episodes, Rules

_RUNNING = wp.constant(int(End.RUNNING))
_INVALID = wp.constant(int(End.INVALID))

_STREAM_LEVEL = wp.constant(0)
_STREAM_START = wp.constant(1)
_STREAM_COMMAND = wp.constant(2)
_STREAM_PUSH = wp.constant(3)
_PUSH_STAGGER = wp.constant(7919)  # a prime: pushes meet the environments one after the other


@wp.func
def _random_stream(counter: int, stream: int, num_envs: int, env: int) -> wp.uint32:
    # Observation noise takes the offsets from 0 up (kernels.observation); these lie below.
    return wp.rand_init(counter, -1 - (stream * num_envs + env))


@wp.func
def next_level(level: int, walked: float, commanded_speed: float, drawn: int, rules: Rules) -> int:
    """Terrain level after an episode: up if it walked far, down if it lagged behind; past the last, the drawn one."""
    if walked > rules.promotion_distance:
        return wp.where(level + 1 < rules.num_levels, level + 1, drawn)
    if walked < commanded_speed * rules.demotion_time_s:
        return wp.max(level - 1, 0)
    return level


@wp.kernel
def _promote_episodes_kernel(
    joint_q: wp.array2d[float], rules: Rules, terrain_of_env_out: wp.array[int], episodes_out: Episodes
):
    """Grid (num_envs,)."""
    env = wp.tid()
    end = episodes_out.end[env]
    if end == _RUNNING:
        return
    level = episodes_out.level[env]
    if end != _INVALID:
        rng = _random_stream(episodes_out.counter[0], _STREAM_LEVEL, episodes_out.end.shape[0], env)
        drawn = wp.randi(rng, 0, rules.num_levels)
        walked = wp.length(wp.vec2(joint_q[env, 0], joint_q[env, 1]) - episodes_out.start[env])
        speed = wp.length(wp.vec2(episodes_out.command[env, 0], episodes_out.command[env, 1]))
        level = next_level(level, walked, speed, drawn, rules)
    episodes_out.level[env] = level
    terrain_of_env_out[env] = level * rules.num_columns + episodes_out.column[env]


def promote_episodes(joint_q: Any, rules: Rules, terrain_of_env_out: Any, episodes_out: Episodes) -> None:
    """Move the ended episodes up or down the terrain levels by how far they came; an invalid one stays.

    Args:
        joint_q: Joint coordinates at the end, shape (num_envs, 7 + num_joints).
        rules: Levels, columns and the distances that decide.
        terrain_of_env_out: Tile of each environment, shape (num_envs,).
        episodes_out: Updates ``level``.
    """
    wp.launch(
        _promote_episodes_kernel,
        dim=joint_q.shape[0],
        inputs=[joint_q, rules],
        outputs=[terrain_of_env_out, episodes_out],
        device=joint_q.device,
    )


@wp.kernel
def _restart_episodes_kernel(
    terrain_of_env: wp.array[int],
    terrain: Terrain,
    ranges: StartRanges,
    base_com: wp.vec3,
    default_joint_pos: wp.array[float],
    joint_q_out: wp.array2d[float],
    joint_qd_out: wp.array2d[float],
    feet_out: Feet,
    episodes_out: Episodes,
):
    """Grid (num_envs,)."""
    env = wp.tid()
    if episodes_out.end[env] == _RUNNING:
        return
    rng = _random_stream(episodes_out.counter[0], _STREAM_START, terrain_of_env.shape[0], env)
    t = terrain_of_env[env]
    place_robot(rng, terrain, t, ranges, base_com, default_joint_pos, env, joint_q_out, joint_qd_out)
    episodes_out.start[env] = wp.vec2(joint_q_out[env, 0], joint_q_out[env, 1])
    episodes_out.steps[env] = 0
    episodes_out.total_reward[env] = 0.0
    for j in range(default_joint_pos.shape[0]):
        episodes_out.last_action[env, j] = 0.0
    for g in range(feet_out.air_time.shape[1]):
        feet_out.air_time[env, g] = 0.0
        feet_out.touched[env, g] = 0


def restart_episodes(
    terrain_of_env: Any, terrain: Terrain, ranges: StartRanges, base_com: wp.vec3, default_joint_pos: Any,
    joint_q_out: Any, joint_qd_out: Any, feet_out: Feet, episodes_out: Episodes,
) -> None:  # fmt: skip
    """Put the robots whose episodes ended at a new randomised start, with nothing remembered of the episode before.

    Args:
        terrain_of_env: Terrain of each environment, shape (num_envs,).
        terrain: Height grids.
        ranges: Nominal start and ranges.
        base_com: Mass centre of the base in its frame [m].
        default_joint_pos: Default pose [rad], shape (num_joints,).
        joint_q_out: Joint coordinates, shape (num_envs, 7 + num_joints).
        joint_qd_out: Joint velocities, shape (num_envs, 6 + num_joints).
        feet_out: Contact memory.
        episodes_out: Reads ``end``; restarts ``start``, ``steps``, ``total_reward`` and ``last_action``.
    """
    wp.launch(
        _restart_episodes_kernel,
        dim=terrain_of_env.shape[0],
        inputs=[terrain_of_env, terrain, ranges, base_com, default_joint_pos],
        outputs=[joint_q_out, joint_qd_out, feet_out, episodes_out],
        device=joint_q_out.device,
    )


@wp.func
def _draw_command(rng: wp.uint32, rules: Rules, env: int, episodes_out: Episodes):
    vx = wp.randf(rng, rules.lin_vel_x[0], rules.lin_vel_x[1])
    vy = wp.randf(rng, rules.lin_vel_y[0], rules.lin_vel_y[1])
    episodes_out.heading[env] = wp.randf(rng, -wp.pi, wp.pi)
    moving = wp.where(wp.length(wp.vec2(vx, vy)) > rules.min_speed, 1.0, 0.0)
    episodes_out.command[env, 0] = moving * vx
    episodes_out.command[env, 1] = moving * vy


@wp.kernel
def _command_episodes_kernel(
    rules: Rules, joint_q: wp.array2d[float], joint_qd_out: wp.array2d[float], episodes_out: Episodes
):
    """Grid (num_envs,)."""
    env = wp.tid()
    counter = episodes_out.counter[0]
    num_envs = joint_q.shape[0]
    if rules.crosses == 1:
        command = goal_command(wp.vec2(joint_q[env, 0], joint_q[env, 1]), base_yaw(joint_q, env), rules.crossing)
        for k in range(3):
            episodes_out.command[env, k] = command[k]
    else:
        if episodes_out.steps[env] % rules.command_steps == 0:
            _draw_command(_random_stream(counter, _STREAM_COMMAND, num_envs, env), rules, env, episodes_out)
        error = wrap_angle(episodes_out.heading[env] - base_yaw(joint_q, env))
        episodes_out.command[env, 2] = wp.clamp(rules.yaw_gain * error, -rules.max_yaw_rate, rules.max_yaw_rate)
    if rules.push_steps == 0:
        return
    if (counter + env * _PUSH_STAGGER) % rules.push_steps == 0:
        rng = _random_stream(counter, _STREAM_PUSH, num_envs, env)
        joint_qd_out[env, 0] = wp.randf(rng, -rules.push_speed, rules.push_speed)
        joint_qd_out[env, 1] = wp.randf(rng, -rules.push_speed, rules.push_speed)


def command_episodes(rules: Rules, joint_q: Any, joint_qd_out: Any, episodes_out: Episodes) -> None:
    """Tell every robot what to do next, and push where that is due.

    Where robots cross, the command is to go to the goal; else a new one is drawn where it is due (at the start too),
    and headings become yaw rates.

    Args:
        rules: Ranges and intervals.
        joint_q: Joint coordinates, shape (num_envs, 7 + num_joints).
        joint_qd_out: Joint velocities, shape (num_envs, 6 + num_joints); a push overwrites vx and vy.
        episodes_out: Updates ``heading`` and ``command``.
    """
    wp.launch(
        _command_episodes_kernel,
        dim=joint_q.shape[0],
        inputs=[rules, joint_q],
        outputs=[joint_qd_out, episodes_out],
        device=joint_q.device,
    )


@wp.kernel
def _remember_steps_kernel(joint_qd: wp.array2d[float], episodes_out: Episodes):
    """Grid (num_envs, num_joints)."""
    env, j = wp.tid()
    episodes_out.previous_action[env, j] = episodes_out.last_action[env, j]
    episodes_out.previous_joint_vel[env, j] = joint_qd[env, 6 + j]
    if env == 0 and j == 0:
        episodes_out.counter[0] = episodes_out.counter[0] + 1


def remember_steps(joint_qd: Any, episodes_out: Episodes) -> None:
    """Keep action and joint rates for the next step's rewards, and advance the counter; the last launch of a step."""
    wp.launch(
        _remember_steps_kernel,
        dim=episodes_out.last_action.shape,
        inputs=[joint_qd],
        outputs=[episodes_out],
        device=joint_qd.device,
    )
