"""Conditions under which a robot crosses: payload, weak motors, delays, noise, a push.

They belong to a terrain, as its ground does: a row of numbers each (:class:`Condition`). Where an episode begins its
robot is made as the row says, on the device.
"""

from enum import IntEnum
from typing import Any

import warp as wp

from kernels.coordinates import Delay
from kernels.dynamics import Robots, Tree
from kernels.episode import Episodes, Outcome
from kernels.observation import Noise, noise_width


class Condition(IntEnum):
    """Columns of a row of conditions."""

    PAYLOAD = 0
    """Mass on the base, over that of the robot."""
    PAYLOAD_X = 1
    """Where it is, from the base's mass centre, ahead [m, base frame]."""
    PAYLOAD_Y = 2
    """... to the left [m]."""
    PAYLOAD_Z = 3
    """... above [m]."""
    STRENGTH = 4
    """Factor of the torques of all motors, and of their limits."""
    DELAY = 5
    """Time after which an action counts, beside the robot's own [s]."""
    LAG = 6
    """Age of what the controller observes [s]."""
    NOISE = 7
    """Noise of observations, over legged_gym's (:class:`Noise`)."""
    PUSH_X = 8
    """Velocity that a push adds to the base, along the way [m/s]."""
    PUSH_Y = 9
    """... to the left of the way [m/s]."""
    PUSH_TIME = 10
    """When the robot is pushed, from the episode's beginning [s]."""
    FRICTION = 11
    """Factor of the friction of all contacts."""


BASE = wp.constant(1)
"""The solver's number of the base."""


@wp.struct
class Nominal:
    """The base of each robot by its model, shape (num_envs,), quaternions wxyz."""

    mass: wp.array[float]
    total_mass: wp.array[float]
    """Of the robot."""
    centre: wp.array[wp.vec3]
    frame: wp.array[wp.quat]
    """Principal axes of the inertia."""
    inertia: wp.array[wp.vec3]


@wp.struct
class Disturbed:
    """What the conditions of running episodes need, shape (num_envs, ...)."""

    row: wp.array2d[float]
    """Conditions of each robot."""
    noise: Noise
    """Half widths at a factor of 1."""
    former: wp.array3d[float]
    """Observations of the last control steps, shape (num_envs, 1 + most steps, observation_size)."""
    age: wp.array2d[int]
    """Observations since the episode began, shape (num_envs, observation_size): each column counts for itself."""


@wp.func
def _spread(d: wp.vec3) -> wp.mat33:
    """Inertia of a unit mass at ``d`` [m]."""
    return wp.length_sq(d) * wp.identity(n=3, dtype=float) - wp.outer(d, d)


@wp.kernel
def _begin_conditions_kernel(
    begins: wp.array[int],
    terrain_of_env: wp.array[int],
    conditions: wp.array2d[float],
    nominal: Nominal,
    own_delay: int,
    physics_dt: float,
    tree_out: Tree,
    robots_out: Robots,
    delay_out: Delay,
    disturbed_out: Disturbed,
):
    """Grid (num_envs,)."""
    env = wp.tid()
    if begins[env] == 0:
        return
    t = terrain_of_env[env]
    for k in range(conditions.shape[1]):
        disturbed_out.row[env, k] = conditions[t, k]
    for k in range(disturbed_out.age.shape[1]):
        disturbed_out.age[env, k] = 0
    delay_out.steps[env] = own_delay + int(wp.round(conditions[t, int(Condition.DELAY)] / physics_dt))
    robots_out.strength[env] = conditions[t, int(Condition.STRENGTH)]
    mass, rotation = nominal.mass[env], nominal.frame[env]
    added = wp.max(conditions[t, int(Condition.PAYLOAD)] * nominal.total_mass[env], -0.5 * mass)
    frame = wp.quat(rotation[0], rotation[1], rotation[2], rotation[3])
    moved, moments = wp.vec3(0.0), 1.0 * nominal.inertia[env]
    if added < 0.0:  # less of the base itself
        moments *= (mass + added) / mass
    if added > 0.0:
        offset = wp.vec3(
            conditions[t, int(Condition.PAYLOAD_X)],
            conditions[t, int(Condition.PAYLOAD_Y)],
            conditions[t, int(Condition.PAYLOAD_Z)],
        )
        moved = (added / (mass + added)) * offset
        to_base = wp.quat_to_matrix(wp.quat(rotation[1], rotation[2], rotation[3], rotation[0]))
        inertia = to_base * wp.diag(moments) * wp.transpose(to_base)
        inertia += mass * _spread(moved) + added * _spread(offset - moved)
        axes, principal = wp.eig3(inertia)
        turned = wp.quat_from_matrix(axes)
        frame = wp.quat(turned[3], turned[0], turned[1], turned[2])
        moments = principal
    tree_out.body_mass[env, BASE] = mass + added
    tree_out.subtree_mass[env, BASE] = nominal.total_mass[env] + added
    tree_out.body_ipos[env, BASE] = nominal.centre[env] + moved
    tree_out.body_iquat[env, BASE] = frame
    tree_out.body_inertia[env, BASE] = moments


def begin_conditions(
    begins: Any, terrain_of_env: Any, conditions: Any, nominal: Nominal, own_delay: int, physics_dt: float,
    tree_out: Tree, robots_out: Robots, delay_out: Delay, disturbed_out: Disturbed,
) -> None:  # fmt: skip
    """Make robots as the conditions of their terrains, (num_terrains, 12), say where ``begins`` (num_envs,) is not 0.

    A payload is a point mass; a negative one leaves less of the base, half of it at least. The weights by which the
    solver softens constraints stay those of the robot without it.
    """
    inputs = [begins, terrain_of_env, conditions, nominal, own_delay, physics_dt]
    outputs = [tree_out, robots_out, delay_out, disturbed_out]
    wp.launch(_begin_conditions_kernel, begins.shape[0], inputs, outputs=outputs, device=begins.device)


@wp.kernel
def _disturb_kernel(
    episodes: Episodes, num_joints: int, dt: float, every: int, disturbed_out: Disturbed,
    joint_qd_out: wp.array2d[float], observation_out: wp.array2d[float],
):  # fmt: skip
    """Grid (num_envs, num_columns): the columns of an observation, and with the first one the push."""
    env, k = wp.tid()
    if k == 0 and episodes.outcome[env] == Outcome.RUNNING:
        due = int(wp.round(disturbed_out.row[env, int(Condition.PUSH_TIME)] / dt))
        steps = episodes.steps[env]
        if steps <= due and due < steps + every:
            joint_qd_out[env, 0] += disturbed_out.row[env, int(Condition.PUSH_X)]
            joint_qd_out[env, 1] += disturbed_out.row[env, int(Condition.PUSH_Y)]
    age = disturbed_out.age[env, k]
    factor = disturbed_out.row[env, int(Condition.NOISE)]
    if factor > 0.0:
        # Of the episode's own stream, so that neither robot nor slot changes an episode.
        state = wp.rand_init(int(episodes.rng[env]), age * observation_out.shape[1] + k)
        observation_out[env, k] += factor * noise_width(disturbed_out.noise, k, num_joints) * wp.randf(state, -1.0, 1.0)
    lag = int(wp.round(disturbed_out.row[env, int(Condition.LAG)] / (float(every) * dt)))
    if lag > 0:
        size = disturbed_out.former.shape[1]
        disturbed_out.former[env, age % size, k] = observation_out[env, k]
        observation_out[env, k] = disturbed_out.former[env, wp.max(age - lag, 0) % size, k]
    disturbed_out.age[env, k] = age + 1


def disturb(
    episodes: Episodes, num_joints: int, dt: float, every: int, disturbed_out: Disturbed, joint_qd_out: Any,
    observation_out: Any,
) -> None:  # fmt: skip
    """Push robots whose time comes in the next control step, and disturb what all observe.

    A push is a kick of the base's velocity, joint_qd (num_envs, 6 + num_joints), which is observed a step later.
    Observations, (num_envs, num_columns), get noise, and those of ``LAG`` ago are shown: the first ones until there are
    some so old. Episodes count steps of ``dt`` [s], ``every`` of them in a control step.
    """
    inputs, outputs = [episodes, num_joints, dt, every], [disturbed_out, joint_qd_out, observation_out]
    shape, device = observation_out.shape, observation_out.device
    wp.launch(_disturb_kernel, shape, inputs, outputs=outputs, device=device)
