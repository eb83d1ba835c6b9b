"""What is to be seen, as triangles: a terrain coloured by height, a robot's bodies, and arrows."""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from sim.robots.robot import RobotCfg
from sim.robots.skeleton import Geom, Skeleton
from sim.terrain import SPACING

Color = tuple[int, int, int]

_LOW, _LEVEL, _HIGH = (np.array(color) for color in ((40, 84, 138), (214, 210, 196), (158, 66, 38)))
_LEAST_RANGE = 0.3  # [m]: lower ground is not painted as if it were mountains
_LINE_EVERY = 1.0  # [m]
_LINE_DARKNESS = 0.84
_BASE, _LIMB, _FOOT, _BONE = (112, 124, 146), (150, 160, 176), (230, 92, 34), (182, 188, 198)
_BONE_RADIUS = 0.35  # in that of the robot's thinnest limb or foot
_SEGMENTS = 20  # round a capsule


@dataclass(frozen=True, kw_only=True)
class Mesh:
    """Triangles with a colour a vertex."""

    vertices: NDArray[np.float32]
    """[m], shape (num_vertices, 3)."""
    faces: NDArray[np.uint32]
    """Indices of vertices, counter-clockwise seen from outside, shape (num_faces, 3)."""
    colors: NDArray[np.uint8]
    """RGBA as on a screen (sRGB), shape (num_vertices, 4)."""

    def as_trimesh(self) -> trimesh.Trimesh:
        """The same for trimesh: normals that round the edges, and colours in linear light, as glTF wants them."""
        colors = self.colors.copy()
        colors[:, :3] = in_linear_light(colors[:, :3])
        mesh = trimesh.Trimesh(self.vertices, self.faces, vertex_colors=colors, process=False)
        _ = mesh.vertex_normals  # computed now, an export has them
        return mesh


def in_linear_light(colors: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """Colours as on a screen (sRGB) as the browser takes those of vertices, in the same shape."""
    share = colors / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)  # sRGB's own curve
    return np.rint(255.0 * linear).astype(np.uint8)


def terrain_mesh(heights: NDArray[np.floating]) -> Mesh:
    """The surface that the robot walks on, triangle by triangle: blue below 0, brown above, a darker line every metre.

    Args:
        heights: Height grid [m], shape (nrow, ncol), row along y, column along x.
    """
    nrow, ncol = heights.shape
    y, x = np.meshgrid(SPACING * np.arange(nrow), SPACING * np.arange(ncol), indexing="ij")
    vertices = np.stack([x, y, heights], axis=-1).reshape(-1, 3).astype(np.float32)
    near = (np.arange(nrow - 1)[:, None] * ncol + np.arange(ncol - 1)).ravel()
    # Each cell is cut from its (low x, high y) to its (high x, low y) corner, as the physics has it.
    lower = np.stack([near, near + 1, near + ncol], axis=1)
    upper = np.stack([near + 1, near + ncol + 1, near + ncol], axis=1)
    faces = np.concatenate([lower, upper]).astype(np.uint32)
    return Mesh(vertices=vertices, faces=faces, colors=_height_colors(heights).reshape(-1, 4))


def _height_colors(heights: NDArray[np.floating]) -> NDArray[np.uint8]:
    """RGBA of each node, shape (nrow, ncol, 4)."""
    share = np.clip(heights / max(float(np.abs(heights).max()), _LEAST_RANGE), -1.0, 1.0)[..., None]
    color = np.where(share < 0, _LEVEL + (_LEVEL - _LOW) * share, _LEVEL + (_HIGH - _LEVEL) * share)
    every = round(_LINE_EVERY / SPACING)
    color[::every] *= _LINE_DARKNESS
    color[:, ::every] *= _LINE_DARKNESS
    opaque = np.full((*heights.shape, 1), 255.0)
    return np.concatenate([color, opaque], axis=-1).astype(np.uint8)


def geom_mesh(geom: Geom, color: Color) -> Mesh:
    """A shape in its body's frame."""
    if geom.vertices is not None and geom.faces is not None:
        shape = trimesh.Trimesh(geom.vertices, geom.faces, process=False)
    else:
        shape = _primitive(geom.kind, geom.size)
    transform = trimesh.transformations.quaternion_matrix(geom.quaternion)  # w x y z too
    transform[:3, 3] = geom.position
    return _painted(shape, transform, color)


def _primitive(kind: str, size: NDArray[np.float64]) -> trimesh.Trimesh:
    """A shape about its own centre, along z."""
    radius = float(size[0])
    if kind == "capsule":
        return trimesh.creation.capsule(height=2.0 * float(size[1]), radius=radius, count=(_SEGMENTS, _SEGMENTS))
    if kind == "cylinder":
        return trimesh.creation.cylinder(radius=radius, height=2.0 * float(size[1]), sections=_SEGMENTS)
    if kind == "box":
        return trimesh.creation.box(extents=2.0 * size)
    ball = trimesh.creation.icosphere(subdivisions=2, radius=1.0)
    ball.apply_scale(size if kind == "ellipsoid" else (radius, radius, radius))
    return ball


def _painted(shape: trimesh.Trimesh, transform: NDArray[np.float64], color: Color) -> Mesh:
    vertices = trimesh.transform_points(shape.vertices, transform).astype(np.float32)
    colors = np.tile(np.array([*color, 255], dtype=np.uint8), (len(vertices), 1))
    return Mesh(vertices=vertices, faces=np.asarray(shape.faces, dtype=np.uint32), colors=colors)


def arrow_mesh(color: Color) -> Mesh:
    """An arrow along z, 1 m long when it is not scaled."""
    shaft = trimesh.creation.cylinder(radius=0.02, segment=[[0.0, 0.0, 0.0], [0.0, 0.0, 0.75]], sections=_SEGMENTS)
    head = trimesh.creation.cone(radius=0.05, height=0.25, sections=_SEGMENTS)
    head.apply_translation([0.0, 0.0, 0.75])
    return _joined([_painted(part, np.eye(4), color) for part in (shaft, head)])


def arrow_pose(begin: NDArray[np.floating], end: NDArray[np.floating]) -> tuple[NDArray[np.float64], float]:
    """Quaternion w x y z that turns z into the way from one point to another, and the length of that [m], not 0."""
    length = float(np.linalg.norm(end - begin))
    x, y, z = (end - begin) / length
    half = np.array([1.0 + z, -y, x, 0.0])  # the half turn between z and it
    size = float(np.linalg.norm(half))
    return (half / size if size > 1e-6 else np.array([0.0, 1.0, 0.0, 0.0])), length


def body_meshes(skeleton: Skeleton, robot: RobotCfg) -> list[Mesh | None]:
    """Each body's shapes in its own frame, coloured by role; None of a body with nothing to see.

    A robot whose file has only shapes to collide with gets bones from joint to joint and to its feet, or its parts
    would hang in the air.
    """
    parts: list[list[Mesh]] = [[] for _ in skeleton.body_names]
    for geom in skeleton.geoms:
        parts[geom.body].append(geom_mesh(geom, _color_of(geom.name, robot)))
    if not any(geom.kind == "mesh" for geom in skeleton.geoms):
        for body, end in _bones(skeleton, robot):
            parts[body].append(_bone(end, _bone_radius(skeleton, robot)))
    return [_joined(meshes) if meshes else None for meshes in parts]


def _color_of(name: str, robot: RobotCfg) -> Color:
    if name in robot.foot_geoms:
        return _FOOT
    return _BASE if name in robot.base_geoms else _LIMB


def _bones(skeleton: Skeleton, robot: RobotCfg) -> list[tuple[int, NDArray[np.float64]]]:
    """Body and end point in its frame of every bone, which begins at the body's origin."""
    to_child = [(parent, skeleton.offsets[child]) for child, parent in enumerate(skeleton.parents) if parent >= 0]
    return to_child + [(geom.body, geom.position) for geom in skeleton.geoms if geom.name in robot.foot_geoms]


def _bone_radius(skeleton: Skeleton, robot: RobotCfg) -> float:
    sizes = [float(geom.size[0]) for geom in skeleton.geoms if geom.name in (*robot.limb_geoms, *robot.foot_geoms)]
    return _BONE_RADIUS * float(np.median(sizes))


def _bone(end: NDArray[np.float64], radius: float) -> Mesh:
    length = float(np.linalg.norm(end))
    shape = trimesh.creation.capsule(height=length, radius=radius, count=(8, 8))
    direction = end / length if length > 0.0 else np.array([0.0, 0.0, 1.0])
    transform = np.asarray(trimesh.geometry.align_vectors([0.0, 0.0, 1.0], direction), dtype=np.float64)
    transform[:3, 3] = 0.5 * end
    return _painted(shape, transform, _BONE)


def _joined(meshes: list[Mesh]) -> Mesh:
    starts = np.cumsum([0, *(len(mesh.vertices) for mesh in meshes[:-1])])
    return Mesh(
        vertices=np.concatenate([mesh.vertices for mesh in meshes]),
        faces=np.concatenate([mesh.faces + np.uint32(start) for mesh, start in zip(meshes, starts, strict=True)]),
        colors=np.concatenate([mesh.colors for mesh in meshes]),
    )
