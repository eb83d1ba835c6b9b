"""A robot's file as MuJoCo compiles it: at most one actuator a joint, with its name; geoms touch the ground alone."""

import itertools
import re
import warnings
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import mujoco
import numpy as np
from numpy.typing import NDArray

from kernels.conditions import LINKS
from sim.files.command import with_traceback
from sim.robots.model_files import ModelFiles, read_model_files
from sim.robots.robot import RobotCfg

mj: Any = mujoco  # MuJoCo, whose stubs lack most types
_JOINT = mj.mjtTrn.mjTRN_JOINT
_GAINS = ("stiffness", "damping", "effort_limit", "armature")
PER_JOINT = ("default_joint_pos", *_GAINS, "saturation_effort", "velocity_limit")
"""Settings with a value for each joint."""
_MIDDLE = 0.01  # links whose mass centres are nearer to the base's middle lie on both sides [m]
_SLACK = 1e-3  # files round [rad]
_URDF_FRICTION = 1.0
_URDF_TIME_CONSTANT_S = 0.01
_SKEW = 0.01  # share by which a principal axis may miss a joint's
_MATRIX = [[0, 3, 4], [3, 1, 5], [4, 5, 2]]  # of MuJoCo's xx, yy, zz, xy, xz, yz
_SMALL_MARGIN = 1e-3  # of a geom, which MuJoCo Menagerie's robots have and which is left out [m]
_LEAST_GYRATION = 1e-4  # radius of gyration below which a body is a point [m]
_CONSTRAINT_FLAGS = ("constraint", "equality", "frictionloss", "limit", "contact", "refsafe")
_FORCE_FLAGS = ("spring", "damper", "gravity", "clampctrl", "actuation")
_ZERO_OPTIONS = ("density", "viscosity", "wind", "disableactuator")
_ZERO_ATTRIBUTES = {
    "body": ("gravcomp", "mocap"),
    "joint": ("ref",),
    "geom": ("margin", "gap", "adhesion", "surfacevel"),
    "actuator": ("armature", "damping", "delay"),
}  # attributes of elements that must be 0
_NEWTON_SOLVERS = {
    "<equality> (connect|weld)": "SolverKamino, closed loops",
    "only joint of its body": "SolverMuJoCo, D6 joints",
    "a (ball joint|tendon)": "SolverMuJoCo, ball joints and tendons",
    "a <velocity> drive": "SolverMuJoCo, targets of velocity",
}  # by their own documentation


def joint_names(model: Any) -> tuple[str, ...]:
    """Names of a compiled robot's joints without that of its base."""
    return tuple(model.joint(k).name for k in range(1, model.njnt))


@lru_cache(maxsize=8)
def number_links(robot: RobotCfg) -> NDArray[np.int32]:
    """Bodies by number from ``-LINKS``, on the right, over 0, the base, to ``LINKS``, spread over each side's links."""
    model = robot_spec(robot).compile()
    data = mj.MjData(model)
    data.qpos[3:7] = 1.0, 0.0, 0.0, 0.0
    mj.mj_kinematics(model, data)
    to_left = data.xipos[2:, 1] - data.xpos[1, 1]
    sides = [2 + np.flatnonzero(side * to_left > -_MIDDLE) for side in (-1.0, 1.0)]
    sides = [links if len(links) else np.array([1]) for links in sides]
    right, left = (links[-(-np.arange(1, LINKS + 1) * len(links) // LINKS) - 1] for links in sides)
    return np.array([*right[::-1], 1, *left], np.int32)


def number_arm_actuators(robot: RobotCfg, driven: Sequence[int]) -> list[int]:
    """Actuators of the robot's ``arm_joints``; ``driven`` are the indices of the actuators' joints."""
    return [[*driven].index(robot.joint_names.index(name)) for name in robot.arm_joints]


@lru_cache(maxsize=8)
def number_arm_ends(robot: RobotCfg) -> list[int]:
    """The outermost body of each arm: those of ``arm_joints`` that carry no other one."""
    model = robot_spec(robot).compile()
    bodies = {int(model.joint(name).bodyid[0]) for name in robot.arm_joints}
    carrying = set[int]()
    for body in bodies:
        while body := int(model.body_parentid[body]):
            carrying.add(body)
    return sorted(bodies - carrying)


def touching_geoms(*bodies: Any) -> list[Any]:
    """Geoms of bodies that touch the ground, body by body."""
    return [geom for body in bodies for geom in body.geoms if geom.contype or geom.conaffinity]


def read_mesh(model: Any, geom: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices [m] and faces of a compiled geom that is a mesh, shapes (num_vertices, 3) and (num_faces, 3)."""
    mesh = model.mesh(model.geom_dataid[geom])
    vertices, faces = model.mesh_vert[int(mesh.vertadr[0]) :], model.mesh_face[int(mesh.faceadr[0]) :]
    return vertices[: int(mesh.vertnum[0])], faces[: int(mesh.facenum[0])]


def rotation_matrix(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrix of a quaternion w x y z, shape (3, 3)."""
    matrix = np.zeros(9)
    mj.mju_quat2Mat(matrix, np.asarray(quaternion, dtype=np.float64))
    return matrix.reshape(3, 3)


class Drives(NamedTuple):
    """Position drives of a robot's joints; arrays have a row a joint."""

    stiffness: NDArray[np.float64]  # position gain [N m/rad]; 0 without a position actuator
    damping: NDArray[np.float64]  # velocity gain [N m s/rad]
    effort: NDArray[np.float64]  # largest torque [N m]; inf without a limit
    targets: NDArray[np.float64]  # range of targets [rad], shape (num_joints, 2); NaN without one
    followers: frozenset[int]  # joints without a drive, which an equality lets follow others


def read_drives(model: Any) -> Drives:
    """Reads the actuators of a compiled file that has no :func:`drive_problems`."""
    stiffness, damping = np.zeros((2, model.njnt - 1))
    effort = np.full(model.njnt - 1, np.inf)
    targets = np.full((model.njnt - 1, 2), np.nan)
    for joint, _, span, scale in _torque_ranges(model):
        effort[joint] = min(effort[joint], scale * float(span[1]))
    for k in range(model.nu):
        if _actuator_kind(model, k) == "position":
            joint = _driven_joint(model, k)
            stiffness[joint], damping[joint] = model.actuator_gainprm[k, 0], -model.actuator_biasprm[k, 2]
            if model.actuator_ctrllimited[k]:
                targets[joint] = model.actuator_ctrlrange[k]
    return Drives(stiffness=stiffness, damping=damping, effort=effort, targets=targets, followers=_followers(model))


def drive_problems(spec: Any, model: Any) -> Iterator[str]:
    """What no position drive can do, with its line in the file."""
    driven = set[int]()
    for k, actuator in enumerate(spec.actuators):
        joint, kind = _driven_joint(model, k), _actuator_kind(model, k)
        checks = {
            "an actuator that moves no joint": joint < 0,
            kind: kind not in ("position", "motor"),
            "a second actuator": joint in driven,
            "a drive of a joint that follows another": joint in _followers(model),
            "a gear other than 1 on a position actuator": kind == "position" and model.actuator_gear[k, 0] != 1.0,
        }
        yield from [f"{what} on {actuator.target} ({actuator.info})" for what in checks if checks[what]][:1]
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
    gain, bias = model.actuator_gainprm[k], model.actuator_biasprm[k]
    is_fixed = model.actuator_gaintype[k] == mj.mjtGain.mjGAIN_FIXED
    is_affine = is_fixed and model.actuator_biastype[k] == mj.mjtBias.mjBIAS_AFFINE and not bias[0]
    if is_fixed and model.actuator_biastype[k] == mj.mjtBias.mjBIAS_NONE and not gain[1:].any():
        return "motor"
    if is_affine and gain[0] > 0.0 and bias[1] == -gain[0]:
        return "position"
    if is_affine and not bias[1] and bias[2] == -gain[0]:
        return "a <velocity> drive, as of wheels,"
    return "an actuator that is neither <position> nor <motor>"


def set_drives(spec: Any, drives: Drives, robot: RobotCfg) -> None:
    """Gives each joint a position actuator, by the settings' gains if they have some, or a motor for a network."""
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
        if robot.actuator_net is None:
            actuator.set_to_position(kp=stiffness[k], kv=damping[k])
        else:
            actuator.set_to_motor()
        actuator.gear = 1.0, 0.0, 0.0, 0.0, 0.0, 0.0
        actuator.dyntype = mj.mjtDyn.mjDYN_NONE
        actuator.forcelimited = np.isfinite(effort[k])
        actuator.forcerange = (-effort[k], effort[k]) if np.isfinite(effort[k]) else (0.0, 0.0)
        actuator.ctrllimited = robot.actuator_net is None and not np.isnan(drives.targets[k, 0])
        actuator.ctrlrange = np.nan_to_num(drives.targets[k])


class RobotFile(NamedTuple):
    """Content of a robot's file, without its settings."""

    spec: Any  # the ``MjSpec``, stripped to what simulations use; every touching geom has a name
    model: Any
    home: list[float] | None  # joint angles of its keyframe ``home`` [rad]; None without one
    is_urdf: bool


def robot_spec(robot: RobotCfg, *, visuals: bool = False) -> Any:
    """The robot as an ``MjSpec`` that compiles, or all that is wrong; with ``visuals`` a URDF keeps what it shows."""
    robot_file = read_robot_file(robot.model_file, visuals=visuals)
    if problems := file_problems(robot, robot_file):
        raise ValueError(f"robot '{robot.name}': {'; '.join(problems)}")
    set_drives(robot_file.spec, read_drives(robot_file.model), robot)
    for geom in touching_geoms(*robot_file.spec.bodies):
        if robot.friction is not None:
            geom.friction[0] = robot.friction
        if robot.contact_time_constant_s is not None:
            geom.solref = robot.contact_time_constant_s, 1.0
    return robot_file.spec


def read_robot_file(model_file: Path, *, visuals: bool = False) -> RobotFile:
    """Reads a robot's file; an error says all that is wrong with it."""
    files = read_model_files(model_file, visuals=visuals)
    try:
        spec = _read_urdf(files.root) if files.is_urdf else mj.MjSpec.from_file(str(model_file))
        home = next((list(key.qpos) for key in spec.keys if key.name == "home"), [])
        _name_geoms(spec)
        refused = [*_refused_elements(spec)]
        # What simulations leave out; whatever names a body would keep it from being fused.
        unused = (spec.sensors, spec.keys, spec.excludes, spec.pairs, spec.cameras, spec.lights, spec.tuples)
        for element in itertools.chain(*unused):
            spec.delete(element)
        usual = mj.MjSpec()
        for name in ("gravity", "impratio"):
            setattr(usual.option, name, getattr(spec.option, name))
        spec.option = usual.option
        spec.fuse_static()
        for geom in touching_geoms(spec.worldbody):
            warnings.warn(f"{model_file}: geom {geom.name} belongs to the world and is left out", stacklevel=2)
            spec.delete(geom)
        model = spec.compile()
    except Exception as error:  # MuJoCo's own type has no name
        reason = _quote_urdf(" ".join(str(error).split()), files)
        raise ValueError(with_traceback(error, f"{model_file} cannot be read by MuJoCo: {reason}")) from None
    problems = [*_structure_problems(model)]
    if refused := [*refused, *drive_problems(spec, model)]:
        problems.append(f"{', '.join(refused)} cannot be simulated: take it out, or write it otherwise")
    if len(home) not in (0, model.nq):
        problems.append(f"qpos of the keyframe home must be {model.nq} numbers, got {len(home)}")
    if problems:
        text = "; ".join(f"{model_file}: {_quote_urdf(problem, files)}" for problem in problems)
        solvers = "; ".join(solver for pattern, solver in _NEWTON_SOLVERS.items() if re.search(pattern, text))
        raise ValueError(text + f" (Newton could, but not here: {solvers})" * bool(solvers))
    return RobotFile(spec=spec, model=model, home=home[7:] or None, is_urdf=files.is_urdf)


def _read_urdf(root: ET.Element) -> Any:
    """The ``MjSpec`` of a URDF: contact as in docs/robots.md, and what is fixed to a link adds its mass to it."""
    compiler = root
    for tag in ("mujoco", "compiler"):
        element = compiler.find(tag)
        compiler = ET.SubElement(compiler, tag) if element is None else element
    compiler.attrib.setdefault("inertiafromgeom", "false")
    compiler.attrib |= dict.fromkeys(("strippath", "fusestatic", "discardvisual"), "false")
    ET.indent(root)  # every element on a line of its own
    spec = mj.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    for body in spec.bodies:
        geoms = touching_geoms(body)
        for number, geom in enumerate(geoms):
            geom.name = body.name if len(geoms) == 1 else f"{body.name}_{number}"
            geom.friction[0] = _URDF_FRICTION
            geom.solref = _URDF_TIME_CONSTANT_S, 1.0
    for base in spec.worldbody.bodies:
        if not base.joints:  # the world's joint may be floating already
            base.add_freejoint()
        _merge_masses(base)  # MuJoCo refuses inertias of fixed links that no body could have
    return spec


def _merge_masses(body: Any) -> list[Any]:
    """Gives a body the masses that are fixed to it; returns them: mass [kg], centre [m], inertia [kg m^2]."""
    axes = rotation_matrix(body.iquat)
    inertia = np.diag(body.inertia) if np.isnan(body.fullinertia[0]) else body.fullinertia[_MATRIX]
    masses = [(float(body.mass), np.array(body.ipos), axes @ inertia @ axes.T)] if body.mass > 0.0 else []
    for child in body.bodies:
        child_masses = _merge_masses(child)
        if not child.joints:
            turn = rotation_matrix(child.quat)
            masses += [(m, child.pos + turn @ centre, turn @ inertia @ turn.T) for m, centre, inertia in child_masses]
            child.mass, child.inertia, child.fullinertia = 0.0, np.zeros(3), np.full(6, np.nan)
    if body.joints and masses:
        mass = sum(m for m, _, _ in masses)
        middle = sum(m * centre for m, centre, _ in masses) / mass
        shifts = [(m, centre - middle, inertia) for m, centre, inertia in masses]
        whole = np.sum([inertia + m * (d @ d * np.eye(3) - np.outer(d, d)) for m, d, inertia in shifts], axis=0)
        if body.joints[0].type == mj.mjtJoint.mjJNT_HINGE:
            whole = _move_rotor(whole, body.joints[0])
        body.explicitinertial, body.mass, body.ipos, body.iquat = True, mass, middle, (1.0, 0.0, 0.0, 0.0)
        body.fullinertia = whole[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return masses


def _move_rotor(inertia: NDArray[np.float64], joint: Any) -> NDArray[np.float64]:
    """Moves the inertia about the joint's axis that no body can have to the joint's armature; returns the rest."""
    # The largest principal inertia of a body is at most the sum of the others; some URDFs add that of the motor.
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    about_axis = float(axis @ inertia @ axis)
    excess = 2.0 * about_axis - float(np.trace(inertia))
    if excess <= 0.0 or np.linalg.norm(inertia @ axis - about_axis * axis) > _SKEW * about_axis:
        return inertia
    excess += _SKEW * (about_axis - excess)  # the axis is a principal one but for rounding
    joint.armature += excess
    return inertia - excess * np.outer(axis, axis)


def _quote_urdf(text: str, files: ModelFiles) -> str:
    """A message with the elements of a URDF in place of line numbers, which are not those of the file."""
    lines = dict(enumerate(ET.tostring(files.root, encoding="unicode").split("\n"), 1)) if files.is_urdf else {}
    return re.sub(r"line (\d+)", lambda line: lines.get(int(line[1]), line[0]).strip(), text)


def _name_geoms(spec: Any) -> None:
    """Gives touching geoms without a name that of their body, and lets them touch the ground alone."""
    taken = {geom.name for geom in spec.geoms}
    for index, body in enumerate(spec.bodies):
        for number, geom in enumerate(touching_geoms(body)):
            if not geom.name:
                geom.name = f"{body.name or f'body_{index}'}_geom_{number}"
                while geom.name in taken:
                    geom.name += "_"
            taken.add(geom.name)
            geom.contype, geom.conaffinity = 1, 0
            geom.margin *= geom.margin > _SMALL_MARGIN


def _refused_elements(spec: Any) -> Iterator[str]:
    """Elements and attributes of a specification, with their line in the file."""
    option = spec.option
    for flag in (*_CONSTRAINT_FLAGS, *_FORCE_FLAGS):
        if option.disableflags & getattr(mj.mjtDisableBit, f"mjDSBL_{flag.upper()}"):
            yield f'<flag {flag}="disable"> in <option>'
    if option.enableflags & mj.mjtEnableBit.mjENBL_OVERRIDE:
        yield '<flag override="enable">'
    yield from (f"<option {name}>" for name in _ZERO_OPTIONS if np.any(getattr(option, name)))
    if option.gravity[0] or option.gravity[1] or not option.gravity[2] < 0.0:
        yield f"<option gravity> that does not point down, {option.gravity}"
    yield from _refused_equalities(spec)
    bodies, joints, geoms = spec.bodies, spec.joints, touching_geoms(*spec.bodies)
    elements = {"body": bodies, "joint": joints, "geom": geoms, "actuator": spec.actuators}
    for kind, names in _ZERO_ATTRIBUTES.items():
        for element, name in itertools.product(elements[kind], names):
            if np.any(getattr(element, name)):
                yield f"<{kind} {name}> of {element.name} ({element.info})"
    for joint in joints:
        is_free = joint.type == mj.mjtJoint.mjJNT_FREE
        refused = {
            "a ball joint": joint.type == mj.mjtJoint.mjJNT_BALL,
            "a joint without a name": not (is_free or joint.name),
            f"<joint damping> of {joint.name}": np.any(joint.damping[1:]),
            f"<joint stiffness> of {joint.name}": np.any(joint.stiffness[0 if is_free else 1 :]),
        }
        yield from (f"{what} ({joint.info})" for what, is_refused in refused.items() if is_refused)
    for geom in geoms:
        if geom.type in (mj.mjtGeom.mjGEOM_HFIELD, mj.mjtGeom.mjGEOM_SDF):
            yield f"a height field or distance field as geom {geom.name} ({geom.info})"
    if spec.compiler.inertiafromgeom == mj.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE:
        for body in bodies:
            if body.explicitinertial and not (body.joints or body.geoms):
                yield f'<inertial> of {body.name} ({body.info}) beside inertiafromgeom="true"'
    yield from (f"a tendon ({tendon.info})" for tendon in spec.tendons)
    yield from (f"a flexible body ({flex.info})" for flex in spec.flexes)


def _refused_equalities(spec: Any) -> Iterator[str]:
    """Equalities but those by which a joint follows one leader linearly, with MuJoCo's usual stiffness."""
    followers = [equality.name1 for equality in spec.equalities]
    usual = mj.MjSpec().add_equality()
    for equality in spec.equalities:
        is_linear = equality.type == mj.mjtEq.mjEQ_JOINT and not np.any(equality.data[2:5])
        has_leader = equality.name2 and equality.name2 not in followers and followers.count(equality.name1) == 1
        is_usual = all(np.array_equal(getattr(equality, name), getattr(usual, name)) for name in ("solref", "solimp"))
        if not (is_linear and has_leader and is_usual and equality.active):
            kind = mj.mjtEq(equality.type).name.removeprefix("mjEQ_").lower()
            yield f"<equality> {kind} of {equality.name1} ({equality.info})"


def _structure_problems(model: Any) -> Iterator[str]:
    """Complaints about a compiled model that is no robot of single joints on a free base."""
    if not model.njnt or model.jnt_type[0] != mj.mjtJoint.mjJNT_FREE or model.jnt_bodyid[0] != 1:
        yield "the first body must move freely: give it a <freejoint/>"
        return
    if not model.geom_contype[model.geom_bodyid > 0].any():
        yield "no geom touches anything: give some contype 1, in a URDF a <collision>"
    for k in range(1, model.njnt):
        if model.jnt_type[k] == mj.mjtJoint.mjJNT_FREE or model.body_jntnum[model.jnt_bodyid[k]] != 1:
            yield f"joint {model.joint(k).name} must be a hinge or slide, the only joint of its body"
    poses = np.hstack([model.body_pos, model.body_quat, model.body_ipos])
    for k in range(1, model.nbody):
        if not np.isfinite(poses[k]).all():
            yield f"position and rotation of body {model.body(k).name} must be numbers"
        if model.body_inertia[k].min() < _LEAST_GYRATION**2 * model.body_mass[k]:
            yield f"inertia of body {model.body(k).name} is that of a point: give it that of a body [kg m^2]"


def file_problems(robot: RobotCfg, file: RobotFile) -> list[str]:
    """Complaints about settings that do not fit the robot's file: names, and values for each joint."""
    model, drives, names = file.model, read_drives(file.model), robot.joint_names
    geoms = [geom.name for geom in touching_geoms(*file.spec.bodies)]
    kinds = {"joint": (names, joint_names(model)), "geom that touches the ground": (robot.geom_names, geoms)}
    unknown = []
    for kind, (given, present) in kinds.items():
        if missing := ", ".join(name for name in given if name not in present):
            unknown.append(f"no {kind} is named {missing} in {robot.model_file}: the file has {', '.join(present)}")
    if names != joint_names(model):
        order = f"joint_names must follow the file's order {joint_names(model)}, got {names}"
        return unknown if {*names} - {*joint_names(model)} else [order, *unknown]
    problems = []
    for field in PER_JOINT:
        values = getattr(robot, field)
        if values is not None and len(values) != len(names):
            problems.append(f"{field} needs {len(names)} values, one a joint, got {len(values)}")
    for field in ("armature", "damping", "frictionloss"):
        values = getattr(model, f"dof_{field}")[6:]
        if negative := [f"{names[k]} ({values[k]:g})" for k in np.flatnonzero(~(values >= 0.0))]:
            problems.append(f"{field} must be a number, 0 or more, got {', '.join(negative)}")
    pose = robot.default_joint_pos
    if len(pose) == len(names):
        low, high = np.where(model.jnt_limited[1:, None] == 1, model.jnt_range[1:], (-np.inf, np.inf)).T
        beyond = np.flatnonzero(~((low - _SLACK <= pose) & (pose <= high + _SLACK)))
        if len(beyond):
            listed = ", ".join(f"{names[k]} ({low[k]:g} to {high[k]:g}, got {pose[k]:g})" for k in beyond)
            degrees = ": angles are in radians" if np.abs(pose).max() > 2.0 * np.pi else ""
            problems.append(f"default_joint_pos is outside of the file's range for {listed}{degrees}")
    limitless = ", ".join(name for name, effort in zip(names, drives.effort, strict=True) if np.isinf(effort))
    if limitless and (file.is_urdf or robot.saturation_effort) and robot.effort_limit is None:
        problems.append(f"no torque limit above 0 for {limitless}: give it in the file or by effort_limit")
    gains = drives.stiffness if robot.stiffness is None else robot.stiffness
    limp = ", ".join(names[k] for k, gain in enumerate(gains) if not (gain > 0.0 or k in drives.followers))
    if limp and not problems and robot.actuator_net is None:
        problems.append(f"no gains for {limp}: give stiffness and damping, or <position> in {robot.model_file}")
    return [*problems, *unknown]
