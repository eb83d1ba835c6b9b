"""A robot of its file and its settings, and the complaints about settings that do not fit the file."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from sim.robots.drives import set_drives
from sim.robots.elements import joint_names, touching_geoms
from sim.robots.robot import RobotCfg
from sim.robots.robot_file import RobotFile, read_robot_file

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
