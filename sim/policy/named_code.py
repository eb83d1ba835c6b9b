"""Code that a user names on the command line: a function or setting in a module, or in a Python file."""

import hashlib
import importlib
import importlib.util
import sys
from pathlib import Path
from types import ModuleType
from typing import Any


def in_one_line(error: BaseException) -> str:
    """Kind of an error and the first line of what it says."""
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return ": ".join([type(error).__name__, *lines[:1]])


def run_file(path: Path) -> ModuleType:
    """Runs a Python file as a module of its own, as it is now; its neighbours can be imported from it.

    Raises:
        ValueError: If there is no such file, or it fails.
    """
    if not path.is_file():
        raise ValueError(f"{path}: no such file")
    path = path.resolve()
    name = f"faultline_file_{hashlib.sha256(str(path).encode()).hexdigest()[:16]}"
    spec = importlib.util.spec_from_file_location(name, path)
    if spec is None or spec.loader is None:
        raise ValueError(f"{path} is no Python file: expected a name that ends in .py")
    module = importlib.util.module_from_spec(spec)
    if str(path.parent) not in sys.path:
        sys.path.append(str(path.parent))  # last: a neighbour must not stand in for an installed package
    importlib.invalidate_caches()
    sys.modules[name] = module
    try:
        exec(compile(path.read_bytes(), str(path), "exec"), module.__dict__)  # no .pyc that an edit could outrun
    except (Exception, SystemExit) as error:  # a file can fail with anything
        del sys.modules[name]
        raise ValueError(f"{path} fails: {in_one_line(error)}") from error
    return module


def find_named(place: str, name: str) -> Any:
    """What a module or a Python file calls ``name``.

    Args:
        place: An importable module, or a file whose name ends in .py.
        name: Dots reach into classes.

    Raises:
        Exception: Anything, if it cannot be run or has no such name.
    """
    found: Any = run_file(Path(place)) if place.endswith(".py") else importlib.import_module(place)
    for part in name.split("."):
        found = getattr(found, part)
    return found
