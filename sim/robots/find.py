"""Which robot a command line or a file names, and the penalty scales that were measured with it."""

import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from sim.controllers.spec import controller_hash
from sim.files.atomic import read_json
from sim.files.command import command_line
from sim.robots.identity import check_robot_identity
from sim.robots.robot import RobotCfg
from sim.robots.shipped import ROBOTS


def get_robot(spec: "str | RobotCfg | None") -> RobotCfg:
    """Settings of a robot that the command line names; :func:`robot_of` is for what a file names.

    It names a shipped robot, or the file of another: a robot.toml, or Python, which is run and must set ``ROBOT``. None
    is ANYmal; settings are returned as they are.
    """
    if isinstance(spec, RobotCfg):
        return spec
    spec = spec or "anymal"
    if spec in ROBOTS:
        return ROBOTS[spec]
    if spec.endswith((".py", ".toml")):
        from sim.robots.user import load_robot  # Newton takes seconds to load: not for the help of commands

        return load_robot(Path(spec))
    known = ", ".join(ROBOTS)
    raise ValueError(f"unknown robot '{spec}': expected {known}, a robot.toml or a Python file (docs/robots.md)")


def robot_label(name: str) -> str:
    """Name of a shipped robot as its makers write it; the name itself of any other."""
    return ROBOTS[name].label if name in ROBOTS else name


def robot_of(record: Mapping[str, Any], given: "str | RobotCfg | None", file: Path, *, kind: str = "run") -> RobotCfg:
    """The robot that a file names, for example a run's, if it is still what it was.

    A shipped robot is known by its name. Any other must be named on the command line too: no code runs that only a
    file names. The record has the keys of :func:`sim.robots.identity.robot_identity`; ``given`` is what the command
    names, if anything; errors name the file and its ``kind``.
    """
    name, robot = record["robot"], None if given is None else get_robot(given)
    if robot is not None and robot.name != name:
        raise ValueError(f"{file} is of {name}, got --robot {given}: give that robot or another {kind}")
    if robot is None and name not in ROBOTS:
        raise ValueError(f"{file} is of robot '{name}', which is not shipped: name its settings file too, by --robot")
    robot = robot or ROBOTS[name]
    check_robot_identity(record, robot, file, "make it anew")
    return robot


def read_penalty_scales(robot: RobotCfg, policy: str | None = None) -> tuple[float, ...]:
    """Scales of the penalties, in their order; an error says how to measure those of the command line's policy."""
    given = policy if robot.settings_file is not None else None  # a shipped robot's are of its own controller
    remedy = f"run `{command_line('archive', robot=robot.spec, policy=given)}`, which measures them first"
    if given is None and not robot.policy_file.exists():
        remedy = f"train its controller first with `{robot.train_command}`, or name one with --policy; then {remedy}"
    if not robot.scales_file.exists():
        raise ValueError(f"no penalty scales of robot '{robot.name}': expected {robot.scales_file}; {remedy}")
    content = read_json(robot.scales_file)
    check_robot_identity(content, robot, robot.scales_file, remedy)
    scales = content.get("scales")
    scales = scales if isinstance(scales, dict) else {}
    missing = [name for name in robot.penalties if type(scales.get(name)) not in (int, float)
               or not 0.0 < scales[name] <= sys.float_info.max]  # fmt: skip
    if missing:
        raise ValueError(f"{robot.scales_file} holds no positive scale for {', '.join(missing)}: {remedy}")
    return tuple(float(scales[name]) for name in robot.penalties)


def fitting_space(robot: RobotCfg) -> str | None:
    """The terrain space that the robot's scales were measured on, whose height fits it; None of a shipped robot."""
    if robot.settings_file is None or not robot.scales_file.exists():
        return None
    return read_json(robot.scales_file).get("space")


def scaled_by_another(robot: RobotCfg, policy: str) -> str | None:
    """What to say of a search whose controller is not the one that the scales were measured with; None if it is.

    Scales of the robot's own controller make searches against others comparable: this is no mistake.
    """
    measured = read_json(robot.scales_file) if robot.scales_file.exists() else {}
    if measured.get("policy_sha256") in (None, controller_hash(policy)):
        return None
    return f"Penalties are scaled by those of {measured.get('policy')}, with which {robot.scales_file} was measured."
