"""What a training or a vendor left of a controller and its robot, as robot.toml and controller.toml."""

import os
import re
import shutil
from pathlib import Path
from typing import Any

from sim.controllers.formats.booster import Booster
from sim.controllers.formats.deploy_yaml import DeployYaml
from sim.controllers.formats.holosoma import Holosoma
from sim.controllers.formats.isaac_lab import IsaacLab
from sim.controllers.formats.leapp import Leapp
from sim.controllers.formats.legged_gym import LeggedGym
from sim.controllers.formats.mjlab import Mjlab
from sim.controllers.formats.rl_sar import RlSar
from sim.controllers.formats.source import Source
from sim.controllers.formats.unitree_rl_gym import UnitreeRlGym
from sim.controllers.formats.weights import Weights
from sim.controllers.spec import data_file
from sim.files.command import command_line
from sim.files.settings import to_toml
from sim.robots.compiled import PER_JOINT
from sim.robots.model_files import MENAGERIE, find_model, find_robot_of_scene
from sim.robots.user import NEW_NAME, is_new_name

FORMATS = (
    *(IsaacLab(), DeployYaml(), UnitreeRlGym(), RlSar(), LeggedGym(), Booster(), Leapp()),
    *(Mjlab(), Holosoma(), Weights()),
)
"""Formats of sources: the first that matches a path reads it into a Source, and returns the file of the weights."""
_ROBOT_SETTINGS = ("actuator_net", "drive_delay_steps", "physics_dt", "decimation", "speed", "max_duration_s")
_ACTION_SETTINGS = ("policy", "joints", "action_scale", "action_offset", "action_clip")
_OBSERVATION_SETTINGS = ("observation_clip", "activation", "history", "observation")
_SETTINGS_BY_FILE = {
    "robot.toml": ("model_file", *PER_JOINT, *_ROBOT_SETTINGS, "scan_x", "scan_y"),
    "controller.toml": (*_ACTION_SETTINGS, *_OBSERVATION_SETTINGS),
}


def import_controller(path: Path, model: str | Path | None, out: Path) -> bool:
    """Writes robot.toml and controller.toml, with the weights beside them, to the folder ``out``, and prints both.

    ``path`` is a source of one of :data:`FORMATS`; the robot is called after the folder. ``model`` is what
    :func:`sim.robots.model_files.find_model` finds; None if the source names its model.
    Returns whether nothing is left to be filled in.
    """
    if existing := [str(out / name) for name in _SETTINGS_BY_FILE if (out / name).exists()]:
        files = " and ".join(existing)
        raise ValueError(f"--out must name a folder without a robot, got {files}: move them away first")
    if not is_new_name(out.resolve().name):
        raise ValueError(f"--out must end in {NEW_NAME}, got {out}")
    if not path.exists():
        raise ValueError(f"{path} is not there: expected a folder, a YAML, or weights")
    source = Source(file=path, model_file=None if model is None else find_robot_of_scene(find_model(model)))
    source_format: Any = next((source_format for source_format in FORMATS if source_format.matches(path)), None)
    if source_format is None:
        raise ValueError(f"{path} must be {', or '.join(source_format.label for source_format in FORMATS)}")
    weights_file = _read(source_format, path, source)
    copies = {file: out / file.name for file in (weights_file, data_file(weights_file)) if file is not None}
    for file, copy in copies.items():
        if copy.exists() and copy.read_bytes() != file.read_bytes():
            raise ValueError(f"{copy} must be a copy of {file}, got other weights: move them away first")
    out.mkdir(parents=True, exist_ok=True)
    model_file = source.model_file
    is_named = model_file is None or str(model).startswith(MENAGERIE)
    model_setting = str(model) if is_named else os.path.relpath(model_file.resolve(), out.resolve())
    source.set(model_file=Path(model_setting), policy=weights_file.name)
    print(f"{path} is read as {source_format.label}; its weights are {weights_file}, its model is {model_file}.")
    for file, copy in copies.items():
        if not copy.exists():
            shutil.copyfile(file, copy)
    for file, names in _SETTINGS_BY_FILE.items():
        text = "".join(f"{_format_setting(name, source)}\n" for name in names if name in source.settings)
        (out / file).write_text(f"# Of {path.name}\n{text}", encoding="utf-8")
        print(f"\n{out / file}:\n{text}", end="")
    order = [name for names in _SETTINGS_BY_FILE.values() for name in names]
    gaps = [name for name in order if source.settings.get(name, "") is None]
    print(f"\nFill in {', '.join(gaps)}; then:" if gaps else "\nNext:")
    for name in ("check", "archive"):
        print(f"  {command_line(name, robot=out / 'robot.toml')}")
    return not gaps


def _read(source_format: Any, path: Path, source: Source) -> Path:
    """The file of the weights; errors name the source and its format."""
    try:
        return source_format.read(path, source)
    except (ArithmeticError, AttributeError, LookupError, StopIteration, TypeError, ValueError, re.error) as error:
        files = {str(source.file), str(source.model_file)}
        if isinstance(error, ValueError) and any(file in str(error) for file in files):
            raise
        problem = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        if not isinstance(error, KeyError | ValueError):
            problem = f"it is laid out otherwise ({type(error).__name__}: {error})"
        raise ValueError(f"{path} must be {source_format.label}, but {problem}") from None


def _format_setting(name: str, source: Source) -> str:
    """The line of a setting in its file."""
    value: Any = source.settings[name]
    reason = source.reasons[name]
    if value is None:
        return f"# {name} = ...  # fill in: {reason}"
    text = to_toml(value)
    if name == "observation":
        text = "".join(["[\n", *(f"  {to_toml(term)},\n" for term in value), "]"])
    return f"{name} = {text}{f'  # a guess: {reason}' if reason else ''}"
