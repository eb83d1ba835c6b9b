"""What every results file says of where it comes from and what it is of: command, code, device, robot, controller."""

import hashlib
import json
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, fields
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import version
from pathlib import Path
from typing import Any

from sim.controllers.spec import ControllerSpec, controller_hash
from sim.robots.model_files import read_model_files
from sim.robots.robot import RobotCfg

PENALTY_DEFINITION = "squared"
"""How yaw_rate, vel_x and vel_y of :mod:`kernels.penalties` measure an error; records by another are not read."""
ROOMS = ("kernels", "sim", "qd", "train")
"""Folders of the source code."""

ROOT = Path(__file__).resolve().parents[2]
"""Folder of the rooms."""
_PACKAGES = ("newton", "mujoco", "mujoco-warp", "warp-lang", "torch", "onnxruntime", "ribs", "rsl-rl-lib", "numpy")
_SOURCES = (".py", ".cu", ".xml")
_NOT_IN_DIGEST = ("model_file", "settings_file", "training", "learning", "tuning")
_SHOWN = 12  # digits of a hash in a message


def provenance(device: str, seed: int) -> dict[str, Any]:
    """Command, commit, hash of the sources, device, versions, seed and date of the running program.

    ``dirty`` says whether sources or scripts differ from the commit. Where there is no git, FAULTLINE_COMMIT names the
    commit, with -dirty behind it if they do.
    """
    given = os.environ.get("FAULTLINE_COMMIT", "")
    commit, dirty = given.removesuffix("-dirty") or None, given.endswith("-dirty")
    if commit is None:
        places = [*(ROOT / name for name in (*ROOMS, "results/make")), ":(exclude)sim/robots/*/pack/*"]
        changed = _output(["git", "status", "--porcelain", "--untracked-files=no", "--", *places])
        commit, dirty = _output(["git", "rev-parse", "HEAD"]), None if changed is None else changed != ""
    return {
        "command": _command(),
        "commit": commit,
        "sources_sha256": sources_sha256(),
        "dirty": dirty,
        "device": device_name(device),
        "versions": versions(),
        "seed": seed,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


@cache
def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on."""
    return {"python": platform.python_version(), **{name: version(name) for name in _PACKAGES}}


def sources_sha256(rooms: Sequence[str] = ROOMS) -> str:
    """SHA-256 of the source files of rooms: Python, CUDA and robot models."""
    digest = hashlib.sha256()
    for room in rooms:
        for path in sorted((ROOT / room).rglob("*")):
            if path.suffix in _SOURCES:
                digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def code_fingerprint(rooms: Sequence[str]) -> str:
    """SHA-256 of the sources of rooms and of all package versions: equal ones compute the same."""
    return hashlib.sha256(json.dumps([sources_sha256(rooms), versions()], sort_keys=True).encode()).hexdigest()


def _command() -> str:
    """The running command as a user types it; a path outside the working folder is cut to its name."""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    module = spec.name.removesuffix(".__main__") if spec else Path(sys.argv[0]).stem
    program = ["faultline"] if module == "faultline" else ["python", "-m", module]
    return shlex.join([*program, *map(without_machine, sys.argv[1:])])


def without_machine(word: str) -> str:
    """A word of a command line, or a path, without where on this machine it lies: an absolute path's last name."""
    here = f"{Path.cwd()}{os.sep}"
    return re.sub(r"(?<![\w.~-])/(?:[^/=:\s]+/)+(?=[^/])", "", word.replace(here, ""))


def device_name(device: str) -> str:
    """What a Warp device is, in words; its own name where this machine cannot tell."""
    if not device.startswith("cuda"):
        return f"CPU ({platform.machine()}, {os.cpu_count()} cores)"
    import torch  # takes seconds to load, and is loaded wherever a GPU works

    return torch.cuda.get_device_name(device) if torch.cuda.is_available() else device


def _output(command: Sequence[str | Path]) -> str | None:
    """What a program prints, run in the checkout; None where it is missing or fails."""
    try:
        done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=20, check=True)
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip()


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


def identity(robot: RobotCfg, policy: str | Path) -> dict[str, str | None]:
    """What a record of a robot under a controller names: ``robot``, ``policy`` (a name without folders), their hashes.

    ``policy_sha256`` is None for a controller without a file.
    """
    controller = {"policy": ControllerSpec.parse(policy).label, "policy_sha256": controller_hash(str(policy))}
    return {"robot": robot.name, **robot_identity(robot), **controller}


def check_robot(record: Mapping[str, Any], robot: RobotCfg, file: Path, remedy: str) -> None:
    """Refuses the record in a file that is of the robot before it changed; ``remedy`` is what else helps."""
    expected, now = record.get("robot_sha256"), robot_digest(robot)
    if expected != now:
        raise ValueError(
            f"{file} is of robot '{robot.name}' as it was before its settings, model or meshes changed (expected "
            f"SHA-256 {str(expected)[:_SHOWN]}, got {now[:_SHOWN]} of {robot.spec}): put that back, or {remedy}"
        )


def check_identity(record: Mapping[str, Any], robot: RobotCfg, file: Path, remedy: str) -> None:
    """Refuses a record of a robot that has changed since (:func:`check_robot`) or of penalties defined otherwise."""
    definition = record.get("penalty_definition")
    if definition != PENALTY_DEFINITION:
        raise ValueError(f"{file} is of penalties by {definition} errors, expected {PENALTY_DEFINITION} ones; {remedy}")
    check_robot(record, robot, file, remedy)
