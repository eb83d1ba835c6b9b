"""Where a result comes from: the keys that every results file carries."""

import hashlib
import os
import platform
import re
import shlex
import subprocess
import sys
from collections.abc import Sequence
from datetime import UTC, datetime
from importlib.metadata import version
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).resolve().parents[2]
_PACKAGES = ("newton", "mujoco", "mujoco-warp", "warp-lang", "torch", "onnxruntime", "ribs", "rsl-rl-lib", "numpy")


def provenance(device: str, seed: int) -> dict[str, Any]:
    """Command, commit, device, versions, seed and date of the running program."""
    return {
        "command": _command(),
        "commit": os.environ.get("FAULTLINE_COMMIT") or _output(["git", "rev-parse", "HEAD"]),
        "device": device_name(device),
        "versions": versions(),
        "seed": seed,
        "date": datetime.now(UTC).isoformat(timespec="seconds"),
    }


def versions() -> dict[str, str | None]:
    """Versions of Python and of the packages that results depend on; None of one that is not installed."""
    return {"python": platform.python_version(), **{name: _version(name) for name in _PACKAGES}}


def code_fingerprint(rooms: Sequence[str]) -> str:
    """SHA-256 of the sources and robot files of rooms and of all package versions: equal ones compute the same."""
    digest = hashlib.sha256(repr(sorted(versions().items())).encode())
    for room in rooms:
        for path in sorted((_ROOT / room).rglob("*")):
            if path.suffix in (".py", ".xml"):
                digest.update(str(path.relative_to(_ROOT)).encode() + b"\0" + path.read_bytes())
    return digest.hexdigest()


def _command() -> str:
    """The running command as a user types it; a path outside the working folder is cut to its name."""
    spec = getattr(sys.modules.get("__main__"), "__spec__", None)
    module = spec.name.removesuffix(".__main__") if spec else Path(sys.argv[0]).stem
    program = ["faultline"] if module == "faultline" else ["python", "-m", module]
    return shlex.join([*program, *map(without_machine, sys.argv[1:])])


def without_machine(word: str) -> str:
    """A word of a command line, or a path, without where on this machine it lies: an absolute path's last name."""
    here = f"{Path.cwd()}{os.sep}"
    return re.sub(r"(?<![\w.~-])/(?:[^/=:\s]+/)+(?=[^/])", "", word.replace(here, ""))


def _version(package: str) -> str | None:
    try:
        return version(package)
    except ModuleNotFoundError:  # a checkout on the path without being installed
        return None


def device_name(device: str) -> str:
    """What a Warp device is, in words; its own name where this machine cannot tell."""
    if not device.startswith("cuda"):
        return f"CPU ({platform.machine()}, {os.cpu_count()} cores)"
    index = device.partition(":")[2] or "0"
    return _output(["nvidia-smi", "--query-gpu=name", "--format=csv,noheader", f"--id={index}"]) or device


def _output(command: list[str]) -> str | None:
    """What a program prints, run in the checkout; None where it is missing or fails."""
    try:
        done = subprocess.run(
            command, cwd=Path(__file__).parent, capture_output=True, text=True, timeout=20, check=True
        )
    except (OSError, subprocess.SubprocessError):
        return None
    return done.stdout.strip() or None
