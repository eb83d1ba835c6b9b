"""Npz files: read as data, compared with their checksums, so that nothing in them can run; and written."""

import io
import zipfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_ENDING = ".npy"


def array_names(path: Path) -> list[str]:
    """Names of the arrays in an npz file; any Exception if it is damaged or another file."""
    with zipfile.ZipFile(path) as members:
        return [name.removesuffix(_ENDING) for name in members.namelist()]


def read_arrays(
    path: Path, names: Sequence[str] | None = None, *, max_bytes: float = float("inf")
) -> dict[str, NDArray[Any]]:
    """All arrays of an npz file, or some by name; any Exception if it is damaged, or lacks one, or one is larger."""
    with zipfile.ZipFile(path) as members:
        available = [name.removesuffix(_ENDING) for name in members.namelist()]
        names = available if names is None else names
        if missing := set(names) - set(available):
            raise ValueError(f"it lacks {', '.join(sorted(missing))}")
        large = {name: size for name in names if (size := members.getinfo(name + _ENDING).file_size) > max_bytes}
        if large:
            raise ValueError(f"{', '.join(large)} of {max(large.values()):,} bytes, at most {max_bytes:,} are read")
        data = {name: members.read(name + _ENDING) for name in names}  # np.load would leave some checksums unread
    return {name: np.lib.format.read_array(io.BytesIO(member), allow_pickle=False) for name, member in data.items()}


def check_shapes(arrays: Mapping[str, NDArray[Any]], shapes: Mapping[str, Sequence[int | str]]) -> None:
    """Raises a ValueError if the shape of an array does not fit; a text in a shape stands for one size everywhere."""
    sizes: dict[int | str, int] = {}
    for name, shape in shapes.items():
        if name not in arrays:
            continue
        got = arrays[name].shape
        sizes = {size: length for size, length in zip(shape, got, strict=False) if isinstance(size, str)} | sizes
        expected = tuple(sizes.get(size, size) for size in shape)
        if got != expected:
            raise ValueError(f"{name} must have shape {expected}, got {got}")


def npz_bytes(arrays: Mapping[str, NDArray[Any]], *, compression: int = zipfile.ZIP_DEFLATED) -> bytes:
    """A packed npz file; equal arrays give equal bytes. ``zipfile.ZIP_BZIP2`` halves whole numbers, but is slow."""
    whole = io.BytesIO()
    with zipfile.ZipFile(whole, "w", compression) as members:
        for name, values in arrays.items():
            with members.open(name + _ENDING, "w") as member:  # without a date
                np.lib.format.write_array(member, values, allow_pickle=False)
    return whole.getvalue()
