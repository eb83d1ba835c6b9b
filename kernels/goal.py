"""Where a crossing leads: the goal, what is told on the way to it, and the borders of the world."""

import warp as wp

from kernels.state import wrap_angle


@wp.struct
class Task:
    """Goal, speed and limits of a crossing."""

    goal: wp.vec2
    goal_radius: float
    speed: float
    """Commanded speed [m/s]."""
    yaw_gain: float
    max_yaw_rate: float
    lower: wp.vec2
    """World-local corner of the allowed area [m]; leaving it ends the episode as OUT."""
    upper: wp.vec2
    max_steps: int
    """Physics steps of the longest episode."""
    first_counted_step: int
    """Penalties count from this physics step on."""
    base_force: float
    """Contact force on the base that counts as a collision [N]."""
    max_speed: float
    """Any velocity beyond is invalid [m/s or rad/s]."""
    overflow_mask: int
    """Solver overflow bits that make an episode invalid."""


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
def is_at_goal(position: wp.vec3, task: Task) -> bool:
    """Whether a base there, world-local [m], has reached the goal."""
    return wp.length(task.goal - wp.vec2(position[0], position[1])) < task.goal_radius


@wp.func
def is_out(position: wp.vec3, task: Task) -> bool:
    """Whether a base there, world-local [m], has left the world."""
    beside = position[1] < task.lower[1] or position[1] > task.upper[1]
    return beside or position[0] < task.lower[0] or position[0] > task.upper[0]
