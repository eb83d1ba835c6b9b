"""Controllers as they are deployed: YAML of rl_sar and of unitree_rl_gym, ONNX of mjlab, or weights alone."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from sim.controllers.formats.network import find_widths, load_network
from sim.controllers.formats.source import BLIND_TERMS, SETTINGS, TERM_NAMES, Source, make_term
from sim.files.settings import YAML_SUFFIXES, read_yaml, to_toml

_TERMS = TERM_NAMES | {"g1_phase": "clock", "cmd": "command"}
_SCALED = ("lin_vel", "commands", "ang_vel", "cmd", "dof_pos", "dof_vel")
_CLOCK_PERIOD = 0.8  # of the code of both [s]
_RL_SAR_KEYS = ("default_dof_pos", "rl_kp", "rl_kd", "action_scale", "dt", "decimation")
_RL_SAR_OPTIONAL_KEYS = {"torque_limits": "effort_limit", "clip_obs": "observation_clip"}
_WITHOUT_EFFECT = ("fixed_kp", "fixed_kd", "num_of_dofs", "num_observations", "joint_controller_names", "framework")
_MJLAB_KEYS = ("default_joint_pos", "joint_stiffness", "joint_damping", "action_scale")
_UNITREE_KEYS = ("default_angles", "kps", "kds", "action_scale", "simulation_dt", "control_decimation")


class RlSar:
    """Reads a YAML over the base.yaml of its robot, which is beside it or in the folder above."""

    label = "a controller of rl_sar (its YAML, or a folder with config.yaml)"

    def matches(self, path: Path) -> bool:
        """Whether it is a YAML of one name that has observations, or a folder with such a config.yaml."""
        file = path / "config.yaml" if path.is_dir() else path
        if file.suffix not in YAML_SUFFIXES or not file.is_file():
            return False
        values = list(read_yaml(file).values())
        return len(values) == 1 and isinstance(values[0], dict) and "observations" in values[0]

    def read(self, path: Path, source: Source) -> Path:
        """Settings of both files, refused by name if they are not understood."""
        source.file = file = path / "config.yaml" if path.is_dir() else path
        bases = [folder / "base.yaml" for folder in (file.parent, file.parent.parent)]
        base = next(filter(Path.is_file, bases), None)
        if base is None:
            raise ValueError(f"base.yaml of the robot is not there: expected {' or '.join(map(str, bases))}")
        content = next(iter(read_yaml(base).values())) | next(iter(read_yaml(file).values()))
        if content.pop("wheel_indices", None):
            raise ValueError(f"{file}: wheel_indices must be empty, since wheels are not supported")
        names = content.pop("joint_names")
        joints = [names[k] for k in content.pop("joint_mapping")]
        source.set_joints(joints)
        optional = {key: name for key, name in _RL_SAR_OPTIONAL_KEYS.items() if key in content}
        source.move(content, dict(zip(_RL_SAR_KEYS, SETTINGS, strict=True)) | optional, joints)
        if "clip_actions_upper" in content:
            limits = map(content.pop, ("clip_actions_lower", "clip_actions_upper"))
            pairs = [list(pair) for pair in zip(*limits, strict=True)]
            high = pairs[0][1]
            source.set(action_clip=high if all(pair == [-high, high] for pair in pairs) else pairs)
        steps = content.pop("observations_history", None) or [0]
        if steps not in (list(range(len(steps))), list(range(len(steps)))[::-1]):
            raise ValueError(f"{file}: observations_history must be all steps from 0 on, got {steps}")
        priority = content.pop("observations_history_priority", "time")
        by = {"time": "row", "term": "term"}.get(priority)
        if by is None:
            raise ValueError(f"{file}: observations_history_priority must be time or term, got {priority}")
        if len(steps) > 1:
            history = {"length": len(steps), "newest": "last" if steps[0] else "first", "by": by, "fill": "zeros"}
            source.set(history=history, reason="steps before the start are zeros, as in rl_sar's own loop")
        terms = content.pop("observations")
        source.refuse_unknown(terms, _TERMS)
        scales = {_TERMS[name]: content.pop(f"{name}_scale") for name in _SCALED if f"{name}_scale" in content}
        periods = {"clock": _CLOCK_PERIOD}
        names = [_TERMS[term] for term in terms]
        source.set(observation=[make_term(name, scales.get(name), period_s=periods.get(name)) for name in names])
        weights = _find_weights(file.parent, content.pop("model_name"))
        source.refuse_unknown(content, _WITHOUT_EFFECT)
        return weights


class UnitreeRlGym:
    """Reads a YAML, and the observation of deploy_mujoco.py, which fixes its terms and their order."""

    label = "a deployment of unitree_rl_gym (a YAML with kps, kds, ...)"

    def matches(self, path: Path) -> bool:
        """Whether it is a YAML with gains called kps."""
        return path.suffix in YAML_SUFFIXES and path.is_file() and "kps" in read_yaml(path)

    def read(self, path: Path, source: Source) -> Path:
        """Settings of the YAML, and the observation of the script, with a clock if there are two columns for it."""
        content = read_yaml(path)
        count = content.pop("num_actions")
        width = content.pop("num_obs")
        if count != len(source.joints):
            joints = f"{len(source.joints)}, the joints of {source.model_file}"
            raise ValueError(f"{path}: num_actions must be {joints}, got {count}")
        blind = 9 + 3 * count
        if width not in (blind, blind + 2):
            by_hand = "describe it by hand (docs/controllers.md)"
            raise ValueError(f"{path}: num_obs must be {blind}, or {blind + 2} with a clock, got {width}: {by_hand}")
        source.move(content, dict(zip(_UNITREE_KEYS, SETTINGS, strict=True)), source.joints)
        scales = {_TERMS[name]: content.pop(f"{name}_scale") for name in ("ang_vel", "cmd", "dof_pos", "dof_vel")}
        terms = [make_term(name, scales.get(name)) for name in BLIND_TERMS]
        reason = "the order of unitree_rl_gym's deploy_mujoco.py"
        if width > blind:
            terms.append(make_term("clock", period_s=_CLOCK_PERIOD))
            reason += ", and the period of its clock"
        source.set(observation=terms, reason=reason)
        weights = _find_weights(path.parent, content.pop("policy_path"))
        source.refuse_unknown(content, ("xml_path", "simulation_duration", "cmd_init"))
        return weights


def _find_weights(folder: Path, name: str) -> Path:
    """The file of weights in a folder; its name may have a path of another machine."""
    file = folder / Path(name).name
    if not file.is_file():
        raise ValueError(f"{file} is not there: put the weights that {folder} names beside it")
    return file


def _read_metadata(file: Path) -> Mapping[str, str]:
    try:
        return {item.key: item.value for item in onnx.ModelProto.FromString(file.read_bytes()).metadata_props}
    except Exception as error:  # protobuf's errors have no base
        raise ValueError(f"{file} is no ONNX file: {error}") from None


class Mjlab:
    """Reads the metadata of an ONNX file, which are rounded to three decimals."""

    label = "a controller of mjlab (an ONNX file with its metadata)"

    def matches(self, path: Path) -> bool:
        """Whether it is an ONNX file that names its observations."""
        return path.suffix == ".onnx" and path.is_file() and "observation_names" in _read_metadata(path)

    def read(self, path: Path, source: Source) -> Path:
        """Settings of the metadata; the file is also that of the weights."""
        load_network(path, "cpu", None, label="it")  # refuses a damaged file
        content: dict[str, Any] = {key: text.split(",") for key, text in _read_metadata(path).items() if text}
        names = content.pop("observation_names")
        joints = content.pop("joint_names")
        source.refuse_unknown(names, TERM_NAMES)
        values = {key: [*map(float, content.pop(key))] for key in _MJLAB_KEYS}
        source.move(values, dict(zip(_MJLAB_KEYS, SETTINGS, strict=False)), joints)
        source.set_joints(joints)
        source.set(physics_dt=0.005, decimation=4, reason="the metadata do not say it; mjlab's own tasks are like this")
        columns = ("scale", "clip", "history_length")
        scales, clips, lengths = (content.pop(f"observation_terms_{name}", [""] * len(names)) for name in columns)
        source.refuse_unknown(content, ("run_path", "command_names", "observation_terms_flatten_history_dim"))
        terms = []
        for name, scale, clip in zip(names, scales, clips, strict=True):
            imu = source.find_imu() if TERM_NAMES[name] == "lin_vel" else None
            limits = [float(limit) for limit in (clip or "-inf;inf").split(";")]
            limits = np.clip(limits, -1e9, 1e9).tolist() if np.isfinite(limits).any() else None
            terms.append(make_term(TERM_NAMES[name], float(scale or 1.0), clip=limits, at=imu))
        source.set_history(terms, [max(1, round(float(length or 0))) for length in lengths])
        reason = "the velocity is that of the IMU's site" * any("at" in term for term in terms)
        source.set(observation=terms, reason=reason)
        return path


class Weights:
    """Reads the widths of a network of any format."""

    label = "weights alone (an rsl_rl checkpoint, TorchScript or ONNX)"

    def matches(self, path: Path) -> bool:
        """Whether it is a file that may hold weights."""
        return path.is_file() and path.suffix not in YAML_SUFFIXES

    def read(self, path: Path, source: Source) -> Path:
        """Leaves nearly all settings for the user to fill in, and says what belongs there."""
        network: Any = load_network(path, "cpu", None, label="it")
        width, count = find_widths(network)
        if activation := getattr(getattr(network, "head", network), "activation", None):
            source.set(activation=activation)
        pose = f"an angle of each joint [rad], its pose at action 0: {', '.join(source.joints)}"
        source.set(default_joint_pos=source.home, reason="" if source.home else pose)
        if not source.model.nu or not source.model.actuator_biasprm[:, 1].any():
            for name, unit in (("stiffness", "N m/rad"), ("damping", "N m s/rad")):
                source.set(**{name: None}, reason=f"a gain of each joint, or one number [{unit}]")
        source.set(physics_dt=0.005, decimation=4, reason="50 control steps a second, as most controllers have")
        source.set(action_scale=None, reason="radians per unit of action, one or one a joint")
        if count not in (None, len(source.joints)):
            source.set(joints=None, reason=f"the {count} joints that it moves, in its order")
        example = to_toml([make_term("lin_vel", at=source.find_imu()), *map(make_term, BLIND_TERMS)])
        source.set(observation=None, reason=f"its {width or 'all'} columns in its order, with scale; of {example}")
        return path
