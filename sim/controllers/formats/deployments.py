"""Deployments by YAML: of unitree_rl_gym, of unitree_rl_lab and unitree_rl_mjlab, and of rl_sar."""

from pathlib import Path
from typing import Any

import numpy as np

from sim.controllers.formats.isaac import ISAAC_LAB_TERMS, read_action, read_term
from sim.controllers.formats.source import BLIND_TERMS, TERM_NAMES, Source, collapse, find_checkpoint, make_terms
from sim.files.settings import read_yaml

_UNITREE_KEYS = {"default_angles": "default_joint_pos", "kps": "stiffness", "kds": "damping"}
_UNITREE_KEYS |= {"action_scale": "action_scale", "simulation_dt": "physics_dt", "control_decimation": "decimation"}
_FUNCTIONS = {name: name for name in ISAAC_LAB_TERMS if name != "height_scan"}
_FUNCTIONS["velocity_commands"] = "generated_commands"
_STEPS = 4  # physics steps a control step, in the tasks of both
_RL_SAR_TERMS = TERM_NAMES | {"g1_phase": "clock"}
_SCALED = ("lin_vel", "commands", "ang_vel", "cmd", "dof_pos", "dof_vel")
_RL_SAR_KEYS = {"default_dof_pos": "default_joint_pos", "rl_kp": "stiffness", "rl_kd": "damping"}
_RL_SAR_KEYS |= {"action_scale": "action_scale", "dt": "physics_dt", "decimation": "decimation"}
_RL_SAR_OPTIONAL_KEYS = {"torque_limits": "effort_limit", "clip_obs": "observation_clip"}
_WITHOUT_EFFECT = ("fixed_kp", "fixed_kd", "num_of_dofs", "num_observations", "joint_controller_names", "framework")


def read_unitree_rl_gym(path: Path, source: Source) -> Path:
    """Settings of the YAML, and the observation of the script, with a clock if there are two columns for it."""
    content = read_yaml(path)
    source.find_model_file(content.pop("xml_path", None))
    count, width = content.pop("num_actions"), content.pop("num_obs")
    if count != len(source.joints):
        raise ValueError(f"{path}: num_actions must be the model's {len(source.joints)} joints, got {count}")
    blind = 9 + 3 * count
    if width not in (blind, blind + 2):
        must = f"must be {blind}, or {blind + 2} with a clock"
        raise ValueError(f"{path}: num_obs {must}, got {width}: describe it by hand (docs/controllers.md)")
    source.move(content, _UNITREE_KEYS, source.joints)
    scales = {TERM_NAMES[name]: content.pop(f"{name}_scale") for name in ("ang_vel", "cmd", "dof_pos", "dof_vel")}
    has_clock = width > blind
    reason = "the order of unitree_rl_gym's deploy_mujoco.py" + ", and the period of its clock" * has_clock
    source.set(observation=make_terms([*BLIND_TERMS, *["clock"] * has_clock], scales), reason=reason)
    source.refuse_unknown(content, ("simulation_duration", "cmd_init", "policy_path"))
    return source.find_weights(content["policy_path"])


def read_deploy_yaml(path: Path, source: Source) -> Path:
    """Settings of a deploy.yaml, which numbers joints by the motors of Unitree's SDK; returns the exported network."""
    source.file = file = path / "params" / "deploy.yaml" if path.is_dir() else path
    content = read_yaml(file)
    motors = content.pop("joint_ids_map")
    if len({*motors}) != len(source.joints) or not all(isinstance(motor, int) for motor in motors):
        raise ValueError(f"{file}: joint_ids_map must number the model's {len(source.joints)} joints, got {motors}")
    joints = _find_order(motors, source)
    for name in ("stiffness", "damping"):
        gains = content[name]
        slots = sorted(motors) if len(gains) == len(motors) else range(len(gains))  # motors that are not there
        content[name] = [gains[slots.index(motor)] for motor in motors]
    source.move(content, {name: name for name in ("stiffness", "damping", "default_joint_pos")}, joints)
    reason = f"{file.name} says the control step alone; the tasks of its makers have {_STEPS} physics steps in it"
    source.set(physics_dt=round(content.pop("step_dt") / _STEPS, 6), decimation=_STEPS, reason=reason)
    actions = content.pop("actions")
    for name, action in actions.items():
        moved = _select_joints(action.get("joint_ids"), joints)
        action |= {"class_type": name, "joint_names": moved, "preserve_order": True, "use_default_offset": False}
    reason = "the order in which the motors of a limb follow each other; joints are numbered, not named"
    read_action(actions, joints, reason, source)
    source.set(joints=source.settings.get("joints", joints), reason=reason)
    terms, commands = content.pop("observations"), content.pop("commands")
    by = "row" if terms.pop("use_gym_history", False) else "term"
    source.refuse_unknown([*content, *terms], _FUNCTIONS)
    rows = []
    for name, item in terms.items():
        params = dict(item["params"] or {})
        selected = _select_joints((params.get("asset_cfg") or {}).get("joint_ids"), joints)
        params["asset_cfg"] = {"joint_names": selected, "preserve_order": True}
        item |= {"func": _FUNCTIONS[name], "params": params, "scale": collapse(item.get("scale"))}
        row = read_term(name, item, {}, joints, source)
        if row["term"] == "command":
            row["limit"] = source.read_ranges(commands[params["command_name"]]["ranges"])
        rows.append(row)
    source.set_history(rows, [item.get("history_length") or 1 for item in terms.values()], by=by)
    source.set(observation=rows)
    return find_checkpoint(file.parent.parent, "exported/policy.onnx", f"{file.parent.name}/policy.onnx")


def _find_order(motors: list[int], source: Source) -> list[str]:
    """Names of the joints that have these motors: by mjlab in the model's order, by Isaac Lab breadth first."""
    pairs = [path[-2:] for path in source.joint_paths() if len(path) > 1]
    orders = list(source.joints), source.sort_breadth_first()
    numbers = [dict(zip(order, motors, strict=True)) for order in orders]
    neighbours = [sum(motor[joint] == motor[parent] + 1 for parent, joint in pairs) for motor in numbers]
    return orders[int(np.argmax(neighbours))]


def _select_joints(indices: Any, joints: list[str]) -> list[str]:
    """The joints of a list of indices, or of the numbers of a slice, which has None in it; all of them for None."""
    if indices is None or None in indices:
        return joints[slice(*indices or [None])]
    return [joints[k] for k in indices]


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
    source.move(content, _RL_SAR_KEYS | optional, joints)
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
    source.refuse_unknown(names, _RL_SAR_TERMS)
    scales = {_RL_SAR_TERMS[name]: content.pop(f"{name}_scale") for name in _SCALED if f"{name}_scale" in content}
    source.set(observation=make_terms([_RL_SAR_TERMS[name] for name in names], scales))
    source.refuse_unknown(content, (*_WITHOUT_EFFECT, "model_name"))
    return source.find_weights(content["model_name"])
