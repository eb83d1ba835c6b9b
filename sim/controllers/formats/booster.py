"""A controller of Booster Gym: the YAML of its deployment, or of its training."""

from pathlib import Path

from sim.controllers.formats.source import Source, make_terms, read_scales
from sim.files.settings import read_yaml

_GAINS = ("stiffness", "damping")
_DEPLOYED = {"default_joint_pos": "default_qpos", "effort_limit": "torque_limit"} | {name: name for name in _GAINS}
_TERMS = ("gravity", "ang_vel", "command", "clock", "joint_pos", "joint_vel", "last_action")


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
    terms = make_terms(_TERMS, read_scales(scales) | {"gravity": scales["gravity"]}, clock=clock)
    reason = "the order of its code, whose low pass of commands and targets is left out"
    source.set(observation=terms, reason=reason)
    return source.find_weights(cfg["policy_path"])
