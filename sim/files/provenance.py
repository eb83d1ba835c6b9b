"""Where a results file comes from: command, code, device, versions, seed and date."""

import hashlib
import json
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from contextlib import suppress
from datetime import UTC, datetime
from functools import cache
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

ROOMS = ("kernels", "sim", "qd", "train")  # folders of the source code

ROOT = Path(__file__).resolve().parents[2]  # folder of the rooms
_PACKAGES = ("newton", "mujoco", "mujoco-warp", "warp-lang", "torch", "onnxruntime", "ribs", "rsl-rl-lib", "numpy")
_SOURCES = (".py", ".cu", ".toml", ".xml")


def provenance(device: str, seed: int) -> dict[str, Any]:
    """Command (by :func:`without_machine`), commit, hash of the sources, device, versions, seed and date of a result.

    ``dirty``: sources or scripts differ from the commit; None if unknown. FAULTLINE_COMMIT (-dirty) stands for git.
    """
    variable = os.environ.get("FAULTLINE_COMMIT", "")
    commit = variable.removesuffix("-dirty") or None
    dirty: bool | None = variable.endswith("-dirty")
    if commit is None:
        folders = [*(ROOT / name for name in (*ROOMS, "results/make")), ":(exclude)sim/robots/*/packs/*"]
        changes = _run(["git", "status", "--porcelain", "--untracked-files=no", "--", *folders])
        commit = _run(["git", "rev-parse", "HEAD"])
        dirty = None if changes is None else changes != ""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    module = spec.name.removesuffix(".__main__") if spec else Path(sys.argv[0]).stem
    program = ["faultline"] if module == "faultline" else ["python", "-m", module]
    return {
        "command": shlex.join([*program, *map(without_machine, sys.argv[1:])]),
        "commit": commit,
        "sources_sha256": sources_sha256(),
        "dirty": dirty,
        "device": device_name(device),
        "versions": versions(),
        "seed": seed,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


@cache
def versions() -> dict[str, str]:
    """Versions of Python and of the packages that results depend on, as far as they are installed."""
    installed = {"python": platform.python_version()}
    for name in _PACKAGES:
        with suppress(PackageNotFoundError):
            installed[name] = version(name)
    return installed


def sources_sha256(rooms: Sequence[str] = ROOMS) -> str:
    """SHA-256 of the source files of rooms: Python, CUDA, robots and tables of settings."""
    digest = hashlib.sha256()
    for room in rooms:
        for path in sorted((ROOT / room).rglob("*")):
            if path.suffix in _SOURCES:
                digest.update(str(path.relative_to(ROOT)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def code_fingerprint(rooms: Sequence[str]) -> str:
    """SHA-256 of the sources of rooms and of all package versions; equal ones compute the same."""
    return hashlib.sha256(json.dumps([sources_sha256(rooms), versions()], sort_keys=True).encode()).hexdigest()


def without_machine(argument: str) -> str:
    """An argument with paths relative to the working folder, and with the last name alone of paths outside it."""
    return re.sub(r"(?<![\w.~-])/(?:[^/=:\s]+/)+(?=[^/])", "", argument.replace(f"{Path.cwd()}{os.sep}", ""))


def device_name(device: str) -> str:
    """The name of a Warp device's hardware; the device itself if this machine does not have it."""
    if not device.startswith("cuda"):
        return f"CPU ({platform.machine()}, {os.cpu_count()} cores)"
    import torch  # takes seconds to load, and is loaded wherever a GPU works

    return torch.cuda.get_device_name(device) if torch.cuda.is_available() else device


def _run(command: Sequence[str | Path]) -> str | None:
    """Output of a program that runs in the checkout; None if it is missing or fails."""
    try:
        return subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=20, check=True).stdout.strip()
    except (OSError, subprocess.SubprocessError):
        return None
