"""Controllers as black boxes: a batch of observation rows to a batch of actions."""

import functools
import inspect
import multiprocessing
import os
import sys
import warnings
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
import warp as wp

from sim.controllers.described import ControllerCfg, Described, read_controller
from sim.controllers.formats.network import Encoded, Policy, find_widths, load_network
from sim.controllers.formats.rsl_rl import MlpPolicy, RnnPolicy
from sim.controllers.runner import action_problem, reset_all
from sim.controllers.spec import ControllerSpec, import_object, in_one_line, weights_file
from sim.files.atomic import read_json
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg, robot_digest

_EXPECTED = "expected a .toml, .pt, .ts or .onnx file, module:callable or module:adapter@file (docs/controllers.md)"
PolicySpec = str | Path | Policy  # a controller as :func:`load_policy` takes it, or as a callable
_print_once = functools.cache(print)


def prepare_torch(device: str) -> None:
    """Let torch work on Warp's stream of ``device``, so that both see each other's results without waiting.

    On CUDA it takes algorithms that repeat, and multiplies in TF32: networks learned under more noise than it adds.
    """
    if device.startswith("cuda"):
        torch.backends.cudnn.deterministic = True
        torch.set_float32_matmul_precision("high")
        torch.cuda.set_stream(wp.stream_to_torch(wp.get_stream(device)))
    else:
        torch.set_num_threads(1)  # as Warp has: batches are small, and a second thread only waits on a busy core


class _TorchMemory:
    """Memory of torch for Warp's arrays: it is given back in the order of its stream, and no other stream waits."""

    def allocate(self, size_in_bytes: int) -> int:
        return torch.cuda.caching_allocator_alloc(size_in_bytes)

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        torch.cuda.caching_allocator_delete(ptr)


@contextmanager
def on_stream(stream: torch.cuda.Stream | None) -> Iterator[None]:
    """Let torch and Warp work on ``stream``, if any, without waiting; Warp's arrays of that time are not for later."""
    if stream is None:
        yield
    else:
        on_warp = wp.stream_from_torch(stream)
        memory = wp.ScopedAllocator(on_warp.device, _TorchMemory())
        with torch.cuda.stream(stream), wp.ScopedStream(on_warp, sync_enter=False), memory:
            yield


def load_policy(spec: str | Path, robot: RobotCfg, device: str) -> Policy:
    """Loads a controller, as :class:`ControllerSpec` names it, and tries it on rows of the robot, on a Warp device.

    Files are loaded as data only; code runs only from a module or Python file that is named.
    """
    device = str(torch.device("cuda", wp.get_device(device).ordinal)) if device.startswith("cuda") else "cpu"
    if device != "cpu" and not torch.cuda.is_available():
        raise ValueError(f"torch {torch.__version__} has no CUDA: install a build with CUDA, or use --device cpu")
    named = ControllerSpec.parse(spec)
    policy = _load_file(Path(spec), robot, device) if named.module is None else _load_code(named, robot, device)
    _try_rows(policy, (robot.observation_size, robot.num_joints), device, str(spec), f"robot '{robot.name}'")
    if named.module is None and not _separates_rows(policy, robot.observation_size, device):
        what = "fails, or acts differently in an episode's first step, beside other rows or after other steps"
        raise ValueError(f"policy '{spec}' {what}: export it without batches, chance or memory across a reset")
    if named.file is not None and multiprocessing.parent_process() is None:  # a worker's parent warns
        _warn_if_trained_otherwise(Path(named.file), robot)
    return policy


def _warn_if_trained_otherwise(policy: Path, robot: RobotCfg) -> None:
    record = policy.with_suffix(".train.json")
    try:
        trained = read_json(record)["settings"]["robot_sha256"]
    except (OSError, ValueError, LookupError, TypeError):  # no record, or a damaged one
        return
    if trained in (None, robot_digest(robot)):
        return
    now = robot_digest(get_robot(robot.spec))  # a command may have changed its time step or capacities by itself
    if trained != now:
        what = f"a robot of other settings, model or meshes (SHA-256 {trained[:12]} in {record.name})"
        line = f"warning: {policy} was trained with {what} than {robot.spec} has now ({now[:12]})"
        _print_once(line, file=sys.stderr, flush=True)


def _load_code(spec: ControllerSpec, robot: RobotCfg, device: str) -> Any:
    try:
        target: Any = import_object(str(spec.module), str(spec.name))
    except Exception as error:  # a module can fail with anything
        raise ValueError(f"policy '{spec}' cannot be imported: {in_one_line(error)}; {_EXPECTED}") from error
    if not callable(target):
        raise ValueError(f"policy '{spec}' must be callable, got {type(target).__name__}; {_EXPECTED}")
    if spec.file is not None:
        arguments = {"controller": _load_file(Path(spec.file), robot, device, fits=False), "robot": robot}
    elif getattr(target, "faultline_factory", False):
        arguments = {"robot": robot, "device": device}
    elif inspect.isclass(target):
        raise ValueError(f"policy '{spec}' is a class: mark it by `faultline_factory = True`; {_EXPECTED}")
    else:
        return target
    try:
        policy = target(*arguments.values())
    except Exception as error:
        raise ValueError(f"policy '{spec}' failed on ({', '.join(arguments)}): {in_one_line(error)}") from error
    if not callable(policy):
        raise ValueError(f"policy '{spec}' must return a callable, got {type(policy).__name__}")
    return policy


def _load_file(path: Path, robot: RobotCfg, device: str, *, fits: bool = True) -> Policy:
    """The controller in a file; with ``fits`` it must have the robot's sizes."""
    if path == robot.policy_file and not path.exists():
        remedy = f"train one with `{robot.train_command}`, or name another with --policy"
        raise ValueError(f"robot '{robot.name}' has no controller of its own, expected at {path}: {remedy}")
    if not os.path.isfile(path):  # False too for a name that no file can have
        raise ValueError(f"policy '{path}': no such file; {_EXPECTED}")
    if path.suffix == ".py":
        raise ValueError(f"policy '{path}' is a Python file: name what to call in it, {path}:CALLABLE")
    if path.suffix == ".toml":
        return load_described(read_controller(path), weights_file(path), robot, device, path)
    sizes = (robot.observation_size, robot.num_joints) if fits else None
    return load_network(path, device, sizes, label=f"robot '{robot.name}'")


def load_described(cfg: ControllerCfg, weights: Path | None, robot: RobotCfg, device: str, path: Path) -> Described:
    """The controller of a description, which is called ``path`` in errors, with the network of a file."""
    policy = Described(cfg, robot, str(path))
    sizes = policy.observation_size, policy.num_actions
    if weights is None or not os.path.isfile(weights):
        raise ValueError(f"{path}: policy must name a file of weights beside it, got {cfg.policy!r}: put it there")
    label = f"{path} ({policy.columns})"
    load = functools.partial(load_network, device=device, label=label, activation=cfg.activation)
    network: Any = load(weights, sizes=sizes) if cfg.encoder is None else _load_encoded(policy, weights, path, load)
    if cfg.activation is not None and not isinstance(network, MlpPolicy | RnnPolicy | Encoded):
        raise ValueError(f"{path}: activation is of an rsl_rl checkpoint; {weights.name} says its own: leave it out")
    _try_rows(network, sizes, device, str(weights), label)
    rows = torch.randn((64, sizes[0]), generator=torch.Generator().manual_seed(0)).to(device)
    with torch.inference_mode():
        reset_all(network, len(rows), device)
        still = torch.eq(*network(rows).aminmax(dim=0)).tolist()
    if joints := [joint for joint, is_still in zip(cfg.joints or robot.joint_names, still, strict=True) if is_still]:
        warnings.warn(f"policy '{weights}' never moves {', '.join(joints)}", stacklevel=2)
    policy.use(network, torch.device(device))
    return policy


def _load_encoded(policy: Described, weights: Path, path: Path, load: functools.partial[Any]) -> Encoded:
    """The networks of two files; the policy sees the whole observation, or that of the present step."""
    if (encoder := weights_file(path, "encoder")) is None or not os.path.isfile(encoder):
        raise ValueError(f"{path}: encoder must name a file of weights beside it, got {policy.cfg.encoder!r}")
    size, history = policy.observation_size, policy.cfg.history
    sizes = {size, sum(policy.widths) if history is not None and history.by == "row" else size}
    width, count = find_widths(load(weights, sizes=None))[0], find_widths(load(encoder, sizes=None))[1]
    seen = (width or 0) - (count or 0)
    if not count or seen not in sizes:
        what = f"encoder returns {count} columns and {weights.name} takes {width}"
        raise ValueError(f"{path}: {what}: beside them it must see {' or '.join(map(str, sizes))} of the observation")
    start = size - seen if history is not None and history.newest == "last" else 0
    networks = load(weights, sizes=(width, policy.num_actions)), load(encoder, sizes=(size, count))
    return Encoded(*networks, slice(start, start + seen), policy.cfg.encoder_first)


@torch.inference_mode()
def _try_rows(policy: Any, sizes: tuple[int, int], device: str, spec: str, label: str) -> None:
    """Tries a controller of these observation and action sizes on four robots that begin an episode."""
    try:
        reset_all(policy, 4, device)
        action = policy(torch.zeros((4, sizes[0]), device=device))
    except (Exception, SystemExit) as error:  # a controller can fail with anything
        width = find_widths(policy)[0] if isinstance(policy, torch.nn.Module) else None
        why = f"failed on rows of shape {(4, sizes[0])} of {label}: {in_one_line(error)}"
        if width not in (None, sizes[0]):
            why = f"takes {width} columns, {label} gives {sizes[0]}: describe those that it takes (docs/controllers.md)"
        raise ValueError(f"policy '{spec}' {why}") from error
    if problem := action_problem(action, (4, sizes[1])):
        raise ValueError(f"policy '{spec}' must return {sizes[1]} joints' actions for 4 robots, {problem}")
    if not torch.isfinite(action).all():
        raise ValueError(f"policy '{spec}' returned actions that are not finite for a zero observation: mend it first")


@contextmanager
def _in_full_precision() -> Iterator[None]:
    """Lets matrices be multiplied in float32: TF32 may round a row otherwise beside fewer others."""
    before = torch.get_float32_matmul_precision()
    torch.set_float32_matmul_precision("highest")
    try:
        yield
    finally:
        torch.set_float32_matmul_precision(before)


@torch.inference_mode()
@_in_full_precision()
def _separates_rows(policy: Any, width: int, device: str) -> bool:
    """Whether a robot that begins an episode gets the same action beside any others, whatever steps came before."""
    first_actions, generator = [], torch.Generator().manual_seed(0)
    row = 3.0 * torch.randn(width, generator=generator)
    for count in (3, 40):
        steps = 3.0 * torch.randn((12, count, width), generator=generator)
        steps[0, 1] = row  # between the others: sums from either side differ
        try:
            reset_all(policy, count, device)
            actions = [policy(step.to(device))[1].clone() for step in steps]
        except Exception:  # a controller can fail with anything
            return False
        first_actions.append(actions[0])
    return torch.allclose(*first_actions, rtol=1e-3, atol=1e-3, equal_nan=True)


def load_actor(spec: str | Path, robot: RobotCfg) -> MlpPolicy:
    """A robot's controller from an rsl_rl checkpoint, on the CPU, as ONNX can be written of it."""
    prepare_torch("cpu")
    policy = load_policy(spec, robot, "cpu")
    if not isinstance(policy, MlpPolicy):
        raise ValueError(f"policy '{spec}' must be an rsl_rl checkpoint (.pt), got {type(policy).__name__}")
    return policy
