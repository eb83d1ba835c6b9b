"""One file of weights as a source: ONNX with the metadata of mjlab's exporter, or what says nothing but its widths."""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from sim.controllers.formats.network import find_widths, load_network
from sim.controllers.formats.source import BLIND_TERMS, SETTINGS, TERM_NAMES, Source, make_term
from sim.files.settings import YAML_SUFFIXES, to_toml

_MJLAB_KEYS = ("default_joint_pos", "joint_stiffness", "joint_damping", "action_scale")


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
