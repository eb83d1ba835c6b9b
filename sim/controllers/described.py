"""A controller as data: a TOML file says what a network sees, and what its actions mean (docs/controllers.md)."""

import math
import re
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Annotated, Any, NamedTuple

import numpy as np
import torch
from msgspec import Meta
from numpy.typing import NDArray

from kernels.observation import ANG_VEL_SCALE, FORCE_SCALE, JOINT_VEL_SCALE, LIN_VEL_SCALE, SCAN_OFFSET, SCAN_SCALE
from sim.controllers.formats.rsl_rl import ACTIVATIONS
from sim.controllers.runner import is_graph_safe
from sim.controllers.spec import ControllerSpec
from sim.files.settings import NonNegativeInt, PositiveFloat, from_builtins, read_toml, to_toml
from sim.robots.robot import RobotCfg, needed_senses

TERMS: dict[str, tuple[str, ...]] = {
    "lin_vel": ("at",), "ang_vel": (), "gravity": (), "command": ("limit", "order"), "joint_pos": ("joints", "offset"),
    "joint_vel": ("joints",), "last_action": (), "clock": ("period_s", "order", "offset"),
    "constant": ("value",), "rpy": ("axes",), "heading": (), "quat": ("order",), "base_pos": (),
    "contacts": ("threshold",), "torques": ("joints",), "scan": ("order", "x", "y", "offset"),
}  # fmt: skip
"""Fields of each term besides those of all terms; docs/controllers.md explains them."""
ROW_SCALES: dict[str, Any] = {"lin_vel": LIN_VEL_SCALE, "ang_vel": ANG_VEL_SCALE, "gravity": 1.0}
ROW_SCALES |= {"command": (LIN_VEL_SCALE, LIN_VEL_SCALE, ANG_VEL_SCALE), "joint_pos": 1.0}
ROW_SCALES |= {"joint_vel": JOINT_VEL_SCALE, "last_action": 1.0}
"""Scales of a robot's own row before its scan, by quantity, in the order of its columns."""
_ORDERS = {"scan": "(x|y) fastest", "clock": "(sin|cos)( (sin|cos))?", "quat": "w x y z|x y z w"}
_ORDERS["command"] = "(v_x|v_y|yaw_rate)( (v_x|v_y|yaw_rate))*"
_USUAL_ORDERS = {"clock": "sin cos", "command": "v_x v_y yaw_rate"}
_COLUMNS = {"roll": 0, "pitch": 1, "yaw": 2, "w": 0, "x": 1, "y": 2, "z": 3, "v_x": 0, "v_y": 1, "yaw_rate": 2}
"""Columns of axes in the base's angles, in a quaternion, and in a command."""


@dataclass(frozen=True, kw_only=True)
class Term:
    """Columns of the observation: limited, then scaled, then remembered."""

    term: str  # which of :data:`TERMS`
    clip: float | tuple[float, float] | None = None  # largest size, or limits, in the quantity's unit, before ``scale``
    scale: float | tuple[float, ...] = 1.0  # one factor, or one a column
    history: Annotated[int, Meta(ge=1, le=10_000)] | None = None  # control steps seen; :class:`History`'s if None
    at: tuple[float, float, float] | None = None  # where the velocity is measured, base frame [m]; the origin if None
    limit: float | tuple[float, float, float] | None = None  # largest size of each command
    joints: tuple[str, ...] | None = None  # joints in this order; those that the controller moves if None
    period_s: PositiveFloat | None = None  # period of a clock [s]
    order: str | None = None  # "x fastest", "w x y z", "sin cos", "v_x v_y yaw_rate", ...
    x: tuple[float, ...] | None = None  # points of a scan ahead of the base, yaw frame [m]; ``scan_x`` if None
    y: tuple[float, ...] | None = None  # points left of the base [m]; ``scan_y`` if None
    offset: float | tuple[float, ...] | None = None  # subtracted from heights [m], angles [rad]; of a clock, in periods
    value: float | tuple[float, ...] | None = None  # numbers that never change
    axes: Annotated[str, Meta(pattern="^(roll|pitch|yaw)( (roll|pitch|yaw))*$")] | None = None  # angles of the base
    threshold: PositiveFloat | None = None  # a foot with a larger force [N] is 1, else 0; the force itself if None


@dataclass(frozen=True, kw_only=True)
class History:
    """How observations of former control steps are laid out."""

    length: Annotated[int, Meta(ge=1, le=10_000)]  # control steps that the controller sees, with the present one
    newest: Annotated[str, Meta(pattern="^(first|last)$")]
    by: Annotated[str, Meta(pattern="^(row|term)$")]  # row after row, or all steps of a term before the next
    fill: Annotated[str, Meta(pattern="^(zeros|first)$")]  # for steps before the episode: 0, or its first observation


@dataclass(frozen=True, kw_only=True)
class Wander:
    """A sinusoid of joint targets, whose phase depends on the joint angles in an episode's first step alone."""

    joints: tuple[str, ...]
    amplitude: PositiveFloat  # [rad]
    period_s: PositiveFloat


@dataclass(frozen=True, kw_only=True)
class ControllerCfg:
    """What a ``controller.toml`` says."""

    policy: str  # file of the weights, beside it: TorchScript, ONNX, or an rsl_rl checkpoint
    encoder: str | None = None  # file of a network that sees the observation; the policy sees what it returns, too
    encoder_first: bool = False  # whether that stands before the policy's columns of the observation, not behind them
    observation: tuple[Term, ...] = ()  # terms in the order of its columns
    joints: tuple[str, ...] | None = None  # that it moves, in its order; the others hold the default pose; all if None
    hold: dict[str, float] | None = None  # angles that joints beside those hold instead [rad]
    wander: Wander | None = None  # how joints beside those swing about the angles that they hold
    default: tuple[float, ...] | None = None  # pose that joint angles are relative to [rad]; the robot's if None
    action_scale: float | tuple[float, ...]  # radians per unit of action
    action_offset: tuple[float, ...] | None = None  # targets at action 0 [rad]; ``default`` if None
    action_clip: float | tuple[tuple[float, float], ...] | None = None  # largest output, or limits of each joint's
    action_delay_steps: NonNegativeInt = 0  # control steps until an action takes effect
    observation_clip: PositiveFloat | None = None  # largest size of a column, applied last
    history: History | None = None
    activation: Annotated[str, Meta(pattern=f"^({'|'.join(ACTIVATIONS)})$")] | None = None
    """Function between the layers of an rsl_rl checkpoint that does not name it."""


def read_controller(path: Path, text: str | None = None) -> ControllerCfg:
    """Reads a description, or its text; errors name ``path`` and the field."""
    content = read_toml(path, text)
    if "model_file" in content:
        raise ValueError(f"{path} must be a controller, got the settings of a robot: name it by --robot")
    items = content.pop("observation", None)
    if not isinstance(items, list) or not items or not all(isinstance(item, dict) for item in items):
        what = f'observation must be a list of terms, for example [{{term = "gravity"}}], got {items or "none"}'
        raise ValueError(f"{path}: {what}: fill in the lines that an import marked `fill in`")
    terms = []
    for k, item in enumerate(items):
        name = item.get("term")
        if not isinstance(name, str) or name not in TERMS:
            raise ValueError(f"{path}: observation[{k}].term must be one of {', '.join(TERMS)}, got {name}")
        label = f"{path}: observation[{k}] ({name})"
        settings = ("term", "clip", "scale", "history", *TERMS[name])
        if unknown := sorted(item.keys() - settings):
            raise ValueError(f"{label} has no setting {', '.join(unknown)}: there are {', '.join(settings)}")
        item = {"order": _USUAL_ORDERS[name]} | item if name in _USUAL_ORDERS else item
        if missing := {"period_s", "order", "value", "axes"} & {*TERMS[name]} - item.keys():
            raise ValueError(f"{label}: missing '{missing.pop()}'")
        term = from_builtins(Term, item, label)
        if term.order is not None and not re.fullmatch(_ORDERS[name], term.order):
            raise ValueError(f"{label}: order must be of the form {_ORDERS[name]}, got {term.order!r}")
        if name != "clock" and isinstance(term.offset, tuple):
            raise ValueError(f"{label}: offset must be a number, got {list(term.offset)}")
        terms.append(term)
    return replace(from_builtins(ControllerCfg, content, str(path)), observation=tuple(terms))


def format_controller(cfg: ControllerCfg) -> str:
    """The description as TOML, which :func:`read_controller` reads."""
    given = asdict(cfg, dict_factory=lambda items: {name: value for name, value in items if value is not None})
    return "".join(f"{name} = {to_toml(value)}\n" for name, value in given.items())


@dataclass(frozen=True, kw_only=True)
class Sensed:
    """What robots sense, on the observation's device; a sense that the robot lacks has no columns."""

    lin_vel: torch.Tensor  # velocity of the base link's origin, base frame [m/s], shape (num_envs, 3)
    ang_vel: torch.Tensor  # angular velocity of the base, base frame [rad/s], shape (num_envs, 3)
    gravity: torch.Tensor  # direction of gravity, base frame, a unit vector: (0, 0, -1) upright; shape (num_envs, 3)
    command: torch.Tensor  # commanded v_x, v_y [m/s] in the base's yaw frame, and yaw rate [rad/s], shape (num_envs, 3)
    joint_pos: torch.Tensor  # joint angles [rad] in the order of ``robot.joint_names``, shape (num_envs, num_joints)
    joint_vel: torch.Tensor  # joint rates [rad/s], shape (num_envs, num_joints)
    last_action: torch.Tensor  # what the controller last returned, clipped to +-100; shape (num_envs, num_joints)
    # Height of the base over the ground at ``robot.scan_x`` ahead and ``robot.scan_y`` left of it, yaw frame [m],
    # clipped to -0.5..1.5.
    scan: torch.Tensor  # shape (num_envs, len(scan_x), len(scan_y))
    base_pos: torch.Tensor  # position of the base, world-local frame [m], shape (num_envs, 3)
    quat: torch.Tensor  # quaternion wxyz of the base, base to world frame, shape (num_envs, 4)
    contacts: torch.Tensor  # contact force on each of ``robot.foot_geoms`` [N], shape (num_envs, num_feet)
    torques: torch.Tensor  # torques of the joints in the last physics step [N m], shape (num_envs, num_joints)


@lru_cache(maxsize=16)
def _on_device(values: tuple[float, ...], device: torch.device) -> torch.Tensor:
    """Copied once: every control step would wait for it."""
    return torch.tensor(values, dtype=torch.float32, device=device)


def read_row(row: torch.Tensor, robot: RobotCfg) -> Sensed:
    """Splits a robot's observation rows, shape (num_envs, observation_size), into physical quantities."""
    if row.ndim != 2 or row.shape[1] != robot.observation_size:
        raise ValueError(f"row must have shape (num_envs, {robot.observation_size}), got {tuple(row.shape)}")
    columns = row.split(robot.column_sizes, dim=1)
    lin_vel, ang_vel, gravity, speed, yaw_rate, joint_pos, joint_vel, last_action, scan, *senses = columns
    return Sensed(
        lin_vel=lin_vel / LIN_VEL_SCALE,
        ang_vel=ang_vel / ANG_VEL_SCALE,
        gravity=gravity,
        command=torch.cat([speed / LIN_VEL_SCALE, yaw_rate / ANG_VEL_SCALE], dim=1),
        joint_pos=joint_pos + _on_device(robot.default_joint_pos, row.device),
        joint_vel=joint_vel / JOINT_VEL_SCALE,
        last_action=last_action,
        scan=(scan / SCAN_SCALE + SCAN_OFFSET).reshape(len(row), len(robot.scan_x), len(robot.scan_y)),
        base_pos=senses[0],
        quat=senses[1],
        contacts=senses[2] / FORCE_SCALE,
        torques=senses[3] / FORCE_SCALE,
    )


def _euler_angles(sensed: Sensed) -> torch.Tensor:
    """Roll and pitch of the base, and its yaw where its pose is sensed [rad], shape (num_envs, 2 or 3)."""
    x, y, z = sensed.gravity.unbind(1)
    angles = [torch.atan2(-y, -z), torch.atan2(x, torch.hypot(y, z))]
    if sensed.quat.shape[1]:
        w, x, y, z = sensed.quat.unbind(1)
        angles.append(torch.atan2(2.0 * (w * z + x * y), 1.0 - 2.0 * (y * y + z * z)))
    return torch.stack(angles, dim=1)


class _Memory(NamedTuple):
    """State of a controller for each robot, written in place; 0 when an episode begins."""

    steps: torch.Tensor  # control steps of the episode, float, (num_envs, 1)
    action: torch.Tensor  # last output of the network, (num_envs, num_actions)
    sent: torch.Tensor  # outputs without effect yet, the newest first, (num_envs, action_delay_steps, num_actions)
    phase: torch.Tensor  # of joints that wander, in periods, (num_envs, 1)
    past: torch.Tensor  # observations, the newest first, (num_envs, length, width)


class Described(torch.nn.Module):
    """The controller of a description, as a policy of the robot's observation row."""

    def __init__(self, cfg: ControllerCfg, robot: RobotCfg, path: str) -> None:
        """Checks the description of a file against its robot; :meth:`use` sets the network."""
        super().__init__()
        self.cfg = cfg
        self.robot = robot
        self._path = path
        if missing := {*needed_senses(term.axes or term.term for term in cfg.observation)} - {*robot.senses}:
            remedy = f"write into robot.toml senses = {to_toml(sorted({*robot.senses, *missing}))}"
            self._refuse(f"observation needs the robot's {', '.join(sorted(missing))}: {remedy}")
        self._moved = self._find_joints(cfg.joints)
        self._wandering = self._find_joints(cfg.wander.joints, "wander.joints") if cfg.wander else ()
        if taken := {*self._moved} & {*self._wandering, *self._find_joints(tuple(cfg.hold or ()), "hold")}:
            names = [robot.joint_names[k] for k in sorted(taken)]
            self._refuse(f"hold and wander must name joints that the network does not move, got {', '.join(names)}")
        self.num_actions = len(self._moved)
        for name in ("default", "action_scale", "action_offset", "action_clip"):
            values = getattr(cfg, name)
            if isinstance(values, tuple) and len(values) != self.num_actions:
                self._refuse(f"{name} must have one value a joint, {self.num_actions}, got {len(values)}")
        self._check_limits("action_clip", cfg.action_clip)
        self._columns = [self._find_columns(term) for term in cfg.observation]
        self.widths = [len(columns) for columns in self._columns]
        for k, (term, width) in enumerate(zip(cfg.observation, self.widths, strict=True)):
            if isinstance(term.scale, tuple) and len(term.scale) != width:
                self._refuse(f"observation[{k}].scale must be one number or {width}, got {len(term.scale)}")
            self._check_limits(f"observation[{k}].clip", term.clip)
            for limit in np.ravel(term.limit or 0.0):
                self._check_limits(f"observation[{k}].limit", limit)
        self.lengths = [term.history or (cfg.history.length if cfg.history else 1) for term in cfg.observation]
        if max(self.lengths) > 1 and cfg.history is None:
            self._refuse("history must say how steps are laid out: {length = 1, newest, by, fill}")
        if cfg.history is not None and cfg.history.by == "row" and len(set(self.lengths)) > 1:
            self._refuse(f'history.by must be "term" where terms have other lengths, got {self.lengths}')
        self.observation_size = int(np.dot(self.widths, self.lengths))  # columns that the network sees
        terms = zip(cfg.observation, self.widths, self.lengths, strict=True)
        self.columns = ", ".join(f"{term.term} {width}" + (f" x {n}" if n > 1 else "") for term, width, n in terms)
        self.use(None, torch.device("cpu"))

    def use(self, network: Any, device: torch.device) -> None:
        """Set the network, which has :attr:`observation_size` columns and one action a joint."""
        cfg = self.cfg
        self.network, self._device = network, device
        self.graph_safe = is_graph_safe(network)  # its ``reset`` too
        self._memories: dict[int, _Memory] = {}  # by the number of robots: a graph keeps their addresses

        def constant(values: Any) -> torch.Tensor:
            return torch.tensor(np.array(values), dtype=torch.float32, device=device)

        robot_pose = self.robot.default_joint_pos
        moved_pose = [robot_pose[k] for k in self._moved]
        default = cfg.default or moved_pose
        pose = dict(enumerate(robot_pose)) | dict(zip(self._moved, default, strict=True))
        columns: list[tuple[Any, ...]] = []  # zero, lower and upper limit, and scale
        for term, indices in zip(cfg.observation, self._columns, strict=True):
            shift = term.offset or 0.0 if term.term in ("scan", "joint_pos") else 0.0
            zeros = [pose[k] if term.term == "joint_pos" and term.offset is None else shift for k in indices]
            limits = _told_limits(term)[:, [k % 3 for k in indices]]  # only those of a command differ
            columns += zip(zeros, *limits, np.broadcast_to(term.scale, len(indices)), strict=True)
        self._index = [torch.tensor(indices, device=device) for indices in self._columns]
        constants = (term.at or term.value or term.offset or 0.0 for term in cfg.observation)
        self._constants = [constant(np.atleast_1d(values)) for values in constants]
        self._zeros, self._low, self._high, self._scale = constant(columns).T
        self._clip = constant(np.broadcast_to(_limits(cfg.action_clip), (self.num_actions, 2))).T
        self._joints = torch.tensor(self._moved, device=device)
        self._pose = constant(moved_pose)
        self._offset = constant(cfg.action_offset or default)
        self._radians = constant(np.broadcast_to(cfg.action_scale, self.num_actions))
        held = dict(zip(self.robot.joint_names, robot_pose, strict=True)) | (cfg.hold or {})
        self._held = constant(np.subtract([*held.values()], robot_pose) / self.robot.action_scale)
        self._wanderers = torch.tensor(self._wandering, dtype=torch.long, device=device)
        self._phases = constant(0.618 * np.arange(len(self._wandering)))  # so that joints do not swing together
        self._mixed = constant(100.0 * np.arange(1, 1 + self.robot.num_joints))

    def _refuse(self, problem: str) -> None:
        raise ValueError(f"{self._path}: {problem}")

    def _check_limits(self, name: str, clip: Any) -> None:
        if any(lower > upper for lower, upper in np.reshape(_limits(clip), (-1, 2))):
            self._refuse(f"{name} must be above 0, or have its lower limit first, got {clip}")

    def _find_joints(self, names: tuple[str, ...] | None, setting: str = "joints") -> tuple[int, ...]:
        """Indices of joints of the robot, of all by default."""
        joints = self.robot.joint_names
        names = joints if names is None else names
        unknown = [name for name in names if name not in joints]
        if unknown or len(set(names)) < len(names):
            got = ", ".join(unknown or names)
            self._refuse(f"{setting} must be the robot's, each once, got {got}: it has {', '.join(joints)}")
        return tuple(joints.index(name) for name in names)

    def _find_columns(self, term: Term) -> Sequence[int]:
        robot = self.robot
        if "joints" in TERMS[term.term]:
            return self._moved if term.joints is None else self._find_joints(term.joints)
        if term.term in ("rpy", "heading", "quat", "command"):
            return [_COLUMNS[name] for name in (term.axes or term.order or _USUAL_ORDERS.get(term.term, "yaw")).split()]
        if term.term != "scan":
            waves = len((term.order or "").split())
            sizes = {"last_action": self.num_actions, "contacts": len(robot.foot_geoms)}
            sizes |= {"constant": np.size(term.value or 0.0), "clock": waves * np.size(term.offset or 0.0)}
            return range(sizes.get(term.term, 3))
        x, y = (np.round(values, 4).tolist() for values in (term.x or robot.scan_x, term.y or robot.scan_y))
        points = [(a, b) for b in y for a in x] if term.order == "x fastest" else [(a, b) for a in x for b in y]
        robot_points = [*map(tuple, np.round(np.transpose(robot.scan_points()).astype(float), 4).tolist())]
        if not points:
            self._refuse("a scan must have x and y where the robot has no scan_x and scan_y")
        if not {*points} <= {*robot_points}:
            remedy = f"write into robot.toml scan_x = {[*dict.fromkeys(x)]} and scan_y = {[*dict.fromkeys(y)]}"
            self._refuse(f"the scan's points are not those of the robot: {remedy}")
        return [robot_points.index(point) for point in points]

    def _get_memory(self, count: int) -> _Memory:
        if count not in self._memories:
            sent = (self.cfg.action_delay_steps, self.num_actions)
            shapes = (1,), (self.num_actions,), sent, (1,), (max(self.lengths), sum(self.widths))
            self._memories[count] = _Memory(*(torch.zeros((count, *shape), device=self._device) for shape in shapes))
        return self._memories[count]

    @torch.inference_mode()
    def reset(self, rows: torch.Tensor) -> None:
        """Begin an episode where ``rows``, bool, shape (num_envs,), is true."""
        for values in self._get_memory(len(rows)):
            values.masked_fill_(rows.reshape(-1, *[1] * (values.ndim - 1)), 0.0)
        if hasattr(self.network, "reset"):
            self.network.reset(rows)

    @torch.inference_mode()
    def forward(self, row: torch.Tensor) -> torch.Tensor:
        """The robot's actions, shape (num_envs, num_joints)."""
        return self.act(self.network(self.observe(row)))

    @torch.inference_mode()
    def observe(self, row: torch.Tensor) -> torch.Tensor:
        """The network's rows from the robot's, shape (num_envs, observation_size); once a control step."""
        clip = self.cfg.observation_clip
        memory = self._get_memory(len(row))
        sensed = read_row(row, self.robot)
        if self._wandering:
            mixed = torch.frac((sensed.joint_pos * self._mixed).sum(dim=1, keepdim=True))
            memory.phase.copy_(torch.where(memory.steps == 0.0, mixed, memory.phase))
        columns: list[torch.Tensor] = []
        for term, constants, index in zip(self.cfg.observation, self._constants, self._index, strict=True):
            if term.term == "lin_vel":
                quantity = sensed.lin_vel + torch.linalg.cross(sensed.ang_vel, constants.expand_as(sensed.ang_vel))
            elif term.term == "clock":
                angle = memory.steps * (2.0 * math.pi * self.robot.control_dt / (term.period_s or math.inf))
                waves = (getattr(angle + 2.0 * math.pi * constants, wave)() for wave in (term.order or "").split())
                quantity = torch.cat([*waves], dim=1)
            elif term.term == "constant":
                quantity = constants.expand(len(row), -1)
            elif term.threshold is not None:
                quantity = (sensed.contacts > term.threshold).float()
            elif term.term in ("rpy", "heading"):
                quantity = _euler_angles(sensed)
            else:
                quantity = memory.action if term.term == "last_action" else getattr(sensed, term.term).flatten(1)
            columns.append(quantity[:, index])
        now = (torch.cat(columns, dim=1) - self._zeros).clamp(self._low, self._high) * self._scale
        now = now if clip is None else now.clamp(-clip, clip)
        history = self.cfg.history
        if history is None:
            return now
        past = torch.cat([now[:, None], memory.past[:, :-1]], dim=1)
        if history.fill == "first":
            past = torch.where(memory.steps[:, :, None] == 0.0, now[:, None], past)
        memory.past.copy_(past)
        blocks = [past] if history.by == "row" else past.split(self.widths, dim=2)
        steps = [block[:, :length] for block, length in zip(blocks, self.lengths, strict=False)]
        return torch.cat([(block.flip(1) if history.newest == "last" else block).flatten(1) for block in steps], dim=1)

    @torch.inference_mode()
    def act(self, output: torch.Tensor) -> torch.Tensor:
        """The robot's actions from outputs of the network, shape (num_envs, num_actions)."""
        robot, memory = self.robot, self._get_memory(len(output))
        memory.action.copy_(output.clamp(*self._clip))
        actions = self._held.repeat(len(output), 1)
        if (wander := self.cfg.wander) is not None:
            periods = memory.steps * (robot.control_dt / wander.period_s) + memory.phase + self._phases
            actions[:, self._wanderers] += wander.amplitude / robot.action_scale * torch.sin(2 * math.pi * periods)
        memory.steps.add_(1.0)
        queue = torch.cat([memory.action[:, None], memory.sent], dim=1)
        memory.sent.copy_(queue[:, :-1])
        actions[:, self._joints] = (self._offset + self._radians * queue[:, -1] - self._pose) / robot.action_scale
        return actions


def read_speed_limits(policy: str | Path) -> tuple[float, float]:
    """Least and largest speed ahead that a controller is told [m/s]; infinite where no description limits it."""
    told = [term for term in _read_terms(policy) or () if term.term == "command" and "v_x" in (term.order or "")]
    low, high = np.array([_told_limits(term)[:, 0] for term in told] or [(-math.inf, math.inf)]).T
    return float(low.max()), float(high.min())


def observed_terms(policy: str | Path) -> set[str] | None:
    """Which of :data:`TERMS` a controller observes; None if no description says it."""
    terms = _read_terms(policy)
    return None if terms is None else {term.term for term in terms}


def _read_terms(policy: str | Path) -> tuple[Term, ...] | None:
    file = ControllerSpec.parse(policy).file
    return read_controller(Path(file)).observation if file is not None and file.endswith(".toml") else None


def _told_limits(term: Term) -> NDArray[np.float64]:
    """Lower and upper limit of a term's v_x, v_y and yaw rate, shape (2, 3)."""
    sizes = np.broadcast_to(math.inf if term.limit is None else term.limit, 3)
    return np.clip([-sizes, sizes], *_limits(term.clip))


def _limits(clip: Any) -> Any:
    """Lower and upper limit for a size or None; limits, or limits a column, are returned as they are."""
    return clip if isinstance(clip, tuple) else (-math.inf, math.inf) if clip is None else (-clip, clip)
