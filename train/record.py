"""Where a result's numbers come from, and files that are whole or absent."""

import json
import os
import platform
import shlex
import subprocess
import sys
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch

_PACKAGES = ("torch", "warp-lang", "newton", "mujoco-warp", "rsl-rl-lib", "numpy")


def provenance(device: str, seed: int) -> dict[str, Any]:
    """Keys every results file has: command, commit, device, versions, seed, date.

    Args:
        device: Warp device name the numbers were made on.
        seed: The run's seed.
    """
    return {
        "command": shlex.join(["python", "-m", *_module_and_arguments()]),
        "commit": _commit(),
        "device": _device_name(device),
        "versions": {"python": platform.python_version(), **{name: _version(name) for name in _PACKAGES}},
        "seed": seed,
        "date": datetime.now(UTC).strftime("%Y-%m-%dT%H:%M:%SZ"),
    }


def _module_and_arguments() -> list[str]:
    spec = getattr(sys.modules["__main__"], "__spec__", None)
    return [spec.name if spec is not None else Path(sys.argv[0]).name, *sys.argv[1:]]


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:  # on the path, but not installed
        return None


def _commit() -> str | None:
    given = os.environ.get("FAULTLINE_COMMIT")
    if given:
        return given
    command = ["git", "-C", str(Path(__file__).parent), "rev-parse", "HEAD"]
    try:
        return subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _device_name(device: str) -> str:
    if device.startswith("cuda"):
        return torch.cuda.get_device_name(torch.device(device))
    return f"CPU ({platform.machine()}, {os.cpu_count()} cores)"


def write_whole(path: Path, data: bytes) -> None:
    """Write a file that a reader never sees half of, whenever the writer is killed.

    Raises:
        OSError: If the folder cannot be written; a file already there is left as it is.
    """
    part = path.with_name(f".{path.name}.part")
    with part.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    part.replace(path)


def write_json(path: Path, content: dict[str, Any]) -> None:
    """Write a JSON object, whole or not at all; numbers that are not finite are an error."""
    write_whole(path, (json.dumps(content, indent=2, allow_nan=False) + "\n").encode())
