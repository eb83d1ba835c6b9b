"""Robots of a user: load and check their settings file, pack them for another machine."""

import itertools
import math
import os
import re
from collections.abc import Iterator, Sequence
from dataclasses import MISSING, dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from kernels.penalties import PENALTIES
from sim.controllers.spec import run_file
from sim.device import host_device
from sim.files.atomic import write_atomically
from sim.files.settings import check_settings, from_builtins, read_toml, to_toml
from sim.robots.actuator_net import ActuatorNet
from sim.robots.compiled import PER_JOINT, RobotFile, file_problems, joint_names, mj, read_robot_file
from sim.robots.model_files import find_model, read_model_files
from sim.robots.robot import ROBOTS, RobotCfg, needed_senses

_ROLES = ("base_geoms", "foot_geoms", "limb_geoms")
_NAMES = (*_ROLES, "joint_names", "arm_joints", "penalties", "senses")
NEW_NAME = f"a new name of letters, digits, . _ and -, not {' or '.join(ROBOTS)}"  # of files and folders, too
_FOOT_RISE = 0.015  # a foot's lowest point is at most so much above the robot's lowest one [m]
_MAX_SPEED = 300.0  # light legs get faster than 100 rad/s in falls, and where they shake [rad/s]


def is_new_name(name: str) -> bool:
    """Whether a robot may be called so."""
    return re.fullmatch(r"[A-Za-z0-9][\w.-]*", name) is not None and name not in ROBOTS


def load_robot(path: Path) -> RobotCfg:
    """Reads a settings file, or runs one that is Python, and checks the robot that it sets against its model."""
    from sim.robots.model import make_builder  # loads Newton, which takes seconds, as in all of this file
    from sim.robots.probes import make_probes, start_height

    file = path.resolve()  # of a link, the model lies beside what it points to
    robot = _read_toml(path, file) if path.suffix == ".toml" else getattr(run_file(path), "ROBOT", None)
    if type(robot) is not RobotCfg:
        got = "nothing" if robot is None else type(robot).__name__
        raise ValueError(f"{path} must set ROBOT to a sim.robots.robot.RobotCfg, got {got} (docs/robots.md)")
    try:
        net = robot.actuator_net and replace(robot.actuator_net, file=file.parent / robot.actuator_net.file)
        model = find_model(robot.model_file, file.parent)
        robot = replace(robot, model_file=model, settings_file=file, actuator_net=net)
        check_settings(robot)
        if net is not None:
            ActuatorNet(net)
        robot_file = read_robot_file(robot.model_file)
        builder = make_builder(robot_file.model)
        mistakes = [*settings_problems(robot), *file_problems(robot, robot_file)]
        try:
            with wp.ScopedDevice(host_device()):
                make_probes(builder)
        except ValueError as error:
            mistakes.append(str(error))
        if mistakes:
            raise ValueError("; ".join(mistakes))
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
    return robot if robot.default_base_height else replace(robot, default_base_height=start_height(robot, builder))


def _read_toml(path: Path, file: Path) -> RobotCfg:
    """The robot of a robot.toml; what it leaves out is inferred from its model."""
    settings = read_toml(path)
    names = [field.name for field in fields(RobotCfg) if field.name not in ("label", "paper", "settings_file")]
    if unknown := [name for name in settings if name not in names]:
        raise ValueError(f"{path} has settings that do not exist: {', '.join(unknown)}; there are {', '.join(names)}")
    if no_list := [name for name in _NAMES if not isinstance(settings.get(name, []), list)]:
        raise ValueError(f"{path}: {', '.join(no_list)} must be a list of names")
    if not isinstance(settings.get("model_file"), str):
        raise ValueError(f'{path} must name its MJCF or URDF: model_file = "robot.xml"')
    robot_file = read_robot_file(find_model(settings["model_file"], file.parent))
    joints = joint_names(robot_file.model)
    settings |= {name: per_joint(settings[name], joints, f"{path}: {name}") for name in PER_JOINT if name in settings}
    return from_builtins(RobotCfg, infer_settings(settings, file, robot_file), str(path))


def per_joint(value: Any, joints: Sequence[str], what: str, *, partly: bool = False) -> list[Any]:
    """One value a joint, of a list, of one number, or of a table by joint names or else regular expressions.

    Every joint must match one entry, every entry a joint; ``partly``: a joint may have None, and some entries no joint.
    """
    if isinstance(value, list):
        return value
    if not isinstance(value, dict):
        return [value] * len(joints)
    try:
        matches = [[name] if name in value else [key for key in value if re.fullmatch(key, name)] for name in joints]
    except re.error as error:
        raise ValueError(f"{what} must have names or regular expressions, got {error.pattern!r}: {error}") from None
    idle = [key for key in value if not any(key in keys for keys in matches)]
    if idle and (not partly or (len(idle) == len(value) and joints)):
        raise ValueError(f"{what}: {', '.join(idle)} matches no joint of {', '.join(joints)}")
    for joint, keys in zip(joints, matches, strict=True):
        if len(keys) > 1 or not (keys or partly):
            raise ValueError(f"{what} must match every joint once: got {', '.join(keys) or 'nothing'} for {joint}")
    return [value[keys[0]] if keys else None for keys in matches]


def infer_settings(given: dict[str, Any], file: Path, robot_file: RobotFile) -> dict[str, Any]:
    """Settings of a robot.toml with those that it leaves out, as docs/robots.md says; ``given`` has lists a joint."""
    from sim.robots.model import make_builder
    from sim.robots.probes import measure_extents

    model = robot_file.model
    nearest = np.where(model.jnt_limited[1:] == 1, np.clip(0.0, *model.jnt_range[1:].T), 0.0).tolist()
    pose = given.get("default_joint_pos", robot_file.home or nearest)
    if len(pose) != model.njnt - 1 or not all(isinstance(q, int | float) and math.isfinite(q) for q in pose):
        raise ValueError(f"{file}: default_joint_pos must be {model.njnt - 1} angles [rad], got {pose}")
    ((bottoms, _),) = measure_extents(make_builder(model), [pose])
    body = {model.geom(k).name: int(model.geom_bodyid[k]) for k in np.flatnonzero(model.geom_contype)}
    last_bodies = {*range(2, model.nbody)} - {*map(int, model.body_parentid)}
    roles = {role: given[role] for role in _ROLES if role in given}  # geoms of those have no other
    low = [name for name, bottom in bottoms.items() if bottom <= min(bottoms.values()) + _FOOT_RISE]
    free = [name for name in bottoms if not any(name in names for names in roles.values())]
    roles.setdefault("base_geoms", [name for name in free if body[name] == 1])
    roles.setdefault("foot_geoms", [name for name in free if name in low and body[name] in last_bodies])
    roles.setdefault("limb_geoms", [name for name in free if name not in roles["base_geoms"] + roles["foot_geoms"]])
    data = mj.MjData(model)
    data.qpos[:] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, *pose]
    mj.mj_kinematics(model, data)
    feet = [k for k in range(model.ngeom) if model.geom(k).name in roles["foot_geoms"]]
    reach = np.abs(data.geom_xpos[feet, :2]) + model.geom_rbound[feet, None]  # of the feet from the base
    weight = -float(model.opt.gravity[2]) * float(model.body_mass.sum())
    controller, names = file.with_name("controller.toml"), joint_names(model)
    content = read_toml(controller) if controller.exists() else {}
    terms = [term for term in content.get("observation", ()) if isinstance(term, dict)]
    scan = next((term for term in terms if term.get("term") == "scan"), {})
    inferred = {
        "name": file.parent.name,
        "joint_names": list(names),
        "arm_joints": [name for name in names if name not in content.get("joints", names)],
        "collision_bit": False,
        "default_joint_pos": pose,
        "penalties": [p.name for p in PENALTIES.values() if p.default and (roles["limb_geoms"] or not p.needs_limbs)],
        "contact_force_limit": float(f"{weight:.3g}"),
        "footprint": [float(np.ceil(100.0 * side) / 100.0) for side in reach.max(axis=0, initial=0.01)],
        "scan_x": scan.get("x", []),
        "scan_y": scan.get("y", []),
        "senses": needed_senses([str(term.get("axes", term.get("term"))) for term in terms]),
        "max_speed": _MAX_SPEED,
    }
    return inferred | roles | given


def describe_inferred(robot: RobotCfg) -> str:
    """The settings that a robot's robot.toml leaves out, as lines that could stand there; nothing of other robots."""
    file = robot.settings_file
    if file is None or file.suffix != ".toml":
        return ""
    required = [field.name for field in fields(RobotCfg) if field.default is field.default_factory is MISSING]
    optional = ["default_base_height", "max_speed", *filter(vars(robot).get, ("senses", "arm_joints"))]
    names = [name for name in (*required, *optional) if name not in read_toml(file)]
    lines = [f"{name} = {to_toml(getattr(robot, name))}" for name in names]
    return "\n  ".join([f"Inferred; what is not right can be set in {file}:", *lines])


def write_setting(file: Path, name: str, value: Any, reason: str = "") -> None:
    """Writes a setting to the top of a robot.toml, with the reason as a comment, in place of a line of its name."""
    text = re.sub(rf"^{name}\s*=.*\n?", "", file.read_text(encoding="utf-8"), flags=re.MULTILINE)
    comment = f"  # {reason}" if reason else ""
    write_atomically(file, f"{name} = {to_toml(value)}{comment}\n{text}".encode())


def settings_problems(robot: RobotCfg) -> Iterator[str]:
    """Complaints about settings that do not fit each other, one line each; every one has its own type and range."""
    if not is_new_name(robot.name):
        yield f"name must be {NEW_NAME}, got {robot.name!r}"
    for field in _NAMES:
        names = getattr(robot, field)
        if not names and field not in ("limb_geoms", "arm_joints", "penalties", "senses"):
            yield f"{field} must name at least one"
        if len({*names}) < len(names):
            yield f"{field} must hold each name once, got {', '.join(names)}"
    for role, other in itertools.combinations(_ROLES, 2):
        if both := {*getattr(robot, role)} & {*getattr(robot, other)}:
            yield f"a geom has one role: {', '.join(sorted(both))} is in {role} and {other}"
    if not {*robot.penalties} <= {*PENALTIES} or len(robot.penalties) < 2:
        yield f"penalties must be at least 2 of {', '.join(PENALTIES)}, got {', '.join(robot.penalties)}"
    for field, names in (("arm_joints", robot.arm_joints), ("training.steady_joints", robot.training.steady_joints)):
        if missing := [name for name in names if name not in robot.joint_names]:
            yield f"{field}: no joint named {', '.join(missing)} in joint_names"
    for name, other in (("stiffness", "damping"), ("saturation_effort", "velocity_limit")):
        if (getattr(robot, name) is None) != (getattr(robot, other) is None):
            yield f"{name} and {other} must be given together"
    if robot.actuator_net is not None and robot.stiffness is not None:
        yield "actuator_net stands in place of stiffness and damping: leave those out"
    if robot.max_duration_s < robot.control_dt:
        yield f"max_duration_s must be a control step or more, {robot.control_dt:g} s"
    constant, least = robot.contact_time_constant_s, 2.0 * robot.physics_dt
    if constant is not None and constant < least * (1.0 - 1e-9):
        yield f"contact_time_constant_s must be at least twice physics_dt, {least:g} s, got {constant:g}"


@dataclass(frozen=True, kw_only=True)
class PackedRobot:
    """A user's robot with its files, for a machine that may lack them."""

    robot: RobotCfg
    files: tuple[tuple[str, bytes], ...]
    """Path and content of the model's files, itself first, and an actuator network, below a folder in common."""

    def unpacked(self, folder: Path) -> RobotCfg:
        """The robot with its files in ``folder``; they are needed until its model is built."""
        for name, content in self.files:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        net = self.robot.actuator_net and replace(self.robot.actuator_net, file=folder / self.files[-1][0])
        return replace(self.robot, model_file=folder / self.files[0][0], actuator_net=net)


def pack_robot(robot: RobotCfg) -> PackedRobot | str:
    """What to send of a robot: the name alone of a shipped one, which every machine has."""
    if robot.settings_file is None and ROBOTS.get(robot.name) == robot:
        return robot.name
    nets = () if robot.actuator_net is None else (robot.actuator_net.file,)
    files = (*read_model_files(robot.model_file).files, *nets)
    # The folder's own name goes along: a URDF may call its package by it.
    root = Path(os.path.commonpath([file.parent for file in files])).parent
    return PackedRobot(robot=robot, files=tuple((str(file.relative_to(root)), file.read_bytes()) for file in files))
