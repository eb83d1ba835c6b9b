"""Episodes of the command-following task on the device: their state, their ends, and the statistics of training.

What follows an end (curriculum, restart, commands, pushes) is in :mod:`kernels.restart`.
"""

from enum import IntEnum
from typing import Any

import warp as wp

from kernels.goal import Task, is_at_goal, is_out
from kernels.penalties import max_base_force
from kernels.rewards import REWARDS
from kernels.state import base_ang_vel_b, base_lin_vel_b, base_position, projected_gravity, state_is_invalid


class End(IntEnum):
    """How a training episode ended in the step just made."""

    RUNNING = 0
    TIME_OUT = 1
    BASE_COLLISION = 2
    TILT = 3
    INVALID = 4
    GOAL = 5
    OUT = 6


STATISTICS = (
    "steps", "episodes", "time_out", "base_collision", "tilt", "invalid", "goal", "out", "overflow",
    "episode_steps", "episode_reward", "lin_vel_error", "yaw_rate_error",
)  # fmt: skip
"""Columns of the sums that training progress is read from; the six ends count episodes."""

_RUNNING = wp.constant(int(End.RUNNING))
_TIME_OUT = wp.constant(int(End.TIME_OUT))
_BASE_COLLISION = wp.constant(int(End.BASE_COLLISION))
_TILT = wp.constant(int(End.TILT))
_INVALID = wp.constant(int(End.INVALID))
_GOAL = wp.constant(int(End.GOAL))
_OUT = wp.constant(int(End.OUT))
# Columns of STATISTICS as a kernel needs them.
_STEPS = wp.constant(STATISTICS.index("steps"))
_EPISODES = wp.constant(STATISTICS.index("episodes"))
_ENDS = wp.constant(STATISTICS.index("time_out") - int(End.TIME_OUT))
_OVERFLOW = wp.constant(STATISTICS.index("overflow"))
_EPISODE_STEPS = wp.constant(STATISTICS.index("episode_steps"))
_EPISODE_REWARD = wp.constant(STATISTICS.index("episode_reward"))
_LIN_VEL_ERROR = wp.constant(STATISTICS.index("lin_vel_error"))
_YAW_RATE_ERROR = wp.constant(STATISTICS.index("yaw_rate_error"))


@wp.struct
class Rules:
    """Limits, ranges and intervals of the task; steps are control steps."""

    max_steps: int
    """Longest episode."""
    base_force: float
    """Contact force on the base that ends an episode [N]."""
    max_gravity_z: float
    """Tilt ends an episode where the projected gravity's z exceeds this (-1: upright)."""
    max_speed: float
    """Any velocity beyond is invalid [m/s or rad/s]."""
    overflow_mask: int
    """Solver overflow bits that are counted."""
    num_levels: int
    num_columns: int
    """Tile ``level * num_columns + column`` is the terrain of an environment."""
    promotion_distance: float
    """Walked farther [m]: one level up."""
    demotion_time_s: float
    """Walked less than the commanded speed times this: one level down."""
    command_steps: int
    """A new command every so often."""
    lin_vel_x: wp.vec2
    """Range of the commanded vx [m/s]."""
    lin_vel_y: wp.vec2
    min_speed: float
    """Slower commands become 0 [m/s]."""
    yaw_gain: float
    max_yaw_rate: float
    push_steps: int
    """A push every so often; 0 for none."""
    push_speed: float
    """A push sets vx and vy of the mass centre to +- this, world frame [m/s]."""
    crosses: int
    """1: robots are told to go to a goal, where their episode ends; 0: they are told random velocities and headings."""
    crossing: Task
    """The goal and what is told on the way to it; of its ends, the goal and the borders of the world count."""


@wp.struct
class Episodes:
    """Progress of each environment's episode, shape (num_envs,) unless said otherwise."""

    counter: wp.array[int]
    """Control steps so far, counted from a seed: what all random numbers come from; shape (1,)."""
    end: wp.array[int]
    """How the episode ended in the step just made (:class:`End`)."""
    valid: wp.array[int]
    """0 where the step ended in a state not to be trusted."""
    fallen: wp.array[int]
    """1 where the step ended the episode by a base collision, by tilt or in an invalid state."""
    base_force: wp.array[float]
    """Largest contact force on the base noted since the last control step was judged [N]."""
    steps: wp.array[int]
    """Control steps of the episode."""
    level: wp.array[int]
    column: wp.array[int]
    start: wp.array[wp.vec2]
    """Where the episode began, world-local [m]."""
    heading: wp.array[float]
    """Commanded heading [rad]."""
    command: wp.array2d[float]
    """vx, vy [m/s], yaw rate [rad/s]; shape (num_envs, 3)."""
    last_action: wp.array2d[float]
    """Clipped action of the step, shape (num_envs, num_joints)."""
    previous_action: wp.array2d[float]
    previous_joint_vel: wp.array2d[float]
    action: wp.array2d[float]
    """What the policy put out, shape (num_envs, num_joints)."""
    observation: wp.array2d[float]
    """What the policy sees next, shape (num_envs, observation_size)."""
    reward: wp.array[float]
    """Reward of the step just made."""
    reward_terms: wp.array2d[float]
    """Sums of the weighted terms since they were last cleared, shape (num_envs, len(REWARDS))."""
    total_reward: wp.array[float]
    """Reward of the episode so far."""
    statistics: wp.array2d[float]
    """Sums since they were last cleared, columns :data:`STATISTICS`; shape (num_envs, len(STATISTICS))."""


def make_episodes(
    columns: Any, levels: Any, *, num_joints: int, observation_size: int, first_count: int, device: str
) -> Episodes:
    """Allocate the state of the episodes, all zero but for what is given.

    Args:
        columns: Terrain column of each environment, integers of shape (num_envs,).
        levels: Terrain level of each environment, likewise.
        num_joints: Number of actuated joints.
        observation_size: Columns of the observation.
        first_count: Where the counter starts: a number drawn from the seed.
        device: Warp device name.
    """
    num_envs = len(columns)
    episodes = Episodes()
    episodes.counter = wp.array([first_count], dtype=int, device=device)
    episodes.column = wp.array(columns, dtype=int, device=device)
    episodes.level = wp.array(levels, dtype=int, device=device)
    episodes.start = wp.zeros(num_envs, dtype=wp.vec2, device=device)
    for name in ("end", "valid", "fallen", "steps"):
        setattr(episodes, name, wp.zeros(num_envs, dtype=int, device=device))
    for name in ("heading", "reward", "total_reward", "base_force"):
        setattr(episodes, name, wp.zeros(num_envs, dtype=float, device=device))
    widths = {"command": 3, "observation": observation_size}
    widths |= {"statistics": len(STATISTICS), "reward_terms": len(REWARDS)}
    widths |= dict.fromkeys(("action", "last_action", "previous_action", "previous_joint_vel"), num_joints)
    for name, width in widths.items():
        setattr(episodes, name, wp.zeros((num_envs, width), dtype=float, device=device))
    return episodes


@wp.func
def judge_state(
    joint_q: wp.array2d[float], joint_qd: wp.array2d[float], base_force: float, steps: int, rules: Rules, env: int
) -> int:
    """:class:`End` of an episode after its ``steps``-th control step; the gravest of several wins."""
    if state_is_invalid(joint_q, joint_qd, env, rules.max_speed):
        return _INVALID
    if base_force > rules.base_force:
        return _BASE_COLLISION
    if projected_gravity(joint_q, env)[2] > rules.max_gravity_z:
        return _TILT
    if rules.crosses == 1:
        if is_at_goal(base_position(joint_q, env), rules.crossing):
            return _GOAL
        if is_out(base_position(joint_q, env), rules.crossing):
            return _OUT
    if steps >= rules.max_steps:
        return _TIME_OUT
    return _RUNNING


@wp.kernel
def _note_base_forces_kernel(geom_force: wp.array2d[wp.vec3], geom_role: wp.array[int], episodes_out: Episodes):
    """Grid (num_envs,)."""
    env = wp.tid()
    episodes_out.base_force[env] = wp.max(episodes_out.base_force[env], max_base_force(geom_force, geom_role, env))


def note_base_forces(geom_force: Any, geom_role: Any, episodes_out: Episodes) -> None:
    """Note how hard the bases are touched, for :func:`judge_steps`, after each physics step in which a touch counts.

    Args:
        geom_force: Contact forces of the physics step, world frame [N], shape (num_envs, num_geoms).
        geom_role: Role bits of :mod:`kernels.penalties`, shape (num_geoms,).
        episodes_out: Raises ``base_force``.
    """
    inputs, device = [geom_force, geom_role], geom_force.device
    wp.launch(_note_base_forces_kernel, geom_force.shape[0], inputs, outputs=[episodes_out], device=device)


@wp.kernel
def _judge_steps_kernel(
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
    rules: Rules,
    episodes_out: Episodes,
):
    """Grid (num_envs,)."""
    env = wp.tid()
    steps = episodes_out.steps[env] + 1
    end = judge_state(joint_q, joint_qd, episodes_out.base_force[env], steps, rules, env)
    episodes_out.base_force[env] = 0.0
    episodes_out.steps[env] = steps
    episodes_out.end[env] = end
    episodes_out.valid[env] = wp.where(end == _INVALID, 0, 1)
    # An invalid state costs what a fall does: were it free, falling robots would learn to whip their legs too fast.
    stands = end != _TILT and end != _BASE_COLLISION and end != _INVALID
    episodes_out.fallen[env] = wp.where(stands, 0, 1)


def judge_steps(joint_q: Any, joint_qd: Any, rules: Rules, episodes_out: Episodes) -> None:
    """Count a control step and judge which episodes end with it.

    Args:
        joint_q: Joint coordinates after the step, shape (num_envs, 7 + num_joints).
        joint_qd: Joint velocities after the step, shape (num_envs, 6 + num_joints).
        rules: Limits.
        episodes_out: Writes ``steps``, ``end``, ``valid`` and ``fallen``; forgets what forces were noted.
    """
    wp.launch(
        _judge_steps_kernel,
        dim=joint_q.shape[0],
        inputs=[joint_q, joint_qd, rules],
        outputs=[episodes_out],
        device=joint_q.device,
    )


@wp.kernel
def _record_steps_kernel(
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
    base_com: wp.vec3,
    overflow: wp.array[int],
    rules: Rules,
    episodes_out: Episodes,
):
    """Grid (num_envs,)."""
    env = wp.tid()
    end = episodes_out.end[env]
    episodes_out.total_reward[env] += episodes_out.reward[env]
    episodes_out.statistics[env, _STEPS] += 1.0
    if end != _RUNNING:
        episodes_out.statistics[env, _EPISODES] += 1.0
        episodes_out.statistics[env, _ENDS + end] += 1.0
        episodes_out.statistics[env, _EPISODE_STEPS] += float(episodes_out.steps[env])
        episodes_out.statistics[env, _EPISODE_REWARD] += episodes_out.total_reward[env]
    if (overflow[env] & rules.overflow_mask) != 0:
        episodes_out.statistics[env, _OVERFLOW] += 1.0
    if end != _INVALID:
        lin_vel = base_lin_vel_b(joint_q, joint_qd, base_com, env)
        ang_vel = base_ang_vel_b(joint_q, joint_qd, env)
        error = wp.vec2(lin_vel[0] - episodes_out.command[env, 0], lin_vel[1] - episodes_out.command[env, 1])
        episodes_out.statistics[env, _LIN_VEL_ERROR] += wp.length(error)
        episodes_out.statistics[env, _YAW_RATE_ERROR] += wp.abs(ang_vel[2] - episodes_out.command[env, 2])


def record_steps(
    joint_q: Any, joint_qd: Any, base_com: wp.vec3, overflow: Any, rules: Rules, episodes_out: Episodes
) -> None:
    """Add a judged and rewarded step to ``episodes_out.statistics`` and ``total_reward``.

    Args:
        joint_q: Joint coordinates after the step, shape (num_envs, 7 + num_joints).
        joint_qd: Joint velocities after the step, shape (num_envs, 6 + num_joints).
        base_com: Mass centre of the base in its frame [m].
        overflow: Solver overflow bits of the last physics step, shape (num_envs,).
        rules: Which bits count.
        episodes_out: Updated.
    """
    wp.launch(
        _record_steps_kernel,
        dim=joint_q.shape[0],
        inputs=[joint_q, joint_qd, base_com, overflow, rules],
        outputs=[episodes_out],
        device=joint_q.device,
    )
