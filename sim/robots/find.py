"""Which robot a command line or a file names."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sim.files.records import check_identity
from sim.robots.robot import RobotCfg
from sim.robots.shipped import ROBOTS


def get_robot(spec: "str | RobotCfg | None") -> RobotCfg:
    """Settings of a robot that the command line names; :func:`robot_of` is for what a file names.

    Args:
        spec: Name of a shipped robot, or the Python file of another, which is run and must set ``ROBOT``; None is
            ANYmal; settings are returned as they are.
    """
    if isinstance(spec, RobotCfg):
        return spec
    spec = spec or "anymal"
    if spec in ROBOTS:
        return ROBOTS[spec]
    if spec.endswith(".py"):
        from sim.robots.own import load_robot  # Newton takes seconds to load: not for the help of commands

        return load_robot(Path(spec))
    raise ValueError(
        f"unknown robot '{spec}': expected one of {', '.join(sorted(ROBOTS))}, or a Python file that sets ROBOT "
        "(docs/robots.md)"
    )


def robot_of(record: Mapping[str, Any], given: "str | RobotCfg | None", file: Path, *, flag: str = "run") -> RobotCfg:
    """The robot that a file names, for example a run's, if it is still what it was.

    A shipped robot is known by its name. Any other must be named on the command line too: no code runs that only a
    file names.

    Args:
        record: What the file says: ``robot``, its name, and the rest of :func:`sim.files.records.identity`.
        given: What the command line names, if anything.
        file: The file, for errors.
        flag: The flag that names it, for errors.
    """
    name, robot = record["robot"], None if given is None else get_robot(given)
    if robot is not None and robot.name != name:
        raise ValueError(f"{file} is of {name}, got --robot {given}: give that robot or another --{flag}")
    if robot is None and name not in ROBOTS:
        raise ValueError(
            f"{file} is of robot '{name}', which is not shipped: name its settings file too (--robot .../{name}.py), "
            "since no code runs that the command line does not name"
        )
    robot = robot or ROBOTS[name]
    check_identity(record, robot, file, "make it anew")
    return robot
