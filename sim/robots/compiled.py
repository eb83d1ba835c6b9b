"""A robot's file as MuJoCo compiles it, in the one form that simulations and pictures are made of.

Of each joint there is at most one position actuator, of the joint's name; every geom that touches anything touches the
ground and nothing else; options are MuJoCo's but gravity and ``impratio``.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Collection, Container, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from sim.files.command import with_traceback
from sim.robots.model_files import ModelFiles, read_model_files
from sim.robots.robot import RobotCfg

mj: Any = mujoco
"""MuJoCo, whose types are not written down."""
_JOINT, _TRN, _BIAS = mj.mjtJoint, mj.mjtTrn.mjTRN_JOINT, mj.mjtBias
_URDF_FRICTION = 1.0
_URDF_TIME_CONSTANT_S = 0.01
_SLACK = 1e-3  # files round [rad]
_SKEW = 0.01  # share by which a principal axis may miss a joint's
_LEAST_GYRATION = 1e-4  # radius of gyration below which a body is a point [m]
PER_JOINT = ("default_joint_pos", "stiffness", "damping", "effort_limit", "armature", "saturation_effort",
             "velocity_limit")  # fmt: skip
"""Settings with a value for each joint."""
_NEEDED = ("constraint", "equality", "frictionloss", "limit", "contact", "spring", "damper", "gravity", "clampctrl",
           "actuation", "refsafe")  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class RobotFile:
    """What a robot's file says, whatever its settings."""

    spec: Any
    """The ``MjSpec``, with what simulations take of it, under names."""
    model: Any
    drives: "_Drives"
    home: list[float] | None
    """Joint angles of its keyframe ``home`` [rad]; None without one."""
    is_urdf: bool


def robot_spec(robot: RobotCfg, *, visuals: bool = False) -> Any:
    """The robot as an ``MjSpec`` that compiles; an error says all that is wrong with its file or its settings.

    What these say of gains, torque limits, armature and contact counts. With ``visuals`` a URDF keeps what it shows.
    """
    of_file = read_robot_file(robot.model_file, visuals=visuals)
    if problems := file_problems(robot, of_file):
        raise ValueError(f"robot '{robot.name}': {'; '.join(problems)}")
    _set_drives(of_file.spec, of_file.drives, robot)
    for geom in touching_geoms(*of_file.spec.bodies):
        if robot.friction is not None:
            geom.friction[0] = robot.friction
        if robot.contact_time_constant_s is not None:
            geom.solref = robot.contact_time_constant_s, 1.0
    return of_file.spec


def read_robot_file(model_file: Path, *, visuals: bool = False) -> RobotFile:
    """Reads a robot's file; an error says all that is wrong with it."""
    files = read_model_files(model_file, visuals=visuals)
    try:
        spec = _of_urdf(files.root) if files.is_urdf else mj.MjSpec.from_file(str(model_file))
        home = next((list(key.qpos) for key in spec.keys if key.name == "home"), [])
        strange = _keep_robot(spec)
        spec.fuse_static()
        model = spec.compile()
    except Exception as error:  # MuJoCo's own type has no name
        reason = _with_element(" ".join(str(error).split()), files)
        raise ValueError(with_traceback(error, f"{model_file} cannot be read by MuJoCo: {reason}")) from None
    drives = _Drives(spec, model)
    problems = _structure_problems(model)
    if strange := strange + drives.problems:
        problems.append(f"{', '.join(strange)} cannot be simulated: take it out, or write it otherwise")
    if len(home) not in (0, model.nq):
        problems.append(f"qpos of the keyframe home must be {model.nq} numbers, got {len(home)}")
    if problems:
        raise ValueError("; ".join(f"{model_file}: {_with_element(problem, files)}" for problem in problems))
    return RobotFile(spec=spec, model=model, drives=drives, home=home[7:] or None, is_urdf=files.is_urdf)


def _with_element(text: str, files: ModelFiles) -> str:
    """What MuJoCo says of a URDF with the element itself in place of its line, which is not that of the file."""
    lines = dict(enumerate(ET.tostring(files.root, encoding="unicode").split("\n"), 1)) if files.is_urdf else {}
    return re.sub(r"line (\d+)", lambda line: lines.get(int(line[1]), line[0]).strip(), text)


def joint_names(model: Any) -> tuple[str, ...]:
    """Names of a compiled robot's joints without that of its base."""
    return tuple(model.joint(k).name for k in range(1, model.njnt))


def touching_geoms(*bodies: Any) -> list[Any]:
    """Geoms of bodies that touch the ground, body by body."""
    return [geom for body in bodies for geom in body.geoms if geom.contype or geom.conaffinity]


def mesh_of(model: Any, geom: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices [m] and faces of a compiled geom that is a mesh, shapes (num_vertices, 3) and (num_faces, 3)."""
    mesh = model.mesh(model.geom_dataid[geom])
    vertices, faces = model.mesh_vert[int(mesh.vertadr[0]) :], model.mesh_face[int(mesh.faceadr[0]) :]
    return vertices[: int(mesh.vertnum[0])], faces[: int(mesh.facenum[0])]


def _of_urdf(root: ET.Element) -> Any:
    """A URDF with a free base, its contact by the page on robots; what is fixed to a link adds its mass to it."""
    compiler = root
    for tag in ("mujoco", "compiler"):
        own = compiler.find(tag)
        compiler = ET.SubElement(compiler, tag) if own is None else own
    compiler.attrib.setdefault("inertiafromgeom", "false")
    compiler.attrib |= dict.fromkeys(("strippath", "fusestatic", "discardvisual"), "false")
    ET.indent(root)  # every element on a line of its own
    spec = mj.MjSpec.from_string(ET.tostring(root, encoding="unicode"))
    for body in spec.bodies:
        touching = touching_geoms(body)
        for number, geom in enumerate(touching):
            geom.name = body.name if len(touching) == 1 else f"{body.name}_{number}"
            geom.friction[0], geom.solref = _URDF_FRICTION, (_URDF_TIME_CONSTANT_S, 1.0)
    for first in spec.worldbody.bodies:
        if not first.joints:  # the world's joint may be floating already
            first.add_freejoint()
        _sum_masses(first)  # MuJoCo alone refuses inertias of fixed links that are those of no body
    return spec


def _sum_masses(body: Any) -> list[Any]:
    """Gives a body what is fixed to it: its mass, and where its own and theirs are in it, [kg], [m], [kg m^2]."""
    axes, inertia = rotation_matrix(body.iquat), np.diag(body.inertia)
    if not np.isnan(body.fullinertia[0]):
        inertia = body.fullinertia[[[0, 3, 4], [3, 1, 5], [4, 5, 2]]]
    parts = [(float(body.mass), np.array(body.ipos), axes @ inertia @ axes.T)] if body.mass > 0.0 else []
    for child in body.bodies:
        of_child, turn = _sum_masses(child), rotation_matrix(child.quat)
        if not child.joints:
            parts += [(mass, child.pos + turn @ at, turn @ own @ turn.T) for mass, at, own in of_child]
            child.mass, child.inertia, child.fullinertia = 0.0, np.zeros(3), np.full(6, np.nan)
    if body.joints and parts:
        mass = sum(part for part, _, _ in parts)
        centre = sum(part * at for part, at, _ in parts) / mass
        shifts = [(part, at - centre, own) for part, at, own in parts]
        whole = np.sum([own + part * (d @ d * np.eye(3) - np.outer(d, d)) for part, d, own in shifts], axis=0)
        if body.joints[0].type == _JOINT.mjJNT_HINGE:
            whole = _without_rotor(whole, body.joints[0])
        body.explicitinertial, body.mass, body.ipos, body.iquat = True, mass, centre, (1.0, 0.0, 0.0, 0.0)
        body.fullinertia = whole[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
    return parts


def _without_rotor(inertia: NDArray[np.float64], joint: Any) -> NDArray[np.float64]:
    """An inertia without what it has about the joint's axis beyond any body's: a rotor's, the joint's armature."""
    # The largest principal inertia of a body is at most the sum of the others; some URDFs add that of the motor.
    axis = np.array(joint.axis) / np.linalg.norm(joint.axis)
    about = float(axis @ inertia @ axis)
    excess = 2.0 * about - float(np.trace(inertia))
    if excess <= 0.0 or np.linalg.norm(inertia @ axis - about * axis) > _SKEW * about:
        return inertia
    excess += _SKEW * (about - excess)  # the axis is a principal one but for rounding
    joint.armature += excess
    return inertia - excess * np.outer(axis, axis)


def rotation_matrix(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of a quaternion w x y z, shape (3, 3)."""
    matrix = np.zeros(9)
    mj.mju_quat2Mat(matrix, np.asarray(quaternion, dtype=np.float64))
    return matrix.reshape(3, 3)


def _keep_robot(spec: Any) -> list[str]:
    """Leaves what simulations take of a file, under names; returns what they cannot take, by its place."""
    option, gravity = spec.option, spec.option.gravity.copy()
    flags = [name for name in _NEEDED if option.disableflags & getattr(mj.mjtDisableBit, f"mjDSBL_{name.upper()}")]
    others = [name for name in ("density", "viscosity", "wind", "disableactuator") if np.any(getattr(option, name))]
    problems = [f'<flag {name}="disable"> in <option>' for name in flags] + [f"<option {name}>" for name in others]
    problems += ['<flag override="enable">'] * bool(option.enableflags & mj.mjtEnableBit.mjENBL_OVERRIDE)
    if gravity[0] or gravity[1] or not gravity[2] < 0.0:
        problems.append(f"<option gravity> that does not point down, {gravity}")
    followers, plain = [equality.name1 for equality in spec.equalities], mj.MjSpec().add_equality()
    for equality in spec.equalities:
        follows = equality.type == mj.mjtEq.mjEQ_JOINT and equality.name2 and not np.any(equality.data[2:5])
        once = followers.count(equality.name1) == 1 and equality.name2 not in followers
        usual = all(np.array_equal(getattr(equality, name), getattr(plain, name)) for name in ("solref", "solimp"))
        if not (follows and once and usual and equality.active):
            kind = mj.mjtEq(equality.type).name.removeprefix("mjEQ_").lower()
            problems.append(f"<equality> {kind} of {equality.name1} ({equality.info})")

    def refuse(kind: str, part: Any, **values: Any) -> None:
        strange = [name for name, value in values.items() if np.any(value)]
        problems.extend(f"<{kind} {name}> of {part.name} ({part.info})" for name in strange)

    from_geoms = spec.compiler.inertiafromgeom == mj.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    lost = [body for body in spec.bodies if from_geoms and body.explicitinertial and not (body.joints or body.geoms)]
    problems += [f'<inertial> of {body.name} ({body.info}) beside inertiafromgeom="true"' for body in lost]
    problems += [f"a tendon ({tendon.info})" for tendon in spec.tendons]
    problems += [f"a flexible body ({flex.info})" for flex in spec.flexes]
    taken = {geom.name for geom in spec.geoms}
    for place, body in enumerate(spec.bodies):
        problems += [f"a ball joint ({joint.info})" for joint in body.joints if joint.type == _JOINT.mjJNT_BALL]
        for number, geom in enumerate(touching_geoms(body)):
            geom.name = geom.name or _free_name(f"{body.name or f'body_{place}'}_geom_{number}", taken)
            taken.add(geom.name)
            geom.contype, geom.conaffinity = 1, 0
            if geom.type in (mj.mjtGeom.mjGEOM_HFIELD, mj.mjtGeom.mjGEOM_SDF):
                problems.append(f"a height field or distance field as geom {geom.name} ({geom.info})")
            refuse("geom", geom, margin=geom.margin, gap=geom.gap, adhesion=geom.adhesion, surfacevel=geom.surfacevel)
        refuse("body", body, gravcomp=body.gravcomp, mocap=body.mocap)
        for joint in body.joints:
            free = joint.type == _JOINT.mjJNT_FREE
            problems += [] if free or joint.name else [f"a joint without a name ({joint.info})"]
            refuse("joint", joint, ref=joint.ref, damping=joint.damping[1:], stiffness=joint.stiffness[not free :])
    for actuator in spec.actuators:
        refuse("actuator", actuator, armature=actuator.armature, damping=actuator.damping, delay=actuator.delay)
    # What names a body keeps it from being fused.
    for part in (*spec.sensors, *spec.keys, *spec.excludes, *spec.pairs, *spec.cameras, *spec.lights, *spec.tuples):
        spec.delete(part)
    impratio = option.impratio
    spec.option = mj.MjSpec().option
    spec.option.gravity, spec.option.impratio = gravity, impratio
    return problems


def _free_name(name: str, taken: Container[str]) -> str:
    """A name that is not taken: this one, or with underscores behind it."""
    while name in taken:
        name += "_"
    return name


def _structure_problems(model: Any) -> list[str]:
    """What is no robot of single joints on a free base."""
    if not model.njnt or model.jnt_type[0] != _JOINT.mjJNT_FREE or model.jnt_bodyid[0] != 1:
        return ["the first body must move freely: give it a <freejoint/>"]
    alone = np.flatnonzero(model.body_jntnum != 1)[1:]
    crowded = [model.joint(k).name for k in range(1, model.njnt)
               if model.jnt_type[k] == _JOINT.mjJNT_FREE or model.jnt_bodyid[k] in alone]  # fmt: skip
    fixed = [model.geom(k).name for k in range(model.ngeom) if model.geom_bodyid[k] == 0 and model.geom_contype[k]]
    poses = np.hstack([model.body_pos, model.body_quat, model.body_ipos])[1:]
    lost = [model.body(1 + k).name for k in np.flatnonzero(~np.isfinite(poses).all(axis=1))]
    slight = [model.body(k).name for k in range(1, model.nbody)
              if model.body_inertia[k].min() < _LEAST_GYRATION**2 * model.body_mass[k]]  # fmt: skip
    touches = model.geom_contype[model.geom_bodyid > 0].any()
    findings = [
        ([] if touches else ["none"], "no geom touches anything: give some contype 1, in a URDF a <collision>"),
        (crowded, f"every joint must be a hinge or slide on a body of its own, unlike that of {', '.join(crowded)}"),
        (fixed, f"geoms that belong to the world, not to the robot: {', '.join(fixed)}: take them out"),
        (lost, f"position and rotation must be numbers, unlike those of {', '.join(lost)}"),
        (slight, f"inertia of {', '.join(slight)} is that of a point: give it that of a body [kg m^2]"),
    ]
    return [text for names, text in findings if names]


def file_problems(robot: RobotCfg, of_file: RobotFile, wrong: Collection[str] = ()) -> list[str]:
    """What of a robot's settings does not fit its file, one line each; fields in ``wrong`` are not compared with it."""
    problems = [] if "joint_names" in wrong else _joint_problems(robot, of_file, wrong)
    roles = [role for role in ("base_geoms", "limb_geoms", "foot_geoms") if role not in wrong]
    wanted, spec = [name for role in roles for name in getattr(robot, role)], of_file.spec
    touching = [geom.name for geom in touching_geoms(*spec.bodies)]
    sites = {site.name for site in spec.sites} - {*touching}
    visual = {geom.name for geom in spec.geoms if not geom.contype} - {""}
    for kind, names in (("a site", sites), ("a geom that touches nothing", visual)):
        if got := [name for name in wanted if name in names]:
            problems.append(f"{', '.join(got)} is {kind} in {robot.model_file}: name geoms that touch the ground")
    known = [name for name in wanted if name not in sites | visual]
    return problems + _unknown("geom", known, touching, robot)


def _unknown(kind: str, wanted: Sequence[str], present: Sequence[str], robot: RobotCfg) -> list[str]:
    missing = ", ".join(name for name in wanted if name not in present)
    return [f"no {kind} named {missing} in {robot.model_file}: the file has {', '.join(present)}"] * bool(missing)


def _joint_problems(robot: RobotCfg, of_file: RobotFile, wrong: Collection[str]) -> list[str]:
    """What is wrong with the joints' names, and with the settings that have a value for each."""
    model, drives, names = of_file.model, of_file.drives, robot.joint_names
    if problems := _unknown("joint", names, joint_names(model), robot):
        return problems
    if names != joint_names(model):
        return [f"joint_names must follow the file's order {joint_names(model)}, got {names}"]
    values = {name: getattr(robot, name) for name in PER_JOINT if name not in wrong}
    short = {name: len(given) for name, given in values.items() if given is not None and len(given) != len(names)}
    problems = [f"{name} needs {len(names)} values, one a joint, got {got}" for name, got in short.items()]
    for name in ("armature", "damping", "frictionloss"):
        of_joints = zip(names, getattr(model, f"dof_{name}")[6:], strict=True)
        if beyond := [f"{joint} ({value:g})" for joint, value in of_joints if not value >= 0.0]:
            problems.append(f"{name} must be a number, 0 or more, got {', '.join(beyond)}")
    if "default_joint_pos" in values and "default_joint_pos" not in short:
        pose = robot.default_joint_pos
        ranges = zip(names, pose, model.jnt_limited[1:], model.jnt_range[1:], strict=True)
        beyond = [f"{name} ({low:g} to {high:g}, got {angle:g})" for name, angle, limited, (low, high) in ranges
                  if limited and not low - _SLACK <= angle <= high + _SLACK]  # fmt: skip
        if beyond:
            degrees = ": angles are in radians" if any(abs(angle) > 2.0 * np.pi for angle in pose) else ""
            problems.append(f"default_joint_pos is outside of the file's range for {', '.join(beyond)}{degrees}")
    if (of_file.is_urdf or robot.saturation_effort) and robot.effort_limit is None and np.isinf(drives.effort).any():
        weak = ", ".join(name for name, effort in zip(names, drives.effort, strict=True) if np.isinf(effort))
        problems.append(f"no torque limit above 0 for {weak}: give it in the file, or effort_limit in the settings")
    if not problems and {"stiffness", "damping"}.isdisjoint(wrong):
        gains = drives.stiffness if robot.stiffness is None else np.array(robot.stiffness)
        limp = [name for k, name in enumerate(names) if not gains[k] > 0.0 and k not in drives.follow]
        if limp:
            file = robot.model_file
            problems.append(f"no gains for {', '.join(limp)}: give stiffness and damping, or <position> in {file}")
    return problems


class _Drives:
    """What the actuators of a compiled file do to each joint, and what no position actuator can do."""

    def __init__(self, spec: Any, model: Any) -> None:
        joints, count = joint_names(model), len(joint_names(model))
        self.stiffness, self.damping, self.effort = np.zeros(count), np.zeros(count), np.full(count, np.inf)
        self.control, self.problems = np.full((count, 2), np.nan), list[str]()
        self.follow = {int(model.eq_obj1id[k]) - 1 for k in np.flatnonzero(model.eq_type == mj.mjtEq.mjEQ_JOINT)}
        for k in np.flatnonzero(model.jnt_actfrclimited[1:]):
            self.effort[k] = self._least(model.jnt_actfrcrange[1 + k], f"actuatorfrcrange of {joints[k]}")
        taken: list[int] = []
        for k, actuator in enumerate(spec.actuators):
            joint, where = int(model.actuator_trnid[k, 0]) - 1, f"on {actuator.target} ({actuator.info})"
            kind, geared = self._kind(model, k), model.actuator_gear[k, 0] != 1.0
            findings = [
                (model.actuator_trntype[k] != _TRN or joint < 0, "an actuator that moves no joint"),
                (kind not in ("position", "motor"), kind),
                (joint in taken, "a second actuator"),
                (joint in self.follow, "a drive of a joint that follows another"),
                (kind == "position" and geared, "a gear other than 1 on a position actuator"),
            ]
            if strange := next((text for holds, text in findings if holds), ""):
                self.problems.append(f"{strange} {where}")
            else:
                taken.append(joint)
                self._add(model, k, joint, kind, where)

    def _add(self, model: Any, k: int, joint: int, kind: str, where: str) -> None:
        gear, gain, limits = abs(float(model.actuator_gear[k, 0])), model.actuator_gainprm[k, 0], [self.effort[joint]]
        if model.actuator_forcelimited[k]:
            limits.append(gear * self._least(model.actuator_forcerange[k], f"forcerange {where}"))
        if kind == "position":
            self.stiffness[joint], self.damping[joint] = gain, -model.actuator_biasprm[k, 2]
        if model.actuator_ctrllimited[k] and kind == "position":
            self.control[joint] = model.actuator_ctrlrange[k]
        elif model.actuator_ctrllimited[k]:
            limits.append(gear * abs(gain) * self._least(model.actuator_ctrlrange[k], f"ctrlrange {where}"))
        self.effort[joint] = min(limits)

    def _least(self, span: NDArray[np.float64], what: str) -> float:
        if span[0] != -span[1]:
            self.problems.append(f"{what} that is not the same both ways, {span[0]:g} to {span[1]:g}")
        return float(span[1])

    def _kind(self, model: Any, k: int) -> str:
        if model.actuator_plugin[k] >= 0:
            return "an actuator of a plugin"
        gain, bias = model.actuator_gainprm[k], model.actuator_biasprm[k]
        simple = model.actuator_gaintype[k] == mj.mjtGain.mjGAIN_FIXED and not model.actuator_dyntype[k]
        if simple and model.actuator_biastype[k] == _BIAS.mjBIAS_NONE and not gain[1:].any():
            return "motor"
        if model.actuator_dyntype[k]:
            return "an actuator with a timeconst or other dynamics"
        if simple and model.actuator_biastype[k] == _BIAS.mjBIAS_AFFINE and not bias[0]:
            if gain[0] > 0.0 and bias[1] == -gain[0]:
                return "position"
            if not bias[1] and bias[2] == -gain[0]:
                return "a <velocity> drive, as of wheels,"
        return "an actuator that is neither <position> nor <motor>"


def _set_drives(spec: Any, drives: _Drives, robot: RobotCfg) -> None:
    """One position actuator a joint, in the joints' order, with the gains of the settings if they have some."""
    for actuator in spec.actuators:
        spec.delete(actuator)
    for k, name in enumerate(robot.joint_names):
        joint = spec.joint(name)
        if robot.armature is not None:
            joint.armature = robot.armature[k]
        if k in drives.follow:
            continue
        effort = min(drives.effort[k], np.inf if robot.effort_limit is None else robot.effort_limit[k])
        stiffness = drives.stiffness[k] if robot.stiffness is None else robot.stiffness[k]
        damping = drives.damping[k] if robot.damping is None else robot.damping[k]
        control, limited = drives.control[k], np.isfinite(effort)
        spec.add_actuator(
            name=name, target=name, trntype=_TRN, gear=(1.0, 0.0, 0.0, 0.0, 0.0, 0.0),
            gaintype=mj.mjtGain.mjGAIN_FIXED, gainprm=(stiffness, *(0.0,) * 9), dyntype=mj.mjtDyn.mjDYN_NONE,
            biastype=_BIAS.mjBIAS_AFFINE, biasprm=(0.0, -stiffness, -damping, *(0.0,) * 7),
            forcelimited=limited, forcerange=(-effort, effort) if limited else (0.0, 0.0),
            ctrllimited=not np.isnan(control[0]), ctrlrange=np.nan_to_num(control),
        )  # fmt: skip
