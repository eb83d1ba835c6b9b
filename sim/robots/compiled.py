"""A robot's file as MuJoCo compiles it, in the one form that simulations and pictures are made of.

Each joint has at most one position actuator, of the joint's name; geoms touch the ground and nothing else; options are
MuJoCo's but gravity and ``impratio``.
"""

import re
import xml.etree.ElementTree as ET
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from sim.files.command import with_traceback
from sim.robots.drives import Drives, drive_problems, read_drives, set_drives
from sim.robots.elements import joint_names, mj, touching_geoms
from sim.robots.model_files import ModelFiles, read_model_files
from sim.robots.refused import refused_elements, structure_problems
from sim.robots.robot import RobotCfg
from sim.robots.urdf import read_urdf

PER_JOINT = (
    "default_joint_pos",
    "stiffness",
    "damping",
    "effort_limit",
    "armature",
    "saturation_effort",
    "velocity_limit",
)
"""Settings with a value for each joint."""
_SLACK = 1e-3  # files round [rad]


@dataclass(frozen=True, kw_only=True)
class RobotFile:
    """Content of a robot's file, without its settings."""

    spec: Any
    """The ``MjSpec``, stripped to what simulations use; every touching geom has a name."""
    model: Any
    drives: Drives
    home: list[float] | None
    """Joint angles of its keyframe ``home`` [rad]; None without one."""
    is_urdf: bool


def robot_spec(robot: RobotCfg, *, visuals: bool = False) -> Any:
    """The robot as an ``MjSpec`` that compiles; an error says all that is wrong with its file or its settings.

    Gains, torque limits, armature and contact of the settings replace those of the file. With ``visuals`` a URDF keeps
    what it shows.
    """
    robot_file = read_robot_file(robot.model_file, visuals=visuals)
    if problems := [*file_problems(robot, robot_file)]:
        raise ValueError(f"robot '{robot.name}': {'; '.join(problems)}")
    set_drives(robot_file.spec, robot_file.drives, robot)
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
        spec = read_urdf(files.root) if files.is_urdf else mj.MjSpec.from_file(str(model_file))
        home = next((list(key.qpos) for key in spec.keys if key.name == "home"), [])
        _name_geoms(spec)
        refused = [*refused_elements(spec)]
        _strip(spec)
        spec.fuse_static()
        model = spec.compile()
    except Exception as error:  # MuJoCo's own type has no name
        reason = _quote_urdf(" ".join(str(error).split()), files)
        raise ValueError(with_traceback(error, f"{model_file} cannot be read by MuJoCo: {reason}")) from None
    problems = [*structure_problems(model)]
    if refused := [*refused, *drive_problems(spec, model)]:
        problems.append(f"{', '.join(refused)} cannot be simulated: take it out, or write it otherwise")
    if len(home) not in (0, model.nq):
        problems.append(f"qpos of the keyframe home must be {model.nq} numbers, got {len(home)}")
    if problems:
        raise ValueError("; ".join(f"{model_file}: {_quote_urdf(problem, files)}" for problem in problems))
    return RobotFile(spec=spec, model=model, drives=read_drives(model), home=home[7:] or None, is_urdf=files.is_urdf)


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


def _strip(spec: Any) -> None:
    """Takes out what simulations leave out of a file; whatever names a body would keep it from being fused."""
    for element in (*spec.sensors, *spec.keys, *spec.excludes, *spec.pairs, *spec.cameras, *spec.lights, *spec.tuples):
        spec.delete(element)
    kept = {name: getattr(spec.option, name) for name in ("gravity", "impratio")}
    kept["gravity"] = kept["gravity"].copy()
    spec.option = mj.MjSpec().option
    for name, value in kept.items():
        setattr(spec.option, name, value)


def file_problems(robot: RobotCfg, file: RobotFile) -> Iterator[str]:
    """Complaints about settings that do not fit the robot's file."""
    yield from _joint_problems(robot, file)
    names = [geom.name for geom in touching_geoms(*file.spec.bodies)]
    yield from _missing("geom that touches the ground is", robot.geom_names, names, robot)


def _missing(kind: str, names: Sequence[str], present: Sequence[str], robot: RobotCfg) -> Iterator[str]:
    if missing := ", ".join(name for name in names if name not in present):
        yield f"no {kind} named {missing} in {robot.model_file}: the file has {', '.join(present)}"


def _joint_problems(robot: RobotCfg, file: RobotFile) -> Iterator[str]:
    """Complaints about the joints' names, and about settings with a value for each joint."""
    model, drives, names = file.model, file.drives, robot.joint_names
    if names != joint_names(model):
        missing = [*_missing("joint is", names, joint_names(model), robot)]
        yield from missing or [f"joint_names must follow the file's order {joint_names(model)}, got {names}"]
        return
    fine = True
    for field in PER_JOINT:
        values = getattr(robot, field)
        if values is not None and len(values) != len(names):
            yield f"{field} needs {len(names)} values, one a joint, got {len(values)}"
            fine = False
    for field in ("armature", "damping", "frictionloss"):
        values = getattr(model, f"dof_{field}")[6:]
        if negative := [f"{names[k]} ({values[k]:g})" for k in np.flatnonzero(~(values >= 0.0))]:
            yield f"{field} must be a number, 0 or more, got {', '.join(negative)}"
            fine = False
    pose = robot.default_joint_pos
    if len(pose) == len(names):
        low, high = np.where(model.jnt_limited[1:, None] == 1, model.jnt_range[1:], (-np.inf, np.inf)).T
        beyond = np.flatnonzero(~((low - _SLACK <= pose) & (pose <= high + _SLACK)))
        if len(beyond):
            listed = ", ".join(f"{names[k]} ({low[k]:g} to {high[k]:g}, got {pose[k]:g})" for k in beyond)
            degrees = ": angles are in radians" if np.abs(pose).max() > 2.0 * np.pi else ""
            yield f"default_joint_pos is outside of the file's range for {listed}{degrees}"
            fine = False
    limitless = [name for name, effort in zip(names, drives.effort, strict=True) if np.isinf(effort)]
    if limitless and (file.is_urdf or robot.saturation_effort) and robot.effort_limit is None:
        yield f"no torque limit above 0 for {', '.join(limitless)}: give it in the file or by effort_limit"
        fine = False
    if fine:
        gains = drives.stiffness if robot.stiffness is None else np.array(robot.stiffness)
        limp = [name for k, name in enumerate(names) if not gains[k] > 0.0 and k not in drives.followers]
        if limp:
            yield f"no gains for {', '.join(limp)}: give stiffness and damping, or <position> in {robot.model_file}"
