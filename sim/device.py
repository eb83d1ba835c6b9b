"""Choice of the device, and recording of graphs on it."""

import gc
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache

import warp as wp


def resolve_device(name: str | None) -> str:
    """Warp's name of the user's device; ``None`` is CUDA where there is one, else the CPU."""
    if name is None:
        return "cuda:0" if wp.is_cuda_available() else _cpu_instead()
    if name.startswith("cuda") and not wp.is_cuda_available():
        raise ValueError(f"device '{name}' asked for, but no CUDA device was found here: use --device cpu")
    try:
        return str(wp.get_device("cuda:0" if name == "cuda" else name))
    except (RuntimeError, ValueError) as error:
        present = ", ".join(("cpu", *map(str, wp.get_cuda_devices())))
        raise ValueError(f"unknown device '{name}': expected one of {present}") from error


@cache
def _cpu_instead() -> str:
    """The CPU; a message says so once."""
    print("No CUDA device was found here: this machine works on its CPU.", file=sys.stderr, flush=True)
    return "cpu"


def host_device() -> str:
    """Warp device of small work for the host: the CPU, or the default device where Warp has no compiler for the CPU."""
    return "cpu" if wp.is_cpu_available() else str(wp.get_device())


@contextmanager
def recording() -> Iterator[None]:
    """Suspend garbage collection while a graph is recorded: GPU memory that is freed then can spoil it."""
    collects = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if collects:
            gc.enable()
