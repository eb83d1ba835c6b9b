"""A controller of holosoma: an ONNX file with its metadata, in JSON."""

import json
import math
from pathlib import Path
from typing import Any

from sim.controllers.formats.network import find_widths, load_network
from sim.controllers.formats.onnx_data import read_metadata
from sim.controllers.formats.source import TERM_NAMES, Source, make_term
from sim.robots.user import per_joint

_ORDERS = {"command_ang_vel": "yaw_rate", "command_lin_vel": "v_x v_y", "sin_phase": "sin", "cos_phase": "cos"}
_TERMS = TERM_NAMES | {name: "clock" if "phase" in name else "command" for name in _ORDERS}
_LOCOMOTION = ("actions", "base_ang_vel", "dof_pos", "dof_vel", "projected_gravity", *_ORDERS)
_G1_POSE = {".*_hip_pitch_joint": -0.312, ".*_knee_joint": 0.669, ".*_ankle_pitch_joint": -0.363, ".*_elbow_joint": 0.6}
_G1_POSE |= {".*_shoulder_pitch_joint": 0.2, "left_shoulder_roll_joint": 0.2, "right_shoulder_roll_joint": -0.2}
_T1_POSE = {".*_Hip_Pitch": -0.2, ".*_Knee_Pitch": 0.4, ".*_Ankle_Pitch": -0.25, ".*_Shoulder_Pitch": 0.2}
_T1_POSE |= {"Left_Shoulder_Roll": -1.35, "Right_Shoulder_Roll": 1.35, "Left_Elbow_Yaw": -0.5, "Right_Elbow_Yaw": 0.5}
_ROBOTS: dict[str, tuple[dict[str, float], dict[str, float], float | None]] = {
    "left_hip_pitch_joint": (_G1_POSE, {"base_ang_vel": 0.25, "dof_vel": 0.05}, None),
    "AAHead_yaw": (_T1_POSE, {"dof_vel": 0.1}, 0.03),
}
"""Default pose [rad], scales of terms and armature [kg m^2] of holosoma's G1 and T1, by a joint that only it has."""
_GAIN_BY_ARMATURE = (20.0 * math.pi) ** 2  # of G1, whose joints swing at 10 Hz


class Holosoma:
    """Reads the metadata of an ONNX file, with the experiment_config of the training if they have it."""

    label = "a controller of holosoma (an ONNX file with its metadata)"

    def matches(self, path: Path) -> bool:
        """Whether it is an ONNX file that names its joints and gains as holosoma does."""
        return path.suffix == ".onnx" and path.is_file() and {"dof_names", "kp", "kd"} <= {*read_metadata(path)}

    def read(self, path: Path, source: Source) -> Path:
        """Settings of the metadata; the file is also that of the weights."""
        width = find_widths(load_network(path, "cpu", None, label="it"))[0]
        content = {key: json.loads(text) for key, text in read_metadata(path).items()}
        joints = content["dof_names"]
        source.find_model_file(content.get("robot_urdf_path"))
        cfg, reason = content.get("experiment_config"), ""
        if cfg is None:
            expected = 3 * len(joints) + 13
            if width != expected:
                raise ValueError(f"it must see {expected} columns, since it has no experiment_config, got {width}")
            cfg = _make_usual_config(joints, content["kp"])
            reason = "of holosoma_inference's own configuration, since the file has no experiment_config"
        control = cfg["robot"]["control"]
        if control.get("action_scales_by_effort_limit_over_p_gain"):
            raise ValueError(f"{source.file}: action_scales_by_effort_limit_over_p_gain is not supported")
        angles = cfg["robot"]["init_state"]["default_joint_angles"]
        pose = [angle or 0.0 for angle in per_joint(angles, joints, "default_joint_angles", partly=True)]
        values = {"default_joint_pos": pose, "stiffness": content["kp"], "damping": content["kd"]}
        armature = cfg["robot"].get("dof_armature_list")
        values |= {"armature": armature} if armature and not source.model.dof_armature[6:].any() else {}
        source.move(values, {name: name for name in values}, joints)
        source.set(default_joint_pos=source.settings["default_joint_pos"], reason=reason)
        sim = cfg["simulator"]["config"]["sim"]
        source.set(physics_dt=1.0 / sim["fps"], decimation=sim["control_decimation"], reason=reason)
        source.set_joints(joints)
        source.set(action_scale=control["action_scale"], action_clip=control["action_clip_value"], reason=reason)
        limits = source.read_ranges(content["command_ranges"])
        period = cfg["command"]["setup_terms"]["locomotion_gait"]["params"]["gait_period"]
        group = cfg["observation"]["groups"]["actor_obs"]
        source.refuse_unknown(group["terms"], _TERMS)
        rows = []
        more = {"clock": {"period_s": period, "offset": [0.0, 0.5]}, "command": {"limit": limits}}  # left, right foot
        for name, item in sorted(group["terms"].items()):  # as holosoma orders them
            if item.get("clip") is not None:
                raise ValueError(f"{source.file}: the clip of {name} is not supported")
            term = _TERMS[name]
            rows.append(make_term(term, item.get("scale"), order=_ORDERS.get(name), **more.get(term, {})))
        source.set_history(rows, [group.get("history_length", 1)] * len(rows), fill="zeros")
        source.set(observation=rows, reason=reason)
        return path


def _make_usual_config(joints: list[str], gains: list[float]) -> dict[str, Any]:
    """The experiment_config that a file has not, of the robot with these joints."""
    robot = next((robot for joint, robot in _ROBOTS.items() if joint in joints), None)
    if robot is None:
        raise ValueError(f"it has no experiment_config, and is of neither G1 nor T1, got {', '.join(joints)}")
    pose, scales, armature = robot
    terms = {name: {"scale": scales.get(name)} for name in _LOCOMOTION}
    return {
        "robot": {
            "init_state": {"default_joint_angles": pose},
            "control": {"action_scale": 0.25, "action_clip_value": 100.0},
            "dof_armature_list": [armature or gain / _GAIN_BY_ARMATURE for gain in gains],
        },
        "simulator": {"config": {"sim": {"fps": 200, "control_decimation": 4}}},
        "command": {"setup_terms": {"locomotion_gait": {"params": {"gait_period": 1.0}}}},
        "observation": {"groups": {"actor_obs": {"terms": terms}}},
    }
