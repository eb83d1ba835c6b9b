"""What may have happened to a file since it was written."""

import io
import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np

Damage = Callable[[Path], None]


def damages(file: Path, seed: int) -> dict[str, Damage]:
    """Damages of a file by their names: cut off, flipped, replaced, gone, and JSON that is whole but another."""
    rng = np.random.default_rng([seed, len(file.name)])
    whole = file.read_bytes()
    found: dict[str, Damage] = {
        "empty": _content(b""),
        "half": _content(whole[: len(whole) // 2]),
        "a byte short": _content(whole[:-1]),
        "random bytes": _content(rng.bytes(max(1, len(whole)))),
        "gone": lambda file: file.unlink(),
        "a directory": _become_directory,
    }
    for _ in range(6):
        position = int(rng.integers(len(whole)))
        found[f"byte {position} flipped"] = _content(flipped(whole, position, int(rng.integers(1, 256))))
    others = _other_json(whole, rng) if file.name == "config.json" else {}
    return found | {name: _content(data) for name, data in others.items()}


def flipped(data: bytes, position: int, bits: int) -> bytes:
    """Bytes with some bits of one of them flipped."""
    return data[:position] + bytes([data[position] ^ bits]) + data[position + 1 :]


def _content(data: bytes) -> Damage:
    return lambda file: _write(file, data)


def _write(file: Path, data: bytes) -> None:
    file.write_bytes(data)


def _become_directory(file: Path) -> None:
    file.unlink()
    file.mkdir()
    (file / "kept").write_text("somebody's")


_OTHER_VALUES: tuple[Any, ...] = (None, True, -1, 2.5, 10**40, "x", [], [[1]], {}, {"a": {"b": 1}})


def other_values(content: Any, rng: np.random.Generator) -> Any:
    """JSON content with one value, anywhere in it, replaced by another."""
    if isinstance(content, dict | list) and content and rng.random() < 0.85:
        keys = list(content) if isinstance(content, dict) else range(len(content))
        key = keys[int(rng.integers(len(keys)))]
        changed = content.copy()
        changed[key] = other_values(content[key], rng)
        return changed
    return _OTHER_VALUES[int(rng.integers(len(_OTHER_VALUES)))]


def _other_json(whole: bytes, rng: np.random.Generator) -> dict[str, bytes]:
    content = json.loads(whole)
    texts = {"a list": "[]", "an empty object": "{}", "null": "null", "a deep list": "[" * 100_000, "NaN": '{"a": NaN}'}
    texts |= {"a long number": "1" * 5000, "an object in a list": f"[{json.dumps(content)}]"}
    for number in range(16):
        texts[f"another value, {number}"] = json.dumps(other_values(content, rng))
    return {name: text.encode() for name, text in texts.items()}


def npz(arrays: dict[str, Any]) -> bytes:
    """Arrays as the bytes of an npz, objects pickled."""
    buffer = io.BytesIO()
    np.savez_compressed(buffer, allow_pickle=True, **arrays)
    return buffer.getvalue()


def other_arrays(arrays: dict[str, Any]) -> Iterator[tuple[str, dict[str, Any]]]:
    """An archive's arrays with one of them of another kind, shape or value."""
    for name, array in arrays.items():
        yield f"{name} pickled", arrays | {name: array.astype(object)}
        yield f"{name} complex", arrays | {name: np.zeros(array.shape, complex)}
        yield f"{name} with an axis more", arrays | {name: array[None]}
        yield f"without {name}", {key: value for key, value in arrays.items() if key != name}
        if array.dtype.kind == "f":
            yield f"{name} NaN", arrays | {name: np.full_like(array, np.nan)}
        if array.ndim:
            yield f"{name} without its last row", arrays | {name: array[:-1]}
    yield "cells far away", arrays | {"cell": arrays["cell"] + 10**9}
    yield "a million intervals", arrays | {"intervals": np.asarray(1_000_000)}


def snapshot(folder: Path) -> dict[str, bytes | None]:
    """Every file under a folder with its content, and every folder with None."""
    paths = sorted(folder.rglob("*"))
    return {str(path.relative_to(folder)): path.read_bytes() if path.is_file() else None for path in paths}


def copied(source: Path, target: Path) -> Path:
    """A copy of a folder, in place of what was there."""
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target)
    return target
