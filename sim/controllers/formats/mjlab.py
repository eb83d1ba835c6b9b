"""A controller of mjlab: an ONNX file with its metadata."""

from pathlib import Path
from typing import Any

import numpy as np

from sim.controllers.formats.network import load_network
from sim.controllers.formats.onnx_data import read_metadata
from sim.controllers.formats.source import SETTINGS, TERM_NAMES, Source, make_term

_MJLAB_KEYS = ("default_joint_pos", "joint_stiffness", "joint_damping", "action_scale")


class Mjlab:
    """Reads the metadata of an ONNX file, which are rounded to three decimals."""

    label = "a controller of mjlab (an ONNX file with its metadata)"

    def matches(self, path: Path) -> bool:
        """Whether it is an ONNX file that names its observations."""
        return path.suffix == ".onnx" and path.is_file() and "observation_names" in read_metadata(path)

    def read(self, path: Path, source: Source) -> Path:
        """Settings of the metadata; the file is also that of the weights."""
        load_network(path, "cpu", None, label="it")  # refuses a damaged file
        content: dict[str, Any] = {key: text.split(",") for key, text in read_metadata(path).items() if text}
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
