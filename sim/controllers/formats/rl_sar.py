"""Controllers of rl_sar: a YAML over the base.yaml of its robot, which is beside it or in the folder above."""

from pathlib import Path

from sim.controllers.formats.source import SCALES, TERM_NAMES, Source, find_weights, make_term
from sim.controllers.formats.yaml_file import SUFFIXES, read_yaml

_SETTINGS = {
    "default_dof_pos": "default_joint_pos",
    "rl_kp": "stiffness",
    "rl_kd": "damping",
    "dt": "physics_dt",
    "decimation": "decimation",
    "action_scale": "action_scale",
}
_OPTIONAL_SETTINGS = {"torque_limits": "effort_limit", "clip_obs": "observation_clip"}
_TERMS = TERM_NAMES | {"g1_phase": "clock"}
_PERIODS = {"g1_phase": 0.8}  # of rl_sar's code [s]
_WITHOUT_EFFECT = ("fixed_kp", "fixed_kd", "num_of_dofs", "num_observations", "joint_controller_names", "framework")


def _find_config(path: Path) -> Path:
    return path / "config.yaml" if path.is_dir() else path


class RlSar:
    """Reads a YAML over the base.yaml of its robot."""

    label = "a controller of rl_sar (its YAML, or a folder with config.yaml)"

    def matches(self, path: Path) -> bool:
        """Whether it is a YAML of one name that has observations, or a folder with such a config.yaml."""
        file = _find_config(path)
        if file.suffix not in SUFFIXES or not file.is_file():
            return False
        values = list(read_yaml(file).values())
        return len(values) == 1 and isinstance(values[0], dict) and "observations" in values[0]

    def read(self, path: Path, source: Source) -> Path:
        """Settings of both files, refused by name if they are not understood."""
        source.file = file = _find_config(path)
        bases = [folder / "base.yaml" for folder in (file.parent, file.parent.parent)]
        base = next((candidate for candidate in bases if candidate.is_file()), None)
        if base is None:
            raise ValueError(f"base.yaml of the robot is not there: expected {' or '.join(map(str, bases))}")
        content = next(iter(read_yaml(base).values())) | next(iter(read_yaml(file).values()))
        if content.pop("wheel_indices", None):
            raise ValueError(f"{file}: wheel_indices must be empty, since wheels are not supported")
        names = content.pop("joint_names")
        joints = [names[k] for k in content.pop("joint_mapping")]
        source.set_joints(joints)
        optional = {key: name for key, name in _OPTIONAL_SETTINGS.items() if key in content}
        source.move(content, _SETTINGS | optional, joints)
        if "clip_actions_upper" in content:
            limits = zip(content.pop("clip_actions_lower"), content.pop("clip_actions_upper"), strict=True)
            pairs = [list(pair) for pair in limits]
            high = pairs[0][1]
            source.set(action_clip=high if all(pair == [-high, high] for pair in pairs) else pairs)
        steps = content.pop("observations_history", None) or [0]
        _set_history(source, steps, content.pop("observations_history_priority", "time"))
        terms = content.pop("observations")
        source.refuse_unknown(terms, _TERMS)
        scales = {name: content.pop(key) for key, name in SCALES.items() if key in content}
        rows = [make_term(_TERMS[term], scales.get(_TERMS[term]), period_s=_PERIODS.get(term)) for term in terms]
        source.set(observation=rows)
        weights = find_weights(file.parent, content.pop("model_name"))
        source.refuse_unknown(content, _WITHOUT_EFFECT)
        return weights


def _set_history(source: Source, steps: list[int], priority: str) -> None:
    if steps not in (list(range(len(steps))), list(range(len(steps)))[::-1]):
        raise ValueError(f"{source.file}: observations_history must be all steps from 0 on, got {steps}")
    by = {"time": "row", "term": "term"}.get(priority)
    if by is None:
        raise ValueError(f"{source.file}: observations_history_priority must be time or term, got {priority}")
    if len(steps) > 1:
        history = {"length": len(steps), "newest": "last" if steps[0] else "first", "by": by, "fill": "zeros"}
        source.set(history=history, reason="steps before the start are zeros, as in rl_sar's own loop")
