"""A deployment of unitree_rl_gym: the YAML of its deploy_mujoco.py."""

from pathlib import Path

from sim.controllers.formats.source import BLIND_TERMS, SETTINGS, TERM_NAMES, Source, make_terms
from sim.files.settings import read_yaml

_UNITREE_KEYS = ("default_angles", "kps", "kds", "action_scale", "simulation_dt", "control_decimation")


def read_unitree_rl_gym(path: Path, source: Source) -> Path:
    """Settings of the YAML, and the observation of the script, with a clock if there are two columns for it."""
    content = read_yaml(path)
    source.find_model_file(content.pop("xml_path", None))
    count = content.pop("num_actions")
    width = content.pop("num_obs")
    if count != len(source.joints):
        joints = f"{len(source.joints)}, the joints of {source.model_file}"
        raise ValueError(f"{path}: num_actions must be {joints}, got {count}")
    blind = 9 + 3 * count
    if width not in (blind, blind + 2):
        by_hand = "describe it by hand (docs/controllers.md)"
        raise ValueError(f"{path}: num_obs must be {blind}, or {blind + 2} with a clock, got {width}: {by_hand}")
    source.move(content, dict(zip(_UNITREE_KEYS, SETTINGS, strict=True)), source.joints)
    scales = {TERM_NAMES[name]: content.pop(f"{name}_scale") for name in ("ang_vel", "cmd", "dof_pos", "dof_vel")}
    has_clock = width > blind
    reason = "the order of unitree_rl_gym's deploy_mujoco.py" + ", and the period of its clock" * has_clock
    source.set(observation=make_terms([*BLIND_TERMS, *["clock"] * has_clock], scales), reason=reason)
    weights = source.find_weights(content.pop("policy_path"))
    source.refuse_unknown(content, ("simulation_duration", "cmd_init"))
    return weights
