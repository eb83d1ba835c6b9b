"""A controller as data: a TOML file says what a network sees, and what its actions mean (docs/controllers.md)."""

import math
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any, ClassVar, NamedTuple

import torch
from msgspec import Meta

from sim.files.settings import NonNegativeInt, PositiveFloat, PositiveInt, from_builtins
from sim.policy.adapters import Sensed, read_row
from sim.policy.mlp import ACTIVATIONS
from sim.policy.runner import with_rows_of_zeros
from sim.robots.robot import RobotCfg


@dataclass(frozen=True, kw_only=True)
class Term:
    """Columns of the observation: limited, then scaled, then remembered."""

    name: ClassVar[str]

    clip: float | tuple[float, float] | None = None
    """Largest size, or limits, in the quantity's unit, before ``scale``."""
    scale: float | tuple[float, ...] = 1.0
    """One factor, or one a column."""
    history: PositiveInt | None = None
    """How many control steps of it are seen; the controller's if None."""

    def _width(self, controller: "Described") -> int:
        """Columns of one control step."""
        return 3

    def _read(self, sensed: Sensed, controller: "Described", memory: "_Memory") -> torch.Tensor:
        """Its quantity, shape (num_envs, width)."""
        raise NotImplementedError


@dataclass(frozen=True, kw_only=True)
class LinVel(Term):
    """Linear velocity, base frame [m/s]."""

    name = "lin_vel"

    at: tuple[float, float, float] = (0.0, 0.0, 0.0)
    """Place where it is measured, for example of the IMU, base frame [m]."""

    def _read(self, sensed: Sensed, controller: "Described", memory: "_Memory") -> torch.Tensor:
        place = controller.constant(self.at).expand_as(sensed.ang_vel)
        return sensed.lin_vel + torch.linalg.cross(sensed.ang_vel, place)


@dataclass(frozen=True, kw_only=True)
class AngVel(Term):
    """Angular velocity, base frame [rad/s]."""

    name = "ang_vel"

    def _read(self, sensed: Sensed, controller: "Described", memory: "_Memory") -> torch.Tensor:
        return sensed.ang_vel


@dataclass(frozen=True, kw_only=True)
class Gravity(Term):
    """Direction of gravity, base frame: (0, 0, -1) upright."""

    name = "gravity"

    def _read(self, sensed: Sensed, controller: "Described", memory: "_Memory") -> torch.Tensor:
        return sensed.gravity


@dataclass(frozen=True, kw_only=True)
class Command(Term):
    """Commanded v_x, v_y [m/s] and yaw rate [rad/s]."""

    name = "command"

    limit: float | tuple[float, float, float] | None = None
    """The largest size of each that it is told."""

    def _read(self, sensed: Sensed, controller: "Described", memory: "_Memory") -> torch.Tensor:
        if self.limit is None:
            return sensed.command
        limit = controller.constant(_each(self.limit, 3))
        return torch.clamp(sensed.command, -limit, limit)


@dataclass(frozen=True, kw_only=True)
class JointPos(Term):
    """Joint angles minus its default pose [rad]."""

    name = "joint_pos"

    joints: tuple[str, ...] | None = None
    """Other joints than those that it moves; in this order."""

    def _width(self, controller: "Described") -> int:
        return len(controller.numbers(self.joints))

    def _read(self, sensed: Sensed, controller: "Described", memory: "_Memory") -> torch.Tensor:
        numbers = controller.numbers(self.joints)
        return sensed.joint_pos[:, controller.index(numbers)] - controller.constant(controller.pose_of(numbers))


@dataclass(frozen=True, kw_only=True)
class JointVel(Term):
    """Joint rates [rad/s]."""

    name = "joint_vel"

    joints: tuple[str, ...] | None = None
    """Other joints than those that it moves; in this order."""

    def _width(self, controller: "Described") -> int:
        return len(controller.numbers(self.joints))

    def _read(self, sensed: Sensed, controller: "Described", memory: "_Memory") -> torch.Tensor:
        return sensed.joint_vel[:, controller.index(controller.numbers(self.joints))]


@dataclass(frozen=True, kw_only=True)
class LastAction(Term):
    """What its network last returned, within ``action_clip``; 0 at the start."""

    name = "last_action"

    def _width(self, controller: "Described") -> int:
        return controller.num_actions

    def _read(self, sensed: Sensed, controller: "Described", memory: "_Memory") -> torch.Tensor:
        return memory.action


@dataclass(frozen=True, kw_only=True)
class Clock(Term):
    """Sine and cosine of the time since the episode began."""

    name = "clock"

    period_s: PositiveFloat

    def _width(self, controller: "Described") -> int:
        return 2

    def _read(self, sensed: Sensed, controller: "Described", memory: "_Memory") -> torch.Tensor:
        angle = memory.steps * (2.0 * math.pi * controller.robot.control_dt / self.period_s)
        return torch.cat([torch.sin(angle), torch.cos(angle)], dim=1)


@dataclass(frozen=True, kw_only=True)
class Scan(Term):
    """Height of the base over the ground minus ``offset`` [m], at points about the base, yaw frame."""

    name = "scan"

    order: Annotated[str, Meta(pattern="^(x fastest|y fastest)$")]
    x: tuple[float, ...] | None = None
    """Ahead of the base [m]; the robot's ``scan_x`` if None."""
    y: tuple[float, ...] | None = None
    """Left of it [m]; the robot's ``scan_y`` if None."""
    offset: float = 0.0

    def points(self, robot: RobotCfg) -> list[tuple[float, float]]:
        """Where it is measured, in its order [m]."""
        xs, ys = self.x or robot.scan_x, self.y or robot.scan_y
        if self.order == "x fastest":
            return [(x, y) for y in ys for x in xs]
        return [(x, y) for x in xs for y in ys]

    def _width(self, controller: "Described") -> int:
        return len(self.points(controller.robot))

    def _read(self, sensed: Sensed, controller: "Described", memory: "_Memory") -> torch.Tensor:
        return sensed.scan.flatten(1)[:, controller.index(controller.scan_numbers(self))] - self.offset


@dataclass(frozen=True, kw_only=True)
class History:
    """How observations of former control steps are laid out."""

    length: PositiveInt
    """Control steps that are seen, the present one among them."""
    newest: Annotated[str, Meta(pattern="^(first|last)$")]
    by: Annotated[str, Meta(pattern="^(row|term)$")]
    """Whole rows one after the other, or all steps of a term before the next."""
    fill: Annotated[str, Meta(pattern="^(zeros|first)$")]
    """What stands for steps before the episode: zeros, or its first observation."""


@dataclass(frozen=True, kw_only=True)
class ControllerCfg:
    """What a ``controller.toml`` says."""

    policy: str
    """File of the weights, beside it: TorchScript, ONNX, or an rsl_rl checkpoint."""
    observation: tuple[Term, ...] = ()
    """Terms in the order of its columns."""
    joints: tuple[str, ...] | None = None
    """Joints in its order; others hold the robot's default pose; all of the robot if None."""
    default: tuple[float, ...] | None = None
    """Its pose [rad], which angles are relative to; the robot's if None."""
    action_scale: float | tuple[float, ...]
    """Radians per unit of action."""
    action_offset: tuple[float, ...] | None = None
    """Targets at action 0 [rad]; its default pose if None."""
    action_clip: float | tuple[tuple[float, float], ...] | None = None
    """Largest size of the network's output, or its limits, one pair a joint."""
    action_delay_steps: NonNegativeInt = 0
    """Control steps after which an action counts."""
    observation_clip: PositiveFloat | None = None
    """Largest size of a column, after all else."""
    history: History | None = None
    activation: Annotated[str, Meta(pattern=f"^({'|'.join(ACTIVATIONS)})$")] | None = None
    """Between the layers of an rsl_rl checkpoint, which does not say it."""


_TERMS = {term.name: term for term in Term.__subclasses__()}


def read_controller(path: Path) -> ControllerCfg:
    """Reads a description; an error names the file and the field."""
    try:
        content = tomllib.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} cannot be read as TOML: {error}") from None
    items = content.pop("observation", None)
    if not isinstance(items, list) or not items or not all(isinstance(item, dict) for item in items):
        raise ValueError(f'{path}: observation must be a list of terms, for example [{{term = "gravity"}}]')
    terms = []
    for k, item in enumerate(items):
        name = item.pop("term", None)
        if not isinstance(name, str) or name not in _TERMS:
            raise ValueError(f"{path}: observation[{k}].term must be one of {', '.join(_TERMS)}, got {name}")
        terms.append(from_builtins(_TERMS[name], item, f"{path}: observation[{k}] ({name})"))
    return replace(from_builtins(ControllerCfg, content, str(path)), observation=tuple(terms))


class _Memory(NamedTuple):
    """What a controller knows of each robot, written in place; tensors lead with num_envs."""

    steps: torch.Tensor
    """Control steps since the episode began, float, shape (num_envs, 1)."""
    action: torch.Tensor
    """Last output of the network."""
    sent: torch.Tensor
    """Outputs that do not count yet, the newest first, shape (num_envs, action_delay_steps, num_actions)."""
    past: torch.Tensor
    """Observations, the newest first, shape (num_envs, length, width)."""
    begins: torch.Tensor
    """Whether the coming step is the first, bool, shape (num_envs, 1, 1)."""


class Described(torch.nn.Module):
    """The controller of a description, as a policy of the robot's observation row."""

    def __init__(self, cfg: ControllerCfg, robot: RobotCfg, place: str) -> None:
        """Checks a description, called ``place`` in errors, against its robot; :meth:`use` sets the network."""
        super().__init__()
        self.cfg, self.robot, self._place = cfg, robot, place
        self.network: Any = None
        self._device = torch.device("cpu")
        self._numbers: dict[Any, tuple[int, ...]] = {}
        self._tensors: dict[Any, torch.Tensor] = {}
        self._memories: dict[int, _Memory] = {}  # by the number of robots: a graph keeps their addresses
        self.num_actions = len(self.numbers(None))
        for name in ("default", "action_scale", "action_offset", "action_clip"):
            values = getattr(cfg, name)
            if isinstance(values, tuple) and len(values) != self.num_actions:
                self._refuse(f"{name} must have one value a joint, {self.num_actions}, got {len(values)}")
        if any(lower > upper for lower, upper in _limits(cfg.action_clip, 1)):
            self._refuse(f"action_clip must be above 0, or have its lower limits first, got {cfg.action_clip}")
        self.widths = [term._width(self) for term in cfg.observation]
        for k, (term, width) in enumerate(zip(cfg.observation, self.widths, strict=True)):
            if isinstance(term.scale, tuple) and len(term.scale) != width:
                self._refuse(f"observation[{k}].scale must be one number or {width}, got {len(term.scale)}")
            if any(lower > upper for lower, upper in _limits(term.clip, 1)):
                self._refuse(f"observation[{k}].clip must be above 0, or have its lower limit first, got {term.clip}")
            if isinstance(term, Scan):
                self.scan_numbers(term)
        history = cfg.history
        self.lengths = [term.history or (history.length if history else 1) for term in cfg.observation]
        if max(self.lengths) > 1 and history is None:
            self._refuse("history must say how steps are laid out: {length = 1, newest, by, fill}")
        if history is not None and history.by == "row" and len(set(self.lengths)) > 1:
            self._refuse(f'history.by must be "term" where terms have other lengths, got {self.lengths}')

    def use(self, network: Any, device: torch.device) -> None:
        """Set the network, which has :attr:`observation_size` columns and one action a joint."""
        self.network, self._device = network, device

    def _refuse(self, problem: str) -> None:
        raise ValueError(f"{self._place}: {problem}")

    def numbers(self, joints: tuple[str, ...] | None) -> tuple[int, ...]:
        """The robot's numbers of joints, by default of those that it moves."""
        if joints not in self._numbers:
            own, given = self.robot.joint_names, self.cfg.joints if joints is None else joints
            names = own if given is None else given
            unknown = [name for name in names if name not in own]
            if unknown or len(set(names)) < len(names):
                got = f"no {', '.join(unknown)}" if unknown else "each of them once"
                self._refuse(f"joints must be the robot's, which has {got}, only {', '.join(own)}")
            self._numbers[joints] = tuple(own.index(name) for name in names)
        return self._numbers[joints]

    def pose_of(self, numbers: Sequence[int]) -> tuple[float, ...]:
        """Its default pose of the robot's joints of these numbers, and the robot's of those that it does not move."""
        pose = dict(enumerate(self.robot.default_joint_pos))
        pose |= zip(self.numbers(None), self.cfg.default or [pose[k] for k in self.numbers(None)], strict=True)
        return tuple(pose[k] for k in numbers)

    def scan_numbers(self, term: Scan) -> tuple[int, ...]:
        """The robot's numbers of a scan's points."""
        if term in self._numbers:
            return self._numbers[term]
        xs, ys = self.robot.scan_points()
        numbers = {(round(float(x), 4), round(float(y), 4)): k for k, (x, y) in enumerate(zip(xs, ys, strict=True))}
        points = [(round(x, 4), round(y, 4)) for x, y in term.points(self.robot)]
        if not points:
            self._refuse("a scan must have x and y where the robot has no scan_x and scan_y")
        if not set(points) <= numbers.keys():
            x, y = ([*dict.fromkeys(values)] for values in zip(*points, strict=True))
            self._refuse(
                f"the scan's points are not those of the robot: write into robot.toml scan_x = {x} and scan_y = {y}"
            )
        self._numbers[term] = tuple(numbers[point] for point in points)
        return self._numbers[term]

    def constant(self, values: Sequence[float]) -> torch.Tensor:
        """Floats on the device, which are copied once."""
        if values not in self._tensors:
            self._tensors[values] = torch.tensor(values, dtype=torch.float32, device=self._device)
        return self._tensors[values]

    def index(self, numbers: tuple[int, ...]) -> torch.Tensor:
        """Column numbers on the device, which are copied once."""
        if ("index", numbers) not in self._tensors:
            self._tensors["index", numbers] = torch.tensor(numbers, device=self._device)
        return self._tensors["index", numbers]

    @property
    def observation_size(self) -> int:
        """Columns that the network sees."""
        return sum(width * length for width, length in zip(self.widths, self.lengths, strict=True))

    @property
    def columns(self) -> str:
        """What the network sees, in words."""
        terms = zip(self.cfg.observation, self.widths, self.lengths, strict=True)
        parts = [f"{term.name} {width}" + (f" x {n}" if n > 1 else "") for term, width, n in terms]
        return ", ".join(parts)

    @property
    def graph_safe(self) -> bool:
        """Whether it may be captured as a CUDA graph, its ``reset`` too."""
        plain = isinstance(self.network, torch.nn.Module) and not hasattr(self.network, "reset")
        return plain or getattr(self.network, "graph_safe", False)

    def _memory_of(self, count: int) -> _Memory:
        if count not in self._memories:
            sizes = ((1,), (self.num_actions,), (self.cfg.action_delay_steps, self.num_actions),
                     (max(self.lengths), sum(self.widths)))  # fmt: skip
            zeros = [torch.zeros((count, *size), device=self._device) for size in sizes]
            begins = torch.ones((count, 1, 1), dtype=torch.bool, device=self._device)
            self._memories[count] = _Memory._make([*zeros, begins])
        return self._memories[count]

    @torch.inference_mode()
    def reset(self, rows: torch.Tensor) -> None:
        """Begin an episode where ``rows``, bool, shape (num_envs,), is true."""
        memory = self._memory_of(len(rows))
        memory.begins.copy_(rows[:, None, None])
        for values in memory[:-1]:
            values.masked_fill_(rows.reshape(-1, *[1] * (values.ndim - 1)), 0.0)
        if hasattr(self.network, "reset"):
            self.network.reset(rows)

    @torch.inference_mode()
    def forward(self, row: torch.Tensor) -> torch.Tensor:
        """The robot's actions, shape (num_envs, num_joints)."""
        cfg, memory = self.cfg, self._memory_of(len(row))
        sensed = read_row(row, self.robot)
        now = torch.cat([self._column(term, sensed, memory) for term in cfg.observation], dim=1)
        if cfg.observation_clip is not None:
            now = now.clamp(-cfg.observation_clip, cfg.observation_clip)
        seen = self._with_history(now, memory)
        if hasattr(self.network, "reset"):
            output = self.network(seen)
        else:
            output = self.network(with_rows_of_zeros(seen))[: len(row)]
        memory.action.copy_(self._clipped(output))
        memory.steps.add_(1.0)
        memory.begins.zero_()
        queue = torch.cat([memory.action[:, None], memory.sent], dim=1)
        memory.sent.copy_(queue[:, :-1])
        return self._as_the_robots(queue[:, -1])

    def _column(self, term: Term, sensed: Sensed, memory: _Memory) -> torch.Tensor:
        value = term._read(sensed, self, memory)
        if term.clip is not None:
            ((lower, upper),) = _limits(term.clip, 1)
            value = value.clamp(lower, upper)
        return value * (self.constant(term.scale) if isinstance(term.scale, tuple) else term.scale)

    def _with_history(self, now: torch.Tensor, memory: _Memory) -> torch.Tensor:
        history = self.cfg.history
        if history is None:
            return now
        past = torch.cat([now[:, None], memory.past[:, :-1]], dim=1)
        if history.fill == "first":
            past = torch.where(memory.begins, now[:, None], past)
        memory.past.copy_(past)
        terms = [past] if history.by == "row" else past.split(self.widths, dim=2)
        lengths = self.lengths if history.by == "term" else self.lengths[:1]
        steps = [term[:, :length] for term, length in zip(terms, lengths, strict=True)]
        if history.newest == "last":
            steps = [term.flip(1) for term in steps]
        return torch.cat([term.flatten(1) for term in steps], dim=1)

    def _clipped(self, action: torch.Tensor) -> torch.Tensor:
        clip = self.cfg.action_clip
        if clip is None:
            return action
        lower, upper = (self.constant(limits) for limits in zip(*_limits(clip, self.num_actions), strict=True))
        return torch.clamp(action, lower, upper)

    def _as_the_robots(self, action: torch.Tensor) -> torch.Tensor:
        """Actions of all joints that make its targets; of the joints that it does not move they are 0."""
        cfg, robot, moved = self.cfg, self.robot, self.numbers(None)
        scale = self.constant(_each(cfg.action_scale, self.num_actions))
        target = self.constant(cfg.action_offset or self.pose_of(moved)) + scale * action
        own = (target - self.constant(tuple(robot.default_joint_pos[k] for k in moved))) / robot.action_scale
        actions = own.new_zeros(len(own), robot.num_joints)
        actions[:, self.index(moved)] = own
        return actions


def _each(value: float | tuple[float, ...], count: int) -> tuple[float, ...]:
    return value if isinstance(value, tuple) else (value,) * count


def _limits(clip: Any, count: int) -> Sequence[tuple[float, float]]:
    """Lower and upper limits of so many columns, by one size, one pair, one pair each or None."""
    if isinstance(clip, tuple):
        return clip if isinstance(clip[0], tuple) else [clip] * count
    return [(-math.inf, math.inf) if clip is None else (-clip, clip)] * count
