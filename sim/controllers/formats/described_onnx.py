"""ONNX files that are described: by metadata of mjlab and holosoma, or by the YAML of LEAPP."""

import functools
import hashlib
import json
import math
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from onnx import numpy_helper

from sim.controllers.formats.isaac import read_scan
from sim.controllers.formats.network import find_widths, load_network
from sim.controllers.formats.onnx_data import read_metadata, read_onnx
from sim.controllers.formats.source import TERM_NAMES, Source, collapse, make_term
from sim.files.settings import read_yaml, to_toml
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
}  # default pose [rad] and terms with scales of holosoma_inference's G1 and T1, by a joint that only that robot has
_GAIN_BY_ARMATURE = (20.0 * math.pi) ** 2  # of G1, whose joints swing at 10 Hz
_PORTS = {"state/body/rotation": "quat", "state/body/position": "base_pos", "state/joint/position": "joint_pos"}
_PORTS |= {"state/body/linear_velocity": "lin_vel", "state/body/angular_velocity": "ang_vel"}
_PORTS |= {"state/joint/velocity": "joint_vel", "command/body/velocity": "command", "velocity_command": "command"}
_TARGET = "target/joint/position"
_GAINS = {"kp": "stiffness", "kd": "damping"}


def read_mjlab(path: Path, source: Source) -> Path:
    """Settings of the metadata, which are rounded to three decimals; returns the file."""
    content: dict[str, Any] = {key: text.split(",") for key, text in read_metadata(path).items() if text}
    names = content.pop("observation_names")
    joints = content.pop("joint_names")
    source.refuse_unknown(names, _MJLAB_TERMS)
    source.move({key: [*map(float, content.pop(key))] for key in _MJLAB_KEYS}, _MJLAB_KEYS, joints)
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


def read_leapp(path: Path, source: Source) -> Path:
    """Settings of the YAML of one model, and what the network returns, targets of joints and gains, or holds."""
    content = read_yaml(path)
    source.refuse_unknown(content, ("models", "pipeline", "system information", "semantic"))
    if len(content["models"]) != 1:
        raise ValueError(f"{path}: models must be one, got {', '.join(content['models'])}: export them as one node")
    (model,) = content["models"].values()
    pipeline, parameters = content["pipeline"], model["parameters"]
    weights = source.find_weights(parameters["model_path"])
    if hashlib.sha256(weights.read_bytes()).hexdigest() != parameters["sha256sum"]:
        raise ValueError(f"{weights} must have sha256sum {parameters['sha256sum']}: give the file of this YAML")
    if "initial_values" in pipeline:
        values = source.find_weights(pipeline["initial_values"]).read_bytes()
        numbers = values[8 + int.from_bytes(values[:8], "little") :]  # safetensors: length, header, numbers
        if any(numbers) or not numbers:
            raise ValueError(f"{path}: initial_values must be zeros, got others in {pipeline['initial_values']}")
    graph, data = read_onnx(weights)
    inputs = {port["name"]: port for port in model["inputs"]}
    ports = [inputs[port.name] for port in graph.graph.input if not inputs[port.name].get("is_state")]
    source.set(observation=[_read_port(port, source) for port in ports])
    outputs = {port.get("kind"): port for port in model["outputs"] if not port.get("is_state")}
    source.refuse_unknown(map(str, outputs), (_TARGET, *_GAINS))
    joints = outputs[_TARGET]["element_names"][-1]
    source.set_joints(joints)
    source.set(action_scale=1.0, action_offset=[0.0] * len(joints))
    for column, (kind, name) in enumerate(_GAINS.items(), start=1):
        drives = zip(source.model.actuator_trnid[:, 0], source.model.actuator_biasprm, strict=True)
        values = {source.model.joint(joint).name: -float(bias[column]) for joint, bias in drives if bias[1]}
        if kind in outputs:
            values |= zip(joints, _read_constant(data, outputs[kind]["name"]), strict=True)
        without = [joint for joint in source.joints if joint not in values]
        gap = f"a value of each joint: {to_toml(values)}; none is said of {', '.join(without)}" * bool(without)
        source.set(**{name: None if gap else collapse([*map(values.get, source.joints)])}, reason=gap)
    constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.graph.initializer}
    added = [constants.get(name) for node in graph.graph.node if node.op_type == "Add" for name in node.input]
    offsets = [value for value in added if value is not None and value.size == len(joints)]
    pose = dict(zip(source.joints, source.robot_file.home or [0.0] * len(source.joints), strict=True))
    pose |= dict(zip(joints, offsets[-1].ravel().astype(float).round(6).tolist(), strict=True)) if offsets else {}
    reason = "what the network adds to its actions, else the model's home, or 0"
    source.set(default_joint_pos=collapse([*map(pose.get, source.joints)]), reason=reason)
    scene = content.get("semantic", {}).get("scene", {})
    rate = (pipeline.get("configs") or {}).get("frequency", 50.0)
    reason = f"{rate:g} control steps a second" * ("physics_dt" not in scene)
    steps = {"physics_dt": round(0.25 / rate, 6), "decimation": 4}
    source.set(**{key: scene.get(key, value) for key, value in steps.items()}, reason=reason)
    return weights


def _read_port(port: dict[str, Any], source: Source) -> dict[str, Any]:
    name = str(port.get("isaaclab_connection", port["name"]))
    kind = "gravity" if "projected_gravity" in name else _PORTS.get(port.get("kind", ""))
    elements = (port.get("element_names") or [[]])[-1]
    is_world = name.endswith("_w") and kind in ("lin_vel", "ang_vel")
    if kind is None or is_world or (kind == "command" and len(elements) != 3):
        what = f"{name}, a {port.get('kind')} of {', '.join(elements)}"
        raise ValueError(f"{source.file} says what is not understood: {what}; only {', '.join(_PORTS)}, in base frame")
    if kind in ("joint_pos", "joint_vel"):
        return make_term(kind, joints=elements, offset=0.0 if kind == "joint_pos" else None)
    centre = source.model.body_ipos[1].round(5).tolist() if kind == "lin_vel" and "link" not in name else None
    return make_term(kind, at=centre, order=" ".join(element[-1] for element in elements) if kind == "quat" else None)


def _read_constant(data: bytes, name: str) -> list[float]:
    session, rng = onnxruntime.InferenceSession(data), np.random.default_rng(0)
    feeds = [{port.name: rng.normal(size=port.shape).astype("f4") for port in session.get_inputs()} for _ in range(2)]
    first, second = (np.asarray(session.run([name], feed)[0]) for feed in feeds)
    if not np.array_equal(first, second):
        raise ValueError(f"its output {name} must be constant, got values that follow its inputs")
    return first.ravel().astype(float).round(6).tolist()
