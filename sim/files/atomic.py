"""Files that are whole or absent: a reader never sees half of one, whenever the writer is killed."""

import contextlib
import fcntl
import json
import os
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

_TEMPORARY = ".tmp"
_PROBE = ".write-test"
_LINE = 120  # columns


def write_atomically(path: Path, data: bytes) -> None:
    """Replaces a file in one step that survives a kill and a power cut.

    The temporary file has a fixed name beside the target, so that what a kill leaves behind is overwritten by the next
    write instead of piling up. The folder exists.

    Raises:
        OSError: If the file cannot be written, as on a full disk; the old file, or the new one, is then whole.
    """
    temporary = path.with_name(f".{path.name}{_TEMPORARY}")
    try:
        with temporary.open("wb") as file:
            file.write(data)
            file.flush()
            os.fsync(file.fileno())
        os.replace(temporary, path)
        _sync_folder(path.parent)
    except OSError as error:
        with contextlib.suppress(OSError):
            temporary.unlink(missing_ok=True)
        raise unwritable(path, error) from error


def _sync_folder(folder: Path) -> None:
    """Puts a rename on the disk, which may be lost otherwise."""
    handle = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def unwritable(path: Path, error: OSError) -> OSError:
    """The error of a failed write that names the file and the remedy; a bare one names neither."""
    return OSError(
        f"{path} cannot be written: {error.strerror or error}: make room there or give another place; "
        "what was saved before is whole"
    )


def is_leftover(path: Path) -> bool:
    """Whether a file is what a killed write leaves behind, to be overwritten by the next one."""
    return path.name == _PROBE or (path.name.startswith(".") and path.name.endswith(_TEMPORARY))


def check_writable(folder: Path) -> None:
    """Checks that files can be made in a folder, before long work whose result goes there.

    Raises:
        ValueError: If they cannot.
    """
    probe = folder / _PROBE
    try:
        probe.touch()
        probe.unlink(missing_ok=True)
    except OSError as error:
        raise ValueError(f"{folder} cannot be written to: {error.strerror}: give another place") from None


def prepare_output(file: Path) -> None:
    """Makes the folder of a file and checks that the file can be written, before long work.

    Raises:
        ValueError: If it cannot.
    """
    try:
        file.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"cannot write to {error.filename}: {error.strerror}: give another place") from None
    if file.is_dir():
        raise ValueError(f"{file} is a directory, expected a file to write: name a file in it")
    check_writable(file.parent)


def to_json(content: dict[str, Any]) -> bytes:
    """A dictionary as JSON, indented; what fits a line and lists of numbers stand on one.

    Raises:
        ValueError: If a number is not finite.
    """
    return (_as_json(content, "", 0) + "\n").encode()


def _as_json(value: Any, indent: str, before: int) -> str:
    """A value, before which so many columns of its line are taken beside the indent."""
    if not isinstance(value, dict | list | tuple) or not value:
        return json.dumps(value, allow_nan=False)
    inner = f"{indent} "
    if isinstance(value, dict):
        names = json.loads(json.dumps(dict.fromkeys(value), allow_nan=False))  # as JSON has them, words alone
        heads = [f"{json.dumps(name)}: " for name in names]
        parts = [head + _as_json(one, inner, len(head)) for head, one in zip(heads, value.values(), strict=True)]
        opening, closing = "{}"
    else:
        parts = [_as_json(one, inner, 0) for one in value]
        opening, closing = "[]"
    line = f"{opening}{', '.join(parts)}{closing}"
    numbers = opening == "[" and not any(isinstance(one, str | dict | list | tuple) for one in value)
    if numbers or ("\n" not in line and len(indent) + before + len(line) < _LINE):  # a comma may follow
        return line
    rows = ",\n".join(f"{inner}{part}" for part in parts)
    return f"{opening}\n{rows}\n{indent}{closing}"


def read_json(path: Path) -> dict[str, Any]:
    """The dictionary in a JSON file.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If it cannot be read, or holds something else.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"), parse_constant=_refuse_constant)
    except FileNotFoundError:
        raise
    except (OSError, ValueError, RecursionError) as error:
        reason = error.strerror if isinstance(error, OSError) else error
        raise ValueError(f"{path} must be a JSON file, got: {reason}: put a copy of it back") from None
    if not isinstance(content, dict):
        raise ValueError(
            f"{path} must hold a JSON object, got {type(content).__name__}: put a copy of the right file there"
        )
    return content


def _refuse_constant(name: str) -> None:
    raise ValueError(f"{name}, which is no number")


def has_shape(value: Any, shape: Any) -> bool:
    """Whether a JSON value has a shape: a type, [shape of every item], {key: shape} or {...: shape of every value}."""
    if isinstance(shape, list):
        return isinstance(value, list) and all(has_shape(item, shape[0]) for item in value)
    if not isinstance(shape, dict):
        return isinstance(value, shape)
    if not isinstance(value, dict):
        return False
    if ... in shape:
        return all(has_shape(item, shape[...]) for item in value.values())
    return all(key in value and has_shape(value[key], part) for key, part in shape.items())


def check_zip(path: Path) -> None:
    """Compares the parts of a zip file, such as torch and NumPy write, with their checksums.

    Torch never looks at them when it loads: a flipped bit would be another weight.

    Raises:
        ValueError: If the file is no zip file or a part is damaged.
    """
    try:
        with zipfile.ZipFile(path) as file:
            damaged = file.testzip()
    except Exception as error:  # zipfile and zlib answer damage with a dozen types
        raise ValueError(f"{type(error).__name__}: {error}") from None
    if damaged is not None:
        raise ValueError(f"its part '{damaged}' does not have its checksum")


@contextlib.contextmanager
def locked(folder: Path, busy: str) -> Iterator[None]:
    """Keeps other processes that ask for the same out of a directory; ends with the process, however that ends.

    Args:
        folder: The directory.
        busy: What to say if another process is in it.

    Raises:
        ValueError: If one is.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise ValueError(busy) from None
    try:
        yield
    finally:
        os.close(handle)
