"""Which robot a record is of: by the hash of its settings, model and meshes."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import MISSING, fields
from pathlib import Path
from typing import Any

from sim.robots.model_files import read_model_files
from sim.robots.robot import RobotCfg

PENALTY_DEFINITION = "squared"
"""How yaw_rate, vel_x and vel_y of :mod:`kernels.penalties` measure an error; records by another are not read."""
_NOT_IN_DIGEST = ("model_file", "settings_file", "training", "learning", "tuning", "label", "paper")
_SHOWN_DIGITS = 12  # of a hash in a message


def robot_digest(robot: RobotCfg) -> str:
    """SHA-256 of a robot: its settings without those of training, its model and its meshes.

    A setting that has its default is left out, so that a new one changes no hash. The default of an old one must stay.
    """
    settings = {}
    for field in fields(robot):
        value = getattr(robot, field.name)
        default = field.default if field.default_factory is MISSING else field.default_factory()
        if field.name not in _NOT_IN_DIGEST and value != default:
            settings[field.name] = value
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for file in read_model_files(robot.model_file).files:
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def robot_identity(robot: RobotCfg) -> dict[str, str]:
    """The keys ``robot_sha256`` and ``penalty_definition``, which every record of a robot has."""
    return {"robot_sha256": robot_digest(robot), "penalty_definition": PENALTY_DEFINITION}


def check_robot_digest(record: Mapping[str, Any], robot: RobotCfg, file: Path, remedy: str) -> None:
    """Refuses a file's record of the robot before it changed; ``remedy`` is what else helps."""
    expected, now = record.get("robot_sha256"), robot_digest(robot)
    if expected != now:
        raise ValueError(
            f"{file} is of robot '{robot.name}' as it was before its settings, model or meshes changed (expected "
            f"SHA-256 {str(expected)[:_SHOWN_DIGITS]}, got {now[:_SHOWN_DIGITS]} of {robot.spec}): put that back, or "
            f"{remedy}"
        )


def check_robot_identity(record: Mapping[str, Any], robot: RobotCfg, file: Path, remedy: str) -> None:
    """Refuses a file's record of the robot before it changed, or of penalties that are defined otherwise."""
    definition = record.get("penalty_definition")
    if definition != PENALTY_DEFINITION:
        raise ValueError(f"{file} is of penalties by {definition} errors, expected {PENALTY_DEFINITION} ones; {remedy}")
    check_robot_digest(record, robot, file, remedy)
