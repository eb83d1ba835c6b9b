"""What rl_sar, unitree_rl_gym, mjlab and weights alone say of a controller and its robot."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import torch
import yaml

from sim.files.settings import to_toml
from sim.policy.loaders import PlainYaml, load_network
from sim.robots.own import default_pose


class Setting(NamedTuple):
    """A line of a file."""

    value: Any
    """None where the user has to fill it in."""
    why: str = ""
    """Why it is a guess, or what belongs there."""


@dataclass(kw_only=True)
class Found:
    """What a source says; ``unused`` is what it says beside, and nothing needs."""

    weights: Path
    robot: dict[str, Setting]
    controller: dict[str, Setting]
    unused: list[str] = field(default_factory=list)


@dataclass(frozen=True, kw_only=True)
class Model:
    """The robot's own file."""

    file: Path
    compiled: Any
    joints: tuple[str, ...]

    def in_order(self, values: Any, joints: Sequence[str], what: str) -> Any:
        """Values of ``joints``, or one for all, in the order of the file; they must be of all of its joints."""
        if not isinstance(values, list):
            return values
        if len(values) != len(joints):
            raise ValueError(f"{what} must have {len(joints)} values, of {', '.join(joints)}, got {len(values)}")
        missing = [joint for joint in self.joints if joint not in joints]
        strange = [joint for joint in joints if joint not in self.joints]
        if missing or strange:
            words = [f"{', '.join(names)} in {place} alone" for names, place in ((strange, "it"), (missing, self.file))
                     if names]  # fmt: skip
            raise ValueError(f"{what}: joints must be those of the model, got {'; '.join(words)}")
        ordered = [values[list(joints).index(joint)] for joint in self.joints]
        return ordered[0] if all(value == ordered[0] for value in ordered) else ordered

    def breadth_first(self) -> list[str]:
        """Joints from the base outwards, those of a body's children by name."""
        model, order, level = self.compiled, list[str](), [1]
        names = {int(model.jnt_bodyid[k]): model.joint(k).name for k in range(1, model.njnt)}
        while level:
            level = [
                child
                for parent in level
                for child in sorted(np.flatnonzero(model.body_parentid == parent), key=lambda k: names[int(k)])
            ]
            order += [names[int(body)] for body in level]
        return order

    def imu(self) -> list[float] | None:
        """Place of the base's site that is called after an IMU [m]."""
        model = self.compiled
        sites = [k for k in range(model.nsite) if model.site_bodyid[k] == 1 and "imu" in model.site(k).name.lower()]
        return model.site_pos[sites[0]].round(5).tolist() if len(sites) == 1 else None


def read_yaml(file: Path) -> dict[str, Any]:
    """Content of a YAML file, as data alone."""
    try:
        content = yaml.load(file.read_text(encoding="utf-8"), PlainYaml)
    except (OSError, ValueError, yaml.YAMLError) as error:
        raise ValueError(f"{file} cannot be read as YAML: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{file} must hold names with values, got {type(content).__name__}")
    return content


def onnx_metadata(file: Path) -> Mapping[str, str]:
    """What an ONNX file says of itself."""
    import onnxruntime  # takes long to load

    try:
        return onnxruntime.InferenceSession(file.read_bytes()).get_modelmeta().custom_metadata_map
    except Exception as error:  # its errors have no base
        raise ValueError(f"{file} is no ONNX file: {error}") from None


def _weights_of(folder: Path, name: str) -> Path:
    """File of weights that a source names, of which a path of another machine may be known."""
    file = folder / Path(name).name
    if not file.is_file():
        raise ValueError(f"{file} is not there: put the weights that {folder} names beside it")
    return file


def _check(said: Mapping[str, Any], needed: Sequence[str], more: Sequence[str], file: Path) -> None:
    """Refuses names that are missing, and those that nobody understands."""
    if missing := [name for name in needed if name not in said]:
        raise ValueError(f"{file} must say {', '.join(missing)}")
    if unknown := [str(name) for name in said if name not in (*needed, *more)]:
        raise ValueError(f"{file} says what is not understood: {', '.join(unknown)}: take it out if it does not matter")


def _terms_of(names: Sequence[str], file: Path) -> list[str]:
    """What the terms of rl_sar and mjlab are called here."""
    _check(dict.fromkeys(names), (), list(_TERMS), file)
    return [_TERMS[name] for name in names]


def term_of(name: str, scale: Any = None, **more: Any) -> dict[str, Any]:
    """A term of the observation, without what changes nothing."""
    plain = scale is None or all(factor == 1.0 for factor in (scale if isinstance(scale, list) else [scale]))
    given = {key: value for key, value in more.items() if value is not None}
    return {"term": name, **({} if plain else {"scale": scale}), **given}


def joints_setting(joints: Sequence[str], model: Model, why: str = "") -> dict[str, Setting]:
    """The controller's order of joints, where it is not that of the file."""
    return {} if tuple(joints) == model.joints else {"joints": Setting(list(joints), why)}


_TERMS = {
    "lin_vel": "lin_vel", "ang_vel": "ang_vel", "ang_vel_body": "ang_vel", "gravity_vec": "gravity",
    "commands": "command", "dof_pos": "joint_pos", "dof_vel": "joint_vel", "base_lin_vel": "lin_vel",
    "base_ang_vel": "ang_vel", "projected_gravity": "gravity", "command": "command", "velocity_commands": "command",
    "joint_pos": "joint_pos", "joint_vel": "joint_vel", "actions": "last_action", "last_action": "last_action",
}  # fmt: skip
"""Of rl_sar and of mjlab, whose names have nothing but their meaning in common."""
_RL_SAR_SCALES = {"lin_vel": "lin_vel_scale", "ang_vel": "ang_vel_scale", "command": "commands_scale",
                  "joint_pos": "dof_pos_scale", "joint_vel": "dof_vel_scale"}  # fmt: skip
_RL_SAR_NEEDED = ("model_name", "observations", "rl_kp", "rl_kd", "action_scale", "default_dof_pos", "joint_names",
                  "joint_mapping", "dt", "decimation")  # fmt: skip
_RL_SAR_UNUSED = ("fixed_kp", "fixed_kd", "num_of_dofs", "num_observations", "joint_controller_names", "framework")
_RL_SAR_MORE = ("observations_history", "observations_history_priority", "clip_obs", "clip_actions_lower",
                "clip_actions_upper", "wheel_indices", "torque_limits", *_RL_SAR_SCALES.values())  # fmt: skip


def read_rl_sar(source: Path, model: Model) -> Found:
    """A controller's YAML over the base.yaml of its robot, which is beside it or in the folder above."""
    file = source / "config.yaml" if source.is_dir() else source
    (own,) = read_yaml(file).values()
    bases = [folder / "base.yaml" for folder in (file.parent, file.parent.parent)]
    base = next((place for place in bases if place.is_file()), None)
    if base is None:
        raise ValueError(f"base.yaml of the robot is not there: expected {' or '.join(map(str, bases))}")
    settings = next(iter(read_yaml(base).values())) | own
    _check(settings, _RL_SAR_NEEDED, (*_RL_SAR_UNUSED, *_RL_SAR_MORE), file)
    if settings.get("wheel_indices"):
        raise ValueError(f"{file}: wheel_indices must be empty, since wheels are not supported")
    joints = [settings["joint_names"][k] for k in settings["joint_mapping"]]
    names = _terms_of(settings["observations"], file)
    terms = [term_of(name, settings.get(_RL_SAR_SCALES.get(name, ""))) for name in names]
    gains = {"default_joint_pos": "default_dof_pos", "stiffness": "rl_kp", "damping": "rl_kd"}
    if "torque_limits" in settings:
        gains["effort_limit"] = "torque_limits"
    robot = {ours: Setting(model.in_order(settings[name], joints, f"{file}: {name}")) for ours, name in gains.items()}
    robot |= step_settings(settings["dt"], settings["decimation"])
    controller = joints_setting(joints, model) | {"action_scale": Setting(settings["action_scale"])}
    if "clip_actions_upper" in settings:
        low, high = settings["clip_actions_lower"], settings["clip_actions_upper"]
        alike = all((a, b) == (-high[0], high[0]) for a, b in zip(low, high, strict=True))
        limits = high[0] if alike else [list(pair) for pair in zip(low, high, strict=True)]
        controller["action_clip"] = Setting(limits)
    if "clip_obs" in settings:
        controller["observation_clip"] = Setting(settings["clip_obs"])
    steps = settings.get("observations_history") or [0]
    if steps not in (list(range(len(steps))), list(range(len(steps)))[::-1]):
        raise ValueError(f"{file}: observations_history must be all steps from 0 on, got {steps}")
    if len(steps) > 1:
        by = {"time": "row", "term": "term"}[settings.get("observations_history_priority", "time")]
        newest = "first" if steps[0] == 0 else "last"
        history = {"length": len(steps), "newest": newest, "by": by, "fill": "zeros"}
        controller["history"] = Setting(history, "steps before the start are zeros, as in rl_sar's own loop")
    controller["observation"] = Setting(terms)
    unused = [name for name in _RL_SAR_UNUSED if name in settings]
    weights = _weights_of(file.parent, settings["model_name"])
    return Found(weights=weights, robot=robot, controller=controller, unused=unused)


_DEPLOYED = ("policy_path", "simulation_dt", "control_decimation", "kps", "kds", "default_angles", "ang_vel_scale",
             "dof_pos_scale", "dof_vel_scale", "action_scale", "cmd_scale", "num_actions", "num_obs")  # fmt: skip
_DEPLOYED_UNUSED = ("xml_path", "simulation_duration", "cmd_init")
_DEPLOYED_PERIOD_S = 0.8  # of the clock in unitree_rl_gym's deploy_mujoco.py


def read_deployment(source: Path, model: Model) -> Found:
    """A YAML of ``deploy_mujoco``, whose script has the observation: its order, and a clock if there is room for it."""
    settings = read_yaml(source)
    _check(settings, _DEPLOYED, _DEPLOYED_UNUSED, source)
    count, width = settings["num_actions"], settings["num_obs"]
    if count != len(model.joints):
        raise ValueError(f"{source}: num_actions must be {len(model.joints)}, the joints of {model.file}, got {count}")
    if width not in (9 + 3 * count, 11 + 3 * count):
        raise ValueError(
            f"{source}: num_obs must be {9 + 3 * count}, or {11 + 3 * count} with a clock, got {width}: describe it by "
            "hand (docs/controllers.md)"
        )
    gains = {"default_joint_pos": "default_angles", "stiffness": "kps", "damping": "kds"}
    robot = {ours: Setting(model.in_order(settings[name], model.joints, f"{source}: {name}"))
             for ours, name in gains.items()}  # fmt: skip
    robot |= step_settings(settings["simulation_dt"], settings["control_decimation"])
    terms = [
        term_of("ang_vel", settings["ang_vel_scale"]), term_of("gravity"), term_of("command", settings["cmd_scale"]),
        term_of("joint_pos", settings["dof_pos_scale"]), term_of("joint_vel", settings["dof_vel_scale"]),
        term_of("last_action"),
    ]  # fmt: skip
    why = "the order of unitree_rl_gym's deploy_mujoco.py"
    if width == 11 + 3 * count:
        terms.append({"term": "clock", "period_s": _DEPLOYED_PERIOD_S})
        why = f"{why}, and the period of its clock"
    controller = {"action_scale": Setting(settings["action_scale"]), "observation": Setting(terms, why)}
    unused = [name for name in _DEPLOYED_UNUSED if name in settings]
    weights = _weights_of(source.parent, settings["policy_path"])
    return Found(weights=weights, robot=robot, controller=controller, unused=unused)


_MJLAB_NEEDED = ("joint_names", "joint_stiffness", "joint_damping", "default_joint_pos", "action_scale",
                 "observation_names")  # fmt: skip
_MJLAB_UNUSED = ("run_path", "command_names", "observation_terms_flatten_history_dim")


def read_mjlab(source: Path, model: Model) -> Found:
    """An ONNX file with the metadata of mjlab's exporter, rounded to three decimals."""
    said = onnx_metadata(source)
    of_terms = [f"observation_terms_{name}" for name in ("scale", "clip", "history_length")]
    _check(said, _MJLAB_NEEDED, (*of_terms, *_MJLAB_UNUSED), source)
    names = _terms_of(said["observation_names"].split(","), source)
    joints = said["joint_names"].split(",")
    scales, clips, lengths = (said[key].split(",") if said.get(key) else [None] * len(names) for key in of_terms)
    terms, guesses, seen = [], [], []
    for name, scale, clip, length in zip(names, scales, clips, lengths, strict=True):
        term = term_of(name, scale and float(scale))
        limits = [float(limit) for limit in (clip or "-inf;inf").split(";")]
        if np.isfinite(limits).any():
            term["clip"] = np.clip(limits, -1e9, 1e9).tolist()
        if name == "lin_vel" and (place := model.imu()):
            term["at"] = place
            guesses.append("the velocity is that of the IMU's site")
        seen.append(max(1, round(float(length or 0))))
        terms.append(term)
    numbers = {key: _numbers(said[key]) for key in ("default_joint_pos", "joint_stiffness", "joint_damping")}
    robot = {key.removeprefix("joint_"): Setting(model.in_order(values, joints, f"{source}: {key}"))
             for key, values in numbers.items()}  # fmt: skip
    robot |= step_settings(why="the metadata do not say it; mjlab's own tasks are like this")
    scale = _numbers(said["action_scale"])
    controller = joints_setting(joints, model) | {"action_scale": Setting(scale[0] if len(set(scale)) == 1 else scale)}
    controller |= history_setting(terms, seen) | {"observation": Setting(terms, "; ".join(guesses))}
    unused = [f"{name} {said[name]}" for name in _MJLAB_UNUSED if name in said]
    return Found(weights=source, robot=robot, controller=controller, unused=unused)


def _numbers(text: str) -> list[float]:
    return [float(part) for part in text.split(",")]


def step_settings(physics_dt: float = 0.005, decimation: int = 4, why: str = "") -> dict[str, Setting]:
    """Length of a physics step [s], and their number in a control step."""
    return {"physics_dt": Setting(physics_dt, why), "decimation": Setting(decimation, why)}


def history_setting(terms: list[dict[str, Any]], lengths: Sequence[int]) -> dict[str, Setting]:
    """How Isaac Lab and mjlab lay out former steps; lengths that differ are written into the terms."""
    if max(lengths) == 1:
        return {}
    if len(set(lengths)) > 1:
        for term, length in zip(terms, lengths, strict=True):
            term["history"] = length
    return {"history": Setting({"length": max(lengths), "newest": "last", "by": "term", "fill": "first"})}


def read_weights(source: Path, model: Model) -> Found:
    """Weights that say nothing but their widths."""
    width, count = _widths(source)
    place = model.imu()
    at = f", at = {to_toml(place)}" if place else ""
    example = f'[{{term = "lin_vel"{at}}}, {{term = "ang_vel"}}, {{term = "gravity"}}, {{term = "command"}}, ' \
              '{term = "joint_pos"}, {term = "joint_vel"}, {term = "last_action"}]'  # fmt: skip
    pose, keyframe = default_pose(model.file, model.compiled)
    asked = "an angle of each joint [rad], its pose at action 0: " + ", ".join(model.joints)
    robot = {"default_joint_pos": Setting(pose) if keyframe else Setting(None, asked)}
    if not model.compiled.nu or not model.compiled.actuator_biasprm[:, 1].any():
        gains = "a gain of each joint, or one number"
        robot |= {"stiffness": Setting(None, f"{gains} [N m/rad]"), "damping": Setting(None, f"{gains} [N m s/rad]")}
    robot |= step_settings(why="50 control steps a second, as most controllers have")
    columns = f"{width} columns" if width else "all columns"
    controller = {"action_scale": Setting(None, "radians per unit of action, one or one a joint")}
    if count not in (None, len(model.joints)):
        controller["joints"] = Setting(None, f"the {count} joints that it moves, in its order")
    controller["observation"] = Setting(None, f"its {columns} in its order, with scale; of {example}")
    return Found(weights=source, robot=robot, controller=controller)


def _widths(source: Path) -> tuple[int | None, int | None]:
    """Columns and actions of a network, as far as it says them."""
    network: Any = load_network(source, "cpu", None, of="it")
    if hasattr(network, "sizes"):
        return network.sizes
    for weight in network.parameters():
        if weight.ndim == 2:
            try:
                return weight.shape[1], network(torch.zeros(1, weight.shape[1])).shape[1]
            except (RuntimeError, AttributeError):
                continue
    return None, None
