"""The Ray cluster that evaluation runs on: a running cluster's devices, or this machine's."""

import logging
import os
import socket
from typing import Any

import ray
from ray.exceptions import RayError

from sim.files.records import device_name

_CONNECT_LIMIT_S = 10.0


def connect(count: int | None) -> None:
    """Joins the cluster that RAY_ADDRESS names, or starts Ray on this machine.

    Args:
        count: Workers wanted; None for one a device.

    Raises:
        OSError: If there is no cluster at RAY_ADDRESS.
    """
    if ray.is_initialized():
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray's behaviour to come; it warns otherwise
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    address = os.environ.get("RAY_ADDRESS")
    if address is None:
        from qd.workers.evaluator import available_cores

        cores = max(available_cores(), count or 1)
        ray.init(address="local", num_cpus=cores, include_dashboard=False, object_store_memory=256 << 20, **quiet)
        return
    try:
        _check_listens(address)
        ray.init(address=address, **quiet)
    except Exception as error:  # of many types: no such host, another version of Ray, a cluster that went away
        if "AuthenticationError" in str(error.__cause__):
            raise OSError(
                f"the Ray cluster at RAY_ADDRESS={address} wants its token: set RAY_AUTH_MODE=token and put the "
                "token where Ray looks for it (RAY_AUTH_TOKEN or ~/.ray/auth_token), here as on its nodes"
            ) from None
        reason = " ".join(str(error).split())[:300]
        raise OSError(
            f"no Ray cluster at RAY_ADDRESS={address}: {reason}: start one with `ray start --head`, or unset "
            "RAY_ADDRESS to use this machine alone"
        ) from None


def _check_listens(address: str) -> None:
    """Tries to reach ``host:port``; Ray itself would try for minutes.

    Raises:
        OSError: If nothing listens there.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_LIMIT_S).close()


def cluster_device(name: str | None, count: int | None) -> str:
    """Device of the workers, ``cuda`` or ``cpu``.

    Args:
        name: What the user asked for; None means CUDA where the cluster has it.
        count: Workers wanted; None for one a device.

    Raises:
        ValueError: If the device is absent, one GPU among several is named, or this machine has fewer GPUs than wanted.
        OSError: If there is no cluster at RAY_ADDRESS.
    """
    if name not in (None, "cpu", "cuda"):
        raise ValueError(f"with workers on Ray the device must be cpu or cuda, got {name}: Ray deals out the GPUs")
    connect(count)
    gpus = num_devices("cuda")
    if name == "cuda" and not gpus:
        raise ValueError(f"device cuda: the cluster has no GPU: {resources()}; give --device cpu, or add a node")
    device = name or ("cuda" if gpus else "cpu")
    most = num_devices(device)
    if count is not None and count > most and not os.environ.get("RAY_ADDRESS"):
        raise ValueError(f"workers must be at most ray:{most}, one for each GPU of this machine, got ray:{count}")
    return device


def num_devices(device: str) -> int:
    """GPUs or CPU cores that the cluster has now."""
    return int(ray.cluster_resources().get("GPU" if device.startswith("cuda") else "CPU", 0))


def resources() -> str:
    """CPU cores and GPUs of the cluster, in words."""
    return ", ".join(f"{value:g} {name}" for name, value in ray.cluster_resources().items() if name in ("CPU", "GPU"))


def name_of_device(device: str) -> str:
    """The device's full name; a worker is asked for it where this machine has no such device."""
    name = device_name(device)
    if name != device:
        return name
    try:
        return ray.get(ray.remote(num_gpus=1)(device_name).remote("cuda:0"), timeout=120)
    except RayError:  # a name is not worth a search
        return device
