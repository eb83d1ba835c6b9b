"""A deployment of unitree_rl_lab or unitree_rl_mjlab: the deploy.yaml that they export."""

from pathlib import Path
from typing import Any

from sim.controllers.formats.isaac_lab import ISAAC_LAB_TERMS, read_action, read_term
from sim.controllers.formats.source import Source, collapse, find_checkpoint
from sim.files.settings import read_yaml

_FUNCTIONS = {name: name for name in ISAAC_LAB_TERMS if name != "height_scan"}
_FUNCTIONS["velocity_commands"] = "generated_commands"
_STEPS = 4  # physics steps a control step, in the tasks of both


def read_deploy_yaml(path: Path, source: Source) -> Path:
    """Settings of a deploy.yaml, which numbers joints by the motors of Unitree's SDK; returns the exported network."""
    source.file = file = path / "params" / "deploy.yaml" if path.is_dir() else path
    content = read_yaml(file)
    motors = content.pop("joint_ids_map")
    if len({*motors}) != len(source.joints) or not all(isinstance(motor, int) for motor in motors):
        must = f"must number {len(source.joints)} motors once, the joints of {source.model_file}"
        raise ValueError(f"{file}: joint_ids_map {must}, got {motors}")
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
    terms = content.pop("observations")
    commands = content.pop("commands")
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

    def count_neighbours(joints: list[str]) -> int:
        motor_by_joint = dict(zip(joints, motors, strict=True))
        pairs = [path[-2:] for path in source.joint_paths() if len(path) > 1]
        return sum(motor_by_joint[joint] == motor_by_joint[parent] + 1 for parent, joint in pairs)

    return max(list(source.joints), source.sort_breadth_first(), key=count_neighbours)


def _select_joints(indices: Any, joints: list[str]) -> list[str]:
    """The joints of a list of indices, or of the numbers of a slice, which has None in it; all of them for None."""
    if indices is None or None in indices:
        return joints[slice(*indices or [None])]
    return [joints[k] for k in indices]
