"""Robots of one's own: a Python file that sets ``ROBOT``, looked at before any work, told apart, and sent away."""

import hashlib
import json
import os
import re
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import warp as wp

from kernels.penalties import PENALTIES
from sim.policy.named_code import run_file
from sim.robots.model_files import read_model_files
from sim.robots.robot import ROBOTS, RobotCfg
from sim.robots.training import LearningCfg, TrainingCfg, learning_problems, training_problems

_NAMES = ("base_geoms", "foot_geoms", "limb_geoms", "joint_names", "penalties")
_POSITIVE = ("default_base_height", "contact_force_limit", "action_scale", "physics_dt", "max_speed")
_COUNTS = ("decimation", "nconmax", "njmax")
_PER_JOINT = {"stiffness": "positive", "damping": "0 or more", "effort_limit": "positive", "armature": "0 or more"}
_LONGEST_STEP_S = 0.05
_NOT_IN_DIGEST = ("model_file", "settings_file", "training", "learning")


def load_robot(path: Path) -> RobotCfg:
    """Runs a settings file and holds the robot that it sets against its model.

    Raises:
        ValueError: If the file is missing or fails, sets no ``ROBOT``, or something in the settings or the model is
            wrong; as much of it as can be told at once is named.
    """
    from sim.robots.model import build_robot  # which import Newton, and take seconds
    from sim.robots.probes import make_probes

    robot: Any = getattr(run_file(path), "ROBOT", None)
    if type(robot) is not RobotCfg:
        got = "nothing" if robot is None else type(robot).__name__
        raise ValueError(f"{path} must set ROBOT to a sim.robots.robot.RobotCfg, got {got} (README, Bring your own robot)")
    problems = settings_problems(robot)
    if problems:
        raise ValueError(f"{path}: {'; '.join(problems)}")
    path = path.resolve()  # of a link, the model lies beside what it points to
    robot = replace(robot, model_file=path.parent / robot.model_file, settings_file=path)
    with wp.ScopedDevice("cpu"):
        make_probes(build_robot(robot))
    return robot


def settings_problems(robot: RobotCfg) -> list[str]:
    """What is wrong with settings by themselves, one line each."""
    problems = []
    if not isinstance(robot.name, str) or not re.fullmatch(r"[A-Za-z0-9][\w.-]*", robot.name):
        problems.append(f"name must be letters, digits, . _ and -, since files are called after it, got {robot.name!r}")
    elif robot.name in ROBOTS:
        problems.append(f"name must be one of its own, got '{robot.name}', which is a shipped robot")
    if not isinstance(robot.model_file, str | Path):
        problems.append(f"model_file must be a path, got {robot.model_file!r}")
    if not isinstance(robot.training, TrainingCfg):
        problems.append(f"training must be a TrainingCfg, got {type(robot.training).__name__}")
    else:
        problems += training_problems(robot.training)
    if not isinstance(robot.learning, LearningCfg):
        problems.append(f"learning must be a LearningCfg, got {type(robot.learning).__name__}")
    else:
        problems += learning_problems(robot.learning)
    if not isinstance(robot.collision_bit, bool):
        problems.append(f"collision_bit must be True or False, got {robot.collision_bit!r}")
    wrong_names = [f"{name} must be a tuple of names, each once, got {getattr(robot, name)!r}" for name in _NAMES
                   if not _are_names(getattr(robot, name))]  # fmt: skip
    problems += [*wrong_names, *_number_problems(robot)]
    return problems if wrong_names else [*problems, *_name_problems(robot)]


def _name_problems(robot: RobotCfg) -> list[str]:
    """What names say of the parts of the robot; that the model has them is :func:`build_robot`'s to say."""
    problems = [f"{name} must name at least one" for name in ("base_geoms", "foot_geoms", "joint_names")
                if not getattr(robot, name)]  # fmt: skip
    twice = sorted({name for name in robot.geom_names if robot.geom_names.count(name) > 1})
    if twice:
        problems.append(f"a geom has one role: {', '.join(twice)} is in two of base_geoms, limb_geoms and foot_geoms")
    unknown = [name for name in robot.penalties if name not in PENALTIES]
    if unknown or len(robot.penalties) < 2:
        problems.append(f"penalties must be at least 2 of {', '.join(PENALTIES)}, got {', '.join(robot.penalties)}")
    if isinstance(robot.training, TrainingCfg):
        strange = [name for name in robot.training.steady_joints if name not in robot.joint_names]
        if strange:
            problems.append(f"training.steady_joints: no joint named {', '.join(strange)} in joint_names")
    return problems


def _number_problems(robot: RobotCfg) -> list[str]:
    problems = [f"{name} must be a positive number, got {getattr(robot, name)!r}" for name in _POSITIVE
                if not _is_number(getattr(robot, name), above=0.0)]  # fmt: skip
    problems += [f"{name} must be a whole number from 1 on, got {getattr(robot, name)!r}" for name in _COUNTS
                 if type(getattr(robot, name)) is not int or getattr(robot, name) < 1]  # fmt: skip
    if not _are_numbers(robot.footprint, above=0.0) or len(robot.footprint) != 2:
        problems.append(f"footprint must be half length and half width [m], positive, got {robot.footprint!r}")
    for name in ("default_joint_pos", "scan_x", "scan_y"):
        if not _are_numbers(getattr(robot, name)):
            problems.append(f"{name} must be a tuple of numbers, got {getattr(robot, name)!r}")
    for name, what in _PER_JOINT.items():
        values = getattr(robot, name)
        if values is not None and not _are_numbers(values, above=0.0 if what == "positive" else -1e-300):
            problems.append(f"{name} must be a tuple of numbers, {what}, one a joint, got {values!r}")
    if (robot.stiffness is None) != (robot.damping is None):
        problems.append("stiffness and damping must be given together")
    for name in ("friction", "contact_time_constant_s"):
        if getattr(robot, name) is not None and not _is_number(getattr(robot, name), above=0.0):
            problems.append(f"{name} must be a positive number or None, got {getattr(robot, name)!r}")
    if _is_number(robot.physics_dt, above=_LONGEST_STEP_S):
        problems.append(f"physics_dt must be at most {_LONGEST_STEP_S:g} s, got {robot.physics_dt:g}")
    if not problems and (robot.contact_time_constant_s or 1.0) < 2.0 * robot.physics_dt * (1.0 - 1e-9):
        problems.append(
            f"contact_time_constant_s must be at least twice physics_dt, {2.0 * robot.physics_dt:g} s, got "
            f"{robot.contact_time_constant_s:g}"
        )
    return problems


def _are_names(values: Any) -> bool:
    return isinstance(values, tuple) and all(isinstance(name, str) for name in values) and len({*values}) == len(values)


def _is_number(value: Any, above: float = -float("inf")) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and above < value < float("inf")


def _are_numbers(values: Any, above: float = -float("inf")) -> bool:
    return isinstance(values, tuple) and all(_is_number(value, above) for value in values)


def robot_digest(robot: RobotCfg) -> str | None:
    """SHA-256 of what a robot of one's own is: settings but for its training, model and meshes; None of a shipped one.

    Raises:
        ValueError: If a file is missing.
    """
    if robot.settings_file is None:
        return None
    settings = {name: value for name, value in asdict(robot).items() if name not in _NOT_IN_DIGEST}
    digest = hashlib.sha256(json.dumps(settings, sort_keys=True).encode())
    for file in read_model_files(robot.model_file).files:
        digest.update(hashlib.sha256(file.read_bytes()).digest())
    return digest.hexdigest()


def own_hash(robot: RobotCfg) -> dict[str, str]:
    """For the settings that a training remembers: the hash of a robot of one's own, nothing of a shipped one."""
    digest = robot_digest(robot)
    return {} if digest is None else {"robot_sha256": digest}


@dataclass(frozen=True, kw_only=True)
class PackedRobot:
    """A robot of one's own on its way to a machine that need not have its files."""

    robot: RobotCfg
    model: str
    """The model file among ``files``."""
    files: tuple[tuple[str, bytes], ...]
    """Path and content of the model's files, below a folder they have in common."""

    def unpacked(self, folder: Path) -> RobotCfg:
        """The robot with its files in ``folder``; they are needed until its model is built."""
        for name, content in self.files:
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(content)
        return replace(self.robot, model_file=folder / self.model)


def pack_robot(robot: RobotCfg) -> PackedRobot | str:
    """What to send of a robot: the name alone of a shipped one, which every machine has."""
    if robot.settings_file is None and ROBOTS.get(robot.name) == robot:
        return robot.name
    files = read_model_files(robot.model_file).files
    # The folder's own name goes along: a URDF may call its package by it.
    root = Path(os.path.commonpath([file.parent for file in files])).parent
    packed = tuple((str(file.relative_to(root)), file.read_bytes()) for file in files)
    return PackedRobot(robot=robot, model=packed[0][0], files=packed)
