"""YAML files of unitree_rl_gym's deploy_mujoco, whose script fixes the observation and its order."""

from pathlib import Path

from sim.controllers.formats.source import BLIND_TERMS, SCALES, Source, find_weights, make_term
from sim.controllers.formats.yaml_file import SUFFIXES, read_yaml

_SETTINGS = {
    "default_angles": "default_joint_pos",
    "kps": "stiffness",
    "kds": "damping",
    "simulation_dt": "physics_dt",
    "control_decimation": "decimation",
    "action_scale": "action_scale",
}
_SCALES = ("ang_vel_scale", "cmd_scale", "dof_pos_scale", "dof_vel_scale")


class UnitreeRlGym:
    """Reads a YAML, and the observation of the script."""

    label = "a deployment of unitree_rl_gym (a YAML with kps, kds, ...)"

    def matches(self, path: Path) -> bool:
        """Whether it is a YAML with gains called kps."""
        return path.suffix in SUFFIXES and path.is_file() and "kps" in read_yaml(path)

    def read(self, path: Path, source: Source) -> Path:
        """Settings of the YAML, and the observation of the script, with a clock if there are two columns for it."""
        content = read_yaml(path)
        count = content.pop("num_actions")
        width = content.pop("num_obs")
        if count != len(source.joints):
            joints = f"{len(source.joints)}, the joints of {source.model_file}"
            raise ValueError(f"{path}: num_actions must be {joints}, got {count}")
        blind = 9 + 3 * count
        if width not in (blind, blind + 2):
            by_hand = "describe it by hand (docs/controllers.md)"
            raise ValueError(f"{path}: num_obs must be {blind}, or {blind + 2} with a clock, got {width}: {by_hand}")
        source.move(content, _SETTINGS, source.joints)
        scales = {
            SCALES[key]: content.pop(key) for key in ("ang_vel_scale", "cmd_scale", "dof_pos_scale", "dof_vel_scale")
        }
        terms = [make_term(name, scales.get(name)) for name in BLIND_TERMS]
        reason = "the order of unitree_rl_gym's deploy_mujoco.py"
        if width > blind:
            terms.append({"term": "clock", "period_s": 0.8})
            reason += ", and the period of its clock"
        source.set(observation=terms, reason=reason)
        weights = find_weights(path.parent, content.pop("policy_path"))
        source.refuse_unknown(content, ("xml_path", "simulation_duration", "cmd_init"))
        return weights
