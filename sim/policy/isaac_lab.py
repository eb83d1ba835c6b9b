"""What a run folder of Isaac Lab says of a controller and its robot."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from sim.policy.sources import Found, Model, Setting, history_setting, joints_setting, read_yaml, step_settings, term_of
from sim.robots.robot import RobotCfg

_SPEED = RobotCfg.speed
_ISAAC_TERMS = {"base_lin_vel": "lin_vel", "base_ang_vel": "ang_vel", "projected_gravity": "gravity",
                "generated_commands": "command", "joint_pos_rel": "joint_pos", "joint_vel_rel": "joint_vel",
                "last_action": "last_action", "height_scan": "scan", "gait_phase": "clock"}  # fmt: skip
_ISAAC_GROUP = ("concatenate_terms", "concatenate_dim", "enable_corruption", "history_length", "flatten_history_dim")


def read_isaac_lab(source: Path, model: Model) -> Found:
    """A run folder of Isaac Lab: params/env.yaml, params/agent.yaml, exported/ or checkpoints."""
    file = source / "params" / "env.yaml"
    env = read_yaml(file)
    try:
        order, why = _isaac_order(source, model)
        scene, group = env["scene"], env["observations"]["policy"]
        robot = _isaac_robot(env, file, model)
        controller = _isaac_action(env["actions"], order, file, model, why)
        terms = {name: term for name, term in group.items() if name not in _ISAAC_GROUP and term is not None}
        lengths = [group.get("history_length") or term.get("history_length") or 1 for term in terms.values()]
        rows = [_isaac_term(name, term, scene, order, controller, file, model) for name, term in terms.items()]
    except (KeyError, TypeError, AttributeError) as error:
        raise ValueError(f"{file} is not what Isaac Lab writes for a robot: {type(error).__name__}: {error}") from None
    controller |= history_setting(rows, lengths) | {"observation": Setting(rows)}
    agent = read_yaml(source / "params" / "agent.yaml") if (source / "params" / "agent.yaml").is_file() else {}
    if agent.get("clip_actions") is not None:
        controller["action_clip"] = Setting(agent["clip_actions"])
    exported = [place for name in ("policy.pt", "policy.onnx") if (place := source / "exported" / name).is_file()]
    checkpoints = sorted(source.glob("model_*.pt"), key=lambda place: int(re.sub(r"\D", "", place.stem) or 0))
    if not exported and not checkpoints:
        raise ValueError(f"{source} must have weights, exported/policy.pt or model_*.pt, got none")
    activation = [part["activation"] for name in ("actor", "policy") if "activation" in (part := agent.get(name) or {})]
    if not exported and activation:
        controller["activation"] = Setting(activation[0])
    controller["observation"] = controller.pop("observation")  # last
    weights = (*exported, *checkpoints[::-1])[0]
    return Found(weights=weights, robot=robot, controller=controller)


def _isaac_order(source: Path, model: Model) -> tuple[list[str], str]:
    """The order of the robot's joints, which env.yaml does not say, and why it is a guess."""
    for file in sorted(source.rglob("*IO_descriptors.yaml")):
        return read_yaml(file)["articulations"]["robot"]["joint_names"], ""
    return model.breadth_first(), "breadth first, as Isaac Lab orders joints; IO_descriptors.yaml would say it"


def _isaac_robot(env: dict[str, Any], file: Path, model: Model) -> dict[str, Setting]:
    """Pose, gains, limits, steps and speed."""
    articulation, joints = env["scene"]["robot"], model.joints
    pose = articulation["init_state"]["joint_pos"]
    angles = [_matched(pose, joint, file) or 0.0 for joint in joints]
    robot = {"default_joint_pos": Setting(model.in_order(angles, joints, str(file)))}
    values: dict[str, dict[str, Any]] = {name: {} for name in ("stiffness", "damping", "effort_limit", "armature")}
    notes = []
    for name, group in articulation["actuators"].items():
        kind = str(group.get("class_type", "")).rpartition(":")[2]
        if kind not in ("", "ImplicitActuator", "IdealPDActuator"):
            notes.append(f"{name} is a {kind}, simulated as PD gains with a limit")
        for joint in joints:
            if any(re.fullmatch(pattern, joint) for pattern in _list(group["joint_names_expr"])):
                for key, of_key in values.items():
                    given = group.get(key)
                    given = group.get(f"{key}_sim") if given is None else given
                    of_key[joint] = _matched(given, joint, file)
    for key, of_key in values.items():
        known = [of_key.get(joint) for joint in joints]
        if all(value is not None for value in known):
            robot[key] = Setting(model.in_order(known, joints, key), "; ".join(notes) if key == "stiffness" else "")
        elif key in ("stiffness", "damping"):
            without = [joint for joint, value in zip(joints, known, strict=True) if value is None]
            robot[key] = Setting(
                None, f"a gain of each joint: none is said of {', '.join(without)}; {'; '.join(notes)}"
            )
    robot |= step_settings(env["sim"]["dt"], env["decimation"])
    ranges = [command["ranges"]["lin_vel_x"][1] for command in (env.get("commands") or {}).values()
              if isinstance(command, dict) and "lin_vel_x" in (command.get("ranges") or {})]  # fmt: skip
    if ranges and 0.0 < ranges[0] < _SPEED:
        why = f"the fastest that it was trained for; {_SPEED:g} is usual here"
        robot |= {
            "speed": Setting(ranges[0], why),
            "max_duration_s": Setting(round(15.0 / ranges[0], 1), "in proportion"),
        }
    return robot


def _matched(value: Any, joint: str, file: Path) -> Any:
    """The value of a joint: a number, or that of the one regular expression that matches; None without any."""
    if not isinstance(value, dict):
        return value
    found = [part for pattern, part in value.items() if re.fullmatch(pattern, joint)]
    if len(found) > 1:
        raise ValueError(f"{file}: {joint} must match one of {', '.join(value)}, got {len(found)}")
    return found[0] if found else None


def _list(value: Any) -> list[Any]:
    return value if isinstance(value, list) else [value]


def _chosen(patterns: Any, order: Sequence[str], preserve: bool) -> list[str]:
    """The joints that patterns name, in the robot's order or in that of the patterns."""
    found = [joint for pattern in _list(patterns) for joint in order if re.fullmatch(pattern, joint)]
    return list(dict.fromkeys(found)) if preserve else [joint for joint in order if joint in found]


def _isaac_action(
    actions: dict[str, Any], order: Sequence[str], file: Path, model: Model, why: str
) -> dict[str, Setting]:  # fmt: skip
    actions = {name: term for name, term in actions.items() if term is not None}
    kinds = {name: str(term["class_type"]).rpartition(":")[2] for name, term in actions.items()}
    if list(kinds.values()) != ["JointPositionAction"]:
        raise ValueError(f"{file}: actions must be one JointPositionAction, got {kinds}")
    ((name, term),) = actions.items()
    if term.get("clip") is not None:
        raise ValueError(f"{file}: actions.{name}.clip limits targets, which is not supported: give joints that range")
    joints = _chosen(term["joint_names"], order, bool(term.get("preserve_order")))
    scales = [_matched(term["scale"], joint, file) for joint in joints]
    controller = joints_setting(joints, model, why)
    controller["action_scale"] = Setting(scales[0] if len(set(scales)) == 1 else scales)
    if not term.get("use_default_offset", True):
        controller["action_offset"] = Setting([_matched(term["offset"], joint, file) or 0.0 for joint in joints])
    return controller


def _isaac_term(
    name: str, term: dict[str, Any], scene: dict[str, Any], order: Sequence[str], controller: dict[str, Setting],
    file: Path, model: Model,
) -> dict[str, Any]:  # fmt: skip
    function = re.split(r"[:.]", str(term["func"]))[-1]
    params = term.get("params") or {}
    if function not in _ISAAC_TERMS or term.get("modifiers"):
        what = f"{term['func']}{' with modifiers' if term.get('modifiers') else ''}"
        raise ValueError(
            f"{file} says what is not understood: observation {name}, {what}; only {', '.join(_ISAAC_TERMS)}"
        )
    row = term_of(_ISAAC_TERMS[function], term.get("scale"), clip=term.get("clip"))
    if function in ("joint_pos_rel", "joint_vel_rel"):
        asset = params.get("asset_cfg") or {}
        joints = _chosen(asset.get("joint_names") or ".*", order, bool(asset.get("preserve_order")))
        moved = controller["joints"].value if "joints" in controller else list(model.joints)
        if joints != moved:
            row["joints"] = joints
    if function == "gait_phase":
        row["period_s"] = params["period"]
    if function == "height_scan":
        row |= _isaac_scan(scene[params["sensor_cfg"]["name"]], params, file)
    return row


def _isaac_scan(sensor: dict[str, Any], params: dict[str, Any], file: Path) -> dict[str, Any]:
    """Points of a height scanner, which lie in its yaw frame."""
    pattern, place = sensor["pattern_cfg"], sensor["offset"]["pos"]
    level = sensor.get("ray_alignment", "yaw") == "yaw" and sensor.get("attach_yaw_only", True) in (True, None)
    if "resolution" not in pattern or not level:
        raise ValueError(f"{file}: a height scanner must be a grid in the yaw frame, got {pattern}")
    step = pattern["resolution"]
    x, y = (
        [round(centre - side / 2 + k * step, 4) for k in range(int(side / step + 1e-6) + 1)]
        for side, centre in zip(pattern["size"], place, strict=False)
    )
    order = "x fastest" if pattern.get("ordering", "xy") == "xy" else "y fastest"
    return {"order": order, "offset": params.get("offset", 0.5), "x": x, "y": y}
