"""Conversion between our state, targets and contacts and the data of mujoco_warp, in a physics step.

Our coordinates are those of :mod:`kernels.state`. mujoco_warp has the base's quaternion as wxyz, its velocity at the
base's origin, and its rotation rate in the base's frame. All other joints have one axis and the same numbers in both.
"""

from typing import Any

import warp as wp

from kernels.contact import Contacts, Surfaces, vec5
from kernels.launch import kernel_over, launch_grid
from kernels.state import base_ang_vel_b, base_rotation, velocity_beside


@wp.struct
class SolverState:
    """Arrays of mujoco_warp's data, and the columns of joints and targets in them."""

    qpos: wp.array2d[float]
    """Coordinates, shape (num_envs, 7 + num_joints)."""
    qvel: wp.array2d[float]
    """Velocities, shape (num_envs, 6 + num_joints)."""
    ctrl: wp.array2d[float]
    """Controls of the actuators, shape (num_envs, num_actuators)."""
    column_of_joint: wp.array[int]
    """Column of each joint in ``qpos``, shape (num_joints,); in ``qvel`` it is one less."""
    target_of_actuator: wp.array[int]
    """Column in the targets of each actuator, shape (num_actuators,); -1 for none."""
    base_com: wp.vec3


@wp.struct
class Delay:
    """Targets that take effect later; empty where all take effect at once."""

    steps: wp.array[int]
    """Physics steps until a target takes effect, shape (num_envs,)."""
    age: wp.array2d[int]
    """Physics steps since the episode began, shape (num_envs, num_actuators)."""
    former: wp.array3d[float]
    """Targets of the last steps [rad], shape (num_envs, 1 + max steps, num_actuators)."""
    at_first: wp.array[float]
    """Joint targets in effect before the first one is [rad], shape (num_joints,)."""


@wp.func
def _due_target(target: float, at_first: float, env: int, actuator: int, delay_out: Delay) -> float:
    """Keep the target of a physics step, and return the one in effect."""
    if delay_out.steps[env] == 0:
        return target
    age = delay_out.age[env, actuator]
    size = delay_out.former.shape[1]
    due = age - delay_out.steps[env]
    delay_out.former[env, age % size, actuator] = target
    delay_out.age[env, actuator] = age + 1
    if due < 0:
        return at_first
    return delay_out.former[env, due % size, actuator]


@wp.kernel
def _to_solver_kernel(
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
    targets: wp.array2d[float],
    has_state: bool,
    delay_out: Delay,
    solver_out: SolverState,
):
    """Grid (num_envs, 1 + the larger of num_joints and num_actuators): the base, then a joint and an actuator each."""
    env, thread = wp.tid()
    k = thread - 1
    if k >= 0:
        if not has_state and k < solver_out.column_of_joint.shape[0]:
            column = solver_out.column_of_joint[k]
            solver_out.qpos[env, column] = joint_q[env, 7 + k]
            solver_out.qvel[env, column - 1] = joint_qd[env, 6 + k]
        if k < solver_out.target_of_actuator.shape[0]:
            column = solver_out.target_of_actuator[k]
            if column >= 0:
                target = targets[env, column]
                if delay_out.steps.shape[0] > 0:
                    target = _due_target(target, delay_out.at_first[column - 7], env, k, delay_out)
                solver_out.ctrl[env, k] = target
        return
    if has_state:
        return
    com_velocity = wp.vec3(joint_qd[env, 0], joint_qd[env, 1], joint_qd[env, 2])
    rate = wp.vec3(joint_qd[env, 3], joint_qd[env, 4], joint_qd[env, 5])
    velocity = velocity_beside(com_velocity, rate, base_rotation(joint_q, env), -solver_out.base_com)
    rate_b = base_ang_vel_b(joint_q, joint_qd, env)
    for axis in range(3):
        solver_out.qpos[env, axis] = joint_q[env, axis]
        solver_out.qpos[env, 4 + axis] = joint_q[env, 3 + axis]
        solver_out.qvel[env, axis] = velocity[axis]
        solver_out.qvel[env, 3 + axis] = rate_b[axis]
    solver_out.qpos[env, 3] = joint_q[env, 6]


def to_solver(
    joint_q: Any, joint_qd: Any, targets: Any, delay_out: Delay, solver_out: SolverState, *, has_state: bool = False
) -> None:
    """Write coordinates and velocities, unless it ``has_state``, and the targets in effect to mujoco_warp's data."""
    threads = 1 + max(len(solver_out.column_of_joint), len(solver_out.target_of_actuator))
    inputs = [joint_q, joint_qd, targets, has_state, delay_out, solver_out]
    launch_grid(_to_solver_kernel, (len(joint_q), threads), inputs, joint_q.device)


@kernel_over("ranges_out")
def limit_torques(
    joint_qd: wp.array2d[float], solver: SolverState, motors: wp.array[wp.vec3], ranges_out: wp.array2d[wp.vec2]
):
    """Grid (num_envs, num_actuators): write the torque limits [N m] of DC motors at the present velocities.

    ``motors`` are effort limit [N m], stall torque [N m] and speed limit [rad/s] of each, shape (num_actuators,).
    """
    env, k = wp.tid()
    effort = motors[k][0]
    saturation = motors[k][1]
    lost = saturation * joint_qd[env, solver.target_of_actuator[k] - 1] / motors[k][2]
    lower = wp.clamp(-saturation - lost, -effort, effort)
    upper = wp.clamp(saturation - lost, -effort, effort)
    ranges_out[env, k] = wp.vec2(lower, upper)


@wp.kernel
def _from_solver_kernel(solver: SolverState, joint_q_out: wp.array2d[float], joint_qd_out: wp.array2d[float]):
    """Grid (num_envs, 1 + num_joints): the base, then a joint each."""
    env, thread = wp.tid()
    k = thread - 1
    if k >= 0:
        column = solver.column_of_joint[k]
        joint_q_out[env, 7 + k] = solver.qpos[env, column]
        joint_qd_out[env, 6 + k] = solver.qvel[env, column - 1]
        return
    for axis in range(3):
        joint_q_out[env, axis] = solver.qpos[env, axis]
        joint_q_out[env, 3 + axis] = solver.qpos[env, 4 + axis]
    joint_q_out[env, 6] = solver.qpos[env, 3]
    rotation = base_rotation(joint_q_out, env)
    rate = wp.quat_rotate(rotation, wp.vec3(solver.qvel[env, 3], solver.qvel[env, 4], solver.qvel[env, 5]))
    origin_velocity = wp.vec3(solver.qvel[env, 0], solver.qvel[env, 1], solver.qvel[env, 2])
    velocity = velocity_beside(origin_velocity, rate, rotation, solver.base_com)
    for axis in range(3):
        joint_qd_out[env, axis] = velocity[axis]
        joint_qd_out[env, 3 + axis] = rate[axis]


def from_solver(solver: SolverState, joint_q_out: Any, joint_qd_out: Any) -> None:
    """Read coordinates and velocities from mujoco_warp's data."""
    size = (len(joint_q_out), 1 + len(solver.column_of_joint))
    launch_grid(_from_solver_kernel, size, [solver, joint_q_out, joint_qd_out], joint_q_out.device)


@wp.struct
class SolverContacts:
    """mujoco_warp's contacts, and the forces on its rows of constraints."""

    count: wp.array[int]
    worldid: wp.array[int]
    geom: wp.array[wp.vec2i]
    dist: wp.array[float]
    pos: wp.array[wp.vec3]
    frame: wp.array[wp.mat33]
    """Rows: normal (toward the second geom) and two tangents, world frame."""
    dim: wp.array[int]
    friction: wp.array[vec5]
    solref: wp.array[wp.vec2]
    solimp: wp.array[vec5]
    efc_address: wp.array2d[int]
    """Rows of each contact; negative where the contact is inactive."""
    efc_force: wp.array2d[float]
    overflow: wp.array[int]
    too_many: int
    """Overflow bit for too many contacts."""
    ground: int
    """Geom of the ground."""
    slot: wp.array2d[int]
    """Index of each contact of a robot in the arrays above, shape (num_envs, capacity)."""


@kernel_over("contacts.shape")
def contacts_to_solver(contacts: Contacts, surfaces: Surfaces, solver_out: SolverContacts):
    """Grid (num_envs, capacity): write terrain contacts into mujoco_warp's data, whose ``count`` is 0."""
    env, c = wp.tid()
    if c == 0:
        solver_out.overflow[env] = 0
        if contacts.count[env] > contacts.shape.shape[1]:
            solver_out.overflow[env] = solver_out.too_many
    if c >= contacts.count[env]:
        return
    slot = wp.atomic_add(solver_out.count, 0, 1)
    shape = contacts.shape[env, c]
    friction = surfaces.friction[env % surfaces.friction.shape[0], shape]
    solref = surfaces.solref[env % surfaces.solref.shape[0], shape]
    solimp = surfaces.solimp[env % surfaces.solimp.shape[0], shape]
    factor = contacts.friction[env, c]
    friction[0] *= factor
    friction[1] *= factor
    if contacts.time_constant[env, c] > wp.max(solref[0], 0.0):
        solref = wp.vec2(contacts.time_constant[env, c], 1.0)
        solimp[0] = solimp[1]
    solver_out.slot[env, c] = slot
    solver_out.worldid[slot] = env
    solver_out.geom[slot] = wp.vec2i(solver_out.ground, surfaces.geom[shape])
    solver_out.dist[slot] = contacts.distance[env, c]
    solver_out.pos[slot] = contacts.point[env, c]
    normal = contacts.normal[env, c]
    axis = wp.vec3(0.0, 1.0, 0.0)
    if wp.abs(normal[1]) >= 0.5:
        axis = wp.vec3(0.0, 0.0, 1.0)
    tangent = wp.normalize(axis - normal * wp.dot(normal, axis))
    solver_out.frame[slot] = wp.matrix_from_rows(normal, tangent, wp.cross(normal, tangent))
    solver_out.dim[slot] = surfaces.condim[shape]
    solver_out.friction[slot] = friction
    solver_out.solref[slot] = solref
    solver_out.solimp[slot] = solimp
    for row in range(solver_out.efc_address.shape[1]):
        solver_out.efc_address[slot, row] = -1


@kernel_over("contacts_out.shape")
def forces_from_solver(solver: SolverContacts, contacts_out: Contacts):
    """Grid (num_envs, capacity): read the forces of terrain contacts from mujoco_warp's data."""
    env, c = wp.tid()
    if c >= contacts_out.count[env]:
        return
    slot = solver.slot[env, c]
    force = wp.vec3(0.0)
    # An elliptic cone has a row for the normal and one for each tangent (MuJoCo, Computation, "Friction cones").
    for k in range(wp.min(3, solver.dim[slot])):
        row = solver.efc_address[slot, k]
        if row >= 0:
            force += solver.efc_force[env, row] * solver.frame[slot][k]
    contacts_out.force[env, c] = force
