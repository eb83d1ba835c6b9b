"""Where terrains are crossed: on which device, by how many workers, with how many robots at once."""

import os
import re
from dataclasses import dataclass
from typing import Any, NamedTuple, Self

from qd.workers import cluster
from sim.controllers.loaders import load_policy
from sim.device import resolve_device
from sim.files.provenance import provenance
from sim.robots.robot import RobotCfg

_WORKERS = re.compile(r"(?P<ray>ray)(:(?P<actors>[1-9]\d{0,5}))?|(?P<processes>[1-9]\d{0,5})")


class Workers(NamedTuple):
    """Who crosses terrains."""

    on_ray: bool
    """Ray actors, a GPU or a CPU core each, or processes of this machine."""
    count: int | None
    """How many; None: one a device of the cluster, or a core of this machine."""


def parse_workers(text: str | None) -> Workers:
    """Reads ``--workers``: ``4`` processes, ``ray``, or ``ray:4``; None for one process a core."""
    if text is None:
        return Workers(on_ray=False, count=None)
    match = _WORKERS.fullmatch(text)
    if match is None:
        raise ValueError(f"workers must be a number of processes from 1 on, ray, or ray:N, got '{text}'")
    number = match["actors"] or match["processes"]
    return Workers(on_ray=match["ray"] is not None, count=None if number is None else int(number))


def available_cores() -> int:
    """Processor cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


@dataclass(frozen=True)
class Compute:
    """Where terrains are crossed."""

    device: str = "cpu"
    """Warp device name."""
    workers: str | None = None
    """Who crosses them, as :func:`parse_workers` takes it; a GPU without Ray needs one process."""
    num_envs: int | None = None
    """Robots at once over all workers, which take the episodes one after the other; as many as the device is good for
    if None. It changes no result."""

    @classmethod
    def resolve(cls, device: str | None = None, workers: str | None = None, num_envs: int | None = None) -> Self:
        """What a command line asks for, on the device that is there: CUDA if there is one, else the CPU."""
        return cls(choose_device(device, workers), workers, num_envs)

    @property
    def on_gpu(self) -> bool:
        """Whether a GPU crosses them."""
        return self.device.startswith("cuda")

    def origin(self, seed: int) -> dict[str, Any]:
        """Provenance of what is crossed; on a cluster the device is ``cuda`` or ``cpu`` alone."""
        return provenance(self.device, seed) | ({"device": self.device} if parse_workers(self.workers).on_ray else {})


def choose_device(name: str | None, workers: str | None = None) -> str:
    """Warp device name, on Ray of the cluster; None means CUDA where there is one, else the CPU."""
    on_ray, count = parse_workers(workers)
    if on_ray:
        cluster.connect(max(available_cores(), count or 1))
        return cluster.resolve_worker_device(name, count)
    device = resolve_device(name)
    if device.startswith("cuda") and (count or 1) > 1:
        raise ValueError(f"{count} workers need the CPU, got device {device}: give --device cpu, or --workers ray:N")
    return device


def check_policy(policy: str, robot: RobotCfg, device: str) -> None:
    """Loads a controller and tries it on the robot, so that a bad one is found before any long work."""
    # A cluster's GPUs need not be this machine's.
    local_device = device if device == "cpu" else resolve_device(None)
    load_policy(policy, robot, device if local_device.startswith("cuda") else "cpu")
