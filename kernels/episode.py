"""An episode on the device, in crossings and in training: its task, its command, and the latch that ends it."""

from enum import IntEnum
from typing import Any

import warp as wp

from kernels.penalties import max_base_force
from kernels.state import (
    RobotStep,
    base_position,
    base_rotation,
    base_yaw,
    is_too_fast,
    make_zeros,
    projected_gravity,
    row_is_finite,
    wrap_angle,
)


class Outcome(IntEnum):
    """End of an episode; tilt ends episodes of training only."""

    RUNNING = 0
    GOAL = 1
    BASE_COLLISION = 2
    TIME_OUT = 3
    OUT = 4
    INVALID = 5
    TILT = 6


class Invalidity(IntEnum):
    """Why an episode is invalid; of several reasons the first of ACTION, OVERFLOW, STATE and SPEED."""

    NONE = 0
    ACTION = 1
    STATE = 2
    SPEED = 3
    OVERFLOW = 4


PARKING_HEIGHT = wp.constant(50.0)
"""Height at which robots whose episodes have ended are kept [m]."""


@wp.struct
class Task:
    """Goal, command and limits of an episode; steps are the judged ones."""

    goal: wp.vec2
    goal_radius: float
    """The episode ends within this distance of the goal [m]; 0 for never."""
    speed: float
    """Commanded speed toward the goal [m/s]."""
    yaw_gain: float
    """Commanded yaw rate per heading error [1/s]."""
    max_yaw_rate: float
    """Largest commanded yaw rate [rad/s]."""
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
    final_pose: wp.array[wp.transform]
    """Base pose at the end, world-local frame."""
    rng: wp.array[wp.uint32]
    """Random state of the next start."""


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
    episodes_out.final_pose[env] = wp.transform_identity()


@wp.kernel
def _begin_episodes_kernel(mask: wp.array[int], episodes_out: Episodes):
    """Grid (num_envs,)."""
    env = wp.tid()
    if mask[env] != 0:
        begin_episode(env, episodes_out)


def begin_episodes(mask: Any, episodes_out: Episodes) -> None:
    """Set episodes running where the int ``mask`` (num_envs,) is not 0; moves no robot."""
    wp.launch(_begin_episodes_kernel, mask.shape[0], inputs=[mask], outputs=[episodes_out], device=mask.device)


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


@wp.kernel
def _command_goal_kernel(
    joint_q: wp.array2d[float], outcome: wp.array[int], task: Task, command_out: wp.array2d[float]
):
    """Grid (num_envs,)."""
    env = wp.tid()
    command = wp.vec3(0.0)
    if outcome[env] == Outcome.RUNNING:
        command = goal_command(wp.vec2(joint_q[env, 0], joint_q[env, 1]), base_yaw(joint_q, env), task)
    for k in range(3):
        command_out[env, k] = command[k]


def command_goal(joint_q: Any, outcome: Any, task: Task, command_out: Any) -> None:
    """Write each environment's command, zero once its episode has ended; shape (num_envs, 3)."""
    inputs = [joint_q, outcome, task]
    wp.launch(_command_goal_kernel, outcome.shape[0], inputs, outputs=[command_out], device=joint_q.device)


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
def judge_state(step: RobotStep, base_force: float, invalidity: int, steps: int, task: Task, env: int) -> int:
    """Outcome of an episode after its ``steps``-th step; the gravest of several wins."""
    if invalidity != Invalidity.NONE:
        return int(Outcome.INVALID)
    if base_force > task.base_force:
        return int(Outcome.BASE_COLLISION)
    if projected_gravity(step.joint_q, env)[2] > task.max_gravity_z:
        return int(Outcome.TILT)
    position = base_position(step.joint_q, env)
    if wp.length(task.goal - wp.vec2(position[0], position[1])) < task.goal_radius:
        return int(Outcome.GOAL)
    left_sideways = position[1] < task.lower[1] or position[1] > task.upper[1]
    if left_sideways or position[0] < task.lower[0] or position[0] > task.upper[0]:
        return int(Outcome.OUT)
    if steps >= task.max_steps:
        return int(Outcome.TIME_OUT)
    return int(Outcome.RUNNING)


@wp.kernel
def _note_base_forces_kernel(step: RobotStep, episodes_out: Episodes):
    """Grid (num_envs,)."""
    env = wp.tid()
    force = max_base_force(step.geom_force, step.geom_role, env)
    episodes_out.base_force[env] = wp.max(episodes_out.base_force[env], force)


def note_base_forces(step: RobotStep, episodes_out: Episodes) -> None:
    """Raise ``base_force`` to the contact force on the base, after a physics step that is not judged."""
    forces = step.geom_force
    wp.launch(_note_base_forces_kernel, forces.shape[0], [step], outputs=[episodes_out], device=forces.device)


@wp.kernel
def _latch_outcomes_kernel(step: RobotStep, task: Task, episodes_out: Episodes):
    """Grid (num_envs,)."""
    env = wp.tid()
    episodes_out.counted[env] = 0
    if episodes_out.outcome[env] != Outcome.RUNNING:
        return
    steps = episodes_out.steps[env] + 1
    force = wp.max(episodes_out.base_force[env], max_base_force(step.geom_force, step.geom_role, env))
    invalidity = find_invalidity(step, task, env)
    outcome = judge_state(step, force, invalidity, steps, task, env)
    episodes_out.base_force[env] = 0.0
    episodes_out.steps[env] = steps
    if outcome != Outcome.INVALID and steps >= task.first_counted_step:
        episodes_out.counted[env] = 1
    if outcome != Outcome.RUNNING:
        episodes_out.outcome[env] = outcome
        episodes_out.invalidity[env] = invalidity
        episodes_out.final_pose[env] = wp.transform(base_position(step.joint_q, env), base_rotation(step.joint_q, env))


def latch_outcomes(step: RobotStep, task: Task, episodes_out: Episodes) -> None:
    """Judge every running episode after a step and latch its end; clear the noted ``base_force``."""
    num_envs = step.overflow.shape[0]
    wp.launch(_latch_outcomes_kernel, num_envs, [step, task], outputs=[episodes_out], device=step.overflow.device)


@wp.kernel
def _park_ended_kernel(
    outcome: wp.array[int],
    default_joint_pos: wp.array[float],
    joint_q_out: wp.array2d[float],
    joint_qd_out: wp.array2d[float],
    targets_out: wp.array2d[float],
    parked_out: wp.array[int],
):
    """Grid (num_envs,)."""
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


def park_ended(
    outcome: Any, default_joint_pos: Any, joint_q_out: Any, joint_qd_out: Any, targets_out: Any, parked_out: Any
) -> None:
    """Hold the robots whose episodes have ended at rest, high above the ground, where they touch nothing.

    ``parked_out`` (num_envs,) says for how many control steps they have been there, 2 for more. From then on the
    physics leaves them out. Call it every control step.
    """
    inputs = [outcome, default_joint_pos]
    outputs = [joint_q_out, joint_qd_out, targets_out, parked_out]
    wp.launch(_park_ended_kernel, outcome.shape[0], inputs, outputs=outputs, device=outcome.device)
