"""Where terrains are crossed: device, workers and robots at once; and the Ray cluster, which takes seconds to load."""

import importlib
import logging
import os
import re
import socket
from dataclasses import dataclass
from typing import Any, Self

from sim.controllers.loaders import load_policy
from sim.device import resolve_device
from sim.files.provenance import provenance
from sim.robots.robot import RobotCfg

_WORKERS = re.compile(r"(?P<ray>ray)(:(?P<actors>[1-9]\d{0,5}))?|(?P<processes>[1-9]\d{0,5})")
_CONNECT_LIMIT_S = 10.0


def parse_workers(text: str | None) -> tuple[bool, int | None]:
    """Reads ``--workers``: whether Ray actors cross terrains, or processes, and how many; None: one a GPU or core."""
    if text is None:
        return False, None
    match = _WORKERS.fullmatch(text)
    if match is None:
        raise ValueError(f"workers must be a number of processes from 1 on, ray, or ray:N, got '{text}'")
    number = match["actors"] or match["processes"]
    return match["ray"] is not None, None if number is None else int(number)


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
    """Robots at once over all workers, as many as suit the device if None: no result but rounding on a GPU changes."""

    @classmethod
    def resolve(cls, device: str | None = None, workers: str | None = None, num_envs: int | None = None) -> Self:
        """What a command line asks for, on the device that is there: CUDA if there is one, else the CPU."""
        return cls(choose_device(device, workers), workers, num_envs)

    @property
    def on_gpu(self) -> bool:
        """Whether a GPU crosses them."""
        return self.device.startswith("cuda")

    @property
    def on_ray(self) -> bool:
        """Whether Ray actors cross them, a GPU or a CPU core each."""
        return parse_workers(self.workers)[0]

    def origin(self, seed: int) -> dict[str, Any]:
        """Provenance of what is crossed; on a cluster the device is ``cuda`` or ``cpu`` alone."""
        return provenance(self.device, seed) | ({"device": self.device} if self.on_ray else {})


def choose_device(name: str | None, workers: str | None = None) -> str:
    """Warp device name, on Ray of the cluster ``cuda`` or ``cpu``; None means CUDA where there is one, else the CPU."""
    on_ray, count = parse_workers(workers)
    if not on_ray:
        device = resolve_device(name)
        if device.startswith("cuda") and (count or 1) > 1:
            raise ValueError(f"{count} workers need the CPU, got device {device}: give --device cpu or --workers ray:N")
        return device
    connect(count)
    if name not in (None, "cpu", "cuda"):
        raise ValueError(f"with workers on Ray the device must be cpu or cuda, got {name}")
    gpus = num_devices("cuda")
    if name == "cuda" and not gpus:
        raise ValueError(f"device cuda: the cluster has no GPU: {resources()}; give --device cpu, or add a node")
    device = name or ("cuda" if gpus else "cpu")
    limit = num_devices(device)
    if count is not None and count > limit and not os.environ.get("RAY_ADDRESS"):
        raise ValueError(f"workers must be at most ray:{limit}, one for each GPU of this machine, got ray:{count}")
    return device


def connect(count: int | None) -> None:
    """Joins the cluster that RAY_ADDRESS names, or starts Ray on this machine, with room for ``count`` workers."""
    ray = load_ray()
    if ray.is_initialized():
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray's behaviour to come; it warns otherwise
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    address = os.environ.get("RAY_ADDRESS")
    if address is None:
        slots = max(available_cores(), count or 1)
        ray.init(address="local", num_cpus=slots, include_dashboard=False, object_store_memory=256 << 20, **quiet)
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        if host and port.isdecimal():  # Ray itself would try for minutes where nothing listens
            socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_LIMIT_S).close()
        ray.init(address=address, **quiet)
    except Exception as error:  # of many types: no such host, another version of Ray, a token that is missing
        reason = " ".join(str(error.__cause__ or error).split())[:300]
        remedy = "start one with `ray start --head`, or unset RAY_ADDRESS to use this machine alone"
        raise OSError(f"no Ray cluster at RAY_ADDRESS={address}: {reason}: {remedy}") from None


def load_ray() -> Any:
    """The package ``ray``; a ValueError where it is not installed."""
    try:
        return importlib.import_module("ray")
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise ValueError("--workers ray needs Ray, which is not installed: pip install -e '.[cluster]'") from None


def num_devices(device: str) -> int:
    """GPUs or CPU cores that the cluster has now."""
    return int(load_ray().cluster_resources().get("GPU" if device.startswith("cuda") else "CPU", 0))


def resources() -> str:
    """GPUs and CPU cores of the cluster as text."""
    counts = load_ray().cluster_resources().items()
    return ", ".join(f"{value:g} {name}" for name, value in counts if name in ("CPU", "GPU"))


def check_policy(policy: str, robot: RobotCfg, device: str) -> None:
    """Loads a controller and tries it on the robot, so that a bad one is found before any long work."""
    # A cluster's GPUs need not be this machine's.
    local_device = device if device == "cpu" else resolve_device(None)
    load_policy(policy, robot, device if local_device.startswith("cuda") else "cpu")
