"""The Ray cluster that evaluation runs on: this machine's devices, or a running cluster's."""

import logging
import os
import socket
from typing import Any

import ray
from ray.exceptions import RayError

from sim.files.provenance import device_name

_KNOCK_S = 10.0


def connect(wanted: int | str) -> None:
    """Join the cluster that RAY_ADDRESS names, or start Ray on this machine.

    Args:
        wanted: Number of workers, or ``auto``.

    Raises:
        OSError: If there is no cluster at RAY_ADDRESS.
    """
    if ray.is_initialized():
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray's behaviour to come; it warns otherwise
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    address = os.environ.get("RAY_ADDRESS")
    if address:
        try:
            _knock(address)
            ray.init(address=address, **quiet)
        except Exception as error:  # of many types: no such host, another version of Ray, a cluster that went away
            reason = " ".join(str(error).split())[:300]
            if "AuthenticationError" in str(error.__cause__):
                raise OSError(
                    f"the Ray cluster at RAY_ADDRESS={address} wants its token: set RAY_AUTH_MODE=token and put the "
                    "token where Ray looks for it (RAY_AUTH_TOKEN or ~/.ray/auth_token), here as on its nodes"
                ) from None
            raise OSError(
                f"no Ray cluster at RAY_ADDRESS={address}: {reason}: start one with `ray start --head`, or unset "
                "RAY_ADDRESS to use this machine alone"
            ) from None
        return
    from qd.workers.evaluator import available_cores

    cores = available_cores()
    ray.init(
        address="local",
        num_cpus=max(cores, wanted) if isinstance(wanted, int) else cores,
        include_dashboard=False,
        object_store_memory=256 << 20,
        **quiet,
    )


def _knock(address: str) -> None:
    """Tries whether anybody listens at ``host:port``: Ray itself would try for minutes.

    Raises:
        OSError: If nobody does.
    """
    host, _, port = address.removeprefix("ray://").rpartition(":")
    if host and port.isdecimal():
        socket.create_connection((host.strip("[]"), int(port)), timeout=_KNOCK_S).close()


def cluster_device(name: str | None, wanted: int | str) -> str:
    """``cuda`` or ``cpu``: what the workers run on; None means CUDA where the cluster has it.

    Raises:
        ValueError: If the device is absent, or one GPU among several is named.
        OSError: If there is no cluster at RAY_ADDRESS.
    """
    if name not in (None, "cpu", "cuda"):
        raise ValueError(f"with workers the device must be cpu or cuda, got {name}: Ray deals out the GPUs")
    if isinstance(wanted, int) and wanted < 1:
        raise ValueError(f"workers must be at least 1, or auto, got {wanted}")
    connect(wanted)
    gpus = num_devices("cuda")
    if name == "cuda" and not gpus:
        raise ValueError(f"device cuda: the cluster has no GPU: {resources()}; give --device cpu, or add a node")
    device = name or ("cuda" if gpus else "cpu")
    most = num_devices(device)
    if isinstance(wanted, int) and not os.environ.get("RAY_ADDRESS") and wanted > most:
        raise ValueError(f"workers must be at most {most}, as many as this machine has GPUs, got {wanted}")
    return device


def num_devices(device: str) -> int:
    """GPUs or CPU cores of the cluster as it is now."""
    return int(ray.cluster_resources().get("GPU" if device.startswith("cuda") else "CPU", 0))


def resources() -> str:
    """CPU cores and GPUs of the cluster, in words."""
    return ", ".join(f"{value:g} {name}" for name, value in ray.cluster_resources().items() if name in ("CPU", "GPU"))


def name_of_device(device: str) -> str:
    """What the workers run on, in words; asked of one of them where this machine has no such device."""
    name = device_name(device)
    if name != device:
        return name
    try:
        return ray.get(ray.remote(num_gpus=1)(device_name).remote("cuda:0"), timeout=120)
    except RayError:  # a name is not worth a search
        return device
