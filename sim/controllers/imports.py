"""What a training or a vendor left of a controller and its robot, as robot.toml and controller.toml."""

import os
import re
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

from sim.controllers.described import read_controller
from sim.controllers.formats.deployments import read_deploy_yaml, read_rl_sar, read_unitree_rl_gym
from sim.controllers.formats.described_onnx import read_holosoma, read_leapp, read_mjlab
from sim.controllers.formats.isaac import read_booster, read_isaac_lab, read_legged_gym
from sim.controllers.formats.network import find_widths, load_network
from sim.controllers.formats.onnx_data import read_metadata
from sim.controllers.formats.source import BLIND_TERMS, Source, make_term, make_terms
from sim.controllers.spec import data_file
from sim.files.command import command_line
from sim.files.settings import read_yaml, to_toml
from sim.robots.compiled import PER_JOINT
from sim.robots.model_files import MENAGERIE, find_model, find_robot_of_scene
from sim.robots.user import NEW_NAME, is_new_name


def _read_weights_alone(path: Path, source: Source) -> Path:
    """Leaves nearly all settings for the user to fill in, and says what belongs there."""
    network: Any = load_network(path, "cpu", None, label="it")
    width, count = find_widths(network)
    if activation := getattr(getattr(network, "head", network), "activation", None):
        source.set(activation=activation)
    pose = f"an angle of each joint [rad], its pose at action 0: {', '.join(source.joints)}"
    home = source.robot_file.home
    source.set(default_joint_pos=home, reason="" if home else pose)
    if not source.model.nu or not source.model.actuator_biasprm[:, 1].any():
        for name, unit in (("stiffness", "N m/rad"), ("damping", "N m s/rad")):
            source.set(**{name: None}, reason=f"a gain of each joint, or one number [{unit}]")
    source.set(physics_dt=0.005, decimation=4, reason="50 control steps a second, as most controllers have")
    source.set(action_scale=None, reason="radians per unit of action, one or one a joint")
    if count not in (None, len(source.joints)):
        source.set(joints=None, reason=f"the {count} joints that it moves, in its order")
    example = to_toml([make_term("lin_vel", at=source.find_imu()), *make_terms(BLIND_TERMS, {})])
    source.set(observation=None, reason=f"its {width or 'all'} columns in its order, with scale; of {example}")
    return path


_LAB = "a deployment of unitree_rl_lab or unitree_rl_mjlab (a folder with params/deploy.yaml, or that file)"
FORMATS = (
    ({"params/env.yaml"}, read_isaac_lab, "a run of Isaac Lab (a folder with params/env.yaml)"),
    ({"joint_ids_map"}, read_deploy_yaml, _LAB),
    ({"kps"}, read_unitree_rl_gym, "a deployment of unitree_rl_gym (a YAML with kps, kds, ...)"),
    ({"models", "pipeline"}, read_leapp, "a policy of LEAPP (its YAML)"),
    ({"*.observations"}, read_rl_sar, "a controller of rl_sar (its YAML, or a folder with config.yaml)"),
    ({"*.obs_scales"}, read_legged_gym, "a training of legged_gym (its configuration as YAML or JSON)"),
    ({"*.gait_frequency"}, read_booster, "a controller of Booster Gym (the YAML of its deployment or training)"),
    ({"observation_names"}, read_mjlab, "a controller of mjlab (an ONNX file with its metadata)"),
    ({"dof_names", "kp", "kd"}, read_holosoma, "a controller of holosoma (an ONNX file with its metadata)"),
    ({"weights"}, _read_weights_alone, "weights alone (an rsl_rl checkpoint, TorchScript or ONNX)"),
)
"""Formats of sources: the first whose marks a path has reads it into a Source, and returns the file of the weights."""
_DRIVE_SETTINGS = (*PER_JOINT, "actuator_net", "drive_delay_steps")
_ACTION_SETTINGS = ("policy", "joints", "action_scale", "action_offset", "action_clip")
_SETTINGS_BY_FILE = {
    "robot.toml": ("model_file", *_DRIVE_SETTINGS, "physics_dt", "decimation", "speed", "scan_x", "scan_y"),
    "controller.toml": (*_ACTION_SETTINGS, "observation_clip", "activation", "history", "observation"),
}


def _list_marks(path: Path) -> set[str]:
    """What formats are known by: keys of a file's content, those of its tables after ``*.``, and the name of a file."""
    file = path
    if path.is_dir():
        files = [path / name for name in ("params/env.yaml", "params/deploy.yaml", "config.yaml")]
        file = next(filter(Path.is_file, files), path)
    if file.suffix == ".onnx":
        return {"weights", *read_metadata(file)}
    if file.is_file() and file.suffix not in (".yaml", ".yml", ".json"):
        return {"weights"}
    if not file.is_file() or file.name == "env.yaml":  # which is long
        return {file.relative_to(path).as_posix()}
    content = read_yaml(file)
    return {*content}.union(*(map("*.{}".format, table) for table in content.values() if isinstance(table, dict)))


def import_controller(path: Path, model: str | Path | None, out: Path) -> bool:
    """Writes robot.toml and controller.toml of a source to the folder ``out``, with the weights, and prints both.

    ``model`` is what :func:`sim.robots.model_files.find_model` finds; None if the source names its model. The robot is
    called after the folder. Returns whether nothing is left to be filled in.
    """
    if existing := " and ".join(str(out / name) for name in _SETTINGS_BY_FILE if (out / name).exists()):
        raise ValueError(f"--out must name a folder without a robot, got {existing}: move them away first")
    if not is_new_name(out.resolve().name):
        raise ValueError(f"--out must end in {NEW_NAME}, got {out}")
    if not path.exists():
        raise ValueError(f"{path} is not there: expected a folder, a YAML, or weights")
    source = Source(file=path, model_file=None if model is None else find_robot_of_scene(find_model(model)))
    marks = _list_marks(path)
    reader, label = next(((reader, label) for needed, reader, label in FORMATS if needed <= marks), (None, ""))
    if reader is None:
        raise ValueError(f"{path} must be {', or '.join(label for *_, label in FORMATS)}")
    weights_file = _read(reader, label, path, source)
    load_network(weights_file, "cpu", None, label="it", activation=source.settings.get("activation"))  # or is refused
    if weights_file.name in _SETTINGS_BY_FILE:
        raise ValueError(f"{weights_file} must have another name, since the file of that name is written: rename it")
    copies = {file: out / file.name for file in (weights_file, data_file(weights_file)) if file is not None}
    for file, copy in copies.items():
        if copy.exists() and copy.read_bytes() != file.read_bytes():
            raise ValueError(f"{copy} must be a copy of {file}, got other weights: move them away first")
    model_file = source.model_file
    is_named = model_file is None or str(model).startswith(MENAGERIE)
    model_setting = str(model) if is_named else os.path.relpath(model_file.resolve(), out.resolve())
    source.set(model_file=Path(model_setting), policy=weights_file.name)
    lines = {name: _format_setting(name, source) for name in source.settings}
    texts = {file: "".join(lines.get(name, "") for name in names) for file, names in _SETTINGS_BY_FILE.items()}
    gaps = [name for names in _SETTINGS_BY_FILE.values() for name in names if source.settings.get(name, "") is None]
    if not {*gaps} & {*_SETTINGS_BY_FILE["controller.toml"]}:
        read_controller(out / "controller.toml", texts["controller.toml"])  # or is refused, before anything is written
    out.mkdir(parents=True, exist_ok=True)
    print(f"{path} is read as {label}; its weights are {weights_file}, its model is {model_file}.")
    for file, copy in copies.items():
        if not copy.exists():
            shutil.copyfile(file, copy)
    for file, text in texts.items():
        (out / file).write_text(f"# Of {path.name}\n{text}", encoding="utf-8")
        print(f"\n{out / file}:\n{text}", end="")
    print(f"\nFill in {', '.join(gaps)}; then:" if gaps else "\nNext:")
    for name in ("check", "archive"):
        print(f"  {command_line(name, robot=out / 'robot.toml')}")
    return not gaps


def _read(reader: Callable[[Path, Source], Path], label: str, path: Path, source: Source) -> Path:
    """The file of the weights; errors name the source and its format."""
    try:
        return reader(path, source)
    except (ArithmeticError, AttributeError, LookupError, StopIteration, TypeError, ValueError, re.error) as error:
        files = {str(source.file), str(source.model_file)}
        if isinstance(error, ValueError) and any(file in str(error) for file in files):
            raise
        problem = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        if not isinstance(error, KeyError | ValueError):
            problem = f"it is laid out otherwise ({type(error).__name__}: {error})"
        raise ValueError(f"{path} must be {label}, but {problem}") from None


def _format_setting(name: str, source: Source) -> str:
    value: Any = source.settings[name]
    reason = source.reasons[name]
    if value is None:
        return f"# {name} = ...  # fill in: {reason}\n"
    text = to_toml(value)
    if name == "observation":
        text = "".join(["[\n", *(f"  {to_toml(term)},\n" for term in value), "]"])
    return f"{name} = {text}{f'  # a guess: {reason}' if reason else ''}\n"
