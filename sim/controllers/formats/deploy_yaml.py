"""A deployment of unitree_rl_lab or unitree_rl_mjlab: the deploy.yaml that they export."""

from pathlib import Path
from typing import Any

from sim.controllers.formats.source import Source, collapse, find_weights, make_term
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
        limits = source.read_ranges(content.pop("commands")["base_velocity"]["ranges"])
        _read_observations(content.pop("observations"), joints, moved, limits, source)
        source.refuse_unknown(content, ())
        folders = (file.parent, file.parent.parent / "exported")
        files = [folder / f"policy.{suffix}" for folder in folders for suffix in ("onnx", "pt")]
        weights = next(filter(Path.is_file, files), None)
        if weights is None:
            raise ValueError(f"it has no weights, expected {' or '.join(map(str, files))}")
        return weights


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
    """The joints of a list of indices; all of them for a slice or None."""
    return joints if indices in (None, "slice", [None] * 3) else [joints[k] for k in indices]


def _read_observations(
    groups: dict[str, Any], joints: list[str], moved: list[str], limit: list[float], source: Source
) -> None:
    """Terms in their order, of the one group that there may be."""
    if not any("params" in item for item in groups.values()):
        if len(groups) > 1:
            raise ValueError(f"{source.file}: observations must be one group, got {', '.join(groups)}")
        (groups,) = groups.values()
    terms = dict(groups)
    by_row = terms.pop("use_gym_history", False)
    scale_first = terms.pop("scale_first", False)
    source.refuse_unknown(terms, _TERMS)
    rows = []
    for name, item in terms.items():
        params = item.get("params") or {}
        if scale_first and item.get("clip"):
            raise ValueError(f"{source.file}: scale_first is not supported, where {name} has a clip")
        row = make_term(_TERMS[name], collapse(item.get("scale")), clip=item.get("clip"))
        if row["term"] == "command":
            row["limit"] = limit
        elif row["term"] == "clock":
            row["period_s"] = params["period"]
        elif row["term"].startswith("joint"):
            selected = _select_joints((params.get("asset_cfg") or {}).get("joint_ids"), joints)
            row |= {"joints": selected} if selected != moved else {}
        rows.append(row)
    source.set_history(rows, [item.get("history_length") or 1 for item in terms.values()], "row" if by_row else "term")
    source.set(observation=rows)
