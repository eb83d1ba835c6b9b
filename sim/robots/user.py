"""Robots of a user: load and check their settings file, pack them for another machine."""

import itertools
import math
import os
import re
from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
import warp as wp

from kernels.penalties import PENALTIES
from sim.controllers.spec import run_file
from sim.device import host_device
from sim.files.settings import from_builtins, problems, read_toml, to_toml
from sim.robots.compiled import PER_JOINT, file_problems
from sim.robots.elements import joint_names, mj
from sim.robots.model import builder_of
from sim.robots.model_files import read_model_files
from sim.robots.probes import make_probes, measure_extents, start_height
from sim.robots.robot import RobotCfg
from sim.robots.robot_file import RobotFile, read_robot_file
from sim.robots.shipped import ROBOTS

_NAMES = ("base_geoms", "foot_geoms", "limb_geoms", "joint_names", "penalties")
INFERRED = ("name", "joint_names", "default_joint_pos", "base_geoms", "foot_geoms", "limb_geoms", "footprint", "scan_x",
            "scan_y", "contact_force_limit", "penalties", "collision_bit", "default_base_height")  # fmt: skip
"""Settings that a robot.toml may leave out though there is no default."""
_NOT_IN_TOML = ("label", "paper", "settings_file")  # settings
NEW_NAME = f"a new name of letters, digits, . _ and -, not {' or '.join(ROBOTS)}"
"""What a robot may be called, since files and folders are called after it."""
_FOOT_RISE = 0.015  # a foot's lowest point is at most so much above the robot's lowest one [m]


def is_new_name(name: str) -> bool:
    """Whether a robot may be called so."""
    return re.fullmatch(r"[A-Za-z0-9][\w.-]*", name) is not None and name not in ROBOTS


def load_robot(path: Path) -> RobotCfg:
    """Reads a settings file, or runs one that is Python, and checks the robot that it sets against its model."""
    file = path.resolve()  # of a link, the model lies beside what it points to
    robot, of_file = (
        _read_toml(path, file) if path.suffix == ".toml" else (getattr(run_file(path), "ROBOT", None), None)
    )
    if type(robot) is not RobotCfg:
        got = "nothing" if robot is None else type(robot).__name__
        raise ValueError(f"{path} must set ROBOT to a sim.robots.robot.RobotCfg, got {got} (docs/robots.md)")
    if isinstance(robot.model_file, str):
        robot = replace(robot, model_file=Path(robot.model_file))
    mistakes = settings_problems(robot)
    wrong = {line.split(" ", 1)[0] for line in mistakes}
    if "model_file" not in wrong:
        robot = replace(robot, model_file=file.parent / robot.model_file, settings_file=file)
        try:
            of_file = of_file or read_robot_file(robot.model_file)
            mistakes += file_problems(robot, of_file, wrong)
            with wp.ScopedDevice(host_device()):
                builder = builder_of(of_file.model)
                make_probes(builder)
                if not mistakes and not robot.default_base_height:
                    robot = replace(robot, default_base_height=start_height(robot, builder))
        except ValueError as error:
            mistakes.append(str(error))
    if mistakes:
        raise ValueError(f"{path}: {'; '.join(mistakes)}")
    return robot


def _read_toml(path: Path, file: Path) -> tuple[RobotCfg, RobotFile]:
    """The robot of a robot.toml, and its model, from which is inferred what it leaves out."""
    given = read_toml(path)
    known = [field.name for field in fields(RobotCfg) if field.name not in _NOT_IN_TOML]
    if unknown := [name for name in given if name not in known]:
        raise ValueError(f"{path} has settings that do not exist: {', '.join(unknown)}; there are {', '.join(known)}")
    if no_list := [name for name in _NAMES if not isinstance(given.get(name, []), list)]:
        raise ValueError(f"{path}: {', '.join(no_list)} must be a list of names")
    if not isinstance(given.get("model_file"), str):
        raise ValueError(f'{path} must name its MJCF or URDF: model_file = "robot.xml"')
    of_file = read_robot_file(file.parent / given["model_file"])
    joints = joint_names(of_file.model)
    given |= {name: per_joint(given[name], joints, f"{path}: {name}") for name in PER_JOINT if name in given}
    return from_builtins(RobotCfg, infer(given, file, of_file), str(path)), of_file


def per_joint(value: Any, joints: Sequence[str], what: str, *, partly: bool = False) -> list[Any]:
    """One value a joint, of a list, of one number, or of a table by joint names or regular expressions.

    A name counts before an expression; every joint must be matched once, and every entry must match. ``partly``: joints
    without a match have None, entries may be of joints that are not there, but not all.
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
    if idle and (len(idle) == len(value) if partly and joints else not partly):
        raise ValueError(f"{what}: {', '.join(idle)} matches no joint of {', '.join(joints)}")
    wrong = [f"{joint} ({', '.join(keys) or 'by none'})" for joint, keys in zip(joints, matches, strict=True)
             if len(keys) > 1 or not (keys or partly)]  # fmt: skip
    if wrong:
        raise ValueError(f"{what} must match every joint by one entry: got {', '.join(wrong)}")
    return [value[keys[0]] if keys else None for keys in matches]


def infer(given: dict[str, Any], file: Path, of_file: RobotFile) -> dict[str, Any]:
    """Settings of a robot.toml with those that it leaves out, as far as its compiled model says them.

    The base are the geoms of the first body; feet are the geoms of last bodies that come within 1.5 cm of the lowest
    point in the default pose; limbs are all others. The default pose is the keyframe ``home`` of the file, else zero or
    the nearest angle that a joint can take. The contact force limit is the weight. The name is that of the folder of
    ``file``, the robot.toml; the scan is the first one in the observation of a controller.toml beside it. ``given`` has
    one value a joint where a setting is of joints.
    """
    model = of_file.model
    low, high = model.jnt_range[1:].T
    nearest = np.where(model.jnt_limited[1:] == 1, np.clip(0.0, low, high), 0.0).tolist()
    found: dict[str, Any] = {"name": file.parent.name, "joint_names": list(joint_names(model)), "collision_bit": False}
    found |= {"default_joint_pos": of_file.home or nearest} | given
    pose = found["default_joint_pos"]
    if len(pose) != model.njnt - 1 or not all(
        isinstance(angle, int | float) and math.isfinite(angle) for angle in pose
    ):
        raise ValueError(f"{file}: default_joint_pos must be {model.njnt - 1} angles [rad], got {pose}")
    ((bottoms, _),) = measure_extents(builder_of(model), [pose])
    body = {model.geom(k).name: int(model.geom_bodyid[k]) for k in np.flatnonzero(model.geom_contype)}
    taken = {name for role in ("base_geoms", "foot_geoms", "limb_geoms") for name in given.get(role, ())}
    free = [name for name in bottoms if name not in taken]
    low, last = min(bottoms.values()) + _FOOT_RISE, {*range(2, model.nbody)} - {*map(int, model.body_parentid)}
    found.setdefault("base_geoms", [name for name in free if body[name] == 1])
    found.setdefault("foot_geoms", [name for name in free if body[name] in last and bottoms[name] <= low])
    limbs = [name for name in free if name not in {*found["base_geoms"], *found["foot_geoms"]}]
    found.setdefault("limb_geoms", limbs)
    usual = [penalty for penalty in PENALTIES.values() if penalty.default]
    found.setdefault("penalties", [p.name for p in usual if found["limb_geoms"] or not p.needs_limbs])
    weight = -float(model.opt.gravity[2]) * float(model.body_mass.sum())
    found.setdefault("contact_force_limit", float(f"{weight:.3g}"))
    found.setdefault("footprint", _footprint(model, pose, found["foot_geoms"]))
    controller = file.with_name("controller.toml")
    terms = read_toml(controller).get("observation", ()) if controller.exists() else ()
    scans = [term for term in terms if isinstance(term, dict) and term.get("term") == "scan"]
    return {f"scan_{axis}": scans[0].get(axis, []) if scans else [] for axis in "xy"} | found


def _footprint(model: Any, pose: Sequence[float], feet: Sequence[str]) -> list[float]:
    """Half length and half width of the rectangle about the base that holds the feet in the default pose [m]."""
    data = mj.MjData(model)
    data.qpos[:7], data.qpos[7:] = (0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0), pose
    mj.mj_kinematics(model, data)
    numbers = [k for k in range(model.ngeom) if model.geom(k).name in feet]
    reach = np.abs(data.geom_xpos[numbers, :2]) + model.geom_rbound[numbers, None]
    return [float(np.ceil(100.0 * side) / 100.0) for side in reach.max(axis=0, initial=0.01)]


def describe_inferred(robot: RobotCfg) -> str:
    """The settings that a robot's robot.toml leaves out, as lines that could stand there; nothing of other robots."""
    file = robot.settings_file
    if file is None or file.suffix != ".toml":
        return ""
    given = read_toml(file)
    lines = [f"{name} = {to_toml(getattr(robot, name))}" for name in INFERRED if name not in given]
    return "\n  ".join([f"Inferred; what is not right can be set in {file}:", *lines])


def settings_problems(robot: RobotCfg) -> list[str]:
    """What is wrong with settings by themselves, one line each."""
    mistakes = problems(robot)
    wrong = {line.split(" ", 1)[0] for line in mistakes}
    if "name" not in wrong and not is_new_name(robot.name):
        mistakes.append(f"name must be {NEW_NAME}, got {robot.name!r}")
    if wrong.isdisjoint(_NAMES):
        mistakes += _name_problems(robot)
    for one, other in (("stiffness", "damping"), ("saturation_effort", "velocity_limit")):
        if (getattr(robot, one) is None) != (getattr(robot, other) is None):
            mistakes.append(f"{one} and {other} must be given together")
    if wrong.isdisjoint(("max_duration_s", "physics_dt", "decimation")) and robot.max_duration_s < robot.control_dt:
        mistakes.append(f"max_duration_s must be a control step or more, {robot.control_dt:g} s")
    fine = wrong.isdisjoint(("contact_time_constant_s", "physics_dt"))
    given, step = robot.contact_time_constant_s if fine else None, robot.physics_dt
    if given is not None and given < 2.0 * step * (1.0 - 1e-9):
        mistakes.append(f"contact_time_constant_s must be at least twice physics_dt, {2 * step:g} s, got {given:g}")
    return mistakes


def _name_problems(robot: RobotCfg) -> list[str]:
    names = {field: getattr(robot, field) for field in _NAMES}
    roles = {role: names[role] for role in ("base_geoms", "limb_geoms", "foot_geoms")}
    twice = sorted({name for a, b in itertools.combinations(roles.values(), 2) for name in {*a} & {*b}})
    strange = [name for name in getattr(robot.training, "steady_joints", ()) if name not in robot.joint_names]
    known = set(robot.penalties) <= set(PENALTIES) and len(robot.penalties) >= 2
    needed = ("base_geoms", "foot_geoms", "joint_names")
    repeats = {field: ", ".join(row) for field, row in names.items() if len({*row}) < len(row)}
    findings = [
        *((not names[field], f"{field} must name at least one") for field in needed),
        *((True, f"{field} must hold each name once, got {row}") for field, row in repeats.items()),
        (twice, f"a geom has one role: {', '.join(twice)} is in two of {', '.join(roles)}"),
        (not known, f"penalties must be at least 2 of {', '.join(PENALTIES)}, got {', '.join(robot.penalties)}"),
        (strange, f"training.steady_joints: no joint named {', '.join(strange)} in joint_names"),
    ]
    return [text for holds, text in findings if holds]


@dataclass(frozen=True, kw_only=True)
class PackedRobot:
    """A user's robot with its files, for a machine that may lack them."""

    robot: RobotCfg
    files: tuple[tuple[str, bytes], ...]
    """Path and content of the model's files, itself first, below a folder they have in common."""

    def unpacked(self, folder: Path) -> RobotCfg:
        """The robot with its files in ``folder``; they are needed until its model is built."""
        for name, content in self.files:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        return replace(self.robot, model_file=folder / self.files[0][0])


def pack_robot(robot: RobotCfg) -> PackedRobot | str:
    """What to send of a robot: the name alone of a shipped one, which every machine has."""
    if robot.settings_file is None and ROBOTS.get(robot.name) == robot:
        return robot.name
    files = read_model_files(robot.model_file).files
    # The folder's own name goes along: a URDF may call its package by it.
    root = Path(os.path.commonpath([file.parent for file in files])).parent
    return PackedRobot(robot=robot, files=tuple((str(file.relative_to(root)), file.read_bytes()) for file in files))
