"""Controllers that were trained in Isaac Gym: by legged_gym or one of its forks, and by Booster Gym."""

from pathlib import Path

from sim.controllers.formats.rsl_rl import read_activation
from sim.controllers.formats.source import BLIND_TERMS, Source, find_checkpoint, make_terms, read_scales
from sim.files.settings import read_yaml

_CONTROL = ("control_type", "use_actuator_network", "actuator_net_file", "stiffness", "damping")
_HIM_TERMS = ("command", "ang_vel", "gravity", "joint_pos", "joint_vel", "last_action")
_GAINS = ("stiffness", "damping")
_DEPLOYED = {"default_joint_pos": "default_qpos", "effort_limit": "torque_limit"} | {name: name for name in _GAINS}
_BOOSTER_TERMS = ("gravity", "ang_vel", "command", "clock", "joint_pos", "joint_vel", "last_action")


def read_legged_gym(path: Path, source: Source) -> Path:
    """Settings of a configuration, whose observation's width says the terms; returns the network or checkpoint."""
    cfg = read_yaml(path)
    control, normalization, terrain = cfg["control"], cfg["normalization"], cfg.get("terrain") or {}
    source.find_model_file(cfg["asset"]["file"])
    source.refuse_unknown(control, (*_CONTROL, "action_scale", "decimation"))
    if control.get("control_type", "P") != "P":
        raise ValueError(f"control_type must be P, joint positions, got {control['control_type']}")
    if control.get("use_actuator_network"):
        source.set(actuator_net={"file": str(source.find_weights(control["actuator_net_file"]).resolve())})
    else:
        stiffness, damping = (source.match_parts(control[name], name) for name in ("stiffness", "damping"))
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
    factors = read_scales(scales) | {"scan": scales.get("height_measurements")}
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
    terms = make_terms(_BOOSTER_TERMS, read_scales(scales) | {"gravity": scales["gravity"]}, clock=clock)
    reason = "the order of its code, whose low pass of commands and targets is left out"
    source.set(observation=terms, reason=reason)
    return source.find_weights(cfg["policy_path"])
