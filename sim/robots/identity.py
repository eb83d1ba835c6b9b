"""What a record is of: robot, controller and definition of the penalties, each by name and hash.

Runs, penalty scales, training records, recordings and tables name :func:`identity`; whoever reads one compares it by
:func:`check_identity` with what it is about to use.
"""

import functools
import hashlib
import json
import multiprocessing
import sys
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from sim.files.atomic import read_json
from sim.policy.spec import ControllerSpec, controller_hash
from sim.robots.model_files import read_model_files

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg

FIRST_DEFINITION = "absolute"
"""Definition of the penalties in records that name none: there was no other when they were made."""
_NOT_IN_DIGEST = ("model_file", "settings_file", "training", "learning", "tuning")
_SHOWN = 12  # digits of a hash that a message shows


def robot_digest(robot: "RobotCfg") -> str:
    """SHA-256 of a robot: its settings without those of training, its model and its meshes.

    A setting that has its default is left out, so that a new one changes no hash. The default of an old one must stay.

    Raises:
        ValueError: If a file is missing.
    """
    values = {one.name: (getattr(robot, one.name), _default(one)) for one in fields(robot)}
    settings = {
        name: value for name, (value, default) in values.items() if name not in _NOT_IN_DIGEST and value != default
    }
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for file in read_model_files(robot.model_file).files:
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def _default(setting: "Field[Any]") -> Any:
    return setting.default if setting.default_factory is MISSING else setting.default_factory()


def robot_identity(robot: "RobotCfg") -> dict[str, str]:
    """The keys ``robot_sha256`` and ``penalty_definition``, which every record of a robot has.

    Raises:
        ValueError: If a file of the robot is missing.
    """
    return {"robot_sha256": robot_digest(robot), "penalty_definition": penalty_definition()}


def penalty_definition() -> str:
    """How the penalties are defined now."""
    from kernels import penalties  # Warp loads only where something is compared

    return penalties.PENALTY_DEFINITION


def identity(robot: "RobotCfg", policy: str | Path) -> dict[str, str | None]:
    """What a record of a robot under a controller names, as JSON values.

    Returns:
        ``robot`` (its name), ``robot_sha256``, ``penalty_definition``, ``policy`` (a name without folders) and
        ``policy_sha256``, None for a controller without a file.

    Raises:
        ValueError: If a file of the robot is missing.
    """
    who = {"policy": ControllerSpec.parse(policy).label, "policy_sha256": controller_hash(str(policy))}
    return {"robot": robot.name, **robot_identity(robot), **who}


def check_robot(there: Mapping[str, Any], robot: "RobotCfg", file: Path, remedy: str) -> None:
    """Refuses a record of a robot that has changed since.

    A record without a hash of its robot, of an earlier version, is taken with a warning.

    Args:
        there: What the record names.
        robot: The robot of that name, as it is now.
        file: The record, for the message.
        remedy: What to do about it, other than putting back the robot.

    Raises:
        ValueError: If it is another robot.
    """
    expected = there.get("robot_sha256")
    if expected is None:
        warn(f"{file} names no hash of robot '{robot.name}': whether the robot has changed since cannot be told")
    elif expected != (now := robot_digest(robot)):
        raise ValueError(
            f"{file} is of robot '{robot.name}' as it was: its settings, model or meshes have changed since (expected "
            f"SHA-256 {_short(expected)}, got {_short(now)} of {robot.spec}): put back what was there then, or {remedy}"
        )


def check_identity(there: Mapping[str, Any], robot: "RobotCfg", file: Path, remedy: str) -> None:
    """Refuses a record of a robot that has changed since (:func:`check_robot`), or of penalties defined otherwise now.

    Raises:
        ValueError: If one of the two is another.
    """
    definition, now = there.get("penalty_definition", FIRST_DEFINITION), penalty_definition()
    if definition != now:
        raise ValueError(
            f"{file} is of penalties by {definition} errors, expected {now} ones, which this version has: its numbers "
            f"mean something else; {remedy}"
        )
    check_robot(there, robot, file, remedy)


def warn_if_trained_otherwise(policy: Path, robot: "RobotCfg") -> None:
    """Says so where the training record beside a controller names another robot than the one it is to walk."""
    record = policy.with_suffix(".train.json")
    try:
        settings = read_json(record).get("settings")
    except (OSError, ValueError):  # no record, or a damaged one, of which nothing is known
        return
    trained = settings.get("robot_sha256") if isinstance(settings, dict) else None
    if trained is None or trained == robot_digest(robot):
        return
    from sim.robots.robot import get_robot  # it needs this module

    now = robot_digest(get_robot(robot.spec))  # a command may have changed its time step or capacities by itself
    if trained != now:
        warn(
            f"{policy} was trained with a robot of other settings, model or meshes (SHA-256 {_short(trained)} in "
            f"{record.name}) than {robot.spec} has now ({_short(now)})"
        )


def _short(digest: object) -> str:
    return str(digest)[:_SHOWN]


def warn(line: str) -> None:
    """Prints a warning on stderr, once a program; nothing in the worker processes, whose parent says it."""
    if multiprocessing.parent_process() is None:
        _print_once(line)


@functools.cache
def _print_once(line: str) -> None:
    print(f"warning: {line}", file=sys.stderr, flush=True)
