"""Terrain spaces by name: shipped ones, and code of a user that the command line names, tried before any long work."""

import inspect
import re
import shlex
from collections.abc import Callable, Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import ArrayLike, NDArray

from kernels.ground import PATCH, Ground, make_ground
from sim.controllers.spec import ControllerSpec, controller_hash, import_object, in_one_line
from sim.device import host_device
from sim.robots.find import fitting_space
from sim.robots.robot import RobotCfg
from sim.terrains.conditions.kinds import CONDITIONS, GROUPS, TASKS
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.spaces.base import MAX_HEIGHT, Seed, ShippedSpace, TerrainSpace, clipped
from sim.terrains.spaces.course import COURSE
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.spaces.wider import WiderSpace
from sim.terrains.terrains import GROUND_KINDS, check_map

SPACES: dict[str, ShippedSpace] = {SUPER_GAUSSIAN.name: SUPER_GAUSSIAN, COURSE.name: COURSE}
"""Every shipped space by its name."""


class UserSpace(TerrainSpace):
    """A user's space, ``file.py:Space`` or ``module:Space`` (docs/terrains.md); what its code returns is checked."""

    def __init__(self, spec: str, code: Any) -> None:
        self.name, self._code = spec, code
        self.sha256 = controller_hash(spec)
        self.num_genes = self._setting("num_genes", 0, lambda value: isinstance(value, int) and value > 0)
        self.sigma0 = float(self._setting("sigma0", self.sigma0, lambda value: 0.0 < value < np.inf))
        self.genes_per_part = self._setting(
            "genes_per_part", None, lambda value: value is None or (value > 0 and self.num_genes % value == 0)
        )
        self.ground = tuple(kind for kind in GROUND_KINDS if hasattr(code, kind))
        for name in ("rasterise", *(["without"] if hasattr(code, "parts") else [])):
            if not callable(getattr(code, name, None)):
                raise self._wrong(name, "must be a method, got none")

    def __reduce__(self) -> tuple[Any, tuple[str, str | None]]:
        """Pickles by name and hash: a process that unpickles it has loaded its code before."""
        return find_user_space, (self.name, self.sha256)

    def _setting(self, name: str, default: Any, allowed: Callable[[Any], bool]) -> Any:
        value = getattr(self._code, name, default)
        try:
            if allowed(value):
                return value
        except TypeError:  # no number
            pass
        raise self._wrong(name, f"cannot be {value!r}")

    def rasterise(self, genes: Any, spacing: float, heights_out: Any) -> None:
        """Turns genes into heights, as tensors on the device that the arrays are on."""
        self._fill("rasterise", genes, spacing, 0.0, heights_out)

    def lay_ground(self, genes: Any, ground_out: Ground) -> None:
        """Turns genes into maps, as tensors on the device that the arrays are on."""
        maps = {"friction": ground_out.friction, "softness": ground_out.time_constant}
        for kind in self.ground:
            self._fill(kind, genes, PATCH, 0.5, maps[kind])

    def _fill(self, method: str, genes: Any, step: float, first: float, values_out: Any) -> None:
        """Fills a Warp array (num_terrains, y, x) by a user's method, at x and y = ``step * (first + index)``."""
        rows, out = wp.to_torch(genes).clamp(-1.0, 1.0), wp.to_torch(values_out)
        stream: Any = None if rows.device.type == "cpu" else wp.stream_to_torch(wp.get_stream(genes.device))
        with torch.no_grad(), torch.cuda.stream(stream):
            axes = (step * (torch.arange(count, device=rows.device) + first) for count in out.shape[1:])
            y, x = torch.meshgrid(*axes, indexing="ij")
            returned = self._call(method, rows, x, y)
            try:
                values = torch.as_tensor(returned, dtype=torch.float32, device=rows.device)
            except (TypeError, ValueError, RuntimeError):
                raise self._wrong(method, f"must return a tensor, got {type(returned).__name__}") from None
            if values.shape != out.shape:
                expected = f"{tuple(out.shape)} (terrains, y, x)"
                raise self._wrong(method, f"must return shape {expected}, got {tuple(values.shape)}")
            if not bool(torch.isfinite(values).all()):
                raise self._wrong(method, "must return finite values, got NaN or infinity")
            if method in GROUND_KINDS:
                try:
                    check_map(method, values.cpu().numpy())
                except ValueError as error:
                    raise self._wrong(method, f"must return a map: {error}") from None
            out.copy_(values)

    def hard_random(self, count: int, seed: Seed) -> NDArray[np.float32]:
        """What the user's method draws, clipped; uniform genes if it has none."""
        if count < 1 or not hasattr(self._code, "hard_random"):
            return self.uniform_random(count, seed)
        genes = self._call_for_genes("hard_random", count, np.random.default_rng(seed))
        if len(genes) != count:
            raise self._wrong("hard_random", f"must return {count} rows of genes, got {len(genes)}")
        return genes

    def describe(self, genes: ArrayLike) -> str:
        """What the user's method says of a terrain; its parts, or its genes as numbers, if it has none."""
        row = clipped(genes)
        if hasattr(self._code, "describe"):
            return str(self._call("describe", row))
        return super().describe(row) or f"genes {', '.join(f'{gene:.2f}' for gene in row)}"

    def parts(self, genes: ArrayLike) -> tuple[str, ...]:
        """The parts that the user's method names; none if it has none."""
        return tuple(map(str, self._call("parts", clipped(genes)))) if hasattr(self._code, "parts") else ()

    def without(self, genes: ArrayLike, parts: Sequence[int]) -> NDArray[np.float32]:
        """Genes of the same terrains without some of their parts."""
        rows = self.validate(genes)
        if not len(parts):
            return rows
        if not hasattr(self._code, "parts"):
            raise self._wrong("parts", "is missing: terrains of this space have no parts to take away")
        return self._call_for_genes("without", clipped(rows), list(parts))

    def scaled(self, genes: ArrayLike, scale: float) -> NDArray[np.float32] | None:
        """What the user's method makes of genes; None if there is none."""
        if not hasattr(self._code, "scaled"):
            return None
        return self._call_for_genes("scaled", clipped(self.validate(genes)), scale)

    def _call_for_genes(self, method: str, *arguments: Any) -> NDArray[np.float32]:
        returned = self._call(method, *arguments)
        try:
            return clipped(self.validate(returned))
        except (TypeError, ValueError) as error:
            raise self._wrong(method, f"must return genes: {error}") from None

    def _call(self, method: str, *arguments: Any) -> Any:
        try:
            return getattr(self._code, method)(*arguments)
        except Exception as error:  # a user's code can fail with anything
            raise self._wrong(method, f"fails: {in_one_line(error)}") from error

    def _wrong(self, what: str, text: str) -> ValueError:
        return ValueError(f"space '{self.name}': {what} {text}: docs/terrains.md")


LOADED: list[UserSpace] = []
"""Spaces that this process was told to run, the latest first."""


def find_user_space(name: str, sha256: str | None) -> UserSpace:
    """A space that :func:`load_space` loaded, by the hash of its code if there is one."""
    for space in LOADED:
        if space.name == name if sha256 is None else space.sha256 == sha256:
            return space
    if name in (space.name for space in LOADED):
        raise ValueError(f"the code of the space {name} has changed since: put it back, or search anew")
    raise ValueError(f"the space {name} is code, which runs only if named: give --space {shlex.quote(name)}")


def split_name(name: str) -> tuple[str, tuple[str, ...]]:
    """The name of a space without its ground and conditions, and these: ``course+friction`` is of ``course``."""
    base, named = _name_kinds(name)
    return base, tuple(kind for kind in (*GROUND_KINDS, *CONDITIONS, *TASKS) if kind in named)


def _name_kinds(name: str) -> tuple[str, list[str]]:
    """The name of a space without its ground and conditions, and all of these that it names, a group by its members."""
    groups = {kind: (kind,) for kind in (*GROUND_KINDS, *CONDITIONS, *TASKS)} | GROUPS
    base, named = name, list[str]()
    while (split := base.rpartition("+"))[0] and split[2] in groups:
        base = split[0]
        named += groups[split[2]]
    return base, named


def is_user_space(name: str) -> bool:
    """Whether a space is a user's code."""
    base, _ = split_name(name)
    return base not in SPACES and ControllerSpec.parse(base).runs_code


def space_key(name: str, sha256: str | None) -> str:
    """What terrains depend on: the space's name, or the hash of its code if it has one, and its ground."""
    base, kinds = split_name(name)
    return "+".join((sha256 or base, *kinds))


def load_space(name: str | None) -> TerrainSpace:
    """A space that the command line names; a user's code is run, and :func:`get_space` finds it from then on.

    A name is a shipped space's, ``file.py:Space`` or ``module:Space``, a class without arguments, and behind it ground,
    conditions, groups of these and a task, as in ``course+friction+push``; None is the paper's. A user's space is tried
    on three terrains, and unless it has changed once.
    """
    base, kinds = split_name(name or SUPER_GAUSSIAN.name)
    once = "+".join((base, *kinds))
    if len(kinds) < len(_name_kinds(name or "")[1]):
        raise ValueError(f"a space must have each kind of ground and condition once, got {name}: give {once}")
    sha256 = controller_hash(base) if is_user_space(base) else None
    is_loaded = sha256 is not None and (base, sha256) in [(space.name, space.sha256) for space in LOADED]
    if is_user_space(base) and not is_loaded:
        parsed = ControllerSpec.parse(base)
        try:
            code: Any = import_object(str(parsed.module), str(parsed.name))
            code = code() if inspect.isclass(code) else code
        except Exception as error:  # a user's code can fail with anything
            raise ValueError(f"space '{base}' cannot be loaded: {in_one_line(error)}") from error
        space = UserSpace(base, code)
        hard = space.hard_random(2, 0)
        genes = np.concatenate([np.zeros((1, space.num_genes), np.float32), hard])
        with wp.ScopedDevice(host_device()):
            rows = wp.array(genes, dtype=float)
            space.rasterise(rows, SPACING, wp.zeros((len(genes), NUM_ROWS, NUM_COLS), dtype=float))
            space.lay_ground(rows, make_ground(len(genes), host_device()))
        space.without(hard, range(len(space.parts(hard[0]))))
        space.scaled(hard, 0.5)
        space.describe(hard[0])
        LOADED.insert(0, space)
    return get_space(once)


def get_space(name: str, sha256: str | None = None) -> TerrainSpace:
    """A space that a record names; no code runs that :func:`load_space` did not run.

    By the hash of its code in the record, code that has moved is found.
    """
    base, kinds = split_name(name)
    root, _, height = base.rpartition("@")
    space: TerrainSpace
    if root in SPACES and re.fullmatch(r"0?\.\d+", height):
        space = at_height(SPACES[root], float(height))
    elif base in SPACES:
        space = SPACES[base]
    elif is_user_space(base):
        space = find_user_space(base, sha256)
    else:
        kinds_text = ", ".join(f"+{kind}" for kind in (*GROUND_KINDS, *CONDITIONS, *TASKS, *GROUPS))
        expected = f"one of {', '.join(SPACES)}, or file.py:CLASS, and behind it some of {kinds_text}"
        raise ValueError(f"unknown terrain space '{name}': expected {expected}")
    ground = [kind for kind in kinds if kind in GROUND_KINDS]
    if ground and space.ground:
        raise ValueError(f"the space {base} has its ground already, got {name}: leave +{'+'.join(ground)} out")
    return WiderSpace(space, kinds) if kinds else space


def check_conditions(conditions: Sequence[str], robot: RobotCfg, terms: Collection[str] | None = None) -> None:
    """Refuses conditions of what a robot lacks or does not sense, or a controller with these ``terms`` does not see."""
    armed = [f"+{name}" for name in conditions if CONDITIONS[name].needs_arms]
    if armed and not robot.arm_joints:
        rule = f"robot '{robot.name}' must have arm_joints, on which {', '.join(armed)} act, got none"
        raise ValueError(f"{rule}: name them in its settings, or leave that out")
    observed = {name: CONDITIONS[name].observed for name in conditions if CONDITIONS[name].observed}
    senses = {"lin_vel", *(["scan"] if robot.scan_x and robot.scan_y else [])}
    for who, has in ((f"robot '{robot.name}'", senses), ("the controller", terms)):
        if has is not None and (blind := [name for name, term in observed.items() if term not in has]):
            wrong = ", ".join(f"+{name}" for name in blind)
            raise ValueError(f"{who} does not observe {observed[blind[0]]}, which {wrong} disturb: leave them out")


def space_at(space: TerrainSpace, height: float | None, robot: RobotCfg) -> TerrainSpace:
    """A space at a height [m], or, without one, at the height that fits the robot; prints it if it is another one."""
    if height is not None:
        return at_height(space, height)
    fits = MAX_HEIGHT * get_space(fitting_space(robot) or SUPER_GAUSSIAN.name).height_share
    if fits == MAX_HEIGHT or space.height_share != 1.0 or is_user_space(space.name):
        return space
    otherwise = f"(--height, or --space {SUPER_GAUSSIAN.name}@{MAX_HEIGHT:g}, says otherwise)"
    print(f"Heights up to {fits:g} m, as of the penalty scales of {robot.name} {otherwise}.")
    return at_height(space, fits)


def at_height(space: TerrainSpace, height: float) -> TerrainSpace:
    """A shipped space whose heights are those of a robot for which the highest bump is ``height`` [m]."""
    if isinstance(space, WiderSpace):
        return WiderSpace(at_height(space.inner, height), space.kinds)
    if not isinstance(space, ShippedSpace):
        raise ValueError(f"height is for shipped spaces, got {space.name}: a user's space has its own heights")
    if not 0.0 < height <= MAX_HEIGHT:
        raise ValueError(f"height must lie above 0 and at most at {MAX_HEIGHT:g} m, got {height:g}")
    return replace(space, height=height)
