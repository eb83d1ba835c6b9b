"""A deployment of unitree_rl_lab or unitree_rl_mjlab: the deploy.yaml that they export."""

from pathlib import Path
from typing import Any

from sim.controllers.formats.source import Source, collapse, find_checkpoint, make_term
from sim.files.settings import YAML_SUFFIXES, read_yaml

_TERMS = {
    "base_ang_vel": "ang_vel",
    "projected_gravity": "gravity",
    "velocity_commands": "command",
    "joint_pos_rel": "joint_pos",
    "joint_vel_rel": "joint_vel",
    "last_action": "last_action",
    "gait_phase": "clock",
}
_STEPS = 4  # physics steps a control step, in the tasks of both


class DeployYaml:
    """Reads a deploy.yaml, which numbers the joints by the motors of Unitree's SDK and does not name them."""

    label = "a deployment of unitree_rl_lab or unitree_rl_mjlab (a folder with params/deploy.yaml, or that file)"

    def matches(self, path: Path) -> bool:
        """Whether it is such a folder, or a YAML with a joint_ids_map."""
        if path.is_dir():
            return (path / "params" / "deploy.yaml").is_file()
        return path.suffix in YAML_SUFFIXES and "joint_ids_map" in read_yaml(path)

    def read(self, path: Path, source: Source) -> Path:
        """Settings of the YAML, with the names of its joints by the model; returns the exported network."""
        source.file = file = path / "params" / "deploy.yaml" if path.is_dir() else path
        content = read_yaml(file)
        motors = [int(motor) for motor in content.pop("joint_ids_map")]
        if len(motors) != len(source.joints):
            must = f"must number {len(source.joints)}, the joints of {source.model_file}"
            raise ValueError(f"{file}: joint_ids_map {must}, got {len(motors)}")
        joints = _find_order(motors, source)
        for name in ("stiffness", "damping"):
            gains = content[name]
            slots = sorted(motors) if len(gains) == len(motors) else range(len(gains))  # motors that are not there
            content[name] = [gains[slots.index(motor)] for motor in motors]
        names = ("stiffness", "damping", "default_joint_pos")
        default = dict(zip(joints, content["default_joint_pos"], strict=True))
        source.move(content, dict(zip(names, names, strict=True)), joints)
        reason = f"{file.name} says the control step alone; the tasks of its makers have {_STEPS} physics steps in it"
        source.set(physics_dt=round(content.pop("step_dt") / _STEPS, 6), decimation=_STEPS, reason=reason)
        moved = _read_action(content.pop("actions"), default, source)
        by_motors = "the order in which the motors of a limb follow each other; joints are numbered, not named"
        source.set(joints=moved, reason=by_motors)
        _read_observations(content.pop("observations"), joints, moved, content.pop("commands"), source)
        source.refuse_unknown(content, ())
        return find_checkpoint(file.parent.parent, "exported/policy.onnx", f"{file.parent.name}/policy.onnx")


def _find_order(motors: list[int], source: Source) -> list[str]:
    """Names of the joints that have these motors: by mjlab in the model's order, by Isaac Lab breadth first."""
    paths = source.joint_paths()

    def count_neighbours(joints: list[str]) -> int:
        motor_by_joint = dict(zip(joints, motors, strict=True))
        pairs = [path[-2:] for path in paths if len(path) > 1]
        return sum(motor_by_joint[joint] == motor_by_joint[parent] + 1 for parent, joint in pairs)

    return max(list(source.joints), source.sort_breadth_first(), key=count_neighbours)


def _read_action(actions: dict[str, Any], default: dict[str, float], source: Source) -> list[str]:
    """Scale and offset of the targets, with the default pose of all joints; returns those that they move."""
    if list(actions) != ["JointPositionAction"]:
        raise ValueError(f"{source.file}: actions must be one JointPositionAction, got {', '.join(actions)}")
    action = actions["JointPositionAction"]
    if action.get("clip") is not None:
        raise ValueError(f"{source.file}: actions.clip limits targets, which is not supported: give joints that range")
    moved = _select_joints(action.get("joint_ids"), list(default))
    source.set(action_scale=collapse(action["scale"]))
    offset = action.get("offset") or [0.0] * len(moved)
    if offset != [default[joint] for joint in moved]:
        source.set(action_offset=[float(angle) for angle in offset])
    return moved


def _select_joints(indices: Any, joints: list[str]) -> list[str]:
    """The joints of a list of indices, or of the numbers of a slice, which has None in it; all of them for None."""
    if indices is None or None in indices:
        return joints[slice(*indices or [None])]
    return [joints[k] for k in indices]


def _read_observations(
    groups: dict[str, Any], joints: list[str], moved: list[str], commands: dict[str, Any], source: Source
) -> None:
    """Terms in their order; they may be in a table of their own, as the network's input is called."""
    first = next(iter(groups.values()))
    terms = dict(first if len(groups) == 1 and "params" not in first else groups)
    by_row = terms.pop("use_gym_history", False)
    scale_first = terms.pop("scale_first", False)
    source.refuse_unknown(terms, _TERMS)
    rows = []
    for name, item in terms.items():
        if "params" not in item:
            raise ValueError(f"{source.file}: observations must be those of one input, got {', '.join(terms)}")
        if scale_first and item.get("clip"):
            raise ValueError(f"{source.file}: scale_first is not supported, where {name} has a clip")
        params = item["params"] or {}
        row = make_term(_TERMS[name], collapse(item.get("scale")), clip=item.get("clip"))
        if row["term"] == "command":
            row["limit"] = source.read_ranges(commands[params["command_name"]]["ranges"])
        elif row["term"] == "clock":
            row["period_s"] = params["period"]
        elif row["term"].startswith("joint"):
            selected = _select_joints((params.get("asset_cfg") or {}).get("joint_ids"), joints)
            row |= {"joints": selected} if selected != moved else {}
        rows.append(row)
    lengths = [item.get("history_length") or 1 for item in terms.values()]
    source.set_history(rows, lengths, by="row" if by_row else "term")
    source.set(observation=rows)
