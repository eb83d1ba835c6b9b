"""What a format of sources reads: settings of a robot and its controller, with the reasons of guesses."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from sim.robots.compiled import PER_JOINT, RobotFile, joint_names, read_robot_file
from sim.robots.model_files import find_above, find_robot_of_scene
from sim.robots.robot import RobotCfg

_NAMES_BY_TERM = {
    "lin_vel": ("lin_vel", "base_lin_vel"),
    "ang_vel": ("ang_vel", "ang_vel_body", "base_ang_vel"),
    "gravity": ("gravity_vec", "projected_gravity"),
    "command": ("commands", "command", "cmd", "velocity_commands"),
    "joint_pos": ("dof_pos", "joint_pos"),
    "joint_vel": ("dof_vel", "joint_vel"),
    "last_action": ("actions", "last_action"),
}
TERM_NAMES = {name: term for term, names in _NAMES_BY_TERM.items() for name in names}
"""Terms of the observation by the names that rl_sar and mjlab give them."""
BLIND_TERMS = ("ang_vel", "gravity", "command", "joint_pos", "joint_vel", "last_action")
"""Terms of a controller without sight, in the usual order."""


@dataclass(kw_only=True)
class Source:
    """Settings that are read from a source, for a robot whose model the user or the source names."""

    file: Path  # the file that errors name
    model_file: Path | None  # the robot's MJCF or URDF; None until it is known
    settings: dict[str, Any] = field(default_factory=dict)  # of robot.toml and controller.toml; None to be filled in
    reasons: dict[str, str] = field(default_factory=dict)  # why a setting is a guess, or what the user should fill in

    @cached_property
    def robot_file(self) -> RobotFile:
        """The robot's model."""
        if self.model_file is None:
            raise ValueError(f"--model must name the robot's MJCF or URDF: {self.file} names none that is here")
        return read_robot_file(self.model_file)

    @property
    def model(self) -> Any:
        """The compiled MuJoCo model."""
        return self.robot_file.model

    @property
    def joints(self) -> tuple[str, ...]:
        """Joints of the model, in its order."""
        return joint_names(self.model)

    def find_model_file(self, name: Any) -> None:
        """Takes the model that the source names, if the user names none and it is here."""
        if self.model_file is None and str(name).endswith((".urdf", ".xml", ".mjcf")):
            model_file = find_above(str(name), self.file.parent)
            self.model_file = model_file and find_robot_of_scene(model_file)

    def find_weights(self, name: str) -> Path:
        """The file of weights that the source names; its name may have a path of another machine."""
        file = find_above(name, self.file.parent) or self.file.parent / Path(name).name
        if not file.is_file():
            raise ValueError(f"{file} is not there: put the weights that {self.file} names beside it")
        return file

    def set(self, reason: str = "", **settings: Any) -> None:
        """Stores settings, with the reason if they are guesses; those of joints must be numbers."""
        for name, value in settings.items():
            numbers = [*value.values()] if isinstance(value, dict) else value
            if name in PER_JOINT and value is not None and np.array(numbers).dtype.kind not in "if":
                raise ValueError(f"its {name} must be numbers, got {value}")
        self.settings |= settings
        self.reasons |= dict.fromkeys(settings, reason)

    def refuse_unknown(self, names: Iterable[str], known: Iterable[str]) -> None:
        """Raises a ValueError with the names that are not known."""
        if unknown := [str(name) for name in names if name not in known]:
            listed = ", ".join(unknown)
            raise ValueError(f"{self.file} says what is not understood: {listed}: take it out if it does not matter")

    def move(self, content: dict[str, Any], names: Mapping[str, str], joints: Sequence[str]) -> None:
        """Moves values from ``content`` to settings of other names; lists in the order of ``joints`` are reordered."""
        for key, name in names.items():
            value = content.pop(key)
            if name in PER_JOINT and isinstance(value, list):
                if set(joints) != set(self.joints) or len(value) != len(joints):
                    must = f"one a joint of {self.model_file}, {', '.join(self.joints)}"
                    raise ValueError(f"{self.file}: {key} must be {must}, got {len(value)} of {', '.join(joints)}")
                value = [value[list(joints).index(joint)] for joint in self.joints]
            self.set(**{name: collapse(value)})
        self.set_joints(joints)

    def match_parts(self, table: Mapping[str, Any], name: str) -> list[Any]:
        """A value of each joint: that of the last key which is a part of its name, else that of ``default``."""
        values = [([table.get("default")] + [table[key] for key in table if key in joint])[-1] for joint in self.joints]
        if without := [joint for joint, value in zip(self.joints, values, strict=True) if value is None]:
            raise ValueError(f"{name} must have a part of every joint's name, got none of {', '.join(without)}")
        return values

    def set_joints(self, joints: Sequence[str], reason: str = "") -> None:
        """Stores the controller's order of joints, if it is not that of the model."""
        if tuple(joints) != self.joints:
            self.set(joints=list(joints), reason=reason)

    def set_history(self, terms: list[dict[str, Any]], lengths: Sequence[int], **layout: str) -> None:
        """Stores former steps as Isaac Lab and mjlab lay them out; lengths that differ are written into the terms."""
        for term, length in zip(terms, lengths, strict=True):
            term |= {"history": length} if len(set(lengths)) > 1 else {}
        if max(lengths) > 1:
            self.set(history={"length": max(lengths), "newest": "last", "by": "term", "fill": "first", **layout})

    def read_ranges(self, ranges: Mapping[str, Any]) -> list[float]:
        """Largest size of each command, of its ranges; a robot that is slower than usual is given its speed."""
        yaw = ranges["ang_vel_z"] if "ang_vel_z" in ranges else ranges["ang_vel_yaw"]
        limits = [float(ranges["lin_vel_x"][1]), *(float(max(map(abs, pair))) for pair in (ranges["lin_vel_y"], yaw))]
        self.set_speed(ranges)
        return limits

    def set_speed(self, ranges: Mapping[str, Any]) -> None:
        """Stores the fastest forward command of a training [m/s], if it is slower than that of a crossing."""
        fastest = ranges["lin_vel_x"][1] if "lin_vel_x" in ranges else 0.0
        if 0.0 < fastest < RobotCfg.speed:
            self.set(speed=fastest, reason=f"the fastest that it was trained for; {RobotCfg.speed:g} is usual here")

    def joint_paths(self) -> list[list[str]]:
        """The names of joints from the base to each joint."""
        model = self.model
        paths: dict[int, list[str]] = {}
        for k in range(1, model.njnt):  # parents come first
            body = int(model.jnt_bodyid[k])
            paths[body] = [*paths.get(int(model.body_parentid[body]), ()), model.joint(k).name]
        return [*paths.values()]

    def sort_breadth_first(self) -> list[str]:
        """Joints from the base outwards, a body's children by name, as PhysX orders them."""
        return [names[-1] for names in sorted(self.joint_paths(), key=lambda names: (len(names), names))]

    def find_imu(self) -> list[float] | None:
        """Position of the base's only site that is called after an IMU [m], shape (3,)."""
        model = self.model
        sites = [k for k in range(model.nsite) if model.site_bodyid[k] == 1 and "imu" in model.site(k).name.lower()]
        return model.site_pos[sites[0]].round(5).tolist() if len(sites) == 1 else None


def collapse(values: Any) -> Any:
    """One value in place of a list of equal ones."""
    return values[0] if isinstance(values, list) and all(value == values[0] for value in values) else values


def make_term(name: str, scale: Any = None, **fields: Any) -> dict[str, Any]:
    """A term of the observation, without a scale of 1 and fields that are None."""
    if scale is not None and not np.all(np.equal(scale, 1.0)):
        fields = {"scale": scale, **fields}
    return {"term": name, **{key: value for key, value in fields.items() if value is not None}}


def make_terms(names: Iterable[str], scales: Mapping[str, Any], **fields: Mapping[str, Any]) -> list[dict[str, Any]]:
    """Terms of the observation with their scales and fields; a clock has the period of rl_sar and unitree_rl_gym."""
    fields = {"clock": {"period_s": 0.8}} | fields
    return [make_term(name, scales.get(name), **fields.get(name, {})) for name in names]


def find_checkpoint(folder: Path, *exported: str) -> Path:
    """The network that a run exported, whose patterns are tried in turn, else its last checkpoint."""
    files = next(filter(None, (sorted(folder.glob(pattern)) for pattern in exported)), [])
    if len(files) > 1:
        raise ValueError(f"it must have one exported network, got {', '.join(map(str, files))}")
    checkpoints = sorted(folder.glob("model_*.pt"), key=lambda file: int(re.sub(r"\D", "", file.stem) or 0))
    if not files + checkpoints:
        raise ValueError(f"it has no weights, expected {', '.join(exported)} or model_*.pt in {folder}")
    return [*checkpoints, *files][-1]
