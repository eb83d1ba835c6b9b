"""A controller of rl_sar: a YAML over the base.yaml of its robot."""

from pathlib import Path

from sim.controllers.formats.source import SETTINGS, TERM_NAMES, Source, make_terms
from sim.files.settings import read_yaml

_TERMS = TERM_NAMES | {"g1_phase": "clock"}
_SCALED = ("lin_vel", "commands", "ang_vel", "cmd", "dof_pos", "dof_vel")
_RL_SAR_KEYS = ("default_dof_pos", "rl_kp", "rl_kd", "action_scale", "dt", "decimation")
_RL_SAR_OPTIONAL_KEYS = {"torque_limits": "effort_limit", "clip_obs": "observation_clip"}
_WITHOUT_EFFECT = ("fixed_kp", "fixed_kd", "num_of_dofs", "num_observations", "joint_controller_names", "framework")


def read_rl_sar(path: Path, source: Source) -> Path:
    """Settings of a YAML, or of a folder's config.yaml, over base.yaml, which is beside it or two above."""
    source.file = file = path / "config.yaml" if path.is_dir() else path
    bases = [folder / "base.yaml" for folder in file.resolve().parents[:3]]
    if (base := next(filter(Path.is_file, bases), None)) is None:
        raise ValueError(f"base.yaml of the robot is not there: expected {' or '.join(map(str, bases))}")
    content = next(iter(read_yaml(base).values())) | next(iter(read_yaml(file).values()))
    if content.pop("wheel_indices", None):
        raise ValueError(f"{file}: wheel_indices must be empty, since wheels are not supported")
    names = content.pop("joint_names")
    joints = [names[k] for k in content.pop("joint_mapping")]
    optional = {key: name for key, name in _RL_SAR_OPTIONAL_KEYS.items() if key in content}
    source.move(content, dict(zip(_RL_SAR_KEYS, SETTINGS, strict=True)) | optional, joints)
    if "clip_actions_upper" in content:
        limits = map(content.pop, ("clip_actions_lower", "clip_actions_upper"))
        pairs = [list(pair) for pair in zip(*limits, strict=True)]
        high = pairs[0][1]
        source.set(action_clip=high if all(pair == [-high, high] for pair in pairs) else pairs)
    steps = content.pop("observations_history", None) or [0]
    if steps not in (list(range(len(steps))), list(range(len(steps)))[::-1]):
        raise ValueError(f"{file}: observations_history must be all steps from 0 on, got {steps}")
    priority = content.pop("observations_history_priority", "time")
    if (by := {"time": "row", "term": "term"}.get(priority)) is None:
        raise ValueError(f"{file}: observations_history_priority must be time or term, got {priority}")
    if len(steps) > 1:
        history = {"length": len(steps), "newest": "last" if steps[0] else "first", "by": by, "fill": "zeros"}
        source.set(history=history, reason="steps before the start are zeros, as in rl_sar's own loop")
    names = content.pop("observations")
    source.refuse_unknown(names, _TERMS)
    scales = {_TERMS[name]: content.pop(f"{name}_scale") for name in _SCALED if f"{name}_scale" in content}
    source.set(observation=make_terms([_TERMS[name] for name in names], scales))
    weights = source.find_weights(content.pop("model_name"))
    source.refuse_unknown(content, _WITHOUT_EFFECT)
    return weights
