"""What a training or a vendor left of a controller and its robot, as robot.toml and controller.toml."""

import os
import re
import shutil
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import onnx

from sim.controllers.loaders import activation_in, load_network, read_yaml, widths
from sim.files.command import command_line
from sim.files.settings import to_toml
from sim.robots.compiled import PER_JOINT
from sim.robots.elements import joint_names
from sim.robots.robot import RobotCfg
from sim.robots.robot_file import read_robot_file
from sim.robots.user import NEW_NAME, is_new_name, per_joint

_FILES = {
    "robot.toml": ("model_file", *PER_JOINT, "drive_delay_steps", "physics_dt", "decimation", "speed",
                   "max_duration_s"),
    "controller.toml": ("policy", "joints", "action_scale", "action_offset", "action_clip", "observation_clip",
                        "activation", "history", "observation"),
}  # fmt: skip
_TERMS = {
    "lin_vel": "lin_vel", "ang_vel": "ang_vel", "ang_vel_body": "ang_vel", "gravity_vec": "gravity",
    "commands": "command", "dof_pos": "joint_pos", "dof_vel": "joint_vel", "base_lin_vel": "lin_vel",
    "base_ang_vel": "ang_vel", "projected_gravity": "gravity", "command": "command", "velocity_commands": "command",
    "joint_pos": "joint_pos", "joint_vel": "joint_vel", "actions": "last_action", "last_action": "last_action",
}  # fmt: skip
"""Of rl_sar and of mjlab, whose names have nothing but their meaning in common."""
_ISAAC_TERMS = {"base_lin_vel": "lin_vel", "base_ang_vel": "ang_vel", "projected_gravity": "gravity",
                "generated_commands": "command", "joint_pos_rel": "joint_pos", "joint_vel_rel": "joint_vel",
                "last_action": "last_action", "height_scan": "scan", "gait_phase": "clock"}  # fmt: skip
_NO_MOTOR = {"saturation_effort": 1e6, "velocity_limit": 1e6}  # of an ideal drive, beside others with a DC motor
_RL_SAR = {"default_dof_pos": "default_joint_pos", "rl_kp": "stiffness", "rl_kd": "damping", "dt": "physics_dt",
           "decimation": "decimation", "action_scale": "action_scale"}  # fmt: skip
_RL_SAR_MORE = {"torque_limits": "effort_limit", "clip_obs": "observation_clip"}
_SCALES = {"lin_vel_scale": "lin_vel", "ang_vel_scale": "ang_vel", "commands_scale": "command", "cmd_scale": "command",
           "dof_pos_scale": "joint_pos", "dof_vel_scale": "joint_vel"}  # fmt: skip
_DEPLOYMENT = {"default_angles": "default_joint_pos", "kps": "stiffness", "kds": "damping",
               "simulation_dt": "physics_dt", "control_decimation": "decimation",
               "action_scale": "action_scale"}  # fmt: skip
_MJLAB = {"default_joint_pos": "default_joint_pos", "joint_stiffness": "stiffness", "joint_damping": "damping",
          "action_scale": "action_scale"}  # fmt: skip
_BLIND = ("ang_vel", "gravity", "command", "joint_pos", "joint_vel", "last_action")


@dataclass(kw_only=True)
class _Found:
    """What a source says of a robot, whose model is known, and of its controller."""

    file: Path
    """Of the source, as errors name it."""
    model_file: Path
    model: Any
    joints: tuple[str, ...]
    home: list[float] | None
    settings: dict[str, Any] = field(default_factory=dict)
    """None where the user has to fill it in."""
    why: dict[str, str] = field(default_factory=dict)
    """Why a setting is a guess, or what belongs there."""

    def put(self, why: str = "", **settings: Any) -> None:
        self.settings |= settings
        self.why |= dict.fromkeys(settings, why)

    def check_known(self, names: Iterable[str], known: Iterable[str]) -> None:
        """Refuses names that nobody understands."""
        if unknown := [str(name) for name in names if name not in known]:
            what = f"{self.file} says what is not understood: {', '.join(unknown)}"
            raise ValueError(f"{what}: take it out if it does not matter")

    def take(self, said: dict[str, Any], table: Mapping[str, str], joints: Sequence[str]) -> None:
        """Settings that ``table`` gives other names; those of the robot's joints in the order of its file."""
        for key, name in table.items():
            value = said.pop(key)
            if name in PER_JOINT and isinstance(value, list):
                if set(joints) != set(self.joints) or len(value) != len(joints):
                    must = f"one a joint of {self.model_file}, {', '.join(self.joints)}"
                    raise ValueError(f"{self.file}: {key} must be {must}, got {len(value)} of {', '.join(joints)}")
                value = [value[list(joints).index(joint)] for joint in self.joints]
            self.put(**{name: _one_of(value)})

    def order(self, joints: Sequence[str], why: str = "") -> None:
        """The controller's order of joints, where it is not that of the file."""
        if tuple(joints) != self.joints:
            self.put(joints=list(joints), why=why)

    def stack(self, terms: list[dict[str, Any]], lengths: Sequence[int]) -> None:
        """How Isaac Lab and mjlab lay out former steps; lengths that differ are written into the terms."""
        for term, length in zip(terms, lengths, strict=True):
            term |= {"history": length} if len(set(lengths)) > 1 else {}
        if max(lengths) > 1:
            self.put(history={"length": max(lengths), "newest": "last", "by": "term", "fill": "first"})

    def imu(self) -> list[float] | None:
        """Place of the base's site that is called after an IMU [m]."""
        model = self.model
        sites = [k for k in range(model.nsite) if model.site_bodyid[k] == 1 and "imu" in model.site(k).name.lower()]
        return model.site_pos[sites[0]].round(5).tolist() if len(sites) == 1 else None


def import_controller(source: Path, model_file: Path, out: Path) -> None:
    """Writes robot.toml and controller.toml, with the weights beside them, and prints both.

    The source is a folder or a YAML of rl_sar, a YAML of unitree_rl_gym, a run folder of Isaac Lab, an ONNX file, with
    or without mjlab's metadata, or any other weights. The folder ``out`` gives the robot its name.
    """
    if taken := [str(out / name) for name in _FILES if (out / name).exists()]:
        raise ValueError(f"--out must name a folder without a robot, got {' and '.join(taken)}: move them away first")
    if not is_new_name(out.resolve().name):
        raise ValueError(f"--out must end in {NEW_NAME}, got {out}")
    if not source.exists():
        raise ValueError(f"{source} is not there: expected a folder, a YAML, or weights")
    of_file = read_robot_file(model_file)
    joints = joint_names(of_file.model)
    found = _Found(file=source, model_file=model_file, model=of_file.model, joints=joints, home=of_file.home)
    kind, read = _reader_of(source)
    try:
        weights = read(source, found)
    except (ArithmeticError, AttributeError, LookupError, StopIteration, TypeError, ValueError, re.error) as error:
        if isinstance(error, ValueError) and str(found.file) in str(error):
            raise
        problem = f"it has no {error}" if isinstance(error, KeyError) else str(error)
        if not isinstance(error, KeyError | ValueError):
            problem = f"it is laid out otherwise ({type(error).__name__}: {error})"
        raise ValueError(f"{source} must be {kind}, but {problem}") from None
    copy = out / weights.name
    if copy.exists() and copy.read_bytes() != weights.read_bytes():
        raise ValueError(f"{copy} must be a copy of {weights}, got other weights: move them away first")
    out.mkdir(parents=True, exist_ok=True)
    found.put(model_file=Path(os.path.relpath(model_file.resolve(), out.resolve())), policy=weights.name)
    print(f"{source} is read as {kind}; its weights are {weights}.")
    if not copy.exists():
        shutil.copyfile(weights, copy)
    gaps = []
    for file, names in _FILES.items():
        given = [name for name in names if name in found.settings]
        gaps += [name for name in given if found.settings[name] is None]
        text = "".join(f"{_as_line(name, found.settings[name], found.why[name])}\n" for name in given)
        (out / file).write_text(f"# Of {source.name}\n{text}", encoding="utf-8")
        print(f"\n{out / file}:\n{text}", end="")
    print(f"\nFill in {', '.join(gaps)}; then:" if gaps else "\nNext:")
    for name in ("check", "archive"):
        print(f"  {command_line(name, robot=out / 'robot.toml')}")


def _as_line(name: str, value: Any, why: str) -> str:
    if value is None:
        return f"# {name} = ...  # fill in: {why}"
    rows = [f"  {to_toml(term)},\n" for term in value] if name == "observation" else []
    text = "".join(["[\n", *rows, "]"]) if rows else to_toml(value)
    return f"{name} = {text}{f'  # a guess: {why}' if why else ''}"


def _reader_of(source: Path) -> tuple[str, Callable[[Path, _Found], Path]]:
    """What a source is, and what reads it: finds settings, and returns the file of weights."""
    if (source / "params" / "env.yaml").is_file():
        return "a run of Isaac Lab", _read_isaac_lab
    if source.is_dir() or source.suffix in (".yaml", ".yml"):
        file = source / "config.yaml" if source.is_dir() else source
        if source.is_dir() and not file.is_file():
            kinds = "a folder of rl_sar, with config.yaml, or a run of Isaac Lab, with params/env.yaml"
            raise ValueError(f"{source} must be {kinds}, got neither of these files: name the folder with one")
        content = read_yaml(file)
        if "kps" in content:
            return "a deployment of unitree_rl_gym", _read_deployment
        if len(content) == 1 and isinstance(said := next(iter(content.values())), dict) and "observations" in said:
            return "a controller of rl_sar", _read_rl_sar
        raise ValueError(
            f"{file} must be of rl_sar (a name with observations, ...) or unitree_rl_gym (kps, kds, ...), or the run "
            f"folder of Isaac Lab have params/env.yaml; got {', '.join(map(str, content))}"
        )
    if source.suffix == ".onnx" and "observation_names" in _onnx_metadata(source):
        return "a controller of mjlab", _read_mjlab
    return "weights alone", _read_weights


def _onnx_metadata(file: Path) -> Mapping[str, str]:
    try:
        return {item.key: item.value for item in onnx.ModelProto.FromString(file.read_bytes()).metadata_props}
    except Exception as error:  # protobuf's errors have no base
        raise ValueError(f"{file} is no ONNX file: {error}") from None


def _weights_of(folder: Path, name: str) -> Path:
    """File of weights that a source names, of which a path of another machine may be known."""
    file = folder / Path(name).name
    if not file.is_file():
        raise ValueError(f"{file} is not there: put the weights that {folder} names beside it")
    return file


def _one_of(values: Any) -> Any:
    """One value in place of a list of equal ones."""
    return values[0] if isinstance(values, list) and all(value == values[0] for value in values) else values


def _term(name: str, scale: Any = None, **more: Any) -> dict[str, Any]:
    """A term of the observation, without what changes nothing."""
    given = more if scale is None or np.all(np.equal(scale, 1.0)) else {"scale": scale, **more}
    return {"term": name, **{key: value for key, value in given.items() if value is not None}}


def _read_rl_sar(source: Path, found: _Found) -> Path:
    """A controller's YAML over the base.yaml of its robot, which is beside it or in the folder above."""
    found.file = file = source / "config.yaml" if source.is_dir() else source
    bases = [folder / "base.yaml" for folder in (file.parent, file.parent.parent)]
    base = next((place for place in bases if place.is_file()), None)
    if base is None:
        raise ValueError(f"base.yaml of the robot is not there: expected {' or '.join(map(str, bases))}")
    said = next(iter(read_yaml(base).values())) | next(iter(read_yaml(file).values()))
    if said.pop("wheel_indices", None):
        raise ValueError(f"{file}: wheel_indices must be empty, since wheels are not supported")
    names = said.pop("joint_names")
    joints = [names[k] for k in said.pop("joint_mapping")]
    found.order(joints)
    found.take(said, _RL_SAR | {key: name for key, name in _RL_SAR_MORE.items() if key in said}, joints)
    if "clip_actions_upper" in said:
        limits = said.pop("clip_actions_lower"), said.pop("clip_actions_upper")
        pairs = [list(pair) for pair in zip(*limits, strict=True)]
        high = pairs[0][1]
        found.put(action_clip=high if all(pair == [-high, high] for pair in pairs) else pairs)
    steps = said.pop("observations_history", None) or [0]
    if steps not in (list(range(len(steps))), list(range(len(steps)))[::-1]):
        raise ValueError(f"{file}: observations_history must be all steps from 0 on, got {steps}")
    by = {"time": "row", "term": "term"}.get(priority := said.pop("observations_history_priority", "time"))
    if by is None:
        raise ValueError(f"{file}: observations_history_priority must be time or term, got {priority}")
    if len(steps) > 1:
        history = {"length": len(steps), "newest": "last" if steps[0] else "first", "by": by, "fill": "zeros"}
        found.put(history=history, why="steps before the start are zeros, as in rl_sar's own loop")
    terms = said.pop("observations")
    known = _TERMS | {"g1_phase": "clock"}
    found.check_known(terms, known)
    scales = {name: said.pop(key) for key, name in _SCALES.items() if key in said}
    periods = {"g1_phase": 0.8}  # of its code [s]
    found.put(observation=[_term(known[name], scales.get(known[name]), period_s=periods.get(name)) for name in terms])
    weights = _weights_of(file.parent, said.pop("model_name"))
    idle = ("fixed_kp", "fixed_kd", "num_of_dofs", "num_observations", "joint_controller_names", "framework")
    found.check_known(said, idle)
    return weights


def _read_deployment(source: Path, found: _Found) -> Path:
    """A YAML of ``deploy_mujoco``, whose script has the observation: its order, and a clock if there is room for it."""
    said = read_yaml(source)
    count, width = said.pop("num_actions"), said.pop("num_obs")
    if count != len(found.joints):
        joints = f"{len(found.joints)}, the joints of {found.model_file}"
        raise ValueError(f"{source}: num_actions must be {joints}, got {count}")
    blind, clocked = 9 + 3 * count, 11 + 3 * count
    if width not in (blind, clocked):
        by_hand = "describe it by hand (docs/controllers.md)"
        raise ValueError(f"{source}: num_obs must be {blind}, or {clocked} with a clock, got {width}: {by_hand}")
    found.take(said, _DEPLOYMENT, found.joints)
    scales = {_SCALES[key]: said.pop(key) for key in ("ang_vel_scale", "cmd_scale", "dof_pos_scale", "dof_vel_scale")}
    terms = [_term(name, scales.get(name)) for name in _BLIND]
    terms += [{"term": "clock", "period_s": 0.8}] * (width == clocked)
    clock = ", and the period of its clock" * (width == clocked)
    found.put(observation=terms, why=f"the order of unitree_rl_gym's deploy_mujoco.py{clock}")
    weights = _weights_of(source.parent, said.pop("policy_path"))
    found.check_known(said, ("xml_path", "simulation_duration", "cmd_init"))
    return weights


def _read_mjlab(source: Path, found: _Found) -> Path:
    """An ONNX file with the metadata of mjlab's exporter, rounded to three decimals."""
    load_network(source, "cpu", None, of="it")  # what is wrong with it is said before it is written
    said: dict[str, Any] = {key: text.split(",") for key, text in _onnx_metadata(source).items() if text}
    names, joints = said.pop("observation_names"), said.pop("joint_names")
    found.check_known(names, _TERMS)
    found.take({key: [*map(float, said.pop(key))] for key in _MJLAB}, _MJLAB, joints)
    found.order(joints)
    found.put(physics_dt=0.005, decimation=4, why="the metadata do not say it; mjlab's own tasks are like this")
    scales, clips, lengths = (said.pop(f"observation_terms_{name}", [""] * len(names))
                              for name in ("scale", "clip", "history_length"))  # fmt: skip
    found.check_known(said, ("run_path", "command_names", "observation_terms_flatten_history_dim"))
    terms, why = [], ""
    for name, scale, clip in zip(names, scales, clips, strict=True):
        limits = [float(limit) for limit in (clip or "-inf;inf").split(";")]
        limits = np.clip(limits, -1e9, 1e9).tolist() if np.isfinite(limits).any() else None
        place = found.imu() if _TERMS[name] == "lin_vel" else None
        why = "the velocity is that of the IMU's site" if place else why
        terms.append(_term(_TERMS[name], float(scale or 1.0), clip=limits, at=place))
    found.stack(terms, [max(1, round(float(length or 0))) for length in lengths])
    found.put(observation=terms, why=why)
    return source


def _read_weights(source: Path, found: _Found) -> Path:
    """Weights that say nothing but their widths."""
    network: Any = load_network(source, "cpu", None, of="it")
    (width, count), place = widths(network), found.imu()
    if activation := getattr(getattr(network, "head", network), "activation", None):
        found.put(activation=activation)
    asked = f"an angle of each joint [rad], its pose at action 0: {', '.join(found.joints)}"
    found.put(default_joint_pos=found.home, why="" if found.home else asked)
    if not found.model.nu or not found.model.actuator_biasprm[:, 1].any():
        for name, unit in (("stiffness", "N m/rad"), ("damping", "N m s/rad")):
            found.put(**{name: None}, why=f"a gain of each joint, or one number [{unit}]")
    found.put(physics_dt=0.005, decimation=4, why="50 control steps a second, as most controllers have")
    found.put(action_scale=None, why="radians per unit of action, one or one a joint")
    if count not in (None, len(found.joints)):
        found.put(joints=None, why=f"the {count} joints that it moves, in its order")
    example = to_toml([_term("lin_vel", at=place), *map(_term, _BLIND)])
    found.put(observation=None, why=f"its {width or 'all'} columns in its order, with scale; of {example}")
    return source


def _read_isaac_lab(source: Path, found: _Found) -> Path:
    """A run folder of Isaac Lab: params/env.yaml, params/agent.yaml, exported/ or checkpoints."""
    found.file, agent_file = source / "params" / "env.yaml", source / "params" / "agent.yaml"
    env = read_yaml(found.file)
    _isaac_robot(env, found)
    order = _isaac_action(env["actions"], source, found)
    group = env["observations"]["policy"]
    terms = {name: term for name, term in group.items() if isinstance(term, dict)}
    of_all = group.get("history_length")
    lengths = [(term.get("history_length") if of_all is None else of_all) or 1 for term in terms.values()]
    rows = [_isaac_term(name, term, env["scene"], order, found) for name, term in terms.items()]
    found.stack(rows, lengths)
    found.put(observation=rows, why="lin_vel is that of the base's centre of mass" * any("at" in row for row in rows))
    agent = read_yaml(agent_file) if agent_file.is_file() else {}
    if agent.get("clip_actions") is not None:
        found.put(action_clip=agent["clip_actions"])
    exported = [place for name in ("policy.pt", "policy.onnx") if (place := source / "exported" / name).is_file()]
    checkpoints = sorted(source.glob("model_*.pt"), key=lambda place: int(re.sub(r"\D", "", place.stem) or 0))
    if not exported and not checkpoints:
        raise ValueError("it has no weights, expected exported/policy.pt or model_*.pt")
    if not exported and activation_in(agent) is not None:
        found.put(activation=activation_in(agent))
    return (*exported, *checkpoints[::-1])[0]


def _isaac_robot(env: dict[str, Any], found: _Found) -> None:
    """Pose, gains, limits, steps and speed."""
    articulation, joints, file = env["scene"]["robot"], found.joints, found.file
    pose = per_joint(articulation["init_state"]["joint_pos"], joints, f"{file}: init_state.joint_pos", partly=True)
    found.put(default_joint_pos=_one_of([angle or 0.0 for angle in pose]))
    groups, notes = articulation["actuators"], list[str]()
    ideal = [name for name, group in groups.items() if group.get("saturation_effort") is None]
    idle = _NO_MOTOR if len(ideal) == len(groups) else ()
    values: dict[str, dict[str, Any]] = {name: dict.fromkeys(joints) for name in PER_JOINT[1:] if name not in idle}
    for name, group in groups.items():
        kind = str(group.get("class_type", "")).rpartition(":")[2]
        known, drive = ("DelayedPDActuator", "PD gains with a limit") if name in ideal else ("DCMotor", "a DC motor")
        if kind not in ("", "ImplicitActuator", "IdealPDActuator", known):
            notes.append(f"{name} is a {kind}, simulated as {drive}")
        notes += [f"the friction of {name} is left out: give their joints a frictionloss"] * bool(group.get("friction"))
        group |= _NO_MOTOR if name in ideal else {}
        moved = _chosen(group["joint_names_expr"], joints)
        for key, of_key in values.items():
            given = group.get(f"{key}_sim") if group.get(key) is None else group[key]
            of_key |= zip(moved, per_joint(given, moved, f"{file}: {name}.{key}", partly=True), strict=True)
    for key, of_key in values.items():
        without = [joint for joint, value in of_key.items() if value is None]
        said = ", ".join(f"{joint} {value}" for joint, value in of_key.items() if value is not None)
        asked = f"a value of each joint{': ' * bool(said)}{said}; none is said of {', '.join(without)}"
        if not without:
            why = f"1e6 is that of an ideal drive, {', '.join(ideal)}" * bool(ideal and key in _NO_MOTOR)
            found.put(**{key: _one_of([*of_key.values()])}, why="; ".join(notes) if key == "stiffness" else why)
        elif said or key in ("stiffness", "damping"):
            found.put(**{key: None}, why="; ".join([asked, *notes]))
    delays = {name: (group.get("min_delay") or 0, group.get("max_delay") or 0) for name, group in groups.items()}
    if any(most for _, most in delays.values()):
        spans = ", ".join(f"{name} ({least} to {most})" for name, (least, most) in delays.items())
        found.put(drive_delay_steps=int(np.mean([*delays.values()]) + 0.5), why=f"the mean of the delays of {spans}")
    found.put(physics_dt=env["sim"]["dt"], decimation=env["decimation"])
    ranges = [command["ranges"]["lin_vel_x"][1] for command in (env.get("commands") or {}).values()
              if isinstance(command, dict) and "lin_vel_x" in (command.get("ranges") or {})]  # fmt: skip
    if ranges and 0.0 < ranges[0] < RobotCfg.speed:
        found.put(speed=ranges[0], why=f"the fastest that it was trained for; {RobotCfg.speed:g} is usual here")
        found.put(max_duration_s=round(15.0 / ranges[0], 1), why="in proportion")


def _chosen(patterns: Any, order: Sequence[str], preserve: Any = False) -> list[str]:
    """The joints that patterns name, in the robot's order or in that of the patterns."""
    patterns = patterns if isinstance(patterns, list) else [patterns]
    found = dict.fromkeys(joint for pattern in patterns for joint in order if re.fullmatch(pattern, joint))
    return list(found) if preserve else [joint for joint in order if joint in found]


def _isaac_action(actions: dict[str, Any], source: Path, found: _Found) -> list[str]:
    """Scale, offset and order of actions; returns the order of all joints, which env.yaml does not say."""
    file, why = found.file, "breadth first, as Isaac Lab orders joints; IO_descriptors.yaml would say it"
    order = _breadth_first(found.model)
    for said in sorted(source.rglob("*IO_descriptors.yaml"))[:1]:
        order, why = read_yaml(said)["articulations"]["robot"]["joint_names"], ""
    actions = {name: term for name, term in actions.items() if term is not None}
    kinds = {name: str(term["class_type"]).rpartition(":")[2] for name, term in actions.items()}
    if list(kinds.values()) != ["JointPositionAction"]:
        raise ValueError(f"{file}: actions must be one JointPositionAction, got {kinds}")
    ((name, term),) = actions.items()
    if term.get("clip") is not None:
        raise ValueError(f"{file}: actions.{name}.clip limits targets, which is not supported: give joints that range")
    joints = _chosen(term["joint_names"], order, term.get("preserve_order"))
    found.order(joints, why)
    found.put(action_scale=_one_of(per_joint(term["scale"], joints, f"{file}: actions.{name}.scale")))
    if not term.get("use_default_offset", True):
        offset = per_joint(term["offset"], joints, f"{file}: actions.{name}.offset", partly=True)
        found.put(action_offset=[angle or 0.0 for angle in offset])
    return order


def _breadth_first(model: Any) -> list[str]:
    """Joints from the base outwards, those of a body's children by name."""
    names = {int(model.jnt_bodyid[k]): model.joint(k).name for k in range(1, model.njnt)}

    def path(body: int) -> list[str]:
        return [*path(int(model.body_parentid[body])), names[body]] if body in names else []

    return [joints[-1] for joints in sorted(map(path, names), key=lambda joints: (len(joints), joints))]


def _isaac_term(
    name: str, term: dict[str, Any], scene: dict[str, Any], order: Sequence[str], found: _Found
) -> dict[str, Any]:
    function, params = re.split(r"[:.]", str(term["func"]))[-1], term.get("params") or {}
    if function not in _ISAAC_TERMS or term.get("modifiers"):
        what = f"{term['func']}{' with modifiers' if term.get('modifiers') else ''}"
        known = ", ".join(_ISAAC_TERMS)
        raise ValueError(f"{found.file} says what is not understood: observation {name}, {what}; only {known}")
    centre = found.model.body_ipos[1].round(5).tolist() if function == "base_lin_vel" else None
    row = _term(_ISAAC_TERMS[function], term.get("scale"), clip=term.get("clip"), at=centre)
    if function in ("joint_pos_rel", "joint_vel_rel"):
        asset = params.get("asset_cfg") or {}
        joints = _chosen(asset.get("joint_names") or ".*", order, asset.get("preserve_order"))
        if joints != found.settings.get("joints", list(found.joints)):
            row["joints"] = joints
    elif function == "gait_phase":
        row["period_s"] = params["period"]
    elif function == "height_scan":  # points in the yaw frame of its sensor
        sensor = scene[params["sensor_cfg"]["name"]]
        pattern, place = sensor["pattern_cfg"], sensor["offset"]["pos"]
        level = sensor.get("ray_alignment", "yaw") == "yaw" and sensor.get("attach_yaw_only", True) in (True, None)
        if "resolution" not in pattern or not level:
            raise ValueError(f"{found.file}: a height scanner must be a grid in the yaw frame, got {pattern}")
        step = pattern["resolution"]
        x, y = (
            [round(centre - side / 2 + k * step, 4) for k in range(int(side / step + 1e-6) + 1)]
            for side, centre in zip(pattern["size"], place, strict=False)
        )
        first = "x fastest" if pattern.get("ordering", "xy") == "xy" else "y fastest"
        row |= {"order": first, "offset": params.get("offset", 0.5), "x": x, "y": y}
    return row
