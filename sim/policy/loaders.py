"""Controllers as black boxes: a batch of observation rows to a batch of actions."""

import functools
import inspect
import multiprocessing
import os
import sys
import warnings
from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

import torch
import warp as wp

from sim.files.atomic import check_zip, read_json
from sim.files.records import robot_digest
from sim.policy.mlp import MlpPolicy
from sim.policy.runner import action_problem
from sim.policy.spec import ControllerSpec, find_named, in_one_line
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg

_FORMATS = (
    "an rsl_rl checkpoint (.pt), a TorchScript module (.pt, .ts), an ONNX file (.onnx), module:callable or "
    "file.py:callable (a function on device tensors, or a class or factory marked by `faultline_factory = True` that "
    "is called with (robot, device)), or module:adapter@file (a function that is called with (controller, robot))"
)


class Policy(Protocol):
    """Anything that maps observations to actions.

    One that remembers has a method ``reset(rows)``, called before every step with a bool tensor of shape (num_envs,):
    True where a robot begins a new episode. Robots begin at different times. One whose ``reset()`` takes no rows is
    called when all its robots begin together, which leaves robots idle that have ended.
    """

    def __call__(self, observation: torch.Tensor, /) -> torch.Tensor:
        """Actions, shape (num_envs, num_joints), of observation rows, shape (num_envs, observation_size)."""
        ...


def prepare_torch(device: str) -> None:
    """Let torch work on Warp's stream of ``device``, so that both see each other's results without waiting.

    On the CPU, torch gets one thread, as Warp has: batches are small, and a second thread only waits on a busy core.
    """
    if device.startswith("cuda"):
        torch.cuda.set_stream(wp.stream_to_torch(wp.get_stream(device)))
    else:
        torch.set_num_threads(1)


def reason_of(error: BaseException) -> str:
    """What went wrong, in one line; of a refused file without torch's advice to load it as code."""
    text = str(error).partition("WeightsUnpickler error: ")[2] or str(error)
    lines = [line.strip() for line in text.splitlines() if line.strip()] or [""]
    if lines[0].startswith("The following operation failed"):  # in TorchScript, whose own trace comes first
        return lines[-1]
    return f"{type(error).__name__}: {lines[0].partition('. Please')[0]}"


def read_weights(path: Path) -> Any:
    """What ``torch.save`` wrote: plain tensors and values, as data only, and compared with its checksums.

    It raises anything if the file is damaged, foreign, or holds code.
    """
    check_zip(path)
    return torch.load(path, map_location="cpu", weights_only=True)


def load_policy(spec: str | Path, robot: RobotCfg, device: str) -> Policy:
    """Load a controller and try it on one batch of zeros.

    Files are loaded as data only (``weights_only``; TorchScript and ONNX hold no Python) after a look at their
    checksums; code runs only from a module or Python file that is named. TorchScript and ONNX are read by C++, which a
    file made to harm can crash. A warning says if the training record beside a file names another robot.

    Args:
        spec: An rsl_rl checkpoint, a TorchScript file, an ONNX file, ``module:callable``, or ``module:adapter@file``;
            a Python file may stand for the module. An adapter is called with the file's controller, of whatever sizes,
            and the robot, and returns a policy.
        robot: The robot it is to walk: fixes observation and action size.
        device: Warp device name.
    """
    where = str(torch.device("cuda", wp.get_device(device).ordinal)) if device.startswith("cuda") else "cpu"
    if where != "cpu" and not torch.cuda.is_available():
        raise ValueError(
            f"device '{device}' asked for, but this torch ({torch.__version__}) has no CUDA: install a CUDA build or "
            "use --device cpu"
        )
    named = ControllerSpec.parse(spec)
    policy = _load_file(Path(spec), robot, where) if named.place is None else _load_code(named, robot, where)
    _try_policy(policy, robot, where, str(spec))
    if named.file is not None:
        _warn_if_trained_otherwise(Path(named.file), robot)
    return policy


def _warn_if_trained_otherwise(policy: Path, robot: RobotCfg) -> None:
    record = policy.with_suffix(".train.json")
    try:
        settings = read_json(record).get("settings")
    except (OSError, ValueError):  # no record, or a damaged one
        return
    trained = settings.get("robot_sha256") if isinstance(settings, dict) else None
    if trained is None or trained == robot_digest(robot):
        return
    now = robot_digest(get_robot(robot.spec))  # a command may have changed its time step or capacities by itself
    if trained != now and multiprocessing.parent_process() is None:  # a worker's parent warns
        _print_once(
            f"warning: {policy} was trained with a robot of other settings, model or meshes (SHA-256 {trained[:12]} in "
            f"{record.name}) than {robot.spec} has now ({now[:12]})"
        )


@functools.cache
def _print_once(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _load_code(spec: ControllerSpec, robot: RobotCfg, device: str) -> Any:
    assert spec.place is not None and spec.name is not None
    try:
        target: Any = find_named(spec.place, spec.name)
    except Exception as error:  # a module can fail with anything
        raise ValueError(f"policy '{spec}' cannot be imported: {in_one_line(error)}; expected {_FORMATS}") from error
    if not callable(target):
        raise ValueError(f"policy '{spec}' must be callable, got {type(target).__name__}; expected {_FORMATS}")
    if spec.file is not None:
        arguments = _load_file(Path(spec.file), robot, device, fits=False), robot
    elif getattr(target, "faultline_factory", False):
        arguments = robot, device
    elif inspect.isclass(target):
        raise ValueError(
            f"policy '{spec}' is a class: mark it by `faultline_factory = True` to be called with (robot, device)"
        )
    else:
        return target
    try:
        policy = target(*arguments)
    except Exception as error:
        called = "robot, device" if spec.file is None else "controller, robot"
        raise ValueError(f"policy '{spec}' failed, called with ({called}): {in_one_line(error)}") from error
    if not callable(policy):
        raise ValueError(f"policy '{spec}' must return a callable, got {type(policy).__name__}")
    return policy


def _load_file(path: Path, robot: RobotCfg, device: str, *, fits: bool = True) -> Policy:
    """The controller in a file; with ``fits`` it must have the robot's sizes."""
    if path == robot.policy_file and not path.exists():
        raise ValueError(
            f"robot '{robot.name}' has no shipped controller yet, expected at {path}: train one with "
            f"`{robot.train_command}`, or name another with --policy"
        )
    if not os.path.isfile(path):  # False too for a name that no file can have
        raise ValueError(f"policy '{path}': no such file; expected {_FORMATS}")
    if path.suffix == ".py":
        raise ValueError(f"policy '{path}' is a Python file: name what to call in it, {path}:CALLABLE")
    expected = (robot.observation_size, robot.num_joints)
    if path.suffix.lower() == ".onnx":
        from sim.policy.onnx import load_onnx  # onnxruntime takes long to load, and few controllers need it

        return load_onnx(path, expected if fits else None, device)
    try:
        check_zip(path)
    except ValueError as error:
        raise ValueError(f"policy '{path}' is damaged: {error}; put a copy of it back") from error
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # torch warns of TorchScript files
            content = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # a stream of pickle opcodes can fail with anything
        return _load_script(path, device, error)
    state = content.get("actor_state_dict") if isinstance(content, dict) else None
    if not isinstance(state, dict) or "mlp.0.weight" not in state:
        got = ", ".join(map(str, content)) if isinstance(content, dict) else type(content).__name__
        raise ValueError(
            f"policy '{path}' is no rsl_rl checkpoint: expected 'actor_state_dict' with 'mlp.0.weight', got {got}"
        )
    try:
        policy = MlpPolicy(state)
    except (KeyError, RuntimeError, AttributeError, TypeError, IndexError) as error:
        raise ValueError(f"policy '{path}' holds a damaged layer: {error}; save the checkpoint anew") from error
    if fits and policy.sizes != expected:
        raise ValueError(
            f"policy '{path}' maps {policy.sizes[0]} observations to {policy.sizes[1]} actions, but robot "
            f"'{robot.name}' has {expected[0]} observations and {expected[1]} joints: use a controller of this robot, "
            "or an adapter"
        )
    return policy.to(device).eval()


def _load_script(path: Path, device: str, reason: Exception) -> Policy:
    try:
        return torch.jit.load(str(path), map_location=device).eval()
    except Exception as error:
        raise ValueError(
            f"policy '{path}' is neither a checkpoint of plain tensors nor a TorchScript module (truncated, foreign, "
            f"or holding code): {reason_of(reason)}; expected {_FORMATS}"
        ) from error


def _try_policy(policy: Policy, robot: RobotCfg, device: str, spec: str) -> None:
    shape = (4, robot.observation_size)
    try:
        with torch.inference_mode():
            action = policy(torch.zeros(shape, device=device))
    except (Exception, SystemExit) as error:  # a controller can fail with anything
        reason = in_one_line(error) if ControllerSpec.parse(spec).runs_code else reason_of(error)
        raise ValueError(f"policy '{spec}' failed on rows of shape {shape} of '{robot.name}': {reason}") from error
    problem = action_problem(action, (4, robot.num_joints))
    if problem is not None:
        raise ValueError(f"policy '{spec}' must return {robot.num_joints} joints' actions for 4 robots, {problem}")
    if not torch.isfinite(action).all():
        raise ValueError(f"policy '{spec}' returned actions that are not finite for a zero observation: mend it first")


def load_checkpoint(spec: str | Path, robot: RobotCfg) -> MlpPolicy:
    """A robot's controller from an rsl_rl checkpoint, on the CPU, as ONNX can be written of it."""
    prepare_torch("cpu")
    policy = load_policy(spec, robot, "cpu")
    if not isinstance(policy, MlpPolicy):
        raise ValueError(f"policy '{spec}' must be an rsl_rl checkpoint (.pt), got {type(policy).__name__}")
    return policy


PolicySpec = str | Path | Callable[[torch.Tensor], torch.Tensor]
"""A controller as :func:`load_policy` takes it, or as a callable."""
