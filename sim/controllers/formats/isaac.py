"""Trainings in Isaac Lab, and in Isaac Gym by legged_gym, one of its forks, or Booster Gym."""

import re
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np

from sim.controllers.formats.rsl_rl import read_activation
from sim.controllers.formats.source import BLIND_TERMS, Source, collapse, find_checkpoint, make_term, make_terms
from sim.files.settings import read_yaml, to_toml
from sim.robots.compiled import PER_JOINT
from sim.robots.user import per_joint

ISAAC_LAB_TERMS = {"base_lin_vel": "lin_vel", "base_ang_vel": "ang_vel", "projected_gravity": "gravity"}
ISAAC_LAB_TERMS |= {"generated_commands": "command", "joint_pos_rel": "joint_pos", "joint_vel_rel": "joint_vel"}
ISAAC_LAB_TERMS |= {"last_action": "last_action", "height_scan": "scan", "gait_phase": "clock"}
"""Terms of the observation by the names of Isaac Lab's functions."""
_NET_SETTINGS = ("pos_scale", "vel_scale", "torque_scale", "input_order", "input_idx")
_IDEAL_DRIVE = {"saturation_effort": 1e6, "velocity_limit": 1e6}  # stands beside joints with a DC motor
_GAINS = ("stiffness", "damping")
_CONTROL = ("control_type", "use_actuator_network", "actuator_net_file", *_GAINS, "action_scale", "decimation")
_HIM_TERMS = ("command", "ang_vel", "gravity", "joint_pos", "joint_vel", "last_action")
_DEPLOYED = {"default_joint_pos": "default_qpos", "effort_limit": "torque_limit"} | {name: name for name in _GAINS}
_BOOSTER_TERMS = ("gravity", "ang_vel", "command", "clock", "joint_pos", "joint_vel", "last_action")


def read_isaac_lab(path: Path, source: Source) -> Path:
    """Settings of env.yaml and agent.yaml; returns the exported network, else the last checkpoint."""
    source.file = path / "params" / "env.yaml"
    env = read_yaml(source.file)
    agent_file = path / "params" / "agent.yaml"
    agent = read_yaml(agent_file) if agent_file.is_file() else {}
    articulation = env["scene"]["robot"]
    source.find_model_file((articulation.get("spawn") or {}).get("asset_path"))
    pose = per_joint(
        articulation["init_state"]["joint_pos"], source.joints, f"{source.file}: init_state.joint_pos", partly=True
    )
    source.set(default_joint_pos=collapse([angle or 0.0 for angle in pose]))
    _read_actuators(articulation["actuators"], source)
    source.set(physics_dt=env["sim"]["dt"], decimation=env["decimation"])
    for command in (env.get("commands") or {}).values():
        source.set_speed((command.get("ranges") or {}) if isinstance(command, dict) else {})
    joint_order, reason = _order_joints(env, path, source)
    read_action(env["actions"], joint_order, reason, source, limit=agent.get("clip_actions"))
    groups = agent.get("obs_groups") or {}
    rows, lengths = [], []
    for group in map(env["observations"].__getitem__, groups.get("actor") or groups.get("policy") or ["policy"]):
        terms = {name: term for name, term in group.items() if isinstance(term, dict)}
        common = group.get("history_length")
        lengths += [(term.get("history_length") if common is None else common) or 1 for term in terms.values()]
        rows += [read_term(name, term, env["scene"], joint_order, source) for name, term in terms.items()]
    source.set_history(rows, lengths)
    reason = "lin_vel is that of the base's centre of mass" * any("at" in row for row in rows)
    source.set(observation=rows, reason=reason)
    weights = find_checkpoint(path, "exported/policy.pt", "exported/policy.onnx")
    if weights.parent == path and (activation := read_activation(agent)) is not None:
        source.set(activation=activation)
    return weights


def _read_actuators(groups: dict[str, Any], source: Source) -> None:
    notes: list[str] = []
    ideal = [name for name, group in groups.items() if group.get("saturation_effort") is None]
    omitted = [*_IDEAL_DRIVE] if len(ideal) == len(groups) else []
    if nets := [name for name, group in groups.items() if group.get("network_file")]:
        if len(groups) > 1:
            raise ValueError(f"{source.file}: the network of {nets[0]} must drive all joints, got {', '.join(groups)}")
        net = groups[nets[0]]
        settings = {key: net[key] for key in _NET_SETTINGS if net.get(key) not in (None, 1.0, "pos_vel")}
        text = to_toml({"file": Path(net["network_file"]).name, **settings})
        source.set(actuator_net=None, reason=f"{text}, with {net['network_file']} put beside it")
        omitted += ["stiffness", "damping"]
    keys = [key for key in PER_JOINT[1:] if key not in omitted]
    values_by_key: dict[str, dict[str, Any]] = {key: dict.fromkeys(source.joints) for key in keys}
    for name, group in groups.items():
        drive = ("DelayedPDActuator", "PD gains with a limit") if name in ideal else ("DCMotor", "a DC motor")
        kind = str(group.get("class_type", "")).rpartition(":")[2]
        if kind not in ("", "ImplicitActuator", "IdealPDActuator", drive[0]) and name not in nets:
            notes.append(f"{name} is a {kind}, simulated as {drive[1]}")
        if group.get("friction"):
            notes.append(f"the friction of {name} is left out: give their joints a frictionloss")
        group |= _IDEAL_DRIVE if name in ideal else {}
        joints = _match_joints(group["joint_names_expr"], source.joints)
        for key, values in values_by_key.items():
            names = (key, f"actuator_{key}", f"joint_{key}", f"{key}_sim")
            value = next((group[name] for name in names if group.get(name) is not None), None)
            values |= zip(joints, per_joint(value, joints, f"{source.file}: {name}.{key}", partly=True), strict=True)
    for key, values in values_by_key.items():
        without = [joint for joint, value in values.items() if value is None]
        named = ", ".join(f"{joint} {value}" for joint, value in values.items() if value is not None)
        if not without:
            reason = f"1e6 is that of an ideal drive, {', '.join(ideal)}" * bool(ideal and key in _IDEAL_DRIVE)
            source.set(**{key: collapse([*values.values()])}, reason="; ".join(notes) if key == "stiffness" else reason)
        elif named or key in ("stiffness", "damping"):
            gap = f"a value of each joint{': ' * bool(named)}{named}; none is said of {', '.join(without)}"
            source.set(**{key: None}, reason="; ".join([gap, *notes]))
    delays = {name: (group.get("min_delay") or 0, group.get("max_delay") or 0) for name, group in groups.items()}
    if any(longest for _, longest in delays.values()):
        spans = ", ".join(f"{name} ({shortest} to {longest})" for name, (shortest, longest) in delays.items())
        mean = int(np.mean([*delays.values()]) + 0.5)
        source.set(drive_delay_steps=mean, reason=f"the mean of the delays of {spans}")


def _match_joints(patterns: Any, joints: Sequence[str], keep_pattern_order: Any = False) -> list[str]:
    """The joints that patterns name, in the order of the joints or in that of the patterns."""
    patterns = patterns if isinstance(patterns, list) else [patterns]
    named = dict.fromkeys(joint for pattern in patterns for joint in joints if re.fullmatch(pattern, joint))
    return list(named) if keep_pattern_order else [joint for joint in joints if joint in named]


def _order_joints(env: dict[str, Any], path: Path, source: Source) -> tuple[list[str], str]:
    """All joints in the order of the simulation, with the reason if env.yaml does not say it."""
    if descriptors := sorted(path.rglob("*IO_descriptors.yaml")):
        return read_yaml(descriptors[0])["articulations"]["robot"]["joint_names"], ""
    usual = "mjwarp" if "newton" in str(env["sim"].get("physics")).lower() else "physx"
    ordering = env["scene"]["robot"].get("joint_ordering") or usual
    if isinstance(ordering, list):
        return ordering, ""
    if ordering not in ("physx", "mjwarp"):
        raise ValueError(f"{source.file}: joint_ordering must be physx, mjwarp or a list of joints, got {ordering}")
    joints = source.sort_breadth_first() if ordering == "physx" else list(source.joints)
    kind = "breadth first, as PhysX" if ordering == "physx" else "that of the model, as Newton"
    return joints, f"{kind} orders joints; IO_descriptors.yaml would say it"


def read_action(
    actions: dict[str, Any], joint_order: Sequence[str], reason: str, source: Source, *, limit: float | None = None
) -> None:
    """Scale, offset, limits and joints of the action, which ``limit`` clips; ``reason`` explains the joints' order."""
    kinds = {name: str(term["class_type"]).rpartition(":")[2] for name, term in actions.items() if term is not None}
    if list(kinds.values()) != ["JointPositionAction"]:
        raise ValueError(f"{source.file}: actions must be one JointPositionAction, got {kinds}")
    (name,) = kinds
    term = actions[name]
    label = f"{source.file}: actions.{name}"
    joints = _match_joints(term["joint_names"], joint_order, term.get("preserve_order"))
    source.set_joints(joints, reason)
    scale = per_joint(term["scale"], joints, f"{label}.scale")
    source.set(action_scale=collapse(scale))
    pose = dict(zip(source.joints, per_joint(source.settings["default_joint_pos"], source.joints, label), strict=True))
    offset = default = [pose[joint] for joint in joints]
    if not term.get("use_default_offset", True):
        offset = [angle or 0.0 for angle in per_joint(term["offset"], joints, f"{label}.offset", partly=True)]
    if offset != default:
        source.set(action_offset=offset)
    if limit is not None:
        source.set(action_clip=limit)
    if term.get("clip") is not None:
        clips = per_joint(term["clip"], joints, f"{label}.clip", partly=True)
        limits = (np.array([angles or [-np.inf, np.inf] for angles in clips]) - np.c_[offset]) / np.c_[scale]
        limits = np.clip(limits, *(-1e9, 1e9) if limit is None else (-limit, limit)).tolist()
        source.set(action_clip=limits, reason="the range of targets as one of actions, which limits last_action, too")


def read_term(
    name: str, term: dict[str, Any], scene: dict[str, Any], joint_order: Sequence[str], source: Source
) -> dict[str, Any]:
    """A term of the observation; a height scan is one of the scene's sensors."""
    function = re.split(r"[:.]", str(term["func"]))[-1]
    params = term.get("params") or {}
    if function not in ISAAC_LAB_TERMS or term.get("modifiers"):
        what = f"observation {name}, {term['func']}{' with modifiers' * bool(term.get('modifiers'))}"
        raise ValueError(f"{source.file} says what is not understood: {what}; only {', '.join(ISAAC_LAB_TERMS)}")
    centre = source.model.body_ipos[1].round(5).tolist() if function == "base_lin_vel" else None
    row = make_term(ISAAC_LAB_TERMS[function], term.get("scale"), clip=term.get("clip"), at=centre)
    if function in ("joint_pos_rel", "joint_vel_rel"):
        asset = params.get("asset_cfg") or {}
        joints = _match_joints(asset.get("joint_names") or ".*", joint_order, asset.get("preserve_order"))
        if joints != source.settings.get("joints", list(source.joints)):
            row["joints"] = joints
    elif function == "gait_phase":
        row["period_s"] = params["period"]
    elif function == "height_scan":
        sensor = scene[params["sensor_cfg"]["name"]]
        row |= read_scan(sensor, sensor["pattern_cfg"], sensor["offset"]["pos"], source)
        row["offset"] = params.get("offset", 0.5)
    return row


def read_scan(sensor: dict[str, Any], grid: dict[str, Any], centre: Sequence[float], source: Source) -> dict[str, Any]:
    """Order and points [m] of a height scan, whose ``grid`` is about ``centre`` in the base's yaw frame."""
    turns = sensor.get("ray_alignment", "yaw") == "yaw" and sensor.get("attach_yaw_only", True) in (True, None)
    if "resolution" not in grid or not turns:
        raise ValueError(f"{source.file}: a height scanner must be a grid in the yaw frame, got {grid}")
    step, fastest = grid["resolution"], "x" if grid.get("ordering", "xy") == "xy" else "y"
    fields: dict[str, Any] = {"order": f"{fastest} fastest", "offset": 0.0}
    for axis, side, mid in zip("xy", grid["size"], centre, strict=False):
        fields[axis] = [round(mid - side / 2 + k * step, 4) for k in range(int(side / step + 1e-6) + 1)]
    return fields


def read_legged_gym(path: Path, source: Source) -> Path:
    """Settings of a configuration, whose observation's width says the terms; returns the network or checkpoint."""
    cfg = read_yaml(path)
    control, normalization, terrain = cfg["control"], cfg["normalization"], cfg.get("terrain") or {}
    source.find_model_file(cfg["asset"]["file"])
    source.refuse_unknown(control, _CONTROL)
    if control.get("control_type", "P") != "P":
        raise ValueError(f"control_type must be P, joint positions, got {control['control_type']}")
    if control.get("use_actuator_network"):
        source.set(actuator_net={"file": str(source.find_weights(control["actuator_net_file"]).resolve())})
    else:
        stiffness, damping = (source.match_parts(control[name], name) for name in _GAINS)
        source.set(stiffness=stiffness, damping=damping)
    source.set(default_joint_pos=[cfg["init_state"]["default_joint_angles"][joint] for joint in source.joints])
    source.set(physics_dt=cfg["sim"]["dt"], decimation=control["decimation"], action_scale=control["action_scale"])
    source.set(action_clip=normalization["clip_actions"], observation_clip=normalization["clip_observations"])
    source.set_speed((cfg.get("commands") or {}).get("ranges") or {})
    joints = [names[-1] for names in sorted(source.joint_paths())]
    source.set_joints(joints, "a leg after the other, legs by name, as Isaac Gym orders joints")
    width, row = cfg["env"]["num_observations"], cfg["env"].get("num_one_step_observations")
    scales, blind = normalization["obs_scales"], 9 + 3 * len(joints)
    grid = {axis: terrain.get(f"measured_points_{axis}") or [] for axis in "xy"}
    with_velocity = ("lin_vel", *BLIND_TERMS)
    layouts = {0: BLIND_TERMS, 2: (*BLIND_TERMS, "clock")}
    layouts |= {3 + len(grid["x"]) * len(grid["y"]): (*with_velocity, "scan"), 3: with_velocity}
    names = _HIM_TERMS if row == blind else layouts.get(width - blind, ())
    if row == blind:
        source.set(history={"length": width // row, "newest": "first", "by": "row", "fill": "zeros"})
    factors = _read_scales(scales) | {"scan": scales.get("height_measurements")}
    terms = make_terms(names, factors, scan={**grid, "order": "y fastest", "offset": 0.5, "clip": 1.0})
    usual = f"as legged_gym, unitree_rl_gym or HIMLoco order {width} columns"
    gap = f"its {width} columns in its order, with scale; no usual observation is so wide"
    source.set(observation=terms or None, reason=usual if terms else gap)
    weights = find_checkpoint(path.parent, "policy*.pt")
    if weights.name.startswith("model_"):
        source.set(activation=read_activation(cfg) or "elu", reason="elu is usual in legged_gym")
    return weights


def read_booster(path: Path, source: Source) -> Path:
    """Settings of either YAML, whose lists end with the legs, and the observation that the code of both has."""
    cfg = read_yaml(path)
    joints = source.joints
    if "policy" in cfg:
        values = {name: cfg["common"][key][-len(joints) :] for name, key in _DEPLOYED.items()}
        cfg |= cfg["policy"] | cfg["common"]
    else:
        tables = {name: cfg["control"][name] for name in _GAINS}
        tables["default_joint_pos"] = cfg["init_state"]["default_joint_angles"]
        values = {name: source.match_parts(table, name) for name, table in tables.items()}
        cfg |= cfg["env"] | cfg["sim"]
        cfg["gait_frequency"] = sum(cfg["commands"]["gait_frequency"]) / 2.0
        cfg["policy_path"] = f"deploy/models/{path.stem}.pt"
    source.move(values, {name: name for name in values}, joints)
    if "mech" in cfg:
        source.reasons["damping"] = "of the ankles' parallel motors; envs/T1.yaml of the training has the joints'"
    control, scales, count = cfg["control"], cfg["normalization"], cfg["num_actions"]
    if cfg["num_observations"] != 11 + 3 * count:
        raise ValueError(f"num_observations must be {11 + 3 * count}, got {cfg['num_observations']}")
    source.set(physics_dt=cfg["dt"], decimation=control["decimation"], action_scale=control["action_scale"])
    source.set(action_clip=scales["clip_actions"])
    source.set(joints=list(joints[-count:]), reason="the model's last ones, as in its deployment")
    clock = {"period_s": 1.0 / cfg["gait_frequency"], "order": "cos sin"}
    terms = make_terms(_BOOSTER_TERMS, _read_scales(scales) | {"gravity": scales["gravity"]}, clock=clock)
    source.set(observation=terms, reason="the order of its code, whose low pass of commands and targets is left out")
    return source.find_weights(cfg["policy_path"])


def _read_scales(scales: dict[str, Any]) -> dict[str, Any]:
    """Scales of terms by legged_gym's names, in which a command has those of velocities."""
    names = {"lin_vel": "lin_vel", "ang_vel": "ang_vel", "joint_pos": "dof_pos", "joint_vel": "dof_vel"}
    command = [scales["lin_vel"], scales["lin_vel"], scales["ang_vel"]]
    return {"command": command} | {term: scales[name] for term, name in names.items()}
