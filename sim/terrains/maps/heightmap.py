"""Height grids as triangles and as heightfields of MuJoCo's, and heightmaps of a user as terrains to cross.

MuJoCo cuts every cell of a heightfield from its (low x, low y) to its (high x, high y) corner, for contacts as for
rays; ours are cut from (low x, high y) to (high x, low y) (:mod:`kernels.heightfield`). On a grid that is turned by a
quarter the one cut is the other, so our grids are handed over on their side, their columns along MuJoCo's rows: then
both have the same surface, between the nodes too.

A map of a user is a grid of nodes over a rectangle of ``size_m`` (along x, along y), from edge to edge. It is laid with
its middle on the middle of the terrain, 16 m x 8 m, which robots cross from x = 2 m to 14 m. What reaches beyond the
terrain is cut off; where the map ends before it, the height of its edge continues. Heights stay as they are: the ground
of the project's own terrains is at 0.

A node of the terrain takes the mean of the map round it, weighted by a tent: half as wide as the map's own spacing or
the terrain's, whichever is larger. Of a coarser map that is linear interpolation; of a finer one nothing aliases; a map
that has the terrain's own nodes is taken as it is.
"""

import os
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from PIL import Image

from sim.files.atomic import read_json
from sim.files.npz import array_names, read_arrays
from sim.files.settings import from_builtins
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS, SPACING
from sim.terrains.terrains import GroundMaps

LEAST_EXTENT = 1e-3
"""Of flat ground, whose range is 0 where a size or scale may not be [m]."""
_THICKNESS = 1.0  # of the ground below its lowest point [m]
QUARTER_TURN = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
"""Of the geom, quaternion w x y z: its x axis is the grid's y, its y axis the grid's -x."""
_MAX_HEIGHT_M = 10.0  # above or below 0
_MAX_NODES = 10_000  # along one side
_WHOLE = (SPACING * (NUM_COLS - 1), SPACING * (NUM_ROWS - 1))
_GRAY_MODES = ("L", "I", "I;16", "I;16B", "I;16L", "I;16N")


@dataclass(frozen=True, kw_only=True)
class Hfield:
    """What an ``hfield`` asset and the ``geom`` that shows it need beside :data:`QUARTER_TURN`; axes are the grid's."""

    data: NDArray[np.float64]
    """0 to 1, as in ``MjModel.hfield_data``; an asset's ``elevation`` has its rows in reverse."""
    size: tuple[float, float, float, float]
    """Half lengths along the asset's x and y, height of data 1, thickness below data 0 [m]."""
    position: tuple[float, float, float]
    """Of the geom [m]."""


Margins = tuple[tuple[int, int], tuple[int, int]]
"""Nodes to add at low y and high y, and at low x and high x."""


def as_hfield(heights: NDArray[np.floating], *, margin: int | Margins = 0) -> Hfield:
    """A height grid as a heightfield with the same surface, with ``margin`` nodes of edge height more.

    Heights [m] have shape (nrow, ncol), at :data:`sim.terrains.hand_crafted.SPACING`; node (0, 0) stands at x = y = 0.
    """
    margins = ((margin, margin),) * 2 if isinstance(margin, int) else margin
    grid = np.pad(np.asarray(heights, dtype=np.float64), margins, mode="edge")
    lowest, extent = float(grid.min()), float(np.ptp(grid)) or LEAST_EXTENT
    half_y, half_x = (0.5 * SPACING * (count - 1) for count in grid.shape)
    (low_y, _), (low_x, _) = margins
    return Hfield(
        data=((grid - lowest) / extent).T[::-1],
        size=(half_y, half_x, extent, _THICKNESS),
        position=(half_x - SPACING * low_x, half_y - SPACING * low_y, lowest),
    )


def surface_of(heights: NDArray[np.floating], margin: int = 0) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
    """The ground that robots walk on: vertices [m], row by row, and two triangles a cell, cut as the physics cuts it.

    Heights [m] have shape (nrow, ncol), node (0, 0) at x = y = 0; ``margin`` more nodes continue each edge.
    """
    grid = np.pad(heights, margin, mode="edge")
    nrow, ncol = grid.shape
    y, x = (SPACING * (np.arange(count) - margin) for count in grid.shape)
    vertices = np.stack([*np.meshgrid(x, y), grid], axis=-1).reshape(-1, 3)
    low = (np.arange(nrow - 1)[:, None] * ncol + np.arange(ncol - 1)).ravel()
    # Each cell is cut from its (low x, high y) to its (high x, low y) corner.
    faces = np.stack([low, low + 1, low + ncol, low + 1, low + ncol + 1, low + ncol], axis=1)
    return vertices.astype(np.float64), faces.reshape(-1, 3)


@dataclass(frozen=True, kw_only=True)
class Heightmap:
    """A grid of heights over a rectangle."""

    heights: NDArray[np.float64]
    """[m], shape (nrow, ncol): row along y from the lowest, column along x."""
    size_m: tuple[float, float]
    """Along x and along y, from the first node to the last."""
    ground: GroundMaps | None = None
    """Friction and softness, of a map that has the size of a terrain."""


@dataclass(frozen=True, kw_only=True)
class _Meaning:
    """What a file or the caller says of a map."""

    size_m: tuple[Annotated[float, Meta(ge=1, le=100)], Annotated[float, Meta(ge=1, le=100)]]
    scale_m: float = 1.0
    offset_m: float = 0.0


def read_heightmap(
    path: str | Path,
    *,
    size_m: Sequence[float] | None = None,
    scale_m: float | None = None,
    offset_m: float | None = None,
) -> Heightmap:
    """A heightmap from a file: data only, nothing in it can run.

    An ``.npz`` holds ``heights`` (nrow, ncol), floats in metres, row along y, and may hold ``size_m``; of the size of a
    terrain also ``friction`` and ``time_constant_s``, as :class:`sim.terrains.terrains.GroundMaps` has them. A ``.png``
    is 8 or 16-bit grayscale seen from above, x to the right and y up; height = offset + scale * gray level. What is not
    given here is taken from the npz, or from the keys ``size_m``, ``scale_m`` and ``offset_m`` of a JSON of the same
    name beside the image; without an offset it is 0. Sizes are along x and along y; a given scale and offset are of the
    heights of an npz too.
    """
    path = Path(path)
    if not os.path.isfile(path):  # False too for a name that no file can have
        raise FileNotFoundError(f"no heightmap at {path}: expected an .npz or a .png file")
    beside = path.with_suffix(".json")
    values, maps = dict[str, Any](), dict[str, NDArray[Any]]()
    if path.suffix.lower() == ".npz":
        heights, maps = _read_npz(path)
        values = {"size_m": maps.pop("size_m").ravel().tolist()} if "size_m" in maps else {}
    elif path.suffix.lower() == ".png":
        heights = _read_png(path)
        values = read_json(beside) if beside.exists() else {}
        if scale_m is None and "scale_m" not in values:
            raise ValueError(f"{path}: expected metres a gray level: give --scale, or scale_m in {beside.name}")
    else:
        raise ValueError(f"a heightmap must be an .npz or a .png file, got {path}: save it as one of these")
    given = {"size_m": size_m, "scale_m": scale_m, "offset_m": offset_m}
    values = {name: value for name, value in values.items() if name in given}
    values |= {name: value for name, value in given.items() if value is not None}
    if "size_m" not in values:
        raise ValueError(f"{path}: expected its size: give --size X Y [m], or size_m in the .npz or in {beside.name}")
    meaning = from_builtins(_Meaning, values, str(path))
    with np.errstate(over="ignore", invalid="ignore"):  # what is not finite is named below
        heights = heights * meaning.scale_m + meaning.offset_m
    try:
        _check_heights(heights, meaning.size_m)
        if maps and not _is_whole(meaning.size_m):
            whole = " x ".join(f"{side:g}" for side in _WHOLE)
            raise ValueError(f"with friction or softness it must be {whole} m, got {meaning.size_m}")
        arrays: Any = {name: np.asarray(values, np.float32)[None] for name, values in maps.items()}
        ground = replace(GroundMaps.plain(1), **arrays) if maps else None
    except (TypeError, ValueError) as error:
        raise ValueError(f"{path}: {error}") from None
    return Heightmap(heights=heights, size_m=meaning.size_m, ground=ground)


def _read_npz(path: Path) -> tuple[NDArray[np.float64], dict[str, NDArray[Any]]]:
    """Heights, and the other arrays."""
    try:
        names = [name for name in array_names(path) if name in ("size_m", "friction", "time_constant_s")]
        arrays = read_arrays(path, ["heights", *names], max_bytes=8 * _MAX_NODES**2 + 1024)
        return arrays.pop("heights").astype(np.float64, casting="same_kind"), arrays
    except Exception as error:  # zipfile, zlib and npy headers answer damage with a dozen types
        raise ValueError(f"{path} must be an .npz file with an array 'heights', got: {error}") from None


def _read_png(path: Path) -> NDArray[np.float64]:
    try:
        with Image.open(path, formats=["PNG"]) as image:
            mode, size = image.mode, image.size
            gray = np.asarray(image) if mode in _GRAY_MODES and max(size) <= _MAX_NODES else None
    except Exception as error:  # a damaged image can fail with anything
        raise ValueError(f"{path} must be a PNG image, got: {error}") from None
    if gray is None:
        raise ValueError(f"{path} must be grayscale of 8 or 16 bits, got mode '{mode}', {size}: convert it first")
    return gray[::-1].astype(np.float64)


def _is_whole(size_m: tuple[float, float]) -> bool:
    return np.allclose(size_m, _WHOLE, rtol=0.0, atol=1e-6)


def _check_heights(heights: NDArray[np.float64], size_m: tuple[float, float]) -> None:
    """Refuses a map whose nodes would be as far apart along x as along y if the axes were swapped, and now are not."""
    if heights.ndim != 2 or min(heights.shape) < 2 or max(heights.shape) > _MAX_NODES:
        raise ValueError(f"heights must have 2 axes of 2 to {_MAX_NODES} nodes, got {heights.shape}")
    if count := np.count_nonzero(~np.isfinite(heights)):
        raise ValueError(f"{count} of {heights.size} heights are NaN or infinite: fill them first")
    low, high = float(heights.min()), float(heights.max())
    if max(-low, high) > _MAX_HEIGHT_M:
        remedy = "are they metres (--scale), and is the ground about 0 (--offset)?"
        raise ValueError(f"heights must lie in +-{_MAX_HEIGHT_M:g} m, got {low:g} to {high:g} m: {remedy}")
    (rows, columns), (size_x, size_y) = heights.shape, size_m
    now, turned = size_x / (columns - 1) * (rows - 1) / size_y, size_x / (rows - 1) * (columns - 1) / size_y
    if abs(np.log(turned)) < 0.01 and abs(np.log(now)) > np.log(2.0):
        got = f"{heights.shape} over {size_x:g} m along x and {size_y:g} m along y: x and y are swapped"
        raise ValueError(f"heights must be (nrow, ncol) with rows along y, got {got}; transpose them")


def as_terrain(heightmap: Heightmap) -> NDArray[np.float32]:
    """A heightmap as a terrain to cross, by the rules at the top of this file; heights [m], (NUM_ROWS, NUM_COLS)."""
    heights, (size_x, size_y) = heightmap.heights, heightmap.size_m
    if heights.shape == (NUM_ROWS, NUM_COLS) and _is_whole(heightmap.size_m):
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
    """What becomes of a map on the terrain, as text."""
    rows, columns = heightmap.heights.shape
    (size_x, size_y), low, high = heightmap.size_m, heightmap.heights.min(), heightmap.heights.max()
    text = f"{columns} x {rows} nodes over {size_x:g} x {size_y:g} m, heights {low:.2f} to {high:.2f} m"
    for axis, side, whole in zip("xy", heightmap.size_m, _WHOLE, strict=True):
        if abs(side - whole) > 1e-6:
            text += f", {'cut to its middle' if side > whole else 'continued by its edge to'} {whole:g} m along {axis}"
    return text if heightmap.ground is None else f"{text}, with friction or softness of its own"
