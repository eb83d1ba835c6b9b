"""A controller of mjlab: an ONNX file with its metadata."""

from pathlib import Path
from typing import Any

import numpy as np

from sim.controllers.formats.isaac_lab import read_scan
from sim.controllers.formats.onnx_data import read_metadata
from sim.controllers.formats.source import SETTINGS, TERM_NAMES, Source, collapse, make_term
from sim.files.settings import read_yaml

_MJLAB_KEYS = ("default_joint_pos", "joint_stiffness", "joint_damping", "action_scale")
_TERMS = TERM_NAMES | {"height_scan": "scan"}


def read_mjlab(path: Path, source: Source) -> Path:
    """Settings of the metadata, which are rounded to three decimals; returns the file."""
    content: dict[str, Any] = {key: text.split(",") for key, text in read_metadata(path).items() if text}
    names = content.pop("observation_names")
    joints = content.pop("joint_names")
    source.refuse_unknown(names, _TERMS)
    values = {key: [*map(float, content.pop(key))] for key in _MJLAB_KEYS}
    source.move(values, dict(zip(_MJLAB_KEYS, SETTINGS, strict=False)), joints)
    env_file = path.parent / "params" / "env.yaml"
    env = read_yaml(env_file) if env_file.is_file() else None
    if env is None:
        reason = "the metadata do not say it; mjlab's own tasks are like this, and params/env.yaml would say it"
        source.set(physics_dt=0.005, decimation=4, reason=reason)
    else:
        source.set(physics_dt=env["sim"]["mujoco"]["timestep"], decimation=env["decimation"])
    columns = ("scale", "clip", "history_length")
    scales, clips, lengths = (content.pop(f"observation_terms_{name}", [""] * len(names)) for name in columns)
    source.refuse_unknown(content, ("run_path", "command_names", "observation_terms_flatten_history_dim"))
    terms = []
    for name, scale, clip in zip(names, scales, clips, strict=True):
        imu = source.find_imu() if _TERMS[name] == "lin_vel" else None
        factor = collapse([float(value) for value in (scale or "1").split(";")])
        limits = [float(limit) for limit in (clip or "-inf;inf").split(";")]
        limits = np.clip(limits, -1e9, 1e9).tolist() if np.isfinite(limits).any() else None
        points = _read_scan(env, source) if name == "height_scan" else {}
        terms.append(make_term(_TERMS[name], factor, clip=limits, at=imu, **points))
    source.set_history(terms, [max(1, round(float(length or 0))) for length in lengths])
    reason = "the velocity is that of the IMU's site" * any("at" in term for term in terms)
    source.set(observation=terms, reason=reason)
    return path


def _read_scan(env: dict[str, Any] | None, source: Source) -> dict[str, Any]:
    """Fields of the height scan, with the points of its sensor if there is an env.yaml."""
    if env is None:
        gap = "points of its scan {} the base [m]; params/env.yaml would say them, as terrain_scan"
        source.set(scan_x=None, reason=gap.format("ahead of"))
        source.set(scan_y=None, reason=gap.format("left of"))
        return {"order": "x fastest", "offset": 0.0}
    params = env["observations"]["actor"]["terms"]["height_scan"]["params"]
    sensor = {sensor["name"]: sensor for sensor in env["scene"]["sensors"]}[params["sensor_name"]]
    base = source.model.body(1).name
    if sensor["frame"]["name"] != base:
        raise ValueError(f"{source.file}: the scan must be about {base}, got {sensor['frame']}")
    return read_scan(sensor, sensor["pattern"], (0.0, 0.0), source) | {"offset": params.get("offset", 0.0)}
