"""Controllers of mjlab and holosoma: ONNX files with their metadata."""

import functools
import json
import math
from pathlib import Path
from typing import Any

import numpy as np

from sim.controllers.formats.isaac_lab import read_scan
from sim.controllers.formats.network import find_widths, load_network
from sim.controllers.formats.onnx_data import read_metadata
from sim.controllers.formats.source import TERM_NAMES, Source, collapse, make_term
from sim.files.settings import read_yaml
from sim.robots.user import per_joint

_MJLAB_KEYS = {"joint_stiffness": "stiffness", "joint_damping": "damping"}
_MJLAB_KEYS |= {name: name for name in ("default_joint_pos", "action_scale")}
_MJLAB_TERMS = TERM_NAMES | {"height_scan": "scan"}
_ORDERS = {"command_ang_vel": "yaw_rate", "command_lin_vel": "v_x v_y", "sin_phase": "sin", "cos_phase": "cos"}
_HOLOSOMA_TERMS = TERM_NAMES | {name: "clock" if "phase" in name else "command" for name in _ORDERS}
_G1_POSE = {".*_hip_pitch_joint": -0.312, ".*_knee_joint": 0.669, ".*_ankle_pitch_joint": -0.363, ".*_elbow_joint": 0.6}
_G1_POSE |= {".*_shoulder_pitch_joint": 0.2, "left_shoulder_roll_joint": 0.2, "right_shoulder_roll_joint": -0.2}
_T1_POSE = {".*_Hip_Pitch": -0.2, ".*_Knee_Pitch": 0.4, ".*_Ankle_Pitch": -0.25, ".*_Shoulder_Pitch": 0.2}
_T1_POSE |= {"Left_Shoulder_Roll": -1.35, "Right_Shoulder_Roll": 1.35, "Left_Elbow_Yaw": -0.5, "Right_Elbow_Yaw": 0.5}
_ROBOTS = {
    "left_hip_pitch_joint": (_G1_POSE, {"base_ang_vel": {"scale": 0.25}, "dof_vel": {"scale": 0.05}}),
    "AAHead_yaw": (_T1_POSE, {"base_ang_vel": {}, "dof_vel": {"scale": 0.1}}),
}
"""Default pose [rad] and terms with scales of holosoma_inference's G1 and T1, by a joint that only that robot has."""
_GAIN_BY_ARMATURE = (20.0 * math.pi) ** 2  # of G1, whose joints swing at 10 Hz


def read_mjlab(path: Path, source: Source) -> Path:
    """Settings of the metadata, which are rounded to three decimals; returns the file."""
    content: dict[str, Any] = {key: text.split(",") for key, text in read_metadata(path).items() if text}
    names = content.pop("observation_names")
    joints = content.pop("joint_names")
    source.refuse_unknown(names, _MJLAB_TERMS)
    values = {key: [*map(float, content.pop(key))] for key in _MJLAB_KEYS}
    source.move(values, _MJLAB_KEYS, joints)
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
        imu = source.find_imu() if _MJLAB_TERMS[name] == "lin_vel" else None
        factor = collapse([float(value) for value in (scale or "1").split(";")])
        limits = [float(limit) for limit in (clip or "-inf;inf").split(";")]
        limits = np.clip(limits, -1e9, 1e9).tolist() if np.isfinite(limits).any() else None
        points = _read_scan(env, source) if name == "height_scan" else {}
        terms.append(make_term(_MJLAB_TERMS[name], factor, clip=limits, at=imu, **points))
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


def read_holosoma(path: Path, source: Source) -> Path:
    """Settings of the metadata, with the experiment_config of the training if they have it; returns the file."""
    width = find_widths(load_network(path, "cpu", None, label="it"))[0]
    content = {key: json.loads(text) for key, text in read_metadata(path).items()}
    joints = content["dof_names"]
    cfg = content.get("experiment_config")
    source.find_model_file(content.get("robot_urdf_path"))
    pose, terms = next((robot for joint, robot in _ROBOTS.items() if joint in joints), ({}, {}))
    if cfg is None:
        if not pose or width != 3 * len(joints) + 13:
            raise ValueError(f"without experiment_config it must be the locomotion of G1 or T1, got {width} columns")
        terms = terms | {name: {} for name in ("actions", "dof_pos", "projected_gravity", *_ORDERS)}

    def look_up(name: str, usual: Any) -> Any:
        """A value of the experiment_config, whose name has dots; the usual one if there is none."""
        return usual if cfg is None else functools.reduce(dict.__getitem__, name.split("."), cfg)

    reason = "of holosoma_inference's own configuration, since the file has no experiment_config" * (cfg is None)
    control = look_up("robot.control", {"action_scale": 0.25, "action_clip_value": 100.0})
    if control.get("action_scales_by_effort_limit_over_p_gain"):
        raise ValueError(f"{source.file}: action_scales_by_effort_limit_over_p_gain is not supported")
    angles = per_joint(look_up("robot.init_state.default_joint_angles", pose), joints, "joint", partly=True)
    values = {"default_joint_pos": [angle or 0.0 for angle in angles]}
    values |= {"stiffness": content["kp"], "damping": content["kd"]}
    if not source.model.dof_armature[6:].any():
        usual = [round(gain / _GAIN_BY_ARMATURE, 9) for gain in content["kp"]] if pose is _G1_POSE else 0.03
        values["armature"] = look_up("robot.dof_armature_list", usual)
    source.move(values, {name: name for name in values}, joints)
    source.reasons |= dict.fromkeys(("default_joint_pos", "armature"), reason)
    sim = look_up("simulator.config.sim", {"fps": 200, "control_decimation": 4})
    source.set(physics_dt=1.0 / sim["fps"], decimation=sim["control_decimation"], reason=reason)
    source.set(action_scale=control["action_scale"], action_clip=control["action_clip_value"], reason=reason)
    period = look_up("command.setup_terms.locomotion_gait.params.gait_period", 1.0)
    more = {"clock": {"period_s": period, "offset": [0.0, 0.5]}}  # of the left and the right foot
    more["command"] = {"limit": source.read_ranges(content["command_ranges"])}
    group = look_up("observation.groups.actor_obs", {"terms": terms})
    source.refuse_unknown(group["terms"], _HOLOSOMA_TERMS)
    rows = []
    for name, item in sorted(group["terms"].items()):  # as holosoma orders them
        if item.get("clip") is not None:
            raise ValueError(f"{source.file}: the clip of {name} is not supported")
        term = _HOLOSOMA_TERMS[name]
        rows.append(make_term(term, item.get("scale"), order=_ORDERS.get(name), **more.get(term, {})))
    source.set_history(rows, [group.get("history_length", 1)] * len(rows), fill="zeros")
    source.set(observation=rows, reason=reason)
    return path
