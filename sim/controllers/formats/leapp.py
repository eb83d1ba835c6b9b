"""A policy of LEAPP, as Isaac Lab 3 exports it: a YAML that names the inputs and outputs of an ONNX file."""

import hashlib
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from onnx import numpy_helper

from sim.controllers.formats.onnx_data import read_onnx
from sim.controllers.formats.source import Source, collapse, make_term
from sim.files.settings import read_yaml, to_toml

_TERMS = {
    "state/body/rotation": "quat",
    "state/body/position": "base_pos",
    "state/body/linear_velocity": "lin_vel",
    "state/body/angular_velocity": "ang_vel",
    "state/joint/position": "joint_pos",
    "state/joint/velocity": "joint_vel",
    "command/body/velocity": "command",
    "velocity_command": "command",
}
_TARGET = "target/joint/position"
_GAINS = {"kp": "stiffness", "kd": "damping"}


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
    source.set(observation=[_read_term(port, source) for port in ports])
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


def _read_term(port: dict[str, Any], source: Source) -> dict[str, Any]:
    name = str(port.get("isaaclab_connection", port["name"]))
    kind = "gravity" if "projected_gravity" in name else _TERMS.get(port.get("kind", ""))
    elements = (port.get("element_names") or [[]])[-1]
    is_world = name.endswith("_w") and kind in ("lin_vel", "ang_vel")
    if kind is None or is_world or (kind == "command" and len(elements) != 3):
        what = f"{name}, a {port.get('kind')} of {', '.join(elements)}"
        raise ValueError(f"{source.file} says what is not understood: {what}; only {', '.join(_TERMS)}, in base frame")
    if kind in ("joint_pos", "joint_vel"):
        return make_term(kind, joints=elements, offset=0.0 if kind == "joint_pos" else None)
    centre = source.model.body_ipos[1].round(5).tolist() if kind == "lin_vel" and "link" not in name else None
    return make_term(kind, at=centre, order=" ".join(element[-1] for element in elements) if kind == "quat" else None)


def _read_constant(data: bytes, name: str) -> list[float]:
    """An output that is the same whatever goes in."""
    session, rng = onnxruntime.InferenceSession(data), np.random.default_rng(0)
    feeds = [{port.name: rng.normal(size=port.shape).astype("f4") for port in session.get_inputs()} for _ in range(2)]
    first, second = (np.asarray(session.run([name], feed)[0]) for feed in feeds)
    if not np.array_equal(first, second):
        raise ValueError(f"its output {name} must be constant, got values that follow its inputs")
    return first.ravel().astype(float).round(6).tolist()
