"""Which robot a command line or a file names, and the penalty scales that were measured with it."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import msgspec

from sim.controllers.spec import controller_hash
from sim.files.atomic import read_json
from sim.files.command import command_line
from sim.files.settings import PositiveFloat
from sim.robots.robot import ROBOTS, RobotCfg, check_robot_identity

STRAY = {False: "stray_m", True: "stray_resolved_m"}  # keys of scales: how far a route may be missed [m]


def get_robot(spec: str | RobotCfg | None) -> RobotCfg:
    """The robot that the command line names: a shipped one, ANYmal for None, or a file, of which Python is run."""
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


def resolve_robot(record: Mapping[str, Any], given: str | RobotCfg | None, file: Path, kind: str = "run") -> RobotCfg:
    """The robot of a file's record, if unchanged; one that is not shipped must be ``given``: a record runs no code."""
    name = record["robot"]
    if given is None and name not in ROBOTS:
        raise ValueError(f"{file} is of robot '{name}', which is not shipped: name its settings file too, by --robot")
    robot = ROBOTS[name] if given is None else get_robot(given)
    if robot.name != name:
        raise ValueError(f"{file} is of {name}, got robot {robot.name}: give that robot or another {kind}")
    check_robot_identity(record, robot, file, "make it anew")
    return robot


def read_penalty_scales(robot: RobotCfg, policy: str | None = None) -> tuple[float, ...]:
    """Scales of the penalties, in their order; an error says how to measure those of the command line's policy."""
    if robot.settings_file is None:
        policy = None  # a shipped robot's scales are of its own controller
    remedy = f"run `{command_line('archive', robot=robot.spec, policy=policy)}`, which measures them first"
    if policy is None and not robot.policy_file.exists():
        remedy = f"train its controller first with `{robot.train_command}`, or name one with --policy; then {remedy}"
    if not (content := _read_scales(robot)):
        raise ValueError(f"no penalty scales of robot '{robot.name}': expected {robot.scales_file}; {remedy}")
    check_robot_identity(content, robot, robot.scales_file, remedy)
    try:
        scales = msgspec.convert(content.get("scales"), dict[str, PositiveFloat])
        return tuple(scales[name] for name in robot.penalties)
    except (msgspec.ValidationError, KeyError) as error:
        names = ", ".join(robot.penalties)
        raise ValueError(f"{robot.scales_file} needs a positive scale for {names}: {error}; {remedy}") from None


def read_stray(robot: RobotCfg, *, resolved: bool = False) -> float:
    """How far a displacement over two seconds may lie from the one that a route commands [m] (``qd.check``)."""
    content, key = _read_scales(robot), STRAY[resolved]
    if key not in content:
        remedy = f"run `{command_line('archive', robot=robot.spec, space='super_gaussian+command')}`"
        raise ValueError(f"{robot.scales_file} must say how far a route may be missed, got no {key}: {remedy} first")
    return float(content[key])


def fitting_space(robot: RobotCfg) -> str | None:
    """The terrain space that the robot's scales were measured on, whose height fits it; None of a shipped robot."""
    return None if robot.settings_file is None else _read_scales(robot).get("space")


def scaled_by_another(robot: RobotCfg, policy: str) -> str | None:
    """A note on a search whose controller is not that of the robot's scales, which is no mistake; None if it is."""
    measured = _read_scales(robot)
    if measured.get("policy_sha256") in (None, controller_hash(policy)):
        return None
    return f"Penalties are scaled by those of {measured.get('policy')}, with which {robot.scales_file} was measured."


def _read_scales(robot: RobotCfg) -> dict[str, Any]:
    return read_json(robot.scales_file) if robot.scales_file.exists() else {}
