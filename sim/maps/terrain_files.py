"""Terrains as files that other programs read: npz, 16-bit PNG, MJCF and STL, each with what it means in a JSON beside.

All lengths are metres; x runs along the course (0 to 16 m), y across it (0 to 8 m), z up.

MuJoCo cuts every cell of a heightfield from its (low x, low y) to its (high x, high y) corner, for contacts as for
rays; ours are cut from (low x, high y) to (high x, low y) (:mod:`kernels.heightfield`). On a grid that is turned by a
quarter the one cut is the other, so our grids are handed over on their side, their columns along MuJoCo's rows: then
both have the same surface, between the nodes too.
"""

import io
import xml.etree.ElementTree as ET
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from sim.crossing import GROUND_FRICTION
from sim.files.atomic import to_json, write_atomically
from sim.files.npz import npz_bytes
from sim.ground import GroundMaps
from sim.terrain import SPACING

_QUARTER_TURN = (0.5**0.5, 0.0, 0.0, 0.5**0.5)
_LEAST_EXTENT = 1e-3  # of flat ground, whose range is 0 where a size or scale may not be [m]


@dataclass(frozen=True, kw_only=True)
class Hfield:
    """What an ``hfield`` asset and the ``geom`` that shows it need; world axes are those of the height grid."""

    data: NDArray[np.float64]
    """0 to 1, as in ``MjModel.hfield_data``; an asset's ``elevation`` has its rows in reverse."""
    size: tuple[float, float, float, float]
    """Half lengths along the asset's x and y, height of data 1, thickness below data 0 [m]."""
    position: tuple[float, float, float]
    """Of the geom [m]."""
    quaternion: tuple[float, float, float, float] = _QUARTER_TURN
    """Of the geom, w x y z: its x axis is the grid's y, its y axis the grid's -x."""


Margins = tuple[tuple[int, int], tuple[int, int]]
"""Nodes to add at low y and high y, and at low x and high x."""


def as_hfield(heights: NDArray[np.floating], *, margin: int | Margins = 0, thickness: float = 1.0) -> Hfield:
    """A height grid as a heightfield with the same surface.

    Args:
        heights: [m], shape (nrow, ncol), at :data:`sim.terrain.SPACING`; node (0, 0) stands at x = y = 0.
        margin: Nodes of edge height to add, on every side or on each.
        thickness: Of the ground below its lowest point [m].
    """
    margins = ((margin, margin),) * 2 if isinstance(margin, int) else margin
    grid = np.pad(np.asarray(heights, dtype=np.float64), margins, mode="edge")
    lowest, extent = float(grid.min()), float(np.ptp(grid)) or _LEAST_EXTENT
    half_y, half_x = (0.5 * SPACING * (count - 1) for count in grid.shape)
    (low_y, _), (low_x, _) = margins
    return Hfield(
        data=((grid - lowest) / extent).T[::-1],
        size=(half_y, half_x, extent, thickness),
        position=(half_x - SPACING * low_x, half_y - SPACING * low_y, lowest),
    )


Heights = NDArray[np.floating]

_BASE_BELOW = 0.5  # depth of the block under the lowest point of an STL [m]
_TRIANGLE = np.dtype([("normal", "<f4", 3), ("corners", "<f4", (3, 3)), ("attribute", "<u2")])


def _size_of(heights: Heights) -> tuple[float, float]:
    """Along x and along y [m]."""
    return SPACING * (heights.shape[1] - 1), SPACING * (heights.shape[0] - 1)


def _gray_scale(heights: Heights) -> tuple[float, float]:
    """Metres a gray level of a PNG and height of level 0, so that all 16 bits are used."""
    return max(float(np.ptp(heights)), _LEAST_EXTENT) / 65_535, float(heights.min())


def png_of(heights: Heights) -> bytes:
    """A 16-bit grayscale PNG seen from above: x to the right, y up, so that the topmost row is the highest y."""
    scale, offset = _gray_scale(heights)
    gray = np.rint((np.asarray(heights, dtype=np.float64) - offset) / scale).astype(np.uint16)
    buffer = io.BytesIO()
    Image.fromarray(np.ascontiguousarray(gray[::-1])).save(buffer, format="PNG", optimize=True)
    return buffer.getvalue()


def npz_of(heights: Heights, genes: NDArray[np.floating] | None = None, ground: GroundMaps | None = None) -> bytes:
    """``heights`` [m] float32 (nrow, ncol), row along y, ``size_m`` (along x, along y) and, where known, ``genes``.

    With ground of its own also ``friction`` and ``time_constant_s``, float32 (rows, cols), row along y.
    """
    content = {"heights": np.asarray(heights, np.float32), "size_m": np.array(_size_of(heights))}
    if genes is not None:
        content["genes"] = np.asarray(genes, np.float32)
    if ground is not None:
        content |= {"friction": ground.friction[0], "time_constant_s": ground.time_constant_s[0]}
    return npz_bytes(content)


def mjcf_of(heights: Heights, name: str = "terrain") -> bytes:
    """A scene of the terrain alone, in one file: its surface is the simulation's, between the nodes too.

    The geom stands turned by a quarter; x, y and z of the world are the terrain's. Its friction is below every robot's
    own: of two MuJoCo takes the larger.
    """
    field = as_hfield(heights)
    root = ET.Element("mujoco", model=name)
    rows, columns = map(str, field.data.shape)
    # The first row of an elevation has the highest y of the asset; MuJoCo scales what it reads to 0..1.
    lines = [" ".join(f"{value:.7g}" for value in row) for row in field.data[::-1]]
    size = " ".join(map(repr, field.size))
    asset = {"name": "terrain", "nrow": rows, "ncol": columns, "size": size, "elevation": " ".join(lines)}
    ET.SubElement(ET.SubElement(root, "asset"), "hfield", asset)
    world = ET.SubElement(root, "worldbody")
    ET.SubElement(world, "light", directional="true", pos="0 0 10", dir="0.3 0.4 -1")
    geom = {"name": "terrain", "type": "hfield", "hfield": "terrain", "friction": str(GROUND_FRICTION)}
    geom |= {"pos": " ".join(map(repr, field.position)), "quat": " ".join(map(repr, field.quaternion))}
    ET.SubElement(world, "geom", geom)
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True)


def triangles_of(heights: Heights) -> NDArray[np.float64]:
    """Corners [m] of a closed block with the terrain as its top, counter-clockwise from outside, (num_triangles, 3, 3).

    The top's triangles come first, 2 a cell, cut as :mod:`kernels.heightfield` is.
    """
    rows, columns = heights.shape
    y, x = np.meshgrid(SPACING * np.arange(rows), SPACING * np.arange(columns), indexing="ij")
    top = np.stack([x, y, np.asarray(heights, dtype=np.float64)], axis=-1)
    low, along_x, along_y, high = top[:-1, :-1], top[:-1, 1:], top[1:, :-1], top[1:, 1:]
    surface = np.stack([low, along_x, along_y, high, along_y, along_x], axis=2).reshape(-1, 3, 3)
    # Once round the rim, the terrain on the left; below it the bottom's rim, and fans to the middle of the bottom.
    rim = np.concatenate([top[0, :-1], top[:-1, -1], top[-1, :0:-1], top[:0:-1, 0]])
    under = rim * [1.0, 1.0, 0.0] + [0.0, 0.0, top[..., 2].min() - _BASE_BELOW]
    next_rim, next_under = np.roll(rim, -1, axis=0), np.roll(under, -1, axis=0)
    middle = np.broadcast_to(under.mean(axis=0), under.shape)
    walls = np.stack([under, next_under, rim, next_under, next_rim, rim], axis=1).reshape(-1, 3, 3)
    bottom = np.stack([middle, next_under, under], axis=1)
    return np.concatenate([surface, walls, bottom])


def stl_of(heights: Heights) -> bytes:
    """The block of :func:`triangles_of` as binary STL [m]."""
    corners = triangles_of(heights)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    records = np.zeros(len(corners), _TRIANGLE)
    records["corners"] = corners
    records["normal"] = normals / np.linalg.norm(normals, axis=1, keepdims=True)
    return b"faultline terrain, metres".ljust(80) + np.uint32(len(records)).tobytes() + records.tobytes()


FORMATS: dict[str, Callable[[Heights], bytes]] = {"npz": npz_of, "png": png_of, "xml": mjcf_of, "stl": stl_of}
"""Formats by the ending of their files; ``xml`` is MJCF."""


def write_terrain(
    stem: Path,
    heights: Heights,
    *,
    formats: Sequence[str],
    about: dict[str, Any],
    genes: NDArray[np.floating] | None = None,
    ground: GroundMaps | None = None,
) -> list[Path]:
    """Writes a terrain as ``<stem>.<format>``, and as ``<stem>.json`` what the files mean; each atomically.

    Args:
        stem: Path of the files without their endings; the folder exists.
        heights: Height grid [m], shape (nrow, ncol).
        formats: Some of :data:`FORMATS`; the npz holds genes and ground too.
        about: Further keys of the JSON.
        genes: Shape (num_genes,).
        ground: Friction and softness.
    """
    check_formats(formats)
    scale, offset = _gray_scale(heights)
    meaning = {
        "size_m": list(_size_of(heights)),
        "nodes": list(heights.shape),
        "axes": "rows along y, columns along x; the top row of a PNG is the highest y",
        "scale_m": scale,
        "offset_m": offset,
        "png_height": "offset_m + scale_m * gray level",
        **about,
    }
    contents = {e: npz_of(heights, genes, ground) if e == "npz" else FORMATS[e](heights) for e in formats}
    files = {stem.with_name(f"{stem.name}.{ending}"): content for ending, content in contents.items()}
    files[stem.with_name(f"{stem.name}.json")] = to_json(meaning)
    for path, content in files.items():
        write_atomically(path, content)
    return list(files)


def check_formats(formats: Sequence[str]) -> None:
    """Raises ValueError unless all formats are known and there is one."""
    unknown = [ending for ending in formats if ending not in FORMATS]
    if unknown or not formats:
        raise ValueError(f"formats must be some of {', '.join(FORMATS)}, got {', '.join(unknown) or 'none'}")
