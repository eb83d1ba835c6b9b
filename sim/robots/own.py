"""Robots of a user: load and check their settings file, pack them for another machine."""

import itertools
import os
import re
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import warp as wp

from kernels.penalties import PENALTIES
from sim.device import host_device
from sim.files.settings import problems
from sim.policy.spec import run_file
from sim.robots.compiled import read_robot_spec
from sim.robots.model import builder_of
from sim.robots.model_files import read_model_files
from sim.robots.probes import make_probes, start_height
from sim.robots.robot import RobotCfg
from sim.robots.shipped import ROBOTS

_NAMES = ("base_geoms", "foot_geoms", "limb_geoms", "joint_names", "penalties")


def load_robot(path: Path) -> RobotCfg:
    """Runs a settings file and checks the robot that it sets against its model."""
    robot: Any = getattr(run_file(path), "ROBOT", None)
    if type(robot) is not RobotCfg:
        got = "nothing" if robot is None else type(robot).__name__
        raise ValueError(f"{path} must set ROBOT to a sim.robots.robot.RobotCfg, got {got} (docs/robots.md)")
    if isinstance(robot.model_file, str):
        robot = replace(robot, model_file=Path(robot.model_file))
    mistakes = settings_problems(robot)
    wrong = {line.split(" ", 1)[0] for line in mistakes}
    file = path.resolve()  # of a link, the model lies beside what it points to
    if "model_file" not in wrong:
        robot = replace(robot, model_file=file.parent / robot.model_file, settings_file=file)
        with wp.ScopedDevice(host_device()):
            spec, of_model = read_robot_spec(robot, wrong)
            mistakes += of_model
            if spec is not None and not of_model:
                builder = builder_of(spec.compile())
                try:
                    make_probes(builder)
                except ValueError as error:
                    mistakes.append(str(error))
                if not mistakes and not robot.default_base_height:
                    robot = replace(robot, default_base_height=start_height(robot, builder))
    if mistakes:
        raise ValueError(f"{path}: {'; '.join(mistakes)}")
    return robot


def settings_problems(robot: RobotCfg) -> list[str]:
    """What is wrong with settings by themselves, one line each."""
    mistakes = problems(robot)
    wrong = {line.split(" ", 1)[0] for line in mistakes}

    def fine(*names: str) -> bool:
        return wrong.isdisjoint(names)

    if fine("name"):
        if not re.fullmatch(r"[A-Za-z0-9][\w.-]*", robot.name):
            mistakes.append(
                f"name must be letters, digits, . _ and -, since files are named after it, got {robot.name!r}"
            )
        elif robot.name in ROBOTS:
            mistakes.append(f"name must be one of its own, got '{robot.name}', which is a shipped robot")
    if fine(*_NAMES):
        mistakes += _name_problems(robot)
    if (robot.stiffness is None) != (robot.damping is None):
        mistakes.append("stiffness and damping must be given together")
    least = 2.0 * robot.physics_dt if fine("physics_dt") else 0.0
    time_constant_s = robot.contact_time_constant_s
    if fine("contact_time_constant_s") and time_constant_s is not None and time_constant_s < least * (1.0 - 1e-9):
        mistakes.append(
            f"contact_time_constant_s must be at least twice physics_dt, {least:g} s, got {time_constant_s:g}"
        )
    return mistakes


def _name_problems(robot: RobotCfg) -> list[str]:
    mistakes = [f"{name} must name at least one" for name in ("base_geoms", "foot_geoms", "joint_names")
             if not getattr(robot, name)]  # fmt: skip
    mistakes += [f"{name} must hold each name once, got {', '.join(getattr(robot, name))}" for name in _NAMES
              if len(set(getattr(robot, name))) < len(getattr(robot, name))]  # fmt: skip
    roles = {role: set(getattr(robot, role)) for role in ("base_geoms", "limb_geoms", "foot_geoms")}
    twice = sorted({name for a, b in itertools.combinations(roles.values(), 2) for name in a & b})
    if twice:
        mistakes.append(f"a geom has one role: {', '.join(twice)} is in two of {', '.join(roles)}")
    if not set(robot.penalties) <= set(PENALTIES) or len(robot.penalties) < 2:
        mistakes.append(f"penalties must be at least 2 of {', '.join(PENALTIES)}, got {', '.join(robot.penalties)}")
    strange = [name for name in getattr(robot.training, "steady_joints", ()) if name not in robot.joint_names]
    if strange:
        mistakes.append(f"training.steady_joints: no joint named {', '.join(strange)} in joint_names")
    return mistakes


@dataclass(frozen=True, kw_only=True)
class PackedRobot:
    """A user's robot with its files, for a machine that may lack them."""

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
