"""A controller of Booster Gym: the YAML of its deployment, or of its training."""

from pathlib import Path
from typing import Any

from sim.controllers.formats.source import Source, find_weights, make_term
from sim.files.settings import YAML_SUFFIXES, read_yaml

_GAINS = ("stiffness", "damping")
_DEPLOYED = {"default_joint_pos": "default_qpos", "effort_limit": "torque_limit"} | {name: name for name in _GAINS}


class Booster:
    """Reads either YAML; the observation is that of the code of both."""

    label = "a controller of Booster Gym (the YAML of its deployment or training)"

    def matches(self, path: Path) -> bool:
        """Whether it is a YAML with the frequency of a gait."""
        content = read_yaml(path) if path.suffix in YAML_SUFFIXES and path.is_file() else {}
        tables = (content.get("policy"), content.get("commands"))
        return any("gait_frequency" in table for table in tables if isinstance(table, dict))

    def read(self, path: Path, source: Source) -> Path:
        """Settings of the YAML, whose lists end with the legs; returns the exported network."""
        cfg = read_yaml(path)
        joints = source.joints
        if "policy" in cfg:
            values = {name: cfg["common"][key][-len(joints) :] for name, key in _DEPLOYED.items()}
            cfg |= cfg["policy"] | cfg["common"]
        else:
            tables = {name: cfg["control"][name] for name in _GAINS}
            tables["default_joint_pos"] = cfg["init_state"]["default_joint_angles"]
            values = {name: [_match_joint(table, joint) for joint in joints] for name, table in tables.items()}
            cfg |= cfg["env"] | cfg["sim"]
            cfg["gait_frequency"] = sum(cfg["commands"]["gait_frequency"]) / 2.0
            cfg["policy_path"] = f"deploy/models/{path.stem}.pt"
        source.move(values, {name: name for name in values}, joints)
        if "mech" in cfg:
            source.reasons["damping"] = "of the ankles' parallel motors; envs/T1.yaml of the training has the joints'"
        control = cfg["control"]
        scales = cfg["normalization"]
        count = cfg["num_actions"]
        if cfg["num_observations"] != 11 + 3 * count:
            raise ValueError(f"num_observations must be {11 + 3 * count}, got {cfg['num_observations']}")
        source.set(physics_dt=cfg["dt"], decimation=control["decimation"], action_scale=control["action_scale"])
        source.set(action_clip=scales["clip_actions"])
        source.set(joints=list(joints[-count:]), reason="the model's last ones, as in its deployment")
        names = {"gravity": "gravity", "ang_vel": "ang_vel", "joint_pos": "dof_pos", "joint_vel": "dof_vel"}
        gravity, ang_vel, joint_pos, joint_vel = (make_term(name, scales[key]) for name, key in names.items())
        command = make_term("command", [scales["lin_vel"], scales["lin_vel"], scales["ang_vel"]])
        clock = make_term("clock", period_s=1.0 / cfg["gait_frequency"], order="cos sin")
        terms = [gravity, ang_vel, command, clock, joint_pos, joint_vel, make_term("last_action")]
        source.set(
            observation=terms, reason="the order of its code, whose low pass of commands and targets is left out"
        )
        return find_weights(path.parent, cfg["policy_path"])


def _match_joint(table: dict[str, Any], joint: str) -> Any:
    """The value of the last name that is a piece of the joint's; else that of ``default``."""
    values = [value for key, value in table.items() if key in joint]
    return values[-1] if values else table["default"]
