"""Conditions under which robots cross: they vary a robot where its episode begins, and disturb its steps.

A terrain has a row of numbers, the values of all conditions (:mod:`sim.terrains.conditions`). A condition has some
of five Warp functions, which read their numbers from column ``first`` on:

    begin(robot: VariedRobots, row: wp.array[float], first: int, terrain: int, env: int)
    meet(step: DisturbedStep, row: wp.array[float], first: int, env: int)
    disturb(step: DisturbedStep, row: wp.array[float], first: int, env: int, column: int)
    drive(step: ForcedStep, row: wp.array[float], first: int, env: int)
    force(step: ForcedStep, row: wp.array[float], first: int, env: int)
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import warp as wp

from kernels.episode import Episodes
from kernels.heightfield import Terrain
from kernels.launch import kernel_over
from kernels.observation import Sensors

Effects = tuple[tuple[Any, int], ...]
"""Warp functions of conditions, each with the column of its first number."""
BASE = wp.constant(1)
"""The solver's number of the base."""
LINKS = wp.constant(6)
"""Largest number of a link (:func:`sim.robots.compiled.number_links`)."""


@wp.struct
class VariedRobots:
    """What conditions may change of the robots, and the base of each by its model. Quaternions are wxyz."""

    base_mass: wp.array[float]
    """By the model [kg], shape (num_envs,), as all up to ``base_inertia``."""
    total_mass: wp.array[float]
    base_centre: wp.array[wp.vec3]
    base_frame: wp.array[wp.quat]
    """Principal axes of the inertia."""
    base_inertia: wp.array[wp.vec3]
    drive_delay: int
    """Physics steps after which a target counts by the model."""
    physics_dt: float
    body_mass: wp.array2d[float]
    """As simulated [kg], shape (num_envs, num_bodies), as all up to ``body_inertia``."""
    body_subtreemass: wp.array2d[float]
    body_ipos: wp.array2d[wp.vec3]
    body_iquat: wp.array2d[wp.quat]
    body_inertia: wp.array2d[wp.vec3]
    strength: wp.array[float]
    """Factor of the torques of all motors and of their limits, shape (num_envs,)."""
    delay_steps: wp.array[int]
    """Physics steps after which a target counts, shape (num_envs,)."""
    friction: wp.array[float]
    """Factor of all friction on a terrain, shape (num_terrains,)."""
    is_misled: wp.array[int]
    """Whether the height scan reads a wrong map, shape (num_envs,)."""


@wp.struct
class MapView:
    """Where a height scan reads its map: point (x, y) of the scan at origin + x axis + y (axis turned to the left)."""

    origin: wp.vec2
    """World-local [m]."""
    axis: wp.vec2
    height: float
    """Of the base over the map's zero [m]."""
    tilt: wp.vec2
    """How much higher the base seems over a point for each metre that it lies ahead and to the left."""


@wp.struct
class Disturbed:
    """What the conditions of running episodes remember."""

    row: wp.array2d[float]
    """Conditions of each robot, shape (num_envs, number of values)."""
    noise: wp.array[float]
    """Half widths of legged_gym's noise, shape (observation_size,)."""
    former: wp.array3d[float]
    """Observations of the last control steps, shape (num_envs, 1 + max_lag_steps, observation_size)."""
    steps: wp.array[int]
    """Physics steps since the episode began, shape (num_envs,)."""
    map_pose: wp.array2d[wp.spatial_vector]
    """Where the height map had the robot at the last control steps, shape (num_envs, 1 + max_map_steps)."""
    map_drift: wp.array2d[wp.spatial_vector]
    """Drift of the map over its size, of this control step and the next in turns, shape (num_envs, 2)."""
    map_view: wp.array[MapView]
    """Where the scan reads the map in this control step, shape (num_envs,)."""
    held: wp.array2d[float]
    """Height of the base over the ground as each scan point last had it [m], shape (num_envs, num_scan_points)."""
    is_misled: wp.array[int]
    """That of :class:`VariedRobots`."""


@wp.struct
class DisturbedStep:
    """A control step to disturb."""

    memory: Disturbed
    episodes: Episodes
    dt: float
    """Length of the steps that the episodes count [s]."""
    every: int
    """How many of them are a control step."""
    decimation: int
    """How many physics steps are."""
    joint_q: wp.array2d[float]
    joint_qd: wp.array2d[float]
    terrain: Terrain
    terrain_of_env: wp.array[int]
    sensors: Sensors
    observation: wp.array2d[float]


@wp.struct
class ForcedStep:
    """A physics step, to change targets or add forces: arrays of the solver under its names, a row a world."""

    memory: Disturbed
    dt: float
    """Length of a physics step [s]."""
    links: wp.array[int]
    """Bodies by their numbers (:func:`sim.robots.compiled.number_links`), shape (2 * LINKS + 1,)."""
    arm_actuators: wp.array[int]
    """Actuators of the robot's ``arm_joints``, shape (num_arm_joints,)."""
    arm_ends: wp.array[int]
    """Outermost bodies of the arms, shape (num_arms,)."""
    ctrl: wp.array2d[float]
    """Joint targets in effect [rad]."""
    gravity: wp.array[wp.vec3]
    body_rootid: wp.array[int]
    body_isdofancestor: wp.array2d[int]
    """Whether a body moves with a dof, shape (num_bodies, num_dofs)."""
    body_subtreemass: wp.array2d[float]
    body_ipos: wp.array2d[wp.vec3]
    xpos: wp.array2d[wp.vec3]
    xquat: wp.array2d[wp.quat]
    subtree_com: wp.array2d[wp.vec3]
    cdof: wp.array2d[wp.spatial_vector]
    qfrc_smooth: wp.array2d[float]


@wp.func
def age_of(step: DisturbedStep, env: int) -> int:
    """Control steps since the episode began."""
    return step.memory.steps[env] // step.decimation


@wp.func
def push_body(step: ForcedStep, env: int, body: int, force: wp.vec3):
    """Add a force [N], world frame, at the mass centre of a body."""
    wxyz = step.xquat[env, body]
    turn = wp.quat(wxyz[1], wxyz[2], wxyz[3], wxyz[0])
    centre = step.xpos[env, body] + wp.quat_rotate(turn, step.body_ipos[env, body])
    moment = wp.cross(centre - step.subtree_com[env, step.body_rootid[body]], force)
    for n in range(step.qfrc_smooth.shape[1]):
        if step.body_isdofancestor[body, n] != 0:
            step.qfrc_smooth[env, n] += wp.dot(step.cdof[env, n], wp.spatial_vector(moment, force))


@cache
def make_begin(effects: Effects) -> Callable[..., None]:
    """What varies robots by the conditions of their terrains where ``begins`` (num_envs,) is not 0.

    ``conditions`` has shape (num_terrains, number of values). The weights by which the solver softens constraints stay
    those of the robot by its model.
    """

    @kernel_over("begins", module="unique")
    def begin_conditions(
        begins: wp.array[int],
        terrain_of_env: wp.array[int],
        conditions: wp.array2d[float],
        robots_out: VariedRobots,
        disturbed_out: Disturbed,
    ):
        """Grid (num_envs,)."""
        env = wp.tid()
        if begins[env] == 0:
            return
        t = terrain_of_env[env]
        for k in range(conditions.shape[1]):
            disturbed_out.row[env, k] = conditions[t, k]
        disturbed_out.steps[env] = 0
        for k in range(wp.static(len(effects))):
            wp.static(effects[k][0])(robots_out, conditions[t], wp.static(effects[k][1]), t, env)

    return begin_conditions


@cache
def make_robot_stage(effects: Effects, struct: Any, counts: bool = False) -> Callable[..., None]:
    """What acts on each robot in a stage, by a step of the type ``struct``; the one that ``counts`` ends a step.

    The stage ``meet`` changes velocities before a control step, or remembers; ``drive`` changes the joint targets in
    effect before the dynamics find forces by them; ``force`` adds forces before constraints are solved.
    """

    @kernel_over("step.memory.steps", module="unique")
    def act(step: struct):
        """Grid (num_envs,)."""
        env = wp.tid()
        for k in range(wp.static(len(effects))):
            wp.static(effects[k][0])(step, step.memory.row[env], wp.static(effects[k][1]), env)
        if wp.static(counts):
            step.memory.steps[env] += 1

    return act


@cache
def make_disturb(effects: Effects) -> Callable[..., None]:
    """What disturbs the observation of the next control step."""

    @kernel_over("step.observation", module="unique")
    def disturb(step: DisturbedStep):
        """Grid (num_envs, num_columns): the columns of an observation."""
        env, column = wp.tid()
        for k in range(wp.static(len(effects))):
            wp.static(effects[k][0])(step, step.memory.row[env], wp.static(effects[k][1]), env, column)

    return disturb
