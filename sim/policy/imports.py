"""What a training or a vendor left of a controller and its robot, as robot.toml and controller.toml."""

import os
import shutil
from collections.abc import Callable
from pathlib import Path

from sim.files.command import command_line
from sim.files.settings import to_toml
from sim.policy.isaac_lab import read_isaac_lab
from sim.policy.sources import (
    Found,
    Model,
    Setting,
    onnx_metadata,
    read_deployment,
    read_mjlab,
    read_rl_sar,
    read_weights,
    read_yaml,
)
from sim.robots.compiled import joint_names
from sim.robots.own import compile_model


def import_controller(source: Path, model_file: Path, out: Path) -> None:
    """Writes ``out``/robot.toml and controller.toml, with the weights beside them, and prints both.

    Args:
        source: A folder or a YAML of rl_sar, a YAML of unitree_rl_gym, a run folder of Isaac Lab, an ONNX file, with or
            without mjlab's metadata, or any other weights.
        model_file: The robot's MJCF or URDF.
        out: A folder, which gives the robot its name.
    """
    files = {name: out / name for name in ("robot.toml", "controller.toml")}
    if taken := [str(file) for file in files.values() if file.exists()]:
        raise ValueError(f"--out must name a folder without a robot, got {' and '.join(taken)}: move them away first")
    if not source.exists():
        raise ValueError(f"{source} is not there: expected a folder, a YAML, or weights")
    compiled = compile_model(model_file)
    model = Model(file=model_file, compiled=compiled, joints=joint_names(compiled))
    kind, read = _reader_of(source)
    found = read(source, model)
    out.mkdir(parents=True, exist_ok=True)
    here = Path(os.path.relpath(model_file.resolve(), out.resolve()))
    robot = {"model_file": Setting(here), **found.robot}
    controller = {"policy": Setting(found.weights.name), **found.controller}
    print(f"{source} is read as {kind}; its weights are {found.weights}.")
    if found.unused:
        print(f"Not needed: {', '.join(found.unused)}.")
    if not (out / found.weights.name).exists():
        shutil.copyfile(found.weights, out / found.weights.name)
    for file, settings in zip(files.values(), (robot, controller), strict=True):
        text = "".join(f"{_as_line(name, setting)}\n" for name, setting in settings.items())
        file.write_text(f"# Of {source.name}\n{text}", encoding="utf-8")
        print(f"\n{file}:\n{text}", end="")
    gaps = [name for part in (robot, controller) for name, setting in part.items() if setting.value is None]
    if gaps:
        print(f"\nFill in {', '.join(gaps)}; then:")
    else:
        print("\nNext:")
    for name in ("check", "archive"):
        print(f"  {command_line(name, robot=files['robot.toml'])}")


def _as_line(name: str, setting: Setting) -> str:
    value, why = setting
    if value is None:
        return f"# {name} = ...  # fill in: {why}"
    text = to_toml(value)
    if name == "observation":
        text = "[\n" + "".join(f"  {to_toml(term)},\n" for term in value) + "]"
    return f"{name} = {text}{f'  # a guess: {why}' if why else ''}"


def _reader_of(source: Path) -> tuple[str, Callable[[Path, Model], Found]]:
    if (source / "params" / "env.yaml").is_file():
        return "a run of Isaac Lab", read_isaac_lab
    if source.is_dir() or source.suffix in (".yaml", ".yml"):
        file = source / "config.yaml" if source.is_dir() else source
        content = read_yaml(file)
        if "kps" in content:
            return "a deployment of unitree_rl_gym", read_deployment
        if len(content) == 1 and "observations" in (next(iter(content.values())) or ()):
            return "a controller of rl_sar", read_rl_sar
        raise ValueError(
            f"{file} must be of rl_sar (a name with observations, ...) or unitree_rl_gym (kps, kds, ...), or the run "
            f"folder of Isaac Lab have params/env.yaml; got {', '.join(map(str, content))}"
        )
    if source.suffix == ".onnx" and "observation_names" in onnx_metadata(source):
        return "a controller of mjlab", read_mjlab
    return "weights alone", read_weights
