"""Training's additions to an episode: levels of terrain, random commands, pushes, and statistics of progress.

Random numbers come from the counter of :class:`TrainingState` and the environment's number alone: a run is repeatable
on the CPU, and nothing is drawn on the host.
"""

from typing import Any

import warp as wp

from kernels.episode import Episodes, Outcome, Task, goal_command
from kernels.launch import kernel_over, make_zeros
from kernels.rewards import Rewards
from kernels.state import RobotStep, base_ang_vel_b, base_lin_vel_b, base_yaw, wrap_angle

_OUTCOMES = tuple(outcome.name.lower() for outcome in Outcome if outcome != Outcome.RUNNING)
_SUMS = ("overflow", "episode_steps", "episode_reward", "lin_vel_error", "yaw_rate_error")
STATISTICS = ("steps", "episodes", *_OUTCOMES, *_SUMS)
"""Columns of the sums that training progress is read from; the outcomes count episodes."""
_COLUMN = {name: column for column, name in enumerate(STATISTICS)}

_STREAM_LEVEL = wp.constant(0)
_STREAM_START = wp.constant(1)
_STREAM_COMMAND = wp.constant(2)
_STREAM_PUSH = wp.constant(3)
_PUSH_STAGGER = wp.constant(7919)  # a prime: pushes meet the environments one after the other


@wp.struct
class Rules:
    """Commands, pushes and restarts; steps are control steps."""

    crosses: int
    """1: commands lead to the goal of the task; 0: commands are random velocities and headings."""
    overflow_mask: int
    """Overflow bits that count."""
    num_levels: int
    num_columns: int
    """Tile ``level * num_columns + column`` is the terrain of an environment."""
    promotion_distance: float
    """A robot that walks farther goes one level up [m]."""
    demotion_time_s: float
    """A robot that walks less than the commanded speed times this goes one level down."""
    command_steps: int
    """Steps from command to command."""
    lin_vel_x: wp.vec2
    """Range of the commanded vx [m/s]."""
    lin_vel_y: wp.vec2
    min_speed: float
    """Slower commands become 0 [m/s]."""
    push_steps: int
    """Steps from push to push; 0 for none."""
    push_speed: float
    """A push sets vx and vy of the mass centre to +- this, world frame [m/s]."""


@wp.struct
class TrainingState:
    """State of training beside the episodes, shape (num_envs,) unless noted here or in :mod:`kernels`."""

    counter: wp.array[int]
    """Control steps so far, counted from a seed: what all random numbers come from; shape (1,)."""
    ended: wp.array[int]
    """:class:`kernels.episode.Outcome` of the step just made: the episode itself has restarted since."""
    level: wp.array[int]
    column: wp.array[int]
    heading: wp.array[float]
    """Commanded heading [rad]."""
    command: wp.array2d[float]
    action: wp.array2d[float]
    last_action: wp.array2d[float]
    observation: wp.array2d[float]
    """Next input of the policy, shape (num_envs, observation_size)."""
    statistics: wp.array2d[float]
    """Sums since they were last cleared, columns :data:`STATISTICS`; shape (num_envs, len(STATISTICS))."""


def make_training(
    columns: Any, levels: Any, *, num_joints: int, observation_size: int, first_count: int, device: str
) -> TrainingState:
    """Allocate the state, zero but for terrain columns and levels, (num_envs,), and the first count."""
    num_envs = len(columns)
    widths = {"command": 3, "observation": observation_size, "statistics": len(STATISTICS)}
    widths |= {"action": num_joints, "last_action": num_joints}
    shapes = {name: (num_envs, width) for name, width in widths.items()}
    training = make_zeros(TrainingState, device, ended=num_envs, heading=num_envs, **shapes)
    training.counter = wp.array([first_count], dtype=int, device=device)
    training.column = wp.array(columns, dtype=int, device=device)
    training.level = wp.array(levels, dtype=int, device=device)
    return training


@kernel_over("episodes.outcome")
def record_steps(step: RobotStep, rules: Rules, episodes: Episodes, rewards: Rewards, training_out: TrainingState):
    """Grid (num_envs,): keep the outcome of a judged and rewarded step, and add it to the statistics."""
    env = wp.tid()
    outcome = episodes.outcome[env]
    training_out.ended[env] = outcome
    training_out.statistics[env, wp.static(_COLUMN["steps"])] += 1.0
    if outcome != Outcome.RUNNING:
        training_out.statistics[env, wp.static(_COLUMN["episodes"])] += 1.0
        training_out.statistics[env, wp.static(_COLUMN["goal"] - int(Outcome.GOAL)) + outcome] += 1.0
        training_out.statistics[env, wp.static(_COLUMN["episode_steps"])] += float(episodes.steps[env])
        training_out.statistics[env, wp.static(_COLUMN["episode_reward"])] += rewards.total[env]
    if (step.overflow[env] & rules.overflow_mask) != 0:
        training_out.statistics[env, wp.static(_COLUMN["overflow"])] += 1.0
    if outcome != Outcome.INVALID:
        lin_vel = base_lin_vel_b(step, env)
        ang_vel = base_ang_vel_b(step.joint_q, step.joint_qd, env)
        error = wp.vec2(lin_vel[0] - training_out.command[env, 0], lin_vel[1] - training_out.command[env, 1])
        training_out.statistics[env, wp.static(_COLUMN["lin_vel_error"])] += wp.length(error)
        error_yaw = wp.abs(ang_vel[2] - training_out.command[env, 2])
        training_out.statistics[env, wp.static(_COLUMN["yaw_rate_error"])] += error_yaw


@wp.func
def _random_stream(counter: int, stream: int, num_envs: int, env: int) -> wp.uint32:
    # Observation noise takes the offsets from 0 up (kernels.observation); these lie below.
    return wp.rand_init(counter, -1 - (stream * num_envs + env))


@kernel_over("terrain_of_env_out")
def promote_episodes(
    joint_q: wp.array2d[float],
    episodes: Episodes,
    rules: Rules,
    terrain_of_env_out: wp.array[int],
    training_out: TrainingState,
):
    """Grid (num_envs,): move ended episodes a level up if they walked far, down if they lagged behind.

    Past the last level follows a drawn one; invalid episodes stay.
    """
    env = wp.tid()
    outcome = episodes.outcome[env]
    if outcome == Outcome.RUNNING:
        return
    level = training_out.level[env]
    if outcome != Outcome.INVALID:
        rng = _random_stream(training_out.counter[0], _STREAM_LEVEL, joint_q.shape[0], env)
        drawn = wp.randi(rng, 0, rules.num_levels)
        walked = wp.length(wp.vec2(joint_q[env, 0], joint_q[env, 1]) - episodes.start[env])
        speed = wp.length(wp.vec2(training_out.command[env, 0], training_out.command[env, 1]))
        if walked > rules.promotion_distance:
            level = wp.where(level + 1 < rules.num_levels, level + 1, drawn)
        elif walked < speed * rules.demotion_time_s:
            level = wp.max(level - 1, 0)
    training_out.level[env] = level
    terrain_of_env_out[env] = level * rules.num_columns + training_out.column[env]


@kernel_over("episodes_out.rng")
def seed_restarts(training: TrainingState, episodes_out: Episodes):
    """Grid (num_envs,): give episodes that begin at this control step ``rng`` by its counter; they keep it."""
    env = wp.tid()
    num_envs = episodes_out.rng.shape[0]
    if training.ended[env] != 0:
        episodes_out.rng[env] = _random_stream(training.counter[0], _STREAM_START, num_envs, env)


@kernel_over("episodes.steps")
def command_episodes(
    joint_q: wp.array2d[float],
    episodes: Episodes,
    rules: Rules,
    task: Task,
    joint_qd_out: wp.array2d[float],
    training_out: TrainingState,
):
    """Grid (num_envs,): write the next command of every robot, and push where a push is due.

    Where robots cross, the command is to go to the goal; else a new one is drawn where it is due (at the start too),
    and headings become yaw rates. A push overwrites vx and vy of ``joint_qd_out``.
    """
    env = wp.tid()
    counter = training_out.counter[0]
    num_envs = joint_q.shape[0]
    if rules.crosses == 1:
        command = goal_command(wp.vec2(joint_q[env, 0], joint_q[env, 1]), base_yaw(joint_q, env), task)
        for k in range(3):
            training_out.command[env, k] = command[k]
    else:
        if episodes.steps[env] % rules.command_steps == 0:
            drawn = _random_stream(counter, _STREAM_COMMAND, num_envs, env)
            vx = wp.randf(drawn, rules.lin_vel_x[0], rules.lin_vel_x[1])
            vy = wp.randf(drawn, rules.lin_vel_y[0], rules.lin_vel_y[1])
            training_out.heading[env] = wp.randf(drawn, -wp.pi, wp.pi)
            moving = wp.where(wp.length(wp.vec2(vx, vy)) > rules.min_speed, 1.0, 0.0)
            training_out.command[env, 0] = moving * vx
            training_out.command[env, 1] = moving * vy
        error = wrap_angle(training_out.heading[env] - base_yaw(joint_q, env))
        training_out.command[env, 2] = wp.clamp(task.yaw_gain * error, -task.max_yaw_rate, task.max_yaw_rate)
    if rules.push_steps == 0:
        return
    if (counter + env * _PUSH_STAGGER) % rules.push_steps == 0:
        rng = _random_stream(counter, _STREAM_PUSH, num_envs, env)
        joint_qd_out[env, 0] = wp.randf(rng, -rules.push_speed, rules.push_speed)
        joint_qd_out[env, 1] = wp.randf(rng, -rules.push_speed, rules.push_speed)
