"""Heightmaps of a user's own as terrains to cross: what a file must hold, and how it becomes the project's grid.

A map is a grid of nodes over a rectangle of ``size_m`` (along x, along y): its first node stands on one edge, its last
on the other. It is laid with its middle on the middle of the terrain, 16 m x 8 m, which robots cross from x = 2 m to
14 m. What reaches beyond the terrain is cut off; where the map ends before it, the height of its edge continues.
Heights stay as they are: the ground of the project's own terrains is at 0.

A node of the terrain takes the mean of the map round it, weighted by a tent: half as wide as the map's own spacing or
the terrain's, whichever is larger. Of a coarser map that is linear interpolation; of a finer one nothing aliases; a map
that has the terrain's own nodes is taken as it is.
"""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sim.files.atomic import read_json
from sim.files.npz import array_names, read_arrays
from sim.ground import GroundMaps
from sim.terrain import NUM_COLS, NUM_ROWS, SPACING

MIN_SIDE_M = 1.0
MAX_SIDE_M = 100.0
MAX_HEIGHT_M = 10.0
"""Largest height, above or below 0."""
_MAX_NODES = 10_000  # along one side
_MAX_BYTES = 8 * _MAX_NODES**2 + 1024  # of as many float64, and a header
_GROUND = ("friction", "time_constant_s")
_WHOLE = (SPACING * (NUM_COLS - 1), SPACING * (NUM_ROWS - 1))
_GRAY_MODES = ("L", "I", "I;16", "I;16B", "I;16L", "I;16N")


@dataclass(frozen=True, kw_only=True)
class Heightmap:
    """A grid of heights over a rectangle."""

    heights: NDArray[np.float64]
    """[m], shape (nrow, ncol): row along y from the lowest, column along x."""
    size_m: tuple[float, float]
    """Along x and along y, from the first node to the last."""
    ground: GroundMaps | None = None
    """Friction and softness, of a map that has the size of a terrain."""


def read_heightmap(
    path: str | Path,
    *,
    size_m: Sequence[float] | None = None,
    scale_m: float | None = None,
    offset_m: float | None = None,
) -> Heightmap:
    """A heightmap from a file: data only, nothing in it can run.

    An ``.npz`` holds ``heights`` (nrow, ncol), floats in metres, row along y, and may hold ``size_m``; of the size of a
    terrain also ``friction`` and ``time_constant_s``, as :class:`sim.ground.GroundMaps` has them. A ``.png`` is
    8 or 16-bit grayscale seen from above, x to the right and y up; height = offset + scale * gray level. What is not
    given here is taken from the npz, or from the keys ``size_m``, ``scale_m`` and ``offset_m`` of a JSON of the same
    name beside the image; without an offset it is 0.

    Args:
        path: The file.
        size_m: Along x and along y.
        scale_m: Metres a gray level; heights of an npz are multiplied by it too, if it is given.
        offset_m: Height of gray level 0; added to the heights of an npz, if it is given.

    Raises:
        FileNotFoundError: If there is no such file.
        ValueError: If the file is damaged or of another kind, a size or scale is missing, or a number is out of range.
    """
    path = Path(path)
    if not os.path.isfile(path):  # False too for a name that no file can have
        raise FileNotFoundError(f"no heightmap at {path}: expected an .npz or a .png file")
    given = {"size_m": size_m, "scale_m": scale_m, "offset_m": offset_m}
    kind, ground = path.suffix.lower(), None
    if kind == ".npz":
        heights, inside = _read_npz(path)
        ground = inside.pop("ground")
    elif kind == ".png":
        heights = _read_png(path)
        beside = path.with_suffix(".json")
        inside = {name: value for name, value in read_json(beside).items() if name in given} if beside.exists() else {}
        if scale_m is None and "scale_m" not in inside:
            raise ValueError(
                f"{path}: how many metres is a gray level? give --scale, or scale_m in {beside.name} beside it"
            )
    else:
        raise ValueError(f"a heightmap must be an .npz or a .png file, got {path}: save it as one of these")
    known = inside | {name: value for name, value in given.items() if value is not None}
    size = _checked_size(path, known.get("size_m"))
    scale, offset = (_checked_number(path, name, known.get(name, at)) for name, at in (("scale_m", 1), ("offset_m", 0)))
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is named below
        heights = heights * scale + offset
    if ground is not None and not np.allclose(size, _WHOLE, rtol=0.0, atol=1e-6):
        raise ValueError(
            f"{path}: a map with friction or softness must be {_WHOLE[0]:g} m x {_WHOLE[1]:g} m, got {size[0]:g} m x "
            f"{size[1]:g} m: they are of patches of a whole terrain"
        )
    return Heightmap(heights=_checked(path, heights), size_m=size, ground=ground)


def _read_npz(path: Path) -> tuple[NDArray[np.float64], dict[str, Any]]:
    try:
        found = sorted(array_names(path))
        wanted = [name for name in ("heights", "size_m", *_GROUND) if name in found]
        arrays = read_arrays(path, wanted, max_bytes=_MAX_BYTES)
    except Exception as error:  # zipfile, zlib and npy headers answer damage with a dozen types
        raise ValueError(f"{path} must be an .npz file of arrays, but it is damaged or another file: {error}") from None
    if "heights" not in arrays:
        raise ValueError(f"{path} must hold an array 'heights', got {', '.join(found) or 'nothing'}: name it so")
    heights = arrays["heights"]
    if heights.ndim != 2 or heights.dtype.kind != "f":
        raise ValueError(
            f"{path}: heights must be floats [m] of shape (nrow, ncol), got {heights.dtype} of shape {heights.shape}"
        )
    inside: dict[str, Any] = {"size_m": arrays["size_m"].ravel().tolist()} if "size_m" in arrays else {}
    inside["ground"] = _ground_in(path, arrays)
    with np.errstate(invalid="ignore"):  # what is not finite is named later
        return heights.astype(np.float64), inside


def _ground_in(path: Path, arrays: dict[str, NDArray[Any]]) -> GroundMaps | None:
    there = [arrays[name] for name in _GROUND if name in arrays]
    if not there:
        return None
    try:
        plain = GroundMaps.plain(1, there[0].shape)
        maps = (np.asarray(arrays.get(name, getattr(plain, name)[0]), dtype=np.float32)[None] for name in _GROUND)
        friction, time_constant_s = maps
        return GroundMaps(friction=friction, time_constant_s=time_constant_s)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None


def _read_png(path: Path) -> NDArray[np.float64]:
    try:
        with Image.open(path, formats=["PNG"]) as image:
            mode, size = image.mode, image.size
            gray = np.asarray(image) if mode in _GRAY_MODES and max(size) <= _MAX_NODES else None
    except Exception as error:  # a damaged image can fail with anything
        raise ValueError(f"{path} must be a PNG image, but it is damaged or another file: {error}") from None
    if max(size) > _MAX_NODES:
        raise ValueError(f"{path}: an image may have at most {_MAX_NODES} pixels a side, got {size[0]} x {size[1]}")
    if gray is None:
        raise ValueError(f"{path} must be a grayscale image of 8 or 16 bits, got mode '{mode}': convert it first")
    return gray[::-1].astype(np.float64)


def _checked_size(path: Path, size: Any) -> tuple[float, float]:
    if size is None:
        raise ValueError(
            f"{path}: how large is it? give --size X Y in metres, or size_m in the .npz or in a .json beside a .png"
        )
    sides = list(size) if isinstance(size, list | tuple) else [size]
    if len(sides) != 2 or not all(_is_number(side) and MIN_SIDE_M <= side <= MAX_SIDE_M for side in sides):
        raise ValueError(
            f"{path}: size_m must be two lengths of {MIN_SIDE_M:g} to {MAX_SIDE_M:g} m, along x and along y, got "
            f"{size}: a crossing is 16 m x 8 m"
        )
    return float(sides[0]), float(sides[1])


def _is_number(value: Any) -> bool:
    return type(value) in (int, float) and abs(value) <= sys.float_info.max  # False of NaN


def _checked_number(path: Path, name: str, value: Any) -> float:
    if not _is_number(value) or (name == "scale_m" and value == 0):
        raise ValueError(f"{path}: {name} must be a finite number of metres, a scale not 0, got {value}")
    return float(value)


def _checked(path: Path, heights: NDArray[np.float64]) -> NDArray[np.float64]:
    if min(heights.shape) < 2 or max(heights.shape) > _MAX_NODES:
        shape = " x ".join(map(str, heights.shape))
        raise ValueError(f"{path}: a heightmap needs 2 to {_MAX_NODES} nodes a side, got {shape} (rows x columns)")
    if not np.isfinite(heights).all():
        count = np.count_nonzero(~np.isfinite(heights))
        raise ValueError(f"{path}: {count} of {heights.size} heights are NaN or infinite: fill them first")
    low, high = float(heights.min()), float(heights.max())
    if max(-low, high) > MAX_HEIGHT_M:
        raise ValueError(
            f"{path}: heights must lie in +-{MAX_HEIGHT_M:g} m, got {low:g} to {high:g} m: are they metres (--scale), "
            "and is the ground about 0 (--offset)?"
        )
    return heights


def as_terrain(heightmap: Heightmap) -> NDArray[np.float32]:
    """A heightmap as a terrain to cross, by the rules at the top of this file.

    Returns:
        Heights [m], float32, shape (NUM_ROWS, NUM_COLS).
    """
    heights, (size_x, size_y) = heightmap.heights, heightmap.size_m
    if heights.shape == (NUM_ROWS, NUM_COLS) and np.allclose(heightmap.size_m, _WHOLE, rtol=0.0, atol=1e-6):
        return heights.astype(np.float32)
    along_y = _weights(heights.shape[0], size_y, NUM_ROWS)
    along_x = _weights(heights.shape[1], size_x, NUM_COLS)
    return (along_y @ heights @ along_x.T).astype(np.float32)


def _weights(count: int, size: float, num_nodes: int) -> NDArray[np.float64]:
    """Weights of ``count`` nodes of a map in each node of the terrain along one axis, shape (num_nodes, count)."""
    spacing = size / (count - 1)
    nodes = SPACING * (np.arange(num_nodes) - 0.5 * (num_nodes - 1)) + 0.5 * size
    distance = np.abs(np.clip(nodes, 0.0, size)[:, None] - spacing * np.arange(count))
    tent = np.maximum(0.0, 1.0 - distance / max(spacing, SPACING))
    return tent / tent.sum(axis=1, keepdims=True)


def fitted(heightmap: Heightmap) -> str:
    """What becomes of a map on the terrain, in words."""
    rows, columns = heightmap.heights.shape
    said = f"{columns} x {rows} nodes over {heightmap.size_m[0]:g} x {heightmap.size_m[1]:g} m"
    said += f", heights {heightmap.heights.min():.2f} to {heightmap.heights.max():.2f} m"
    sides = zip("xy", heightmap.size_m, _WHOLE, strict=True)
    for axis, side, whole in sides:
        if side > whole + 1e-6:
            said += f", cut to its middle {whole:g} m along {axis}"
        elif side < whole - 1e-6:
            said += f", continued by the height of its edge to {whole:g} m along {axis}"
    return said if heightmap.ground is None else f"{said}, with friction or softness of its own"
