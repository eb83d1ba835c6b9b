"""Controllers as black boxes: a batch of observation rows to a batch of actions."""

import functools
import inspect
import multiprocessing
import os
import re
import sys
import warnings
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Any

import torch
import warp as wp
import yaml

from sim.controllers.described import ControllerCfg, Described, read_controller
from sim.controllers.mlp import ACTIVATIONS, MlpPolicy, RnnPolicy
from sim.controllers.runner import Recurrent, action_problem, forget_all, with_rows_of_zeros
from sim.controllers.spec import ControllerSpec, agent_file, find_named, in_one_line, weights_file
from sim.files.atomic import check_zip, read_json
from sim.robots.find import get_robot
from sim.robots.identity import robot_digest
from sim.robots.robot import RobotCfg

_WEIGHTS = "an rsl_rl checkpoint (.pt), a TorchScript module (.pt, .ts), an ONNX file (.onnx)"
_FORMATS = (
    f"a description (.toml), {_WEIGHTS}, "
    "module:callable or file.py:callable (a function on device tensors, or a class or factory marked by "
    "`faultline_factory = True` that is called with (robot, device)), or module:adapter@file (a function that is "
    "called with (controller, robot))"
)
Policy = Callable[[torch.Tensor], torch.Tensor]
"""Actions, shape (num_envs, num_joints), of observation rows, shape (num_envs, observation_size).

One that remembers has a method ``reset``, of one of the kinds of :data:`sim.controllers.runner.Memory`.
"""
PolicySpec = str | Path | Policy
"""A controller as :func:`load_policy` takes it, or as a callable."""


def prepare_torch(device: str) -> None:
    """Let torch work on Warp's stream of ``device``, so that both see each other's results without waiting.

    On the CPU, torch gets one thread, as Warp has: batches are small, and a second thread only waits on a busy core.
    """
    if device.startswith("cuda"):
        torch.cuda.set_stream(wp.stream_to_torch(wp.get_stream(device)))
    else:
        torch.set_num_threads(1)


class _TorchMemory:
    """Memory of torch for Warp's arrays: it is given back in the order of its stream, and no other stream waits."""

    def allocate(self, size_in_bytes: int) -> int:
        return torch.cuda.caching_allocator_alloc(size_in_bytes)

    def deallocate(self, ptr: int, size_in_bytes: int) -> None:
        torch.cuda.caching_allocator_delete(ptr)


@contextmanager
def on_stream(stream: torch.cuda.Stream | None) -> Iterator[None]:
    """Let torch and Warp work on ``stream``; neither it nor the present one waits for the other.

    Warp's arrays that are made meanwhile must not be used afterwards. None changes nothing.
    """
    if stream is None:
        yield
        return
    on_warp = wp.stream_from_torch(stream)
    memory = wp.ScopedAllocator(on_warp.device, _TorchMemory())
    with torch.cuda.stream(stream), wp.ScopedStream(on_warp, sync_enter=False), memory:
        yield


def read_weights(path: Path) -> Any:
    """What ``torch.save`` wrote: plain tensors and values, as data only, and compared with its checksums.

    It raises a ValueError if the file is damaged, and anything if it is foreign or holds code.
    """
    check_zip(path)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # torch warns of TorchScript files
        return torch.load(path, map_location="cpu", weights_only=True)


def load_policy(spec: str | Path, robot: RobotCfg, device: str) -> Policy:
    """Loads a controller, as :class:`ControllerSpec` names it, and tries it on rows of the robot, on a Warp device.

    Files are loaded as data only (``weights_only``; TorchScript and ONNX hold no Python) after a look at their
    checksums; code runs only from a module or Python file that is named. TorchScript and ONNX are read by C++, which a
    file made to harm can crash. A warning says if the training record beside a file names another robot.
    """
    where = str(torch.device("cuda", wp.get_device(device).ordinal)) if device.startswith("cuda") else "cpu"
    if where != "cpu" and not torch.cuda.is_available():
        raise ValueError(f"torch {torch.__version__} has no CUDA: install a build with CUDA, or use --device cpu")
    named = ControllerSpec.parse(spec)
    policy = _load_file(Path(spec), robot, where) if named.place is None else _load_code(named, robot, where)
    _try_rows(policy, (robot.observation_size, robot.num_joints), where, str(spec), f"robot '{robot.name}'")
    if named.place is None and not _answers_rows_apart(policy, robot.observation_size, where):
        raise ValueError(
            f"policy '{spec}' answers the row of a robot that begins differently, or fails, beside other rows or after "
            "other steps: it mixes rows, draws at random, or remembers what no reset forgets: export it without that"
        )
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
    try:
        target: Any = find_named(str(spec.place), str(spec.name))
    except Exception as error:  # a module can fail with anything
        raise ValueError(f"policy '{spec}' cannot be imported: {in_one_line(error)}; expected {_FORMATS}") from error
    if not callable(target):
        raise ValueError(f"policy '{spec}' must be callable, got {type(target).__name__}; expected {_FORMATS}")
    called, arguments = "robot, device", (robot, device)
    if spec.file is not None:
        called, arguments = "controller, robot", (_load_file(Path(spec.file), robot, device, fits=False), robot)
    elif not getattr(target, "faultline_factory", False):
        if inspect.isclass(target):
            raise ValueError(f"policy '{spec}' is a class: mark it by `faultline_factory = True`; expected {_FORMATS}")
        return target
    try:
        policy = target(*arguments)
    except Exception as error:
        raise ValueError(f"policy '{spec}' failed, called with ({called}): {in_one_line(error)}") from error
    if not callable(policy):
        raise ValueError(f"policy '{spec}' must return a callable, got {type(policy).__name__}")
    return policy


def _load_file(path: Path, robot: RobotCfg, device: str, *, fits: bool = True) -> Policy:
    """The controller in a file; with ``fits`` it must have the robot's sizes."""
    if path == robot.policy_file and not path.exists():
        remedy = f"train one with `{robot.train_command}`, or name another with --policy"
        raise ValueError(f"robot '{robot.name}' has no controller of its own, expected at {path}: {remedy}")
    if not os.path.isfile(path):  # False too for a name that no file can have
        raise ValueError(f"policy '{path}': no such file; expected {_FORMATS}")
    if path.suffix == ".py":
        raise ValueError(f"policy '{path}' is a Python file: name what to call in it, {path}:CALLABLE")
    if path.suffix == ".toml":
        return load_described(read_controller(path), weights_file(path), robot, device, path)
    sizes = (robot.observation_size, robot.num_joints) if fits else None
    return load_network(path, device, sizes, of=f"robot '{robot.name}'")


def load_described(cfg: ControllerCfg, weights: Path | None, robot: RobotCfg, device: str, path: Path) -> Described:
    """The controller of a description, which is called ``path`` in errors, with the network of a file."""
    policy = Described(cfg, robot, str(path))
    sizes = policy.observation_size, policy.num_actions
    if weights is None or not os.path.isfile(weights):
        raise ValueError(f"{path}: policy must name a file of weights beside it, got {cfg.policy!r}: put it there")
    of = f"{path} ({policy.columns})"
    network = load_network(weights, device, sizes, of=of, activation=cfg.activation)
    if cfg.activation is not None and not isinstance(network, MlpPolicy | RnnPolicy):
        raise ValueError(f"{path}: activation is of an rsl_rl checkpoint; {weights.name} says its own: leave it out")
    _try_rows(network, sizes, device, str(weights), of)
    policy.use(network, torch.device(device))
    return policy


def load_network(
    path: Path, device: str, sizes: tuple[int, int] | None, *, of: str, activation: str | None = None
) -> Policy:
    """The network of a checkpoint, TorchScript or ONNX file, with a ``reset(rows)`` if it remembers.

    ``sizes`` are the columns that it must take and the actions that it must return, and errors say ``of`` whom; None
    takes what the file has, a TorchScript module as it is. The ``activation`` is that between the layers of a
    checkpoint; None takes what its file or its training says.
    """
    if path.suffix.lower() == ".onnx":
        from sim.controllers.onnx import load_onnx  # onnxruntime takes long to load, and few controllers need it

        return load_onnx(path, sizes, device)
    try:
        content = read_weights(path)
    except ValueError as error:
        raise ValueError(f"policy '{path}' is damaged: {error}; put a copy of it back") from error
    except Exception as error:  # a stream of pickle opcodes can fail with anything
        return _load_script(path, device, sizes, error)
    state = _actor_state(content, path)
    kind = RnnPolicy if any(key.startswith("rnn.") for key in state) else MlpPolicy
    activation = activation or _activation_of(content, path)
    try:
        policy = kind(state, activation)
        got = policy.sizes
    except (KeyError, RuntimeError, AttributeError, TypeError, IndexError, ValueError, ZeroDivisionError) as error:
        raise ValueError(f"policy '{path}' holds a damaged layer: {error}; save the checkpoint anew") from error
    if sizes is not None and got != sizes:
        raise ValueError(
            f"policy '{path}' maps {got[0]} observations to {got[1]} actions, but {of} has {sizes[0]} observations "
            f"and {sizes[1]} joints: give one that fits, or describe it (docs/controllers.md)"
        )
    return policy.to(device).eval()


_TODAYS = {"actor.": "mlp.", "memory_a.rnn.": "rnn.rnn.", "actor_obs_normalizer.": "obs_normalizer."}
"""Names of rsl_rl 5 for what rsl_rl 1 to 4 keep of an actor."""
_KNOWN = (
    r"mlp\.\d+\.(weight|bias)|rnn\.rnn\.\w+|obs_normalizer\.(_mean|_var|_std|count)|"
    r"distribution\.(log_)?std_param|(log_)?std|critic.*|memory_c\.rnn\.\w+"
)


def _actor_state(content: Any, path: Path) -> dict[str, torch.Tensor]:
    """The actor's tensors by rsl_rl 5's names."""
    forms = ("actor_state_dict", "model_state_dict")
    state = next((content[form] for form in forms if isinstance(content, dict) and form in content), None)
    names = {
        key: next((new + key.removeprefix(old) for old, new in _TODAYS.items() if key.startswith(old)), key)
        for key in (map(str, state) if isinstance(state, dict) else ())
    }
    if not isinstance(state, dict) or "mlp.0.weight" not in names.values():
        got = ", ".join(map(str, state or content)) if isinstance(content, dict) else type(content).__name__
        raise ValueError(
            f"policy '{path}' is no rsl_rl checkpoint: expected 'actor_state_dict' with 'mlp.0.weight', or "
            f"'model_state_dict' with 'actor.0.weight', got {got}"
        )
    beside = content.get("obs_norm_state_dict") or {}
    if not isinstance(beside, dict):
        raise ValueError(f"policy '{path}': obs_norm_state_dict must be a table, got {type(beside).__name__}")
    normaliser = {f"obs_normalizer.{key}": value for key, value in beside.items()}
    names |= {key: key for key in normaliser}
    if unknown := [key for key, name in names.items() if not re.fullmatch(_KNOWN, name)]:
        what = f"has more than a perceptron or a recurrent network: {', '.join(unknown)}"
        raise ValueError(f"policy '{path}' {what}: export it as TorchScript or ONNX")
    parts = {name.partition(".")[2] for name in names.values() if name.startswith("obs_normalizer.")}
    if parts and not {"_mean", "_std"} <= parts:
        raise ValueError(f"policy '{path}' must have _mean and _std of its normaliser, got {', '.join(sorted(parts))}")
    return {names[key]: value for key, value in state.items()} | normaliser


def _activation_of(content: dict[str, Any], path: Path) -> str:
    """What is between a checkpoint's layers, by its file or by the agent.yaml of its training."""
    own = str(content.get("format", "")).startswith("faultline") or (
        "iter" in content and content.keys() <= {"actor_state_dict", "iter", "trained_on"}
    )
    said, agent = content.get("activation", "elu" if own else None), agent_file(path)
    if said is None and agent is not None:
        said = activation_in(read_yaml(agent))
    if said is None:
        raise ValueError(
            f"policy '{path}' does not say what is between its layers: put the agent.yaml of its training "
            'beside it, or describe it with activation = "elu", or another, in a controller.toml (docs/controllers.md)'
        )
    if not isinstance(said, str) or said not in ACTIVATIONS:
        raise ValueError(f"policy '{path}': activation must be one of {', '.join(ACTIVATIONS)}, got {said}")
    return said


def activation_in(agent: dict[str, Any]) -> Any:
    """What an agent.yaml says to be between the actor's layers; None if it does not say it."""
    parts = [part for name in ("actor", "policy") if isinstance(part := agent.get(name), dict)]
    return next((part["activation"] for part in parts if "activation" in part), None)


class _PlainYaml(yaml.SafeLoader):
    """Data alone: of what Python would make by a tag, lists, tables and texts remain."""


def _without_tag(loader: Any, suffix: str, node: yaml.Node) -> Any:
    if isinstance(node, yaml.SequenceNode):
        return loader.construct_sequence(node, deep=True)
    if isinstance(node, yaml.MappingNode):
        return loader.construct_mapping(node, deep=True)
    return loader.construct_scalar(node) or suffix.partition(":")[2]


_PlainYaml.add_multi_constructor("tag:yaml.org,2002:python/", _without_tag)


def read_yaml(file: Path) -> dict[str, Any]:
    """Names and values of a YAML, as data alone; an error names the file."""
    try:
        content = yaml.load(file.read_text(encoding="utf-8"), _PlainYaml)
    except (OSError, ValueError, RecursionError, yaml.YAMLError) as error:
        raise ValueError(f"{file} cannot be read as YAML: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{file} must hold names with values, got {type(content).__name__}")
    return content


class _Script(torch.nn.Module):
    """A TorchScript module without memory, whatever ``reset()`` its exporter gave it."""

    def __init__(self, module: Any) -> None:
        super().__init__()
        self.module = module

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        return self.module(with_rows_of_zeros(rows))[: len(rows)]


class _RecurrentScript(Recurrent):
    """A TorchScript module that remembers one robot in its buffers, with a row of them for each robot."""

    def __init__(self, module: Any, initial: Mapping[str, torch.Tensor], axis: int) -> None:
        super().__init__([*initial.values()], axis)
        self.module = module
        self._places = [name.split(".") for name in initial]

    def step(self, rows: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        owners = [functools.reduce(getattr, place[:-1], self.module) for place in self._places]
        for owner, place, value in zip(owners, self._places, state, strict=True):
            setattr(owner, place[-1], value)
        action = self.module(rows)
        return action, [getattr(owner, place[-1]) for owner, place in zip(owners, self._places, strict=True)]


def _load_script(path: Path, device: str, sizes: tuple[int, int] | None, reason: Exception) -> Policy:
    try:
        module, probe = (torch.jit.load(str(path), map_location=place).eval() for place in (device, "cpu"))
    except Exception as error:
        raise ValueError(
            f"policy '{path}' is neither a checkpoint of plain tensors nor a TorchScript module (truncated, foreign, "
            f"or holding code): {in_one_line(reason)}; expected {_WEIGHTS}"
        ) from error
    return module if sizes is None else _by_robot(module, probe, path, sizes[0], device)


@torch.no_grad()
def _by_robot(module: Any, probe: Any, path: Path, width: int, device: str) -> Policy:
    """A module that remembers each robot in rows of the buffers that a call of its copy on the CPU changes."""
    rows = torch.randn((3, 3, width), generator=torch.Generator().manual_seed(0))  # steps, robots
    begin = next((getattr(probe, name) for name in ("reset", "reset_memory") if hasattr(probe, name)), None)
    if begin is not None:
        begin()
    before = {name: value.clone() for name, value in probe.named_buffers()}
    try:
        once, again = (probe(rows[0, :1]) for _ in range(2))
    except Exception:  # of another width, or nothing to call: it is tried afterwards
        return _Script(module)
    if not isinstance(once, torch.Tensor):  # so is what it returns
        return _Script(module)
    initial = {name: before[name] for name, value in probe.named_buffers() if not torch.equal(before[name], value)}
    if not initial:
        return _Script(module) if begin is None or torch.equal(once, again) else module  # it remembers elsewhere
    apart = []
    for robot in range(rows.shape[1]):
        for name, value in probe.named_buffers():
            value.copy_(before[name])
        apart.append(torch.cat([probe(step[robot : robot + 1]) for step in rows]))
    for axis in (1, 0):  # along which rows act as one robot after the other does
        if all(value.ndim > axis and value.shape[axis] == 1 for value in initial.values()):
            free = _RecurrentScript(probe, initial, axis)
            try:
                together = torch.stack([free(step) for step in rows], dim=1)
            except (RuntimeError, torch.jit.Error):
                continue
            if torch.allclose(together, torch.stack(apart), rtol=1e-4, atol=1e-4):
                return _RecurrentScript(module, initial, axis).to(device)
    where = ", ".join(initial)
    raise ValueError(f"policy '{path}' remembers one robot alone, in {where}: give the checkpoint of which it was made")


def _try_rows(policy: Any, sizes: tuple[int, int], device: str, spec: str, of: str) -> None:
    """Asks a controller for actions of four robots that begin, of these observation and action sizes."""
    shape = (4, sizes[0])
    try:
        with torch.inference_mode():
            forget_all(policy, 4, device)
            action = policy(torch.zeros(shape, device=device))
    except (Exception, SystemExit) as error:  # a controller can fail with anything
        width, _ = widths(policy) if isinstance(policy, torch.nn.Module) else (None, None)
        if width not in (None, sizes[0]):
            what = f"takes {width} columns, {of} gives {sizes[0]}"
            raise ValueError(f"policy '{spec}' {what}: describe those that it takes (docs/controllers.md)") from error
        raise ValueError(f"policy '{spec}' failed on rows of shape {shape} of {of}: {in_one_line(error)}") from error
    problem = action_problem(action, (4, sizes[1]))
    if problem is not None:
        raise ValueError(f"policy '{spec}' must return {sizes[1]} joints' actions for 4 robots, {problem}")
    if not torch.isfinite(action).all():
        raise ValueError(f"policy '{spec}' returned actions that are not finite for a zero observation: mend it first")


def widths(network: Any) -> tuple[int | None, int | None]:
    """Columns and actions of a network, as far as it says them."""
    if hasattr(network, "sizes"):
        return network.sizes
    for weight in network.parameters():
        with suppress(Exception):  # of an inner layer
            return weight.shape[1], network(torch.zeros(1, weight.shape[1], device=weight.device)).shape[1]
    return None, None


@torch.inference_mode()
def _answers_rows_apart(policy: Any, width: int, device: str) -> bool:
    """Whether a robot that begins is answered alike beside any others, whatever came before."""
    generator, answers = torch.Generator().manual_seed(0), list[torch.Tensor]()
    row = 3.0 * torch.randn(width, generator=generator)
    for count in (3, 40):
        steps = 3.0 * torch.randn((12, count, width), generator=generator)
        steps[0, 1] = row  # between the others: sums from either side differ
        try:
            forget_all(policy, count, device)
            actions = [policy(step.to(device))[1].clone() for step in steps]
        except Exception:  # a controller can fail with anything
            return False
        answers.append(actions[0])
    return torch.allclose(*answers, rtol=1e-3, atol=1e-3, equal_nan=True)


def load_actor(spec: str | Path, robot: RobotCfg) -> MlpPolicy:
    """A robot's controller from an rsl_rl checkpoint, on the CPU, as ONNX can be written of it."""
    prepare_torch("cpu")
    policy = load_policy(spec, robot, "cpu")
    if not isinstance(policy, MlpPolicy):
        raise ValueError(f"policy '{spec}' must be an rsl_rl checkpoint (.pt), got {type(policy).__name__}")
    return policy
