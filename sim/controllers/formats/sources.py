"""What a training or a vendor left of a controller: formats of sources, and the settings that are read from them."""

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from sim.controllers.formats.network import find_widths, load_network
from sim.controllers.formats.rsl_rl import read_activation
from sim.files.settings import YAML_SUFFIXES, read_yaml, to_toml
from sim.robots.compiled import PER_JOINT
from sim.robots.robot import RobotCfg
from sim.robots.user import per_joint

_NAMES_BY_TERM = {
    "lin_vel": ("lin_vel", "base_lin_vel"),
    "ang_vel": ("ang_vel", "ang_vel_body", "base_ang_vel"),
    "gravity": ("gravity_vec", "projected_gravity"),
    "command": ("commands", "command", "velocity_commands"),
    "joint_pos": ("dof_pos", "joint_pos"),
    "joint_vel": ("dof_vel", "joint_vel"),
    "last_action": ("actions", "last_action"),
}
TERM_NAMES = {name: term for term, names in _NAMES_BY_TERM.items() for name in names}
"""Terms of the observation by the names that rl_sar and mjlab give them."""
BLIND_TERMS = ("ang_vel", "gravity", "command", "joint_pos", "joint_vel", "last_action")
"""Terms of a controller without sight, in the usual order."""
SETTINGS = ("default_joint_pos", "stiffness", "damping", "action_scale", "physics_dt", "decimation")
"""Settings that most sources have, under names of their own."""


@dataclass(kw_only=True)
class Source:
    """Settings that are read from a source, for a robot whose model is known."""

    file: Path
    """The file that errors name."""
    model_file: Path
    model: Any
    """The compiled MuJoCo model."""
    joints: tuple[str, ...]
    """Joints of the model, in its order."""
    home: list[float] | None
    """The model's home pose [rad], if it has one."""
    settings: dict[str, Any] = field(default_factory=dict)
    """Fields of robot.toml and controller.toml; None where the user has to fill one in."""
    reasons: dict[str, str] = field(default_factory=dict)
    """Why a setting is a guess, or what the user should fill in."""

    def set(self, reason: str = "", **settings: Any) -> None:
        """Stores settings, with the reason if they are guesses."""
        self.settings |= settings
        self.reasons |= dict.fromkeys(settings, reason)

    def refuse_unknown(self, names: Iterable[str], known: Iterable[str]) -> None:
        """Raises a ValueError with the names that are not known."""
        if unknown := [str(name) for name in names if name not in known]:
            what = f"{self.file} says what is not understood: {', '.join(unknown)}"
            raise ValueError(f"{what}: take it out if it does not matter")

    def move(self, content: dict[str, Any], names: Mapping[str, str], joints: Sequence[str]) -> None:
        """Moves values from ``content`` to settings of other names; lists of the source's joints are reordered."""
        for key, name in names.items():
            value = content.pop(key)
            if name in PER_JOINT and isinstance(value, list):
                if set(joints) != set(self.joints) or len(value) != len(joints):
                    must = f"one a joint of {self.model_file}, {', '.join(self.joints)}"
                    raise ValueError(f"{self.file}: {key} must be {must}, got {len(value)} of {', '.join(joints)}")
                value = [value[list(joints).index(joint)] for joint in self.joints]
            self.set(**{name: collapse(value)})

    def set_joints(self, joints: Sequence[str], reason: str = "") -> None:
        """Stores the controller's order of joints, if it is not that of the model."""
        if tuple(joints) != self.joints:
            self.set(joints=list(joints), reason=reason)

    def set_history(self, terms: list[dict[str, Any]], lengths: Sequence[int]) -> None:
        """Stores former steps as Isaac Lab and mjlab lay them out; lengths that differ are written into the terms."""
        for term, length in zip(terms, lengths, strict=True):
            term |= {"history": length} if len(set(lengths)) > 1 else {}
        if max(lengths) > 1:
            self.set(history={"length": max(lengths), "newest": "last", "by": "term", "fill": "first"})

    def find_imu(self) -> list[float] | None:
        """Position of the base's only site that is called after an IMU [m], shape (3,)."""
        model = self.model
        sites = [k for k in range(model.nsite) if model.site_bodyid[k] == 1 and "imu" in model.site(k).name.lower()]
        return model.site_pos[sites[0]].round(5).tolist() if len(sites) == 1 else None


def collapse(values: Any) -> Any:
    """One value in place of a list of equal ones."""
    return values[0] if isinstance(values, list) and all(value == values[0] for value in values) else values


def make_term(name: str, scale: Any = None, **fields: Any) -> dict[str, Any]:
    """A term of the observation, without a scale of 1 and fields that are None."""
    if scale is not None and not np.all(np.equal(scale, 1.0)):
        fields = {"scale": scale, **fields}
    return {"term": name, **{key: value for key, value in fields.items() if value is not None}}


_TERMS = TERM_NAMES | {"g1_phase": "clock", "cmd": "command"}
_SCALED = ("lin_vel", "commands", "ang_vel", "cmd", "dof_pos", "dof_vel")
_CLOCK_PERIOD = 0.8  # of the code of both [s]
_RL_SAR_KEYS = ("default_dof_pos", "rl_kp", "rl_kd", "action_scale", "dt", "decimation")
_RL_SAR_OPTIONAL_KEYS = {"torque_limits": "effort_limit", "clip_obs": "observation_clip"}
_WITHOUT_EFFECT = ("fixed_kp", "fixed_kd", "num_of_dofs", "num_observations", "joint_controller_names", "framework")
_MJLAB_KEYS = ("default_joint_pos", "joint_stiffness", "joint_damping", "action_scale")
_UNITREE_KEYS = ("default_angles", "kps", "kds", "action_scale", "simulation_dt", "control_decimation")
_ISAAC_LAB_TERMS = {
    "base_lin_vel": "lin_vel",
    "base_ang_vel": "ang_vel",
    "projected_gravity": "gravity",
    "generated_commands": "command",
    "joint_pos_rel": "joint_pos",
    "joint_vel_rel": "joint_vel",
    "last_action": "last_action",
    "height_scan": "scan",
    "gait_phase": "clock",
}
_IDEAL_DRIVE = {"saturation_effort": 1e6, "velocity_limit": 1e6}  # stands beside joints with a DC motor


class IsaacLab:
    """Reads env.yaml and agent.yaml of a run."""

    label = "a run of Isaac Lab (a folder with params/env.yaml)"

    def matches(self, path: Path) -> bool:
        """Whether it is a folder with params/env.yaml."""
        return (path / "params" / "env.yaml").is_file()

    def read(self, path: Path, source: Source) -> Path:
        """Settings of env.yaml and agent.yaml; returns the exported network, else the last checkpoint."""
        source.file = path / "params" / "env.yaml"
        env = read_yaml(source.file)
        articulation = env["scene"]["robot"]
        pose = articulation["init_state"]["joint_pos"]
        pose = per_joint(pose, source.joints, f"{source.file}: init_state.joint_pos", partly=True)
        source.set(default_joint_pos=collapse([angle or 0.0 for angle in pose]))
        _read_actuators(articulation["actuators"], source)
        source.set(physics_dt=env["sim"]["dt"], decimation=env["decimation"])
        commands = [command for command in (env.get("commands") or {}).values() if isinstance(command, dict)]
        ranges = [command.get("ranges") or {} for command in commands]
        speed = next((limits["lin_vel_x"][1] for limits in ranges if "lin_vel_x" in limits), 0.0)
        if 0.0 < speed < RobotCfg.speed:
            source.set(speed=speed, reason=f"the fastest that it was trained for; {RobotCfg.speed:g} is usual here")
            source.set(max_duration_s=round(15.0 / speed, 1), reason="in proportion")
        joint_order = _read_action(env["actions"], path, source)
        group = env["observations"]["policy"]
        terms = {name: term for name, term in group.items() if isinstance(term, dict)}
        common = group.get("history_length")
        lengths = [(term.get("history_length") if common is None else common) or 1 for term in terms.values()]
        rows = [_read_term(name, term, env["scene"], joint_order, source) for name, term in terms.items()]
        source.set_history(rows, lengths)
        reason = "lin_vel is that of the base's centre of mass" * any("at" in row for row in rows)
        source.set(observation=rows, reason=reason)
        agent_file = path / "params" / "agent.yaml"
        agent = read_yaml(agent_file) if agent_file.is_file() else {}
        if agent.get("clip_actions") is not None:
            source.set(action_clip=agent["clip_actions"])
        for name in ("policy.pt", "policy.onnx"):
            if (exported := path / "exported" / name).is_file():
                return exported
        checkpoints = sorted(path.glob("model_*.pt"), key=lambda file: int(re.sub(r"\D", "", file.stem) or 0))
        if not checkpoints:
            raise ValueError("it has no weights, expected exported/policy.pt or model_*.pt")
        if (activation := read_activation(agent)) is not None:
            source.set(activation=activation)
        return checkpoints[-1]


def _read_actuators(groups: dict[str, Any], source: Source) -> None:
    """Gains, limits and delays."""
    notes: list[str] = []
    ideal = [name for name, group in groups.items() if group.get("saturation_effort") is None]
    omitted = _IDEAL_DRIVE if len(ideal) == len(groups) else ()
    keys = [key for key in PER_JOINT[1:] if key not in omitted]
    values_by_key: dict[str, dict[str, Any]] = {key: dict.fromkeys(source.joints) for key in keys}
    for name, group in groups.items():
        drive = ("DelayedPDActuator", "PD gains with a limit") if name in ideal else ("DCMotor", "a DC motor")
        kind = str(group.get("class_type", "")).rpartition(":")[2]
        if kind not in ("", "ImplicitActuator", "IdealPDActuator", drive[0]):
            notes.append(f"{name} is a {kind}, simulated as {drive[1]}")
        if group.get("friction"):
            notes.append(f"the friction of {name} is left out: give their joints a frictionloss")
        group |= _IDEAL_DRIVE if name in ideal else {}
        joints = _match_joints(group["joint_names_expr"], source.joints)
        for key, values in values_by_key.items():
            value = group.get(f"{key}_sim") if group.get(key) is None else group[key]
            values |= zip(joints, per_joint(value, joints, f"{source.file}: {name}.{key}", partly=True), strict=True)
    for key, values in values_by_key.items():
        without = [joint for joint, value in values.items() if value is None]
        named = ", ".join(f"{joint} {value}" for joint, value in values.items() if value is not None)
        if not without:
            reason = f"1e6 is that of an ideal drive, {', '.join(ideal)}" * bool(ideal and key in _IDEAL_DRIVE)
            source.set(**{key: collapse([*values.values()])}, reason="; ".join(notes) if key == "stiffness" else reason)
        elif named or key in ("stiffness", "damping"):
            gap = f"a value of each joint{': ' * bool(named)}{named}; none is said of {', '.join(without)}"
            source.set(**{key: None}, reason="; ".join([gap, *notes]))
    delays = {name: (group.get("min_delay") or 0, group.get("max_delay") or 0) for name, group in groups.items()}
    if any(longest for _, longest in delays.values()):
        spans = ", ".join(f"{name} ({shortest} to {longest})" for name, (shortest, longest) in delays.items())
        mean = int(np.mean([*delays.values()]) + 0.5)
        source.set(drive_delay_steps=mean, reason=f"the mean of the delays of {spans}")


def _match_joints(patterns: Any, joints: Sequence[str], keep_pattern_order: Any = False) -> list[str]:
    """The joints that patterns name, in the order of the joints or in that of the patterns."""
    patterns = patterns if isinstance(patterns, list) else [patterns]
    named = dict.fromkeys(joint for pattern in patterns for joint in joints if re.fullmatch(pattern, joint))
    return list(named) if keep_pattern_order else [joint for joint in joints if joint in named]


def _read_action(actions: dict[str, Any], path: Path, source: Source) -> list[str]:
    """Scale, offset and joints of the action; returns the order of all joints, which env.yaml does not say."""
    if descriptors := sorted(path.rglob("*IO_descriptors.yaml")):
        joint_order = read_yaml(descriptors[0])["articulations"]["robot"]["joint_names"]
        reason = ""
    else:
        model = source.model
        names = {int(model.jnt_bodyid[k]): model.joint(k).name for k in range(1, model.njnt)}

        def path_to(body: int) -> list[str]:
            return [*path_to(int(model.body_parentid[body])), names[body]] if body in names else []

        paths = sorted(map(path_to, names), key=lambda joints: (len(joints), joints))
        joint_order = [joints[-1] for joints in paths]  # from the base outwards, a body's children by name
        reason = "breadth first, as Isaac Lab orders joints; IO_descriptors.yaml would say it"
    kinds = {name: str(term["class_type"]).rpartition(":")[2] for name, term in actions.items() if term is not None}
    if list(kinds.values()) != ["JointPositionAction"]:
        raise ValueError(f"{source.file}: actions must be one JointPositionAction, got {kinds}")
    (name,) = kinds
    term = actions[name]
    label = f"{source.file}: actions.{name}"
    if term.get("clip") is not None:
        raise ValueError(f"{label}.clip limits targets, which is not supported: give joints that range")
    joints = _match_joints(term["joint_names"], joint_order, term.get("preserve_order"))
    source.set_joints(joints, reason)
    source.set(action_scale=collapse(per_joint(term["scale"], joints, f"{label}.scale")))
    if not term.get("use_default_offset", True):
        offset = per_joint(term["offset"], joints, f"{label}.offset", partly=True)
        source.set(action_offset=[angle or 0.0 for angle in offset])
    return joint_order


def _read_term(
    name: str, term: dict[str, Any], scene: dict[str, Any], joint_order: Sequence[str], source: Source
) -> dict[str, Any]:
    function = re.split(r"[:.]", str(term["func"]))[-1]
    params = term.get("params") or {}
    if function not in _ISAAC_LAB_TERMS or term.get("modifiers"):
        what = f"observation {name}, {term['func']}{' with modifiers' * bool(term.get('modifiers'))}"
        raise ValueError(f"{source.file} says what is not understood: {what}; only {', '.join(_ISAAC_LAB_TERMS)}")
    centre = source.model.body_ipos[1].round(5).tolist() if function == "base_lin_vel" else None
    row = make_term(_ISAAC_LAB_TERMS[function], term.get("scale"), clip=term.get("clip"), at=centre)
    if function in ("joint_pos_rel", "joint_vel_rel"):
        asset = params.get("asset_cfg") or {}
        joints = _match_joints(asset.get("joint_names") or ".*", joint_order, asset.get("preserve_order"))
        if joints != source.settings.get("joints", list(source.joints)):
            row["joints"] = joints
    elif function == "gait_phase":
        row["period_s"] = params["period"]
    elif function == "height_scan":
        sensor = scene[params["sensor_cfg"]["name"]]
        grid = sensor["pattern_cfg"]
        turns = sensor.get("ray_alignment", "yaw") == "yaw" and sensor.get("attach_yaw_only", True) in (True, None)
        if "resolution" not in grid or not turns:
            raise ValueError(f"{source.file}: a height scanner must be a grid in the yaw frame, got {grid}")
        row["order"] = "x fastest" if grid.get("ordering", "xy") == "xy" else "y fastest"
        row["offset"] = params.get("offset", 0.5)
        step = grid["resolution"]
        for axis, side, mid in zip("xy", grid["size"], sensor["offset"]["pos"], strict=False):
            row[axis] = [round(mid - side / 2 + k * step, 4) for k in range(int(side / step + 1e-6) + 1)]
    return row


class RlSar:
    """Reads a YAML over the base.yaml of its robot, which is beside it or in the folder above."""

    label = "a controller of rl_sar (its YAML, or a folder with config.yaml)"

    def matches(self, path: Path) -> bool:
        """Whether it is a YAML of one name that has observations, or a folder with such a config.yaml."""
        file = path / "config.yaml" if path.is_dir() else path
        if file.suffix not in YAML_SUFFIXES or not file.is_file():
            return False
        values = list(read_yaml(file).values())
        return len(values) == 1 and isinstance(values[0], dict) and "observations" in values[0]

    def read(self, path: Path, source: Source) -> Path:
        """Settings of both files, refused by name if they are not understood."""
        source.file = file = path / "config.yaml" if path.is_dir() else path
        bases = [folder / "base.yaml" for folder in (file.parent, file.parent.parent)]
        base = next(filter(Path.is_file, bases), None)
        if base is None:
            raise ValueError(f"base.yaml of the robot is not there: expected {' or '.join(map(str, bases))}")
        content = next(iter(read_yaml(base).values())) | next(iter(read_yaml(file).values()))
        if content.pop("wheel_indices", None):
            raise ValueError(f"{file}: wheel_indices must be empty, since wheels are not supported")
        names = content.pop("joint_names")
        joints = [names[k] for k in content.pop("joint_mapping")]
        source.set_joints(joints)
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
        by = {"time": "row", "term": "term"}.get(priority)
        if by is None:
            raise ValueError(f"{file}: observations_history_priority must be time or term, got {priority}")
        if len(steps) > 1:
            history = {"length": len(steps), "newest": "last" if steps[0] else "first", "by": by, "fill": "zeros"}
            source.set(history=history, reason="steps before the start are zeros, as in rl_sar's own loop")
        terms = content.pop("observations")
        source.refuse_unknown(terms, _TERMS)
        scales = {_TERMS[name]: content.pop(f"{name}_scale") for name in _SCALED if f"{name}_scale" in content}
        periods = {"clock": _CLOCK_PERIOD}
        names = [_TERMS[term] for term in terms]
        source.set(observation=[make_term(name, scales.get(name), period_s=periods.get(name)) for name in names])
        weights = _find_weights(file.parent, content.pop("model_name"))
        source.refuse_unknown(content, _WITHOUT_EFFECT)
        return weights


class UnitreeRlGym:
    """Reads a YAML, and the observation of deploy_mujoco.py, which fixes its terms and their order."""

    label = "a deployment of unitree_rl_gym (a YAML with kps, kds, ...)"

    def matches(self, path: Path) -> bool:
        """Whether it is a YAML with gains called kps."""
        return path.suffix in YAML_SUFFIXES and path.is_file() and "kps" in read_yaml(path)

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
        source.move(content, dict(zip(_UNITREE_KEYS, SETTINGS, strict=True)), source.joints)
        scales = {_TERMS[name]: content.pop(f"{name}_scale") for name in ("ang_vel", "cmd", "dof_pos", "dof_vel")}
        terms = [make_term(name, scales.get(name)) for name in BLIND_TERMS]
        reason = "the order of unitree_rl_gym's deploy_mujoco.py"
        if width > blind:
            terms.append(make_term("clock", period_s=_CLOCK_PERIOD))
            reason += ", and the period of its clock"
        source.set(observation=terms, reason=reason)
        weights = _find_weights(path.parent, content.pop("policy_path"))
        source.refuse_unknown(content, ("xml_path", "simulation_duration", "cmd_init"))
        return weights


def _find_weights(folder: Path, name: str) -> Path:
    """The file of weights in a folder; its name may have a path of another machine."""
    file = folder / Path(name).name
    if not file.is_file():
        raise ValueError(f"{file} is not there: put the weights that {folder} names beside it")
    return file


def _read_metadata(file: Path) -> Mapping[str, str]:
    try:
        return {item.key: item.value for item in onnx.ModelProto.FromString(file.read_bytes()).metadata_props}
    except Exception as error:  # protobuf's errors have no base
        raise ValueError(f"{file} is no ONNX file: {error}") from None


class Mjlab:
    """Reads the metadata of an ONNX file, which are rounded to three decimals."""

    label = "a controller of mjlab (an ONNX file with its metadata)"

    def matches(self, path: Path) -> bool:
        """Whether it is an ONNX file that names its observations."""
        return path.suffix == ".onnx" and path.is_file() and "observation_names" in _read_metadata(path)

    def read(self, path: Path, source: Source) -> Path:
        """Settings of the metadata; the file is also that of the weights."""
        load_network(path, "cpu", None, label="it")  # refuses a damaged file
        content: dict[str, Any] = {key: text.split(",") for key, text in _read_metadata(path).items() if text}
        names = content.pop("observation_names")
        joints = content.pop("joint_names")
        source.refuse_unknown(names, TERM_NAMES)
        values = {key: [*map(float, content.pop(key))] for key in _MJLAB_KEYS}
        source.move(values, dict(zip(_MJLAB_KEYS, SETTINGS, strict=False)), joints)
        source.set_joints(joints)
        source.set(physics_dt=0.005, decimation=4, reason="the metadata do not say it; mjlab's own tasks are like this")
        columns = ("scale", "clip", "history_length")
        scales, clips, lengths = (content.pop(f"observation_terms_{name}", [""] * len(names)) for name in columns)
        source.refuse_unknown(content, ("run_path", "command_names", "observation_terms_flatten_history_dim"))
        terms = []
        for name, scale, clip in zip(names, scales, clips, strict=True):
            imu = source.find_imu() if TERM_NAMES[name] == "lin_vel" else None
            limits = [float(limit) for limit in (clip or "-inf;inf").split(";")]
            limits = np.clip(limits, -1e9, 1e9).tolist() if np.isfinite(limits).any() else None
            terms.append(make_term(TERM_NAMES[name], float(scale or 1.0), clip=limits, at=imu))
        source.set_history(terms, [max(1, round(float(length or 0))) for length in lengths])
        reason = "the velocity is that of the IMU's site" * any("at" in term for term in terms)
        source.set(observation=terms, reason=reason)
        return path


class Weights:
    """Reads the widths of a network of any format."""

    label = "weights alone (an rsl_rl checkpoint, TorchScript or ONNX)"

    def matches(self, path: Path) -> bool:
        """Whether it is a file that may hold weights."""
        return path.is_file() and path.suffix not in YAML_SUFFIXES

    def read(self, path: Path, source: Source) -> Path:
        """Leaves nearly all settings for the user to fill in, and says what belongs there."""
        network: Any = load_network(path, "cpu", None, label="it")
        width, count = find_widths(network)
        if activation := getattr(getattr(network, "head", network), "activation", None):
            source.set(activation=activation)
        pose = f"an angle of each joint [rad], its pose at action 0: {', '.join(source.joints)}"
        source.set(default_joint_pos=source.home, reason="" if source.home else pose)
        if not source.model.nu or not source.model.actuator_biasprm[:, 1].any():
            for name, unit in (("stiffness", "N m/rad"), ("damping", "N m s/rad")):
                source.set(**{name: None}, reason=f"a gain of each joint, or one number [{unit}]")
        source.set(physics_dt=0.005, decimation=4, reason="50 control steps a second, as most controllers have")
        source.set(action_scale=None, reason="radians per unit of action, one or one a joint")
        if count not in (None, len(source.joints)):
            source.set(joints=None, reason=f"the {count} joints that it moves, in its order")
        example = to_toml([make_term("lin_vel", at=source.find_imu()), *map(make_term, BLIND_TERMS)])
        source.set(observation=None, reason=f"its {width or 'all'} columns in its order, with scale; of {example}")
        return path
