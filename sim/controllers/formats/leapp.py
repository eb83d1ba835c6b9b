"""A policy of LEAPP, as Isaac Lab 3 exports it: a YAML that names the inputs and outputs of an ONNX file."""

import hashlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime
from onnx import numpy_helper
from onnx.reference import ReferenceEvaluator
from onnx.utils import Extractor

from sim.controllers.formats.network import load_network
from sim.controllers.formats.onnx_data import read_onnx
from sim.controllers.formats.source import Source, collapse, find_weights, make_term
from sim.files.settings import YAML_SUFFIXES, read_yaml, to_toml

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


class Leapp:
    """Reads the YAML of one model, whose outputs are targets of joints and their gains."""

    label = "a policy of LEAPP (its YAML)"

    def matches(self, path: Path) -> bool:
        """Whether it is a YAML with models and the pipeline that they form."""
        return path.suffix in YAML_SUFFIXES and path.is_file() and {"models", "pipeline"} <= read_yaml(path).keys()

    def read(self, path: Path, source: Source) -> Path:
        """Settings of the YAML, and the gains that the network returns; it is also the file of the weights."""
        content = read_yaml(path)
        source.refuse_unknown(content, ("models", "pipeline", "system information", "semantic"))
        if len(content["models"]) != 1:
            raise ValueError(f"{path}: models must be one, got {', '.join(content['models'])}: export them as one node")
        (model,) = content["models"].values()
        pipeline, parameters = content["pipeline"], model["parameters"]
        weights = find_weights(path.parent, parameters["model_path"])
        if hashlib.sha256(weights.read_bytes()).hexdigest() != parameters["sha256sum"]:
            raise ValueError(f"{weights} must have sha256sum {parameters['sha256sum']}: give the file of this YAML")
        load_network(weights, "cpu", None, label="it")  # refuses a damaged file
        flow = pipeline.get("feedback_flow") or pipeline.get("feedback_connections") or {}
        pairs = [f"{output} > {port}" for output, ports in flow.items() for port in ports if output != f"{port}_out"]
        source.refuse_unknown(pairs, ())
        if (initial := pipeline.get("initial_values")) is not None:
            values = find_weights(path.parent, initial).read_bytes()
            if any(values[8 + int.from_bytes(values[:8], "little") :]):  # safetensors: length, header, numbers
                raise ValueError(f"{path}: initial_values must be zeros, got others in {initial}")
        graph, data = read_onnx(weights)
        inputs = {port["name"]: port for port in model["inputs"]}
        ports = [inputs[port.name] for port in graph.graph.input if not inputs[port.name].get("is_state")]
        terms = [_read_term(port, source) for port in ports]
        reason = "lin_vel is that of the base's centre of mass" * any("at" in term for term in terms)
        source.set(observation=terms, reason=reason)
        outputs = {port.get("kind"): port for port in model["outputs"] if not port.get("is_state")}
        source.refuse_unknown(map(str, outputs), (_TARGET, *_GAINS))
        joints = outputs[_TARGET]["element_names"][-1]
        source.set_joints(joints)
        source.set(action_scale=1.0, action_offset=[0.0] * len(joints))
        for kind, setting in _GAINS.items():
            gains = dict(zip(joints, _read_gains(data, outputs[kind]["name"]), strict=True)) if kind in outputs else {}
            values = _read_model_gains(source, kind) | gains
            without = [joint for joint in source.joints if joint not in values]
            gap = f"a value of each joint: {to_toml(values)}; none is said of {', '.join(without)}" * bool(without)
            source.set(**{setting: None if gap else collapse([*map(values.get, source.joints)])}, reason=gap)
        pose = dict(zip(source.joints, source.robot_file.home or [0.0] * len(source.joints), strict=True))
        for port in ports:
            pose |= _find_pose(graph, port) if port["kind"] == "state/joint/position" else {}
        reason = "what the network subtracts from joint angles; others as the model's home, or 0"
        source.set(default_joint_pos=[pose[joint] for joint in source.joints], reason=reason)
        scene = content.get("semantic", {}).get("scene", {})
        rate = (pipeline.get("configs") or {}).get("frequency")
        if "physics_dt" in scene:
            source.set(physics_dt=scene["physics_dt"], decimation=scene["decimation"])
        else:
            reason = (
                f"{rate:g} control steps a second" if rate else "50 control steps a second, as most controllers have"
            )
            source.set(physics_dt=round(0.25 / (rate or 50.0), 6), decimation=4, reason=reason)
        return weights


def _read_term(port: dict[str, Any], source: Source) -> dict[str, Any]:
    name = str(port.get("isaaclab_connection", port["name"]))
    kind = "gravity" if "projected_gravity" in name else _TERMS.get(port.get("kind", ""))
    elements = (port.get("element_names") or [[]])[-1]
    is_world = name.endswith("_w") and kind in ("lin_vel", "ang_vel")
    if kind is None or is_world or (kind == "command" and len(elements) != 3):
        what = f"{name}, a {port.get('kind')} of {', '.join(elements)}"
        raise ValueError(
            f"{source.file} says what is not understood: {what}; only {', '.join(_TERMS)} in the base's frame"
        )
    if kind in ("joint_pos", "joint_vel"):
        return make_term(kind, joints=elements, offset=0.0 if kind == "joint_pos" else None)
    centre = source.model.body_ipos[1].round(5).tolist() if kind == "lin_vel" and "link" not in name else None
    return make_term(kind, at=centre, order=" ".join(element[-1] for element in elements) if kind == "quat" else None)


def _read_gains(data: bytes, name: str) -> list[float]:
    """An output that is the same whatever goes in."""
    session, rng = onnxruntime.InferenceSession(data), np.random.default_rng(0)
    ports = session.get_inputs()
    feeds = [{port.name: rng.normal(size=port.shape).astype("f4") for port in ports} for _ in range(2)]
    first, second = (np.asarray(session.run([name], feed)[0]) for feed in feeds)
    if not np.array_equal(first, second):
        raise ValueError(
            f"its output {name} must be constant, got gains that follow the inputs, which are not simulated"
        )
    return first.ravel().astype(float).round(6).tolist()


def _read_model_gains(source: Source, kind: str) -> dict[str, float]:
    """Gains of the model's position actuators, by joint."""
    model, column = source.model, ["kp", "kd"].index(kind) + 1
    biased = [k for k in range(model.nu) if model.actuator_biasprm[k, 1] != 0.0]
    return {model.joint(model.actuator_trnid[k, 0]).name: -float(model.actuator_biasprm[k, column]) for k in biased}


def _find_pose(graph: Any, port: dict[str, Any]) -> dict[str, float]:
    """What a graph subtracts from joint angles that it picks from an input [rad], by joint."""
    constants = {tensor.name: numpy_helper.to_array(tensor) for tensor in graph.graph.initializer}
    joints = port["element_names"][-1]
    for node in graph.graph.node:
        if node.op_type == "Sub" and node.input[1] in constants:
            with suppress(Exception):  # it does not follow from these angles alone
                picked = Extractor(graph).extract_model([port["name"]], [node.input[0]])
                numbers: Any = ReferenceEvaluator(picked).run(
                    None, {port["name"]: np.arange(len(joints), dtype="f4")[None]}
                )
                indices = np.ravel(numbers[0]).astype(int)
                pose = constants[node.input[1]].ravel().astype(float).round(6).tolist()
                return dict(zip([joints[k] for k in indices], pose, strict=True))
    return {}
