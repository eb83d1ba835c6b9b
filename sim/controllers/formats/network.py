"""The network of a file: an rsl_rl checkpoint, a TorchScript module, or ONNX."""

import functools
import re
import warnings
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from sim.controllers.formats.rsl_rl import make_actor, read_weights
from sim.controllers.runner import Recurrent, is_graph_safe, with_rows_of_zeros
from sim.controllers.spec import in_one_line

Policy = Callable[[torch.Tensor], torch.Tensor]
"""Actions (num_envs, num_joints) of observation rows (num_envs, observation_size); with ``reset`` if it remembers."""


def load_network(
    path: Path, device: str, sizes: tuple[int, int] | None, *, label: str, activation: str | None = None
) -> Policy:
    """The network of a checkpoint, TorchScript or ONNX file, with a ``reset(rows)`` if it remembers.

    ``sizes`` are the columns and actions that it must have, those of ``label``; None takes the file's and a
    TorchScript module as it is. ``activation`` is that of a checkpoint; None takes its file's or training's.
    """
    if path.suffix.lower() == ".onnx":
        from sim.controllers.formats.onnx import load_onnx  # onnxruntime takes long to load, and few files need it

        return load_onnx(path, sizes, device)
    try:
        content = read_weights(path)
    except ValueError as error:
        raise ValueError(f"policy '{path}' is damaged: {error}; put a copy of it back") from error
    except Exception as error:  # a stream of pickle opcodes can fail with anything
        try:
            module, probe = (load_script(path, target) for target in (device, "cpu"))
        except ValueError:
            raise
        except Exception as foreign:
            must = "must be an rsl_rl checkpoint of plain tensors, TorchScript, or ONNX that ends in .onnx"
            raise ValueError(f"policy '{path}' {must}: {in_one_line(error)}") from foreign
        return module if sizes is None else _separate_robots(module, probe, path, sizes[0], device)
    policy = make_actor(content, path, activation)
    if sizes is not None and policy.sizes != sizes:
        (seen, moved), (width, count) = policy.sizes, sizes
        must = f"{label} has {width} observations and {count} joints: describe it (docs/controllers.md)"
        raise ValueError(f"policy '{path}' maps {seen} observations to {moved} actions, but {must}")
    return policy.to(device).eval()


def load_script(path: Path, device: str) -> Any:
    """A TorchScript module; one whose code reads or writes files is a ValueError, since it may run on loading."""
    with zipfile.ZipFile(path) as archive:
        code = b"".join(archive.read(name) for name in archive.namelist() if name.endswith(".py"))
    if command := re.search(rb"\bfrom_file\b|\b(torch|aten)\.save\b", code):
        raise ValueError(f"policy '{path}' must be a network alone, but calls {command[0].decode()}: do not trust it")
    return torch.jit.load(str(path), map_location=device).eval()


def find_widths(network: Any) -> tuple[int | None, int | None]:
    """Columns and actions of a network, as far as it has or shows them."""
    if hasattr(network, "sizes"):
        return network.sizes
    for weight in network.parameters():
        with suppress(Exception):  # of an inner layer
            rows = torch.zeros(1, weight.shape[1], device=weight.device)
            return rows.shape[1], _take_actions(network(rows)).shape[1]
    return None, None


class Encoded(torch.nn.Module):
    """A policy of some columns of the observation, and of what an encoder makes of them all."""

    def __init__(self, policy: Any, encoder: Any, columns: slice, encoder_first: bool) -> None:
        super().__init__()
        self._networks = policy, encoder
        self._columns = columns
        self._order = -1 if encoder_first else 1
        self.graph_safe = is_graph_safe(policy) and is_graph_safe(encoder)

    def reset(self, rows: torch.Tensor) -> None:
        """Begin anew where ``rows``, bool, shape (num_envs,), is true."""
        for network in self._networks:
            if hasattr(network, "reset"):
                network.reset(rows)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        """Actions, shape (num_envs, num_joints)."""
        policy, encoder = self._networks
        return policy(torch.cat([rows[:, self._columns], encoder(rows)][:: self._order], dim=1))


def _take_actions(output: Any) -> Any:
    """The actions, which come first where a module returns more."""
    return output[0] if isinstance(output, tuple) else output


def _read_tensors(module: Any) -> dict[str, torch.Tensor]:
    """Buffers of a module, and other tensors that its code names."""
    tensors = dict(module.named_buffers())
    for prefix, inner in module.named_modules():
        for name in re.findall(r"\bself\.(\w+)", getattr(inner, "code", "")):
            value = getattr(inner, name)
            if isinstance(value, torch.Tensor) and not isinstance(value, torch.nn.Parameter):
                tensors[f"{prefix}.{name}".lstrip(".")] = value
    return tensors


class _Script(torch.nn.Module):
    """A module without memory, whatever ``reset()`` its exporter gave it."""

    def __init__(self, module: Any) -> None:
        super().__init__()
        self.module = module

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        return _take_actions(self.module(with_rows_of_zeros(rows)))[: len(rows)]


class _RecurrentScript(Recurrent):
    """A module that remembers one robot in its tensors, with a row of them for each robot."""

    def __init__(self, module: Any, initial: Mapping[str, torch.Tensor], axis: int) -> None:
        super().__init__([*initial.values()], axis)
        self.module = module
        self._paths = [name.split(".") for name in initial]

    def step(self, rows: torch.Tensor, state: list[torch.Tensor]) -> tuple[torch.Tensor, list[torch.Tensor]]:
        owners = [functools.reduce(getattr, path[:-1], self.module) for path in self._paths]
        for owner, path, value in zip(owners, self._paths, state, strict=True):
            setattr(owner, path[-1], value)
        action = _take_actions(self.module(rows))
        return action, [getattr(owner, path[-1]) for owner, path in zip(owners, self._paths, strict=True)]


@torch.no_grad()
def _separate_robots(module: Any, probe: Any, path: Path, width: int, device: str) -> Any:
    """The module with a memory of each robot: the tensors that a call of ``probe``, its copy on the CPU, changes."""
    rows = torch.randn((3, 3, width), generator=torch.Generator().manual_seed(0))  # steps, robots
    reset = getattr(probe, "reset", getattr(probe, "reset_memory", None))
    if reset is not None:
        reset()
    before = {name: value.clone() for name, value in _read_tensors(probe).items()}
    try:
        outputs = [probe(rows[0, :1]) for _ in range(2)]
    except Exception:  # it takes another width, or has nothing to call: trying it later says so
        return _Script(module)
    first, second = map(_take_actions, outputs)
    if first is not outputs[0]:
        warnings.warn(f"policy '{path}' returns {len(outputs[0])} values: all but the first are ignored", stacklevel=2)
    after = _read_tensors(probe)
    initial = {name: value for name, value in before.items() if not torch.equal(value, after[name])}
    if not isinstance(first, torch.Tensor) or not initial:
        is_same = reset is None or not isinstance(first, torch.Tensor) or torch.equal(first, second)
        return _Script(module) if is_same else module  # it has another memory
    separate = []
    for robot in rows.split(1, dim=1):
        for name, value in _read_tensors(probe).items():
            value.copy_(before[name])
        separate.append(torch.cat([_take_actions(probe(row)) for row in robot]))
    for axis in (1, 0):  # the axis of robots is the one along which they act as they do alone
        if all(value.ndim > axis and value.shape[axis] == 1 for value in initial.values()):
            recurrent = _RecurrentScript(probe, initial, axis)
            with suppress(RuntimeError, torch.jit.Error):
                together = torch.stack([recurrent(step) for step in rows], dim=1)
                if torch.allclose(together, torch.stack(separate), rtol=1e-4, atol=1e-4):
                    return _RecurrentScript(module, initial, axis).to(device)
    raise ValueError(f"policy '{path}' remembers one robot alone, in {', '.join(initial)}: give its checkpoint")
