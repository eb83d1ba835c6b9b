"""Routes: a robot moves as a sequence of commands says, and is judged by how far it moves in two seconds.

Episodes whose row of conditions (:mod:`kernels.conditions`) ends in a :class:`kernels.episode.Kind` other than 0 are
no crossings. The way of a route are :data:`SEGMENTS` of equal time. Poses are x, y [m] and yaw [rad].
"""

import warp as wp

from kernels.episode import Episodes, Kind, Outcome, Task
from kernels.launch import kernel_over
from kernels.state import base_yaw

SEGMENTS = 5
"""Of a route, each a share of the robot's time."""
WINDOW_S = 2.0
"""Time over which displacements are compared [s]."""
CALM_S = wp.constant(1.0)
"""Time after a push in which a robot may be off the commanded motion [s]."""
LEAST_SPEED = wp.constant(0.1)
"""What commands less of the robot's speed, or less than this yaw rate [rad/s], is a stop."""


@wp.struct
class Trail:
    """How routes were commanded and walked."""

    first: int
    """First of the numbers of segments in a row of conditions: v_x and v_y over the robot's speed, yaw rate [rad/s]."""
    pushes: wp.array[int]
    """First of the numbers of each push in such a row: x, y and time [s]."""
    walked: wp.array2d[wp.vec3]
    """Poses at the last control steps, a ring of shape (num_envs, 1 + steps of the window)."""
    commanded: wp.array2d[wp.vec3]
    """Those of a robot that does just as it is told, from where it started."""
    age: wp.array[int]
    """Control steps of the episode so far, shape (num_envs,)."""
    here: wp.array[wp.vec3]
    """The commanded pose, shape (num_envs,)."""
    error: wp.array[float]
    """Distance of the displacement over the window from the commanded one [m], shape (num_envs,)."""


@wp.func
def displacement(before: wp.vec3, after: wp.vec3) -> wp.vec2:
    """How far a pose moves, in its own frame [m]."""
    x, y = after[0] - before[0], after[1] - before[1]
    c, s = wp.cos(before[2]), wp.sin(before[2])
    return wp.vec2(c * x + s * y, c * y - s * x)


@wp.func
def moved(pose: wp.vec3, command: wp.vec3, dt: float) -> wp.vec3:
    """A pose after ``dt`` of a command in its own frame."""
    yaw = pose[2] + 0.5 * dt * command[2]
    c, s = wp.cos(yaw), wp.sin(yaw)
    velocity = wp.vec3(c * command[0] - s * command[1], s * command[0] + c * command[1], command[2])
    return pose + dt * velocity


@wp.func
def segment_command(row: wp.array[float], first: int, share: float, task: Task) -> wp.vec3:
    """The command of a route after a ``share`` of its time, within the robot's limits."""
    k = first + 3 * wp.min(int(share * float(wp.static(SEGMENTS))), wp.static(SEGMENTS) - 1)
    moves = wp.where(wp.sqrt(row[k] * row[k] + row[k + 1] * row[k + 1]) < LEAST_SPEED, 0.0, task.speed)
    turn = wp.where(wp.abs(row[k + 2]) < LEAST_SPEED, 0.0, row[k + 2])
    command = wp.vec3(moves * row[k], moves * row[k + 1], turn)
    return wp.max(task.lowest_command, wp.min(task.highest_command, command))


@wp.func
def is_pushed(row: wp.array[float], trail: Trail, time: float) -> bool:
    """Whether a push has come within the last second."""
    for k in range(trail.pushes.shape[0]):
        first = trail.pushes[k]
        since = time - row[first + 2]
        if (row[first] != 0.0 or row[first + 1] != 0.0) and since >= 0.0 and since < CALM_S:
            return True
    return False


@kernel_over("trail_out.age")
def follow_routes(
    joint_q: wp.array2d[float],
    row: wp.array2d[float],
    task: Task,
    dt: float,
    episodes_out: Episodes,
    trail_out: Trail,
    command_out: wp.array2d[float],
):
    """Grid (num_envs,): write the commands of the next control step, of ``dt`` [s], of episodes that are no crossings.

    ``strayed`` counts how long those that have a route are off it. Episodes count steps of which ``task.max_steps``
    make the whole time.
    """
    env = wp.tid()
    if episodes_out.steps[env] == 0:
        episodes_out.kind[env] = int(row[env, row.shape[1] - 1])
        trail_out.age[env] = 0
        trail_out.error[env] = 0.0
        trail_out.here[env] = wp.vec3(0.0)
    if episodes_out.kind[env] == Kind.CROSS or episodes_out.outcome[env] != Outcome.RUNNING:
        return
    age, size, here = trail_out.age[env], trail_out.walked.shape[1], trail_out.here[env]
    pose = wp.vec3(joint_q[env, 0], joint_q[env, 1], base_yaw(joint_q, env))
    trail_out.walked[env, age % size] = pose
    trail_out.commanded[env, age % size] = here
    time = float(age) * dt
    if age + 1 >= size:
        oldest = (age + 1) % size
        ours = displacement(trail_out.walked[env, oldest], pose)
        error = wp.length(ours - displacement(trail_out.commanded[env, oldest], here))
        trail_out.error[env] = error
        if not is_pushed(row[env], trail_out, time):
            episodes_out.strayed[env] = wp.where(error > task.stray_m, episodes_out.strayed[env] + 1, 0)
    command = wp.vec3(0.0)
    if episodes_out.kind[env] == Kind.ROUTE:
        share = float(episodes_out.steps[env]) / float(task.max_steps)
        command = segment_command(row[env], trail_out.first, share, task)
    trail_out.here[env] = moved(here, command, dt)
    trail_out.age[env] = age + 1
    for k in range(3):
        command_out[env, k] = command[k]
