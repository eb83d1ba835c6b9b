"""Elements of MuJoCo's specifications and compiled models, and what actuators do to the joints of a robot."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.robots.robot import RobotCfg

mj: Any = mujoco
"""MuJoCo, whose stubs lack most types."""
_JOINT = mj.mjtTrn.mjTRN_JOINT
_AFFINE = mj.mjtBias.mjBIAS_AFFINE


def joint_names(model: Any) -> tuple[str, ...]:
    """Names of a compiled robot's joints without that of its base."""
    return tuple(model.joint(k).name for k in range(1, model.njnt))


def touching_geoms(*bodies: Any) -> list[Any]:
    """Geoms of bodies that touch the ground, body by body."""
    return [geom for body in bodies for geom in body.geoms if geom.contype or geom.conaffinity]


def read_mesh(model: Any, geom: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices [m] and faces of a compiled geom that is a mesh, shapes (num_vertices, 3) and (num_faces, 3)."""
    mesh = model.mesh(model.geom_dataid[geom])
    vertices = model.mesh_vert[int(mesh.vertadr[0]) :][: int(mesh.vertnum[0])]
    faces = model.mesh_face[int(mesh.faceadr[0]) :][: int(mesh.facenum[0])]
    return vertices, faces


def rotation_matrix(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrix of a quaternion w x y z, shape (3, 3)."""
    matrix = np.zeros(9)
    mj.mju_quat2Mat(matrix, np.asarray(quaternion, dtype=np.float64))
    return matrix.reshape(3, 3)


@dataclass(frozen=True, kw_only=True)
class Drives:
    """Position drives of a robot's joints; arrays have a row a joint."""

    stiffness: NDArray[np.float64]
    """Position gain [N m/rad]; 0 without a position actuator."""
    damping: NDArray[np.float64]
    """Velocity gain [N m s/rad]."""
    effort: NDArray[np.float64]
    """Largest torque [N m]; inf without a limit."""
    targets: NDArray[np.float64]
    """Range of targets [rad], shape (num_joints, 2); NaN without one."""
    followers: frozenset[int]
    """Joints without a drive, which an equality lets follow others."""


def read_drives(model: Any) -> Drives:
    """Reads the actuators of a compiled file that has no :func:`drive_problems`."""
    count = model.njnt - 1
    stiffness, damping = np.zeros((2, count))
    effort = np.full(count, np.inf)
    targets = np.full((count, 2), np.nan)
    for joint, _, span, scale in _torque_ranges(model):
        effort[joint] = min(effort[joint], scale * float(span[1]))
    for k in range(model.nu):
        if _actuator_kind(model, k) == "position":
            joint = _driven_joint(model, k)
            stiffness[joint] = model.actuator_gainprm[k, 0]
            damping[joint] = -model.actuator_biasprm[k, 2]
            if model.actuator_ctrllimited[k]:
                targets[joint] = model.actuator_ctrlrange[k]
    return Drives(stiffness=stiffness, damping=damping, effort=effort, targets=targets, followers=_followers(model))


def drive_problems(spec: Any, model: Any) -> Iterator[str]:
    """What no position drive can do, with its line in the file."""
    driven = set[int]()
    for k, actuator in enumerate(spec.actuators):
        line = f"on {actuator.target} ({actuator.info})"
        joint = _driven_joint(model, k)
        kind = _actuator_kind(model, k)
        if joint < 0:
            yield f"an actuator that moves no joint {line}"
        elif kind not in ("position", "motor"):
            yield f"{kind} {line}"
        elif joint in driven:
            yield f"a second actuator {line}"
        elif joint in _followers(model):
            yield f"a drive of a joint that follows another {line}"
        elif kind == "position" and model.actuator_gear[k, 0] != 1.0:
            yield f"a gear other than 1 on a position actuator {line}"
        driven.add(joint)
    for joint, name, (low, high), _ in _torque_ranges(model):
        if low != -high:
            yield f"{name} of {joint_names(model)[joint]} that is not the same both ways, {low:g} to {high:g}"


def _followers(model: Any) -> frozenset[int]:
    return frozenset(int(model.eq_obj1id[k]) - 1 for k in np.flatnonzero(model.eq_type == mj.mjtEq.mjEQ_JOINT))


def _driven_joint(model: Any, k: int) -> int:
    """Index of the joint that an actuator moves; -1 of one that moves the base or something else."""
    return int(model.actuator_trnid[k, 0]) - 1 if model.actuator_trntype[k] == _JOINT else -1


def _torque_ranges(model: Any) -> Iterator[tuple[int, str, NDArray[np.float64], float]]:
    """Ranges that limit torques: joint, attribute, range and torque of a unit of it [N m]."""
    for joint in np.flatnonzero(model.jnt_actfrclimited[1:]):
        yield int(joint), "actuatorfrcrange", model.jnt_actfrcrange[1 + joint], 1.0
    for k in range(model.nu):
        joint = _driven_joint(model, k)
        gear = abs(float(model.actuator_gear[k, 0]))
        if joint >= 0 and model.actuator_forcelimited[k]:
            yield joint, "forcerange", model.actuator_forcerange[k], gear
        if joint >= 0 and model.actuator_ctrllimited[k] and _actuator_kind(model, k) == "motor":
            yield joint, "ctrlrange", model.actuator_ctrlrange[k], gear * abs(model.actuator_gainprm[k, 0])


def _actuator_kind(model: Any, k: int) -> str:
    """``position``, ``motor``, or a description of what it is else."""
    if model.actuator_plugin[k] >= 0:
        return "an actuator of a plugin"
    if model.actuator_dyntype[k]:
        return "an actuator with a timeconst or other dynamics"
    gain = model.actuator_gainprm[k]
    bias = model.actuator_biasprm[k]
    if model.actuator_gaintype[k] == mj.mjtGain.mjGAIN_FIXED:
        if model.actuator_biastype[k] == mj.mjtBias.mjBIAS_NONE and not gain[1:].any():
            return "motor"
        if model.actuator_biastype[k] == _AFFINE and not bias[0]:
            if gain[0] > 0.0 and bias[1] == -gain[0]:
                return "position"
            if not bias[1] and bias[2] == -gain[0]:
                return "a <velocity> drive, as of wheels,"
    return "an actuator that is neither <position> nor <motor>"


def set_drives(spec: Any, drives: Drives, robot: RobotCfg) -> None:
    """Gives each joint a position actuator, in the joints' order, by the settings' gains if they have some."""
    for actuator in spec.actuators:
        spec.delete(actuator)
    stiffness = drives.stiffness if robot.stiffness is None else robot.stiffness
    damping = drives.damping if robot.damping is None else robot.damping
    effort = np.minimum(drives.effort, np.inf if robot.effort_limit is None else robot.effort_limit)
    for k, name in enumerate(robot.joint_names):
        if robot.armature is not None:
            spec.joint(name).armature = robot.armature[k]
        if k in drives.followers:
            continue
        actuator = spec.add_actuator(name=name, target=name, trntype=_JOINT)
        actuator.set_to_position(kp=stiffness[k], kv=damping[k])
        actuator.gear = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
        actuator.dyntype = mj.mjtDyn.mjDYN_NONE
        actuator.forcelimited = np.isfinite(effort[k])
        actuator.forcerange = (-effort[k], effort[k]) if np.isfinite(effort[k]) else (0.0, 0.0)
        actuator.ctrllimited = not np.isnan(drives.targets[k, 0])
        actuator.ctrlrange = np.nan_to_num(drives.targets[k])
