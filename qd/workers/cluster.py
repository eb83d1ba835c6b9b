"""The Ray cluster: joined or started, and what it has. Ray takes seconds to load and need not be installed."""

import importlib
import logging
import os
import socket
from typing import Any

_CONNECT_LIMIT_S = 10.0


def load_ray() -> Any:
    """The package ``ray``; a ValueError where it is not installed."""
    try:
        return importlib.import_module("ray")
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise ValueError("--workers ray needs Ray, which is not installed: pip install -e '.[cluster]'") from None


def connect(num_cpus: int) -> None:
    """Joins the cluster that RAY_ADDRESS names, or starts Ray on this machine with so many CPU slots."""
    ray = load_ray()
    if ray.is_initialized():
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray's behaviour to come; it warns otherwise
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    address = os.environ.get("RAY_ADDRESS")
    if address is None:
        ray.init(address="local", num_cpus=num_cpus, include_dashboard=False, object_store_memory=256 << 20, **quiet)
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        if host and port.isdecimal():  # Ray itself would try for minutes where nothing listens
            socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_LIMIT_S).close()
        ray.init(address=address, **quiet)
    except Exception as error:  # of many types: no such host, another version of Ray, a token that is missing
        reason = " ".join(str(error.__cause__ or error).split())[:300]
        raise OSError(
            f"no Ray cluster at RAY_ADDRESS={address}: {reason}: start one with `ray start --head`, or unset "
            "RAY_ADDRESS to use this machine alone"
        ) from None


def resolve_worker_device(name: str | None, count: int | None) -> str:
    """Device of ``count`` workers, ``cuda`` or ``cpu``; for None CUDA where the cluster has it."""
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


def num_devices(device: str) -> int:
    """GPUs or CPU cores that the cluster has now."""
    return int(load_ray().cluster_resources().get("GPU" if device.startswith("cuda") else "CPU", 0))


def resources() -> str:
    """GPUs and CPU cores of the cluster as text."""
    counts = load_ray().cluster_resources().items()
    return ", ".join(f"{value:g} {name}" for name, value in counts if name in ("CPU", "GPU"))
