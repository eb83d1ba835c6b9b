"""Files that are whole or absent: a reader never sees half of one, whenever the writer is killed."""

import json
import os
from pathlib import Path
from typing import Any


def write_atomically(path: Path, data: bytes) -> None:
    """Replaces a file in one step that survives a kill and a power cut.

    The temporary file has a fixed name beside the target, so that what a kill leaves behind is overwritten by the next
    write instead of piling up.

    Args:
        path: File to write; its folder exists.
        data: The whole content.

    Raises:
        OSError: If the folder cannot be written to; the old file is then untouched.
    """
    temporary = path.with_name(f".{path.name}.tmp")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
    except OSError:
        temporary.unlink(missing_ok=True)
        raise
    folder = os.open(path.parent, os.O_RDONLY)
    try:
        os.fsync(folder)  # or the rename itself may be lost
    finally:
        os.close(folder)


def check_writable(folder: Path) -> None:
    """Finds out whether files can be made in a folder, before the work whose result goes there.

    Raises:
        ValueError: If they cannot.
    """
    probe = folder / ".write-test"
    try:
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise ValueError(f"{folder} cannot be written to: {error.strerror}: give another place") from None


def to_json(content: dict[str, Any]) -> bytes:
    """A dictionary as indented JSON; a number that is not finite is an error, since JSON has none."""
    return (json.dumps(content, indent=2, allow_nan=False) + "\n").encode()


def read_json(path: Path) -> dict[str, Any]:
    """The dictionary in a JSON file.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it holds something else.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (json.JSONDecodeError, UnicodeDecodeError) as error:
        raise ValueError(f"{path} must be a JSON file, got: {error}") from None
    if not isinstance(content, dict):
        raise ValueError(f"{path} must hold a JSON object, got {type(content).__name__}")
    return content
