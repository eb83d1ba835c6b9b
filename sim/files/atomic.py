"""Files that are whole or absent: a reader never sees half of one, whenever the writer is killed."""

import contextlib
import fcntl
import json
import os
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec

_TEMPORARY = ".tmp"


@contextlib.contextmanager
def explain_failed_write(path: Path) -> Iterator[None]:
    """Adds the file and a remedy to an OSError of writing it."""
    try:
        yield
    except OSError as error:
        remedy = "make room there or give another place; the file of before is whole"
        raise OSError(f"{path} cannot be written: {error.strerror or error}: {remedy}") from error


def write_atomically(path: Path, data: bytes) -> None:
    """Replaces a file in one step that survives a kill and a power cut; an OSError leaves the old file whole."""
    temporary = path.with_name(f".{path.name}{_TEMPORARY}")  # the next write overwrites what a kill leaves behind
    with explain_failed_write(path):
        try:
            with temporary.open("wb") as file:
                file.write(data)
                file.flush()
                os.fsync(file.fileno())
            os.replace(temporary, path)
            with _opened(path.parent) as folder:
                os.fsync(folder)  # or the renaming may be lost
        except OSError:
            with contextlib.suppress(OSError):
                temporary.unlink(missing_ok=True)
            raise


def is_leftover(path: Path) -> bool:
    """Whether a killed write left this file, which the next write replaces."""
    return path.name.startswith(".") and path.name.endswith(_TEMPORARY)


def prepare_output(file: Path) -> None:
    """Makes the folder of a file; raises a ValueError if it cannot be written: to be called before long work."""
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
        tempfile.TemporaryFile(dir=file.parent).close()
    except OSError as error:
        raise ValueError(f"{file.parent} cannot be written to: {error.strerror}: give another place") from None
    if file.is_dir():
        raise ValueError(f"{file} is a directory, expected a file to write: name a file in it")


def to_json(content: dict[str, Any]) -> bytes:
    """A dictionary as indented JSON; a ValueError if a number in it is not finite."""
    return (json.dumps(content, indent=1, allow_nan=False) + "\n").encode()


def read_json(path: Path) -> dict[str, Any]:
    """The dictionary in a JSON file; FileNotFoundError if there is no file, ValueError if it holds something else."""
    try:
        return msgspec.json.decode(path.read_bytes(), type=dict[str, Any])
    except FileNotFoundError:
        raise
    except (OSError, ValueError, RecursionError) as error:
        raise ValueError(f"{path} must be a JSON file of an object, got: {error}: put a copy of it back") from None


@contextlib.contextmanager
def locked(folder: Path, busy: str = "") -> Iterator[None]:
    """Locks a folder; if another process has it, raises a ValueError with the text ``busy``, or waits without one."""
    with _opened(folder) as handle:
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | (fcntl.LOCK_NB if busy else 0))
        except OSError as error:
            cannot = f"{folder} cannot be locked: {error.strerror}: give a folder on another disk"
            raise ValueError(busy if isinstance(error, BlockingIOError) else cannot) from None
        yield


@contextlib.contextmanager
def _opened(folder: Path) -> Iterator[int]:
    handle = os.open(folder, os.O_RDONLY)
    try:
        yield handle
    finally:
        os.close(handle)
