"""Terrains as files that other programs read, each with what it means in a JSON beside.

All lengths are metres; x runs along the course (0 to 16 m), y across it (0 to 8 m), z up.
"""

import io
import xml.etree.ElementTree as ET
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.sax.saxutils import escape

import numpy as np
import trimesh
from numpy.typing import NDArray
from PIL import Image
from trimesh.exchange.gltf import export_glb
from trimesh.exchange.stl import export_stl
from trimesh.visual import interpolate

from sim.crossing import GROUND_FRICTION, CrossingCfg, SolverCfg
from sim.files.atomic import to_json, write_atomically
from sim.files.npz import npz_bytes
from sim.terrains.hand_crafted import SPACING
from sim.terrains.maps.heightmap import LEAST_EXTENT, QUARTER_TURN, as_hfield, surface_of
from sim.terrains.terrains import GroundMaps

FORMATS = ("npz", "png", "npy", "xml", "stl", "glb", "sdf")
"""Formats by the ending of their files; ``xml`` is MJCF, ``sdf`` a model for Gazebo round the STL beside it."""
STEP_M = 1e-3
"""Height of one step of an npy's whole numbers [m], one for all terrains, as a terrain generator takes it."""
_BASE_BELOW = 0.5  # depth of the block under the lowest point of a mesh [m]
_Y_UP = np.array([[1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, -1.0, 0.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
_SIX_LINES = """<?xml version="1.0"?>
<sdf version="1.9"><model name="{name}"><static>true</static><link name="terrain">
<collision name="terrain"><geometry><mesh><uri>{name}.stl</uri></mesh></geometry></collision>
<visual name="terrain"><geometry><mesh><uri>{name}.stl</uri></mesh></geometry>
<material><ambient>.5 .47 .43 1</ambient><diffuse>.7 .66 .6 1</diffuse></material></visual>
</link></model></sdf>
"""


@dataclass(frozen=True, kw_only=True)
class ExportedTerrain:
    """A terrain, and what some of its files say beside its heights."""

    heights: NDArray[np.floating]
    """[m], shape (nrow, ncol)."""
    name: str = "terrain"
    """Stem of its files."""
    genes: NDArray[np.floating] | None = None
    """Shape (num_genes,)."""
    ground: GroundMaps | None = None
    """Friction and softness, where they are not as always."""
    timestep: float = 0.005
    """Physics step of the robot that crosses it [s]."""

    @property
    def size(self) -> tuple[float, float]:
        """Along x and along y [m]."""
        return SPACING * (self.heights.shape[1] - 1), SPACING * (self.heights.shape[0] - 1)

    @property
    def gray_scale(self) -> tuple[float, float]:
        """Metres a gray level of a PNG and height of level 0, so that all 16 bits are used."""
        return max(float(np.ptp(self.heights)), LEAST_EXTENT) / 65_535, float(self.heights.min())

    def on_ground(self, x: float, y: float) -> tuple[float, float, float]:
        """The node next to a place [m]."""
        return x, y, float(self.heights[round(y / SPACING), round(x / SPACING)])


def encode_terrain(terrain: ExportedTerrain, ending: str) -> bytes:
    """The content of a file of one of :data:`FORMATS`."""
    heights, buffer = np.asarray(terrain.heights, dtype=np.float64), io.BytesIO()
    match ending:
        case "npz":  # as sim.terrains.maps.heightmap reads it, and genes
            content = {"heights": np.asarray(terrain.heights, np.float32), "size_m": np.array(terrain.size)}
            if terrain.genes is not None:
                content["genes"] = np.asarray(terrain.genes, np.float32)
            if (ground := terrain.ground) is not None:
                content |= {"friction": ground.friction[0], "time_constant_s": ground.time_constant_s[0]}
            return npz_bytes(content)
        case "png":  # 16-bit gray, seen from above: x to the right, y up, so that the topmost row is the highest y
            scale, offset = terrain.gray_scale
            gray = np.rint((heights - offset) / scale).astype(np.uint16)
            Image.fromarray(np.ascontiguousarray(gray[::-1])).save(buffer, format="PNG", optimize=True)
            return buffer.getvalue()
        case "npy":  # as terrain generators of Isaac Lab and legged_gym hold heights: int16 [x, y], in steps of 1 mm
            steps = np.rint(heights.T / STEP_M)
            if np.abs(steps).max() > np.iinfo(np.int16).max:
                largest = f"{np.abs(heights).max():g} m: leave npy out of the formats"
                raise ValueError(f"heights of an npy must lie within 32.767 m of 0, got {largest}")
            np.save(buffer, np.ascontiguousarray(steps.astype(np.int16)))
            return buffer.getvalue()
        case "stl":
            return export_stl(block_of(terrain.heights))
        case "glb":  # heights as colours; a node turns the block, since y is up in glTF
            block, scene = block_of(terrain.heights), trimesh.Scene()
            colors = interpolate(block.vertices[:, 2].clip(terrain.heights.min()), "viridis")
            mesh = trimesh.Trimesh(block.vertices, block.faces, vertex_colors=colors, process=False)
            scene.add_geometry(mesh, transform=_Y_UP)
            return export_glb(scene)
        case "sdf":
            return _SIX_LINES.format(name=escape(terrain.name, {'"': "&quot;"})).encode()
        case _:
            return _encode_mjcf(terrain)


def _encode_mjcf(terrain: ExportedTerrain) -> bytes:
    """A scene of the terrain alone: its surface, step and solver are the simulation's; gravity is the earth's."""
    field, solver = as_hfield(terrain.heights), SolverCfg()
    root = ET.Element("mujoco", model=terrain.name)
    option = {"timestep": f"{terrain.timestep:g}", "gravity": "0 0 -9.81", "integrator": "implicitfast"}
    option |= {"cone": "elliptic", "iterations": str(solver.iterations), "ls_iterations": str(solver.ls_iterations)}
    ET.SubElement(root, "option", option)
    rows, columns = map(str, field.data.shape)
    # The first row of an elevation has the highest y of the asset; MuJoCo scales what it reads to 0..1.
    lines = [" ".join(f"{value:.7g}" for value in row) for row in field.data[::-1]]
    elevation = {"nrow": rows, "ncol": columns, "size": _join_numbers(field.size), "elevation": " ".join(lines)}
    asset = ET.SubElement(root, "asset")
    ET.SubElement(asset, "hfield", {"name": "terrain", **elevation})
    sky = {"type": "skybox", "builtin": "gradient", "rgb1": "0.72 0.81 0.91", "rgb2": "0.96 0.97 0.98"}
    ET.SubElement(asset, "texture", {"name": "sky", "width": "64", "height": "384", **sky})
    world = ET.SubElement(root, "worldbody")
    ET.SubElement(world, "light", name="sun", directional="true", pos="8 4 10", dir="0.3 0.4 -1", diffuse="0.8 0.8 0.8")
    shape = {"type": "hfield", "hfield": "terrain", "friction": str(GROUND_FRICTION), "rgba": "0.7 0.66 0.6 1"}
    shape["solmix"] = "0"  # the stiffness of a contact is the robot's
    shape |= {"pos": _join_numbers(field.position), "quat": _join_numbers(QUARTER_TURN)}
    ET.SubElement(world, "geom", {"name": "terrain", **shape})
    for name, place, color in (("start", CrossingCfg.start, "1 1 1 1"), ("goal", CrossingCfg.goal, "0 0.62 0.45 1")):
        position = _join_numbers(terrain.on_ground(*place))
        ET.SubElement(world, "site", name=name, type="cylinder", size="0.15 0.01", pos=position, rgba=color)
    ET.indent(root)
    return ET.tostring(root, encoding="utf-8", xml_declaration=True)


def _join_numbers(numbers: Sequence[float]) -> str:
    return " ".join(map(repr, numbers))


def block_of(heights: NDArray[np.floating]) -> trimesh.Trimesh:
    """A closed block [m]; the terrain's triangles come first, 2 a cell, cut as :mod:`kernels.heightfield` is."""
    top, surface = surface_of(heights)
    node = np.arange(len(top)).reshape(heights.shape)
    # Once round the rim, the terrain on the left; below it the bottom's rim, and fans to the middle of the bottom.
    rim = np.concatenate([node[0, :-1], node[:-1, -1], node[-1, :0:-1], node[:0:-1, 0]])
    below = top[rim] * [1.0, 1.0, 0.0] + [0.0, 0.0, top[:, 2].min() - _BASE_BELOW]
    under = len(top) + np.arange(len(rim))
    next_rim, next_under, middle = np.roll(rim, -1), np.roll(under, -1), np.full_like(rim, len(top) + len(rim))
    walls = np.stack([under, next_under, rim, next_under, next_rim, rim], axis=1).reshape(-1, 3)
    faces = np.concatenate([surface, walls, np.stack([middle, next_under, under], axis=1)])
    return trimesh.Trimesh(np.concatenate([top, below, below.mean(axis=0, keepdims=True)]), faces, process=False)


def write_terrain(
    folder: Path, terrain: ExportedTerrain, *, formats: Sequence[str], about: dict[str, Any]
) -> list[Path]:
    """Writes a terrain as ``<name>.<format>``, and as ``<name>.json`` what the files mean; each atomically.

    The folder exists; :func:`check_formats` takes the formats, of which the npz holds genes and ground too; ``about``
    are further keys of the JSON.
    """
    if terrain.ground is not None and "npz" not in formats:
        raise ValueError(f"formats must have npz, which alone holds friction and softness, got {', '.join(formats)}")
    scale, offset = terrain.gray_scale
    meaning = {
        "size_m": list(terrain.size),
        "nodes": list(terrain.heights.shape),
        "start": terrain.on_ground(*CrossingCfg.start),
        "goal": terrain.on_ground(*CrossingCfg.goal),
        "axes": "rows along y, columns along x; of an npy x along the rows; the top row of a PNG is the highest y",
        "scale_m": scale,
        "offset_m": offset,
        "png_height": "offset_m + scale_m * gray level",
        "horizontal_scale": SPACING,
        "vertical_scale": STEP_M,
        "npy_height": "vertical_scale * whole number",
        **about,
    }
    files = {folder / f"{terrain.name}.{ending}": encode_terrain(terrain, ending) for ending in formats}
    files[folder / f"{terrain.name}.json"] = to_json(meaning)
    for path, content in files.items():
        write_atomically(path, content)
    return list(files)


def check_formats(formats: Sequence[str]) -> None:
    """Raises ValueError unless all formats are known, there is one, and an SDF has its mesh."""
    unknown = [ending for ending in formats if ending not in FORMATS]
    if unknown or not formats:
        raise ValueError(f"formats must be some of {', '.join(FORMATS)}, got {', '.join(unknown) or 'none'}")
    if "sdf" in formats and "stl" not in formats:
        raise ValueError(f"formats must have stl, the mesh of an sdf, got {', '.join(formats)}")
