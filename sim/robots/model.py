"""A robot's file, MJCF or URDF, as a Newton model, checked against the robot's settings."""

import xml.etree.ElementTree as ET
from collections.abc import Collection, Sequence
from typing import Any

import newton
import numpy as np
import warp as wp

from sim.files.command import with_traceback
from sim.robots.model_files import ModelFiles, joints_without_effort, read_model_files
from sim.robots.robot import RobotCfg

_URDF_FRICTION = 1.0
_URDF_TIME_CONSTANT_S = 0.01
_vec3: Any = wp.vec3
_RAW_SOLREF = 1  # Newton: MuJoCo's solref is taken as it stands


def leaf_name(label: str) -> str:
    """Name of a Newton label's last part: ``anymal/worldbody/base/LF_HIP`` -> ``LF_HIP``."""
    return label.rsplit("/", 1)[-1]


def joint_names(builder: newton.ModelBuilder) -> list[str]:
    """Names of a robot's joints without that of its base."""
    return [leaf_name(label) for label in builder.joint_label][1:]


def geom_names(builder: newton.ModelBuilder) -> list[str]:
    """Names of a robot's collision shapes."""
    return [leaf_name(label) for label in builder.shape_label]


def build_robot(robot: RobotCfg) -> newton.ModelBuilder:
    """One robot as a Newton builder, ready to be replicated into worlds.

    Visual shapes are left out, bodies that are fixed to each other become one. Collision shapes of a URDF are called as
    their link, with a number from 0 behind where it has several (``LF_SHANK_0``).
    """
    builder, problems = read_robot(robot)
    if problems:
        raise ValueError(f"robot '{robot.name}': {'; '.join(problems)}")
    return builder


def read_robot(robot: RobotCfg, wrong: Collection[str] = ()) -> tuple[newton.ModelBuilder, list[str]]:
    """One robot as :func:`build_robot` makes it, and what is wrong with it, one line each.

    Fields of the settings in ``wrong`` are not compared with the model.
    """
    builder = newton.ModelBuilder()
    newton.solvers.SolverMuJoCo.register_custom_attributes(builder)
    builder.rigid_gap = 0.0  # the default of 0.1 m triples the contacts
    try:
        files = read_model_files(robot.model_file)
    except ValueError as error:
        return builder, [str(error)]
    problems = list(files.problems)
    try:
        _add_model(builder, robot, files)
    except Exception as error:  # an importer can fail with anything
        reason = ": ".join(filter(None, [type(error).__name__, " ".join(str(error).split())]))
        line = with_traceback(error, f"{robot.model_file} cannot be imported: {reason}")
        return newton.ModelBuilder(), problems or [line]
    # The other checks need a tree of single joints, where joints and their columns are the same.
    structure = _structure_problems(builder)
    if structure:
        return builder, problems + structure
    joints = joint_names(builder)
    problems += _number_problems(builder, joints)
    problems += _drive_problems(builder, files.root, joints)
    if "joint_names" not in wrong:
        problems += _joint_name_problems(builder, robot) or _joint_value_problems(builder, robot, files, wrong)
    roles = [role for role in ("base_geoms", "limb_geoms", "foot_geoms") if role not in wrong]
    geoms = [name for role in roles for name in getattr(robot, role)]
    problems += _unknown("geom", geoms, geom_names(builder), robot)
    if not problems and not wrong:
        _set_contact(builder, robot, is_urdf=files.is_urdf)
    return builder, problems


def _add_model(builder: newton.ModelBuilder, robot: RobotCfg, files: ModelFiles) -> None:
    if files.is_urdf:
        for capsule in files.root.iter("capsule"):
            capsule.set("height", capsule.get("length", capsule.get("height", "1")))  # Newton knows it by this name
        builder.default_shape_cfg.density = 0.0  # a link without <inertial> has no mass
        text = ET.tostring(files.root, encoding="unicode")
        builder.add_urdf(text, floating=True, enable_self_collisions=False)
        _name_by_link(builder)
    else:
        builder.add_mjcf(
            str(robot.model_file), enable_self_collisions=False, parse_mujoco_options=False, parse_visuals=False
        )
    if newton.JointType.FIXED in builder.joint_type:
        _merge_fixed_bodies(builder)


def _name_by_link(builder: newton.ModelBuilder) -> None:
    """Calls the shapes of a URDF, which has no names for them that are unique, by their links."""
    bodies = list(builder.shape_body)
    for k, body in enumerate(bodies):
        name = builder.body_label[body]
        builder.shape_label[k] = f"{name}_{bodies[:k].count(body)}" if bodies.count(body) > 1 else name


def _merge_fixed_bodies(builder: newton.ModelBuilder) -> None:
    """Makes one body of those that are fixed to each other, with the mass, mass centre and inertia of all of them.

    Newton's own merging adds inertias about different points.
    """
    model: Any = builder  # its lists hold Warp's types
    root, pose = list(range(model.body_count)), [wp.transform_identity()] * model.body_count
    for joint, kind in enumerate(model.joint_type):  # parents come before their children
        parent, child = model.joint_parent[joint], model.joint_child[joint]
        if kind == newton.JointType.FIXED and parent >= 0:
            in_parent = model.joint_X_p[joint] * wp.transform_inverse(model.joint_X_c[joint])
            root[child], pose[child] = root[parent], pose[parent] * in_parent
    masses = {
        model.body_label[body]: _mass_of(model, [k for k in range(model.body_count) if root[k] == body], pose)
        for body in set(root)
    }
    model.collapse_fixed_joints()
    for body, label in enumerate(model.body_label):
        mass, centre, inertia = masses[label]
        model.body_mass[body], model.body_com[body] = mass, wp.vec3(*centre)
        model.body_inertia[body] = wp.mat33(*inertia.ravel())
        model.body_inv_mass[body] = 1.0 / mass if mass > 0.0 else 0.0
        model.body_inv_inertia[body] = wp.inverse(model.body_inertia[body]) if mass > 0.0 else wp.mat33()


def _mass_of(builder: Any, bodies: list[int], poses: list[Any]) -> tuple[float, np.ndarray, np.ndarray]:
    """Mass [kg], mass centre [m] and inertia about it [kg m^2] of some bodies; poses of all are given."""
    mass = [float(builder.body_mass[k]) for k in bodies]
    centres = [np.array(wp.transform_point(poses[k], _vec3(*builder.body_com[k])), dtype=np.float64) for k in bodies]
    total = sum(mass)
    centre = np.average(centres, axis=0, weights=mass) if total > 0.0 else centres[0]
    inertia = np.zeros((3, 3))
    for k, m, centre_of_body in zip(bodies, mass, centres, strict=True):
        turn = np.array(wp.quat_to_matrix(poses[k].q), dtype=np.float64).reshape(3, 3)
        off = centre_of_body - centre
        inertia += turn @ np.array(builder.body_inertia[k], dtype=np.float64).reshape(3, 3) @ turn.T
        inertia += m * (off @ off * np.eye(3) - np.outer(off, off))
    return total, centre, inertia


def _structure_problems(builder: newton.ModelBuilder) -> list[str]:
    if builder.joint_count == 0 or builder.joint_type[0] != newton.JointType.FREE:
        return ["the first body must move freely: give it a <freejoint/>"]
    problems = []
    joints = joint_names(builder)
    crowded = [name for name, size in zip(joints, builder.joint_dof_dim[1:], strict=True) if sum(size) != 1]
    if crowded:
        problems.append(f"every joint must be a hinge or slide on a body of its own, unlike {', '.join(crowded)}")
    fixed = [name for name, body in zip(geom_names(builder), builder.shape_body, strict=True) if body < 0]
    if fixed:
        problems.append(f"geoms that belong to the world, not to the robot: {', '.join(fixed)}: take them out")
    return problems


def _joint_name_problems(builder: newton.ModelBuilder, robot: RobotCfg) -> list[str]:
    joints = joint_names(builder)
    problems = _unknown("joint", robot.joint_names, joints, robot)
    if not problems and tuple(joints) != robot.joint_names:
        problems.append(f"joint_names must follow the file's order {tuple(joints)}, got {robot.joint_names}")
    return problems


def _joint_value_problems(
    builder: newton.ModelBuilder, robot: RobotCfg, files: ModelFiles, wrong: Collection[str]
) -> list[str]:
    """What is wrong with the settings that have a value for each joint; gains, limits and armature are taken over."""
    joints, problems = robot.joint_names, []
    values = {name: getattr(robot, name) for name in _UNITS if name not in wrong}
    short = {name: len(given) for name, given in values.items() if given is not None and len(given) != len(joints)}
    for name, count in short.items():
        problems.append(f"{name} needs {len(joints)} {_UNITS[name]}, got {count}")
    if "default_joint_pos" in values and "default_joint_pos" not in short:
        problems += _range_problems(builder, robot)
    weak = joints_without_effort(files.root) if files.is_urdf and robot.effort_limit is None else []
    if weak:
        problems.append(f"no <limit effort> above 0 for {', '.join(weak)}: give it, or effort_limit in the settings")
    if len(values) == len(_UNITS) and not short:
        problems += _set_drives(builder, robot)
    return problems


def _range_problems(builder: newton.ModelBuilder, robot: RobotCfg) -> list[str]:
    """Default angles that the joints cannot take."""
    limits = builder.joint_limit_lower[6:], builder.joint_limit_upper[6:]
    ranges = zip(robot.joint_names, robot.default_joint_pos, *limits, strict=True)
    beyond = [f"{name} ({low:g} to {high:g}, got {angle:g})" for name, angle, low, high in ranges
              if not low - _SLACK <= angle <= high + _SLACK]  # fmt: skip
    degrees = ": angles are in radians" if any(abs(angle) > 2.0 * np.pi for angle in robot.default_joint_pos) else ""
    return [f"default_joint_pos is outside of the file's range for {', '.join(beyond)}{degrees}"] if beyond else []


_SLACK = 1e-3  # files round [rad]
_UNITS = {
    "default_joint_pos": "angles",
    "stiffness": "gains [N m/rad]",
    "damping": "gains [N m s/rad]",
    "effort_limit": "limits [N m]",
    "armature": "inertias [kg m^2]",
}


def _unknown(kind: str, wanted: Sequence[str], present: list[str], robot: RobotCfg) -> list[str]:
    missing = [name for name in wanted if name not in present]
    if not missing:
        return []
    return [f"no {kind} named {', '.join(missing)} in {robot.model_file}: the file has {', '.join(present)}"]


def _set_drives(builder: newton.ModelBuilder, robot: RobotCfg) -> list[str]:
    """Takes gains, limits and armature from the settings where they are given; returns the problems of the gains."""
    joints = robot.joint_names
    driven = [name for name, gain in zip(joints, builder.joint_target_ke[6:], strict=True) if gain > 0.0]
    limp = [name for name in joints if name not in driven]
    if robot.stiffness is not None and driven:
        return [f"stiffness and position actuators for {', '.join(driven)} in {robot.model_file}: take one of them out"]
    if robot.stiffness is None and limp:
        return [f"no gains for {', '.join(limp)}: give stiffness and damping, or <position> in {robot.model_file}"]
    for name, gains in (("joint_target_ke", robot.stiffness), ("joint_target_kd", robot.damping),
                        ("joint_effort_limit", robot.effort_limit), ("joint_armature", robot.armature)):  # fmt: skip
        if gains is not None:
            getattr(builder, name)[6:] = list(gains)
    if robot.stiffness is not None:
        builder.joint_target_mode[6:] = [int(newton.JointTargetMode.POSITION)] * len(joints)
    return []


def _set_contact(builder: newton.ModelBuilder, robot: RobotCfg, *, is_urdf: bool) -> None:
    """Friction and contact time constant of the settings; a URDF has none of its own."""
    friction = _URDF_FRICTION if is_urdf and robot.friction is None else robot.friction
    time_constant_s = robot.contact_time_constant_s
    if is_urdf and time_constant_s is None:
        time_constant_s = _URDF_TIME_CONSTANT_S
    if friction is not None:
        builder.shape_material_mu[:] = [friction] * builder.shape_count
    if time_constant_s is not None:
        solref: Any = builder.custom_attributes["mujoco:solref"].values
        modes: Any = builder.custom_attributes["mujoco:solref_mode"].values
        for shape in range(builder.shape_count):
            solref[shape], modes[shape] = wp.vec2(time_constant_s, 1.0), _RAW_SOLREF


_JOINT_COLUMNS = {
    "joint_limit_lower": ("range", -np.inf),
    "joint_limit_upper": ("range", -np.inf),
    "joint_target_ke": ("kp", 0.0),
    "joint_target_kd": ("kv", 0.0),
    "joint_armature": ("armature", 0.0),
    "joint_effort_limit": ("largest torque", 0.0),
}
"""What each column of a builder holds, and at least."""


def _number_problems(builder: newton.ModelBuilder, joints: Sequence[str]) -> list[str]:
    """What is wrong with masses, frames and joints of a robot of single joints, one line each."""
    bodies, problems = [leaf_name(label) for label in builder.body_label], []
    light = [name for name, mass in zip(bodies, builder.body_mass, strict=True) if not 0.0 < mass < np.inf]
    if light:
        problems.append(f"every body must have a mass above 0, unlike {', '.join(light)}: give it an <inertial>")
    hollow = [name for name, inertia in zip(bodies, builder.body_inertia, strict=True)
              if name not in light and not _is_inertia(inertia)]  # fmt: skip
    if hollow:
        problems.append(f"every body must have an inertia above 0 about every axis, unlike {', '.join(hollow)}")
    lost = [name for name, com in zip(bodies, builder.body_com, strict=True) if not np.isfinite(np.array(com)).all()]
    poses = zip(joints, builder.joint_X_p[1:], strict=True)
    lost += [name for name, pose in poses if not np.isfinite(np.array(pose)).all()]
    if lost:
        problems.append(f"position and rotation must be numbers, unlike those of {', '.join(lost)}")
    return problems + _joint_problems(builder, joints)


def _is_inertia(inertia: Any) -> bool:
    matrix = np.array(inertia, dtype=np.float64).reshape(3, 3)
    return bool(np.isfinite(matrix).all()) and float(np.linalg.eigvalsh(matrix).min()) > 0.0


def _joint_problems(builder: newton.ModelBuilder, joints: Sequence[str]) -> list[str]:
    problems = []
    for column, (what, least) in _JOINT_COLUMNS.items():
        values = zip(joints, getattr(builder, column)[6:], strict=True)
        wrong = [f"{name} ({value:g})" for name, value in values if not value >= least]
        if wrong:
            problems.append(f"{what} must be a number{', 0 or more' * (least == 0.0)}, got {', '.join(wrong)}")
    skew = [name for name, axis in zip(joints, builder.joint_axis[6:], strict=True)
            if not abs(np.linalg.norm(np.array(axis, dtype=np.float64)) - 1.0) < 1e-3]  # fmt: skip
    return [*problems, f"axis must be a direction, unlike that of {', '.join(skew)}"] if skew else problems


def effort_limits(builder: newton.ModelBuilder) -> list[float]:
    """Largest torque of each joint [N m]: the joint's own, or its actuator's if that is less."""
    attributes: Any = builder.custom_attributes
    efforts = [float(effort) for effort in builder.joint_effort_limit[6:]]
    names = ("actuator_trnid", "actuator_has_forcerange", "actuator_forcerange")
    for target, limited, span in zip(*(attributes[f"mujoco:{name}"].values or () for name in names), strict=True):
        if limited and 0 <= target[0] - 6 < len(efforts):
            efforts[target[0] - 6] = min(efforts[target[0] - 6], float(span[1]))
    return efforts


def _drive_problems(builder: newton.ModelBuilder, root: ET.Element, joints: Sequence[str]) -> list[str]:
    """Drives and joints that MuJoCo would move otherwise than the simulation, one line each; ``root`` is the file's."""
    attributes: dict[str, Any] = {name: builder.custom_attributes[f"mujoco:{name}"].values for name in _ATTRIBUTES}
    sources, biases, gears, targets = (list(attributes[name] or ()) for name in _ATTRIBUTES[:4])
    direct = newton.solvers.SolverMuJoCo.CtrlSource.CTRL_DIRECT
    driven = [int(target[0]) for target, source in zip(targets, sources, strict=True) if source != direct]
    refs: Any = attributes["dof_ref"] or {}
    mistakes = {
        "an actuator that pulls by itself": [f"number {k}" for k, source in enumerate(sources)
                                             if source == direct and any(biases[k])],
        "a gear other than 1 on an actuator": [f"number {k}" for k, gear in enumerate(gears)
                                               if sources[k] != direct and gear[0] != 1.0],
        "an actuator with a timeconst": ["<position>"] * any(drive.get("timeconst") for drive in root.iter("position")),
        "more than one actuator on a joint": [name for k, name in enumerate(joints) if driven.count(6 + k) > 1],
        "a ref other than 0": [joints[dof - 6] for dof, ref in refs.items() if dof >= 6 and ref != 0.0],
    }  # fmt: skip
    return [
        f"{what} ({', '.join(names)}) is not understood: take it out (<position>, one a joint, and <motor> are)"
        for what, names in mistakes.items()
        if names
    ]


_ATTRIBUTES = ("ctrl_source", "actuator_biasprm", "actuator_gear", "actuator_trnid", "dof_ref")
