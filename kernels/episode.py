"""An episode on the device, in crossings and in training: its task, its command, and the latch that ends it."""

import math
from enum import IntEnum

import warp as wp

from kernels.launch import kernel_over, make_zeros
from kernels.penalties import max_base_force
from kernels.state import RobotStep, base_pose, base_yaw, is_too_fast, projected_gravity, row_is_finite, wrap_angle


class Outcome(IntEnum):
    """End of an episode; tilt ends routes, stands and episodes of training only."""

    RUNNING = 0
    GOAL = 1
    """The goal; or the end of the time of a robot that has stood or followed its route, which may leave the terrain."""
    BASE_COLLISION = 2
    TIME_OUT = 3
    OUT = 4
    INVALID = 5
    TILT = 6
    STRAYED = 7
    """Off the motion that a route commands."""


class Kind(IntEnum):
    """What a robot is asked for (:mod:`kernels.route`)."""

    CROSS = 0
    """To reach the goal."""
    ROUTE = 1
    """To move as a sequence of commands says."""
    STAND = 2
    """To stay where it is."""


class Invalidity(IntEnum):
    """Why an episode is invalid; of several reasons the first of ACTION, OVERFLOW, STATE and SPEED."""

    NONE = 0
    ACTION = 1
    STATE = 2
    SPEED = 3
    OVERFLOW = 4


SEGMENTS = 12
"""Segments of equal length that the way of a steered episode has."""
STEERING = ("speed", "offset", "heading")
"""Of a segment: speed [m/s], offset of the way to the left of the straight line [m], heading left of the way [rad]."""
LOOKAHEAD = wp.constant(1.0)
"""Distance ahead of the place that a steered robot is sent to [m]."""
FALLEN_TILT_DEG = 60.0
"""A robot that leans further than this has fallen [degrees], which ends routes and stands."""
FALLEN_GRAVITY_Z = wp.constant(-math.cos(math.radians(FALLEN_TILT_DEG)))
"""Projected gravity at that tilt."""
STAND_RADIUS = wp.constant(0.5)
"""How far from its start a robot may be that was to stand [m]."""
PARKING_HEIGHT = wp.constant(50.0)
"""Height at which robots whose episodes have ended are kept [m]."""


@wp.struct
class Task:
    """Goal, command and limits of an episode; steps are the judged ones."""

    start: wp.vec2
    """Where the straight line to the goal begins, world-local [m]."""
    goal: wp.vec2
    goal_radius: float
    """The episode ends within this distance of the goal [m]; 0 for never."""
    speed: float
    """Commanded speed toward the goal [m/s]."""
    yaw_gain: float
    """Commanded yaw rate per heading error [1/s]."""
    max_yaw_rate: float
    """Largest commanded yaw rate [rad/s]."""
    lowest_command: wp.vec3
    """Least command of a steered episode: v_x, v_y [m/s], yaw rate [rad/s]."""
    highest_command: wp.vec3
    lower: wp.vec2
    """World-local corner of the allowed area [m]; leaving it ends the episode as OUT."""
    upper: wp.vec2
    max_steps: int
    """Steps of the longest episode."""
    first_counted_step: int
    """First step whose penalties count."""
    base_force: float
    """Contact force on the base that counts as a collision [N]."""
    max_gravity_z: float
    """The episode ends where the z of projected gravity exceeds this (-1: upright); 2 for never."""
    max_speed: float
    """A faster robot is invalid [m/s or rad/s]."""
    overflow_mask: int
    """Solver overflow bits that make an episode invalid."""
    max_strayed: int
    """Control steps in a row off the commanded motion by which a route ends."""
    stray_m: float
    """Displacement over two seconds that lies this far from the commanded one is off it [m]."""


@wp.struct
class Episodes:
    """Progress of each environment's episode, shape (num_envs,)."""

    outcome: wp.array[int]
    """:class:`Outcome`, 0 while it runs."""
    invalidity: wp.array[int]
    """:class:`Invalidity` at the end; means nothing while the episode runs."""
    steps: wp.array[int]
    """Steps up to the end."""
    counted: wp.array[int]
    """1 if the penalties of the last step count."""
    base_force: wp.array[float]
    """Largest contact force on the base since the episode was last judged [N]."""
    start: wp.array[wp.vec2]
    """Where the episode began, world-local [m]."""
    deviation: wp.array[float]
    """Largest distance so far from the straight line of the task [m]."""
    final_pose: wp.array[wp.transform]
    """Base pose at the end, world-local frame."""
    rng: wp.array[wp.uint32]
    """Random state of the next start."""
    kind: wp.array[int]
    """:class:`Kind` of the episode."""
    strayed: wp.array[int]
    """Control steps in a row in which it was off the commanded motion."""


def make_episodes(num_envs: int, device: str | None = None) -> Episodes:
    """Allocate episodes that do not run."""
    episodes = make_zeros(Episodes, device, **dict.fromkeys(Episodes.vars, num_envs))
    episodes.outcome.fill_(int(Outcome.TIME_OUT))
    return episodes


@wp.func
def begin_episode(env: int, episodes_out: Episodes):
    """Set an episode running, with no step made."""
    episodes_out.outcome[env] = int(Outcome.RUNNING)
    episodes_out.steps[env] = 0
    episodes_out.counted[env] = 0
    episodes_out.base_force[env] = 0.0
    episodes_out.deviation[env] = 0.0
    episodes_out.strayed[env] = 0
    episodes_out.final_pose[env] = wp.transform_identity()


@kernel_over("mask")
def begin_episodes(mask: wp.array[int], episodes_out: Episodes):
    """Grid (num_envs,): set episodes running where the mask is not 0; moves no robot."""
    env = wp.tid()
    if mask[env] != 0:
        begin_episode(env, episodes_out)


@wp.func
def goal_command(position: wp.vec2, yaw: float, task: Task) -> wp.vec3:
    """Velocity toward the goal in the yaw frame [m/s] and the yaw rate that turns the robot to it [rad/s]."""
    to_goal = task.goal - position
    error = wrap_angle(wp.atan2(to_goal[1], to_goal[0]) - yaw)
    return wp.vec3(
        task.speed * wp.cos(error),
        task.speed * wp.sin(error),
        wp.clamp(task.yaw_gain * error, -task.max_yaw_rate, task.max_yaw_rate),
    )


@wp.func
def steered_command(position: wp.vec2, yaw: float, steering: wp.array3d[float], episode: int, task: Task) -> wp.vec3:
    """Command by the segment reached: pure pursuit of a place ahead on the segment's offset, and in the end the goal.

    Coulter 1992, "Implementation of the Pure Pursuit Path Tracking Algorithm", with velocities in place of an arc.
    """
    line = task.goal - task.start
    length = wp.length(line)
    along = line / length
    reached = wp.dot(position - task.start, along)
    k = wp.clamp(int(wp.floor(reached / length * float(steering.shape[1]))), 0, steering.shape[1] - 1)
    place = task.goal
    if reached + LOOKAHEAD < length:
        place = task.start + (reached + LOOKAHEAD) * along + steering[episode, k, 1] * wp.vec2(-along[1], along[0])
    error = wrap_angle(wp.atan2(place[1] - position[1], place[0] - position[0]) - yaw)
    speed = steering[episode, k, 0]
    turn = task.yaw_gain * wrap_angle(error + steering[episode, k, 2])
    command = wp.vec3(speed * wp.cos(error), speed * wp.sin(error), turn)
    return wp.max(task.lowest_command, wp.min(task.highest_command, command))


@kernel_over("outcome")
def command_goal(joint_q: wp.array2d[float], outcome: wp.array[int], task: Task, command_out: wp.array2d[float]):
    """Grid (num_envs,): write each environment's command, zero once its episode has ended."""
    env = wp.tid()
    command = wp.vec3(0.0)
    if outcome[env] == Outcome.RUNNING:
        command = goal_command(wp.vec2(joint_q[env, 0], joint_q[env, 1]), base_yaw(joint_q, env), task)
    for k in range(3):
        command_out[env, k] = command[k]


@kernel_over("outcome")
def command_steered(
    joint_q: wp.array2d[float],
    outcome: wp.array[int],
    steering: wp.array3d[float],
    episode_of_env: wp.array[int],
    task: Task,
    command_out: wp.array2d[float],
):
    """Grid (num_envs,): replace the commands of running episodes that are steered, whose ``steering`` is not NaN.

    ``steering`` has a row an episode, shape (num_episodes, num_segments, 3): :data:`STEERING`.
    """
    env = wp.tid()
    episode = episode_of_env[env]
    if episode < 0 or outcome[env] != Outcome.RUNNING:
        return
    if wp.isnan(steering[episode, 0, 0]):
        return
    position = wp.vec2(joint_q[env, 0], joint_q[env, 1])
    command = steered_command(position, base_yaw(joint_q, env), steering, episode, task)
    for k in range(3):
        command_out[env, k] = command[k]


@wp.func
def distance_from_line(joint_q: wp.array2d[float], env: int, task: Task) -> float:
    """Distance of the base from the straight line through start and goal [m]."""
    along = wp.normalize(task.goal - task.start)
    return wp.abs(along[0] * (joint_q[env, 1] - task.start[1]) - along[1] * (joint_q[env, 0] - task.start[0]))


@wp.func
def find_invalidity(step: RobotStep, task: Task, env: int) -> int:
    """Why a step is invalid, if it is; causes come before their effects."""
    if not row_is_finite(step.action, env):
        return int(Invalidity.ACTION)
    if (step.overflow[env] & task.overflow_mask) != 0:
        return int(Invalidity.OVERFLOW)
    if not row_is_finite(step.joint_q, env) or not row_is_finite(step.joint_qd, env):
        return int(Invalidity.STATE)
    if is_too_fast(step.joint_qd, env, task.max_speed):
        return int(Invalidity.SPEED)
    return int(Invalidity.NONE)


@wp.func
def judge_state(
    step: RobotStep, base_force: float, invalidity: int, steps: int, task: Task, episodes: Episodes, env: int
) -> int:
    """Outcome of an episode after its ``steps``-th step; the gravest of several wins."""
    if invalidity != Invalidity.NONE:
        return int(Outcome.INVALID)
    if base_force > task.base_force:
        return int(Outcome.BASE_COLLISION)
    if projected_gravity(step.joint_q, env)[2] > task.max_gravity_z:
        return int(Outcome.TILT)
    x = step.joint_q[env, 0]
    y = step.joint_q[env, 1]
    is_out = x < task.lower[0] or x > task.upper[0] or y < task.lower[1] or y > task.upper[1]
    kind = episodes.kind[env]
    if kind != Kind.CROSS:
        if projected_gravity(step.joint_q, env)[2] > FALLEN_GRAVITY_Z:
            return int(Outcome.TILT)
        if kind == Kind.ROUTE and episodes.strayed[env] >= task.max_strayed:
            return int(Outcome.STRAYED)
        if steps < task.max_steps and (kind == Kind.STAND or not is_out):
            return int(Outcome.RUNNING)
        if kind == Kind.STAND and wp.length(episodes.start[env] - wp.vec2(x, y)) > STAND_RADIUS:
            return int(Outcome.STRAYED)
        return int(Outcome.GOAL)
    if wp.length(task.goal - wp.vec2(x, y)) < task.goal_radius:
        return int(Outcome.GOAL)
    if is_out:
        return int(Outcome.OUT)
    if steps >= task.max_steps:
        return int(Outcome.TIME_OUT)
    return int(Outcome.RUNNING)


@kernel_over("episodes_out.base_force")
def note_base_forces(step: RobotStep, episodes_out: Episodes):
    """Grid (num_envs,): raise ``base_force`` to the force on the base, after a physics step that is not judged."""
    env = wp.tid()
    episodes_out.base_force[env] = wp.max(episodes_out.base_force[env], max_base_force(step, env))


@kernel_over("episodes_out.outcome")
def latch_outcomes(step: RobotStep, task: Task, episodes_out: Episodes):
    """Grid (num_envs,): judge every running episode after a step and latch its end; clear the noted ``base_force``."""
    env = wp.tid()
    episodes_out.counted[env] = 0
    if episodes_out.outcome[env] != Outcome.RUNNING:
        return
    steps = episodes_out.steps[env] + 1
    force = wp.max(episodes_out.base_force[env], max_base_force(step, env))
    invalidity = find_invalidity(step, task, env)
    outcome = judge_state(step, force, invalidity, steps, task, episodes_out, env)
    episodes_out.base_force[env] = 0.0
    episodes_out.deviation[env] = wp.max(episodes_out.deviation[env], distance_from_line(step.joint_q, env, task))
    episodes_out.steps[env] = steps
    if outcome != Outcome.INVALID and steps >= task.first_counted_step:
        episodes_out.counted[env] = 1
    if outcome != Outcome.RUNNING:
        episodes_out.outcome[env] = outcome
        episodes_out.invalidity[env] = invalidity
        episodes_out.final_pose[env] = base_pose(step.joint_q, env)


@kernel_over("outcome")
def park_ended(
    outcome: wp.array[int],
    default_joint_pos: wp.array[float],
    joint_q_out: wp.array2d[float],
    joint_qd_out: wp.array2d[float],
    targets_out: wp.array2d[float],
    parked_out: wp.array[int],
):
    """Grid (num_envs,): hold robots whose episodes have ended at rest, high up, where they touch nothing.

    ``parked_out`` says for how many control steps they have been there, 2 for more. From then on the physics leaves
    them out. Call it every control step.
    """
    env = wp.tid()
    if outcome[env] == Outcome.RUNNING:
        parked_out[env] = 0
        return
    parked_out[env] = wp.min(parked_out[env] + 1, 2)
    for k in range(joint_qd_out.shape[1]):
        joint_qd_out[env, k] = 0.0
    for k in range(6):
        joint_q_out[env, k] = 0.0
    joint_q_out[env, 2] = PARKING_HEIGHT
    joint_q_out[env, 6] = 1.0
    for j in range(default_joint_pos.shape[0]):
        joint_q_out[env, 7 + j] = default_joint_pos[j]
        targets_out[env, 7 + j] = default_joint_pos[j]
