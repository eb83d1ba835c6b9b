"""The network of a file: an rsl_rl checkpoint, a TorchScript module, or ONNX."""

from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any

import torch

from sim.controllers.formats.rsl_rl import make_actor, read_weights
from sim.controllers.formats.torchscript import separate_robots
from sim.controllers.spec import in_one_line

Policy = Callable[[torch.Tensor], torch.Tensor]
"""Actions, shape (num_envs, num_joints), of observation rows, shape (num_envs, observation_size).

A policy that remembers has a method ``reset``, of a kind of :class:`sim.controllers.runner.Memory`.
"""


def load_network(
    path: Path, device: str, sizes: tuple[int, int] | None, *, label: str, activation: str | None = None
) -> Policy:
    """The network of a checkpoint, TorchScript or ONNX file, with a ``reset(rows)`` if it remembers.

    ``sizes`` are the columns that it must take and the actions that it must return, which errors call those of
    ``label``; None takes those of the file, and a TorchScript module as it is. ``activation`` is the function between
    the layers of a checkpoint; None takes that of its file or training.
    """
    if path.suffix.lower() == ".onnx":
        from sim.controllers.formats.onnx import load_onnx  # onnxruntime takes long to load, and few files need it

        return load_onnx(path, sizes, device)
    try:
        content = read_weights(path)
    except ValueError as error:
        raise ValueError(f"policy '{path}' is damaged: {error}; put a copy of it back") from error
    except Exception as error:  # a stream of pickle opcodes can fail with anything
        return _load_script(path, device, sizes, error)
    policy = make_actor(content, path, activation)
    if sizes is not None and policy.sizes != sizes:
        raise ValueError(
            f"policy '{path}' maps {policy.sizes[0]} observations to {policy.sizes[1]} actions, but {label} has "
            f"{sizes[0]} observations and {sizes[1]} joints: give one that fits, or describe it (docs/controllers.md)"
        )
    return policy.to(device).eval()


def _load_script(path: Path, device: str, sizes: tuple[int, int] | None, reason: Exception) -> Policy:
    """A TorchScript module from a file that is no checkpoint, for this reason."""
    try:
        module, probe = (torch.jit.load(str(path), map_location=target).eval() for target in (device, "cpu"))
    except Exception as error:
        raise ValueError(
            f"policy '{path}' is neither an rsl_rl checkpoint of plain tensors nor a TorchScript module (truncated, "
            f"foreign, or holding code): {in_one_line(reason)}: give one of these, or an ONNX file that ends in .onnx"
        ) from error
    return module if sizes is None else separate_robots(module, probe, path, sizes[0], device)


def find_widths(network: Any) -> tuple[int | None, int | None]:
    """Columns and actions of a network, as far as it has or shows them."""
    if hasattr(network, "sizes"):
        return network.sizes
    for weight in network.parameters():
        with suppress(Exception):  # of an inner layer
            return weight.shape[1], network(torch.zeros(1, weight.shape[1], device=weight.device)).shape[1]
    return None, None
