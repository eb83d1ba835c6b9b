"""What the viewer shows, as triangles: a terrain coloured by height, a robot's bodies, and arrows.

Colours of vertices are in linear light, as glTF and the browser want them.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from sim.ground import GroundMaps
from sim.maps.picture import height_colors, tinted
from sim.recording.scene import surface_of
from sim.robots.skeleton import Geom, Skeleton
from sim.terrain import SPACING

Color = tuple[int, int, int]

_LINE_EVERY = 1.0  # [m]
_LINE_DARKNESS = 0.84
_SEGMENTS = 20  # round a capsule
_CREASE = 0.6  # angle between faces from which on an edge is sharp [rad]


@dataclass(frozen=True, kw_only=True)
class Part:
    """Shapes of one body that show the same touch, in its frame."""

    body: int
    touches: tuple[int, ...]
    """Columns of ``robot.geom_names``."""
    mesh: trimesh.Trimesh


def in_bytes(color: tuple[float, float, float]) -> Color:
    """A colour of 0 to 1 in 0 to 255."""
    red, green, blue = (round(255.0 * share) for share in color)
    return red, green, blue


def in_linear_light(colors: NDArray[np.integer]) -> NDArray[np.uint8]:
    """Colours as on a screen (sRGB, 0 to 255) in linear light, in the same shape."""
    share = colors / 255.0
    linear = np.where(share <= 0.04045, share / 12.92, ((share + 0.055) / 1.055) ** 2.4)  # sRGB's own curve
    return np.rint(255.0 * linear).astype(np.uint8)


def terrain_mesh(heights: NDArray[np.floating], ground: GroundMaps | None = None) -> trimesh.Trimesh:
    """The surface that the robot walks on, triangle by triangle: blue below 0, brown above, a darker line every metre.

    Friction and softness of the ``ground`` tint it. The height grid [m] has shape (nrow, ncol), row along y.
    """
    vertices, faces = surface_of(heights)
    color = height_colors(heights)
    color = 255.0 * (color if ground is None else tinted(color, ground))
    every = round(_LINE_EVERY / SPACING)
    color[::every] *= _LINE_DARKNESS
    color[:, ::every] *= _LINE_DARKNESS
    return _mesh(vertices, faces, color.reshape(-1, 3).astype(np.uint8))


def _mesh(vertices: NDArray[np.floating], faces: NDArray[np.integer], colors: NDArray[np.integer]) -> trimesh.Trimesh:
    """Triangles with a colour (sRGB) a vertex, or one of all."""
    colors = np.broadcast_to(in_linear_light(colors), (len(vertices), 3))
    return joined([trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)])


def joined(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """All in one."""
    mesh = trimesh.util.concatenate(meshes)
    assert isinstance(mesh, trimesh.Trimesh)
    _ = mesh.vertex_normals  # computed now, an export has them
    return mesh


def geom_mesh(geom: Geom) -> trimesh.Trimesh:
    """A shape in its body's frame and its colour."""
    if geom.vertices is not None and geom.faces is not None:
        shape = trimesh.Trimesh(geom.vertices, geom.faces, process=False)
    else:
        shape = trimesh.graph.smooth_shade(_primitive(geom.kind, geom.size), angle=_CREASE)
    transform = trimesh.transformations.quaternion_matrix(geom.quaternion)  # w x y z too
    transform[:3, 3] = geom.position
    return _mesh(shape.apply_transform(transform).vertices, shape.faces, np.rint(255.0 * np.array(geom.color)))


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


def arrow_mesh() -> trimesh.Trimesh:
    """An arrow along z, 1 m long when it is not scaled."""
    shaft = trimesh.creation.cylinder(radius=0.02, segment=[[0.0, 0.0, 0.0], [0.0, 0.0, 0.75]], sections=_SEGMENTS)
    head = trimesh.creation.cone(radius=0.05, height=0.25, sections=_SEGMENTS)
    return joined([shaft, head.apply_translation([0.0, 0.0, 0.75])])


def arrow_pose(begin: NDArray[np.floating], end: NDArray[np.floating]) -> tuple[NDArray[np.float64], float]:
    """Quaternion w x y z that turns z into the way from one point to another, and the length of that [m], not 0."""
    length = float(np.linalg.norm(end - begin))
    x, y, z = (end - begin) / length
    half = np.array([1.0 + z, -y, x, 0.0])  # the half turn between z and it
    size = float(np.linalg.norm(half))
    return (half / size if size > 1e-6 else np.array([0.0, 1.0, 0.0, 0.0])), length


def path_mesh(points: NDArray[np.floating], radius: float) -> trimesh.Trimesh:
    """A thin tube of three sides along two or more points [m], in one piece that can be translucent."""
    ahead = np.gradient(points, axis=0)
    left = np.stack([-ahead[:, 1], ahead[:, 0], np.zeros(len(points))], axis=1)
    length = np.linalg.norm(left, axis=1, keepdims=True)
    left = np.where(length > 1e-6, left / np.maximum(length, 1e-6), np.array([0.0, 1.0, 0.0]))
    angles = 2.0 * np.pi * np.arange(3) / 3.0
    round_it = np.cos(angles)[:, None] * left[:, None] + np.sin(angles)[:, None] * np.array([0.0, 0.0, 1.0])
    vertices = (points[:, None] + radius * round_it).reshape(-1, 3)
    k, side = np.divmod(np.arange(3 * (len(points) - 1)), 3)
    a, b = 3 * k + side, 3 * k + (side + 1) % 3
    faces = np.concatenate([np.stack([a, b, a + 3], axis=1), np.stack([b, b + 3, a + 3], axis=1)])
    return trimesh.Trimesh(vertices, faces, process=False)


def robot_parts(skeleton: Skeleton) -> list[Part]:
    """All that is to be seen of a robot."""
    groups = dict[tuple[int, tuple[int, ...]], list[trimesh.Trimesh]]()
    for geom in skeleton.geoms:
        groups.setdefault((geom.body, geom.touches), []).append(geom_mesh(geom))
    return [Part(body=body, touches=touches, mesh=joined(parts)) for (body, touches), parts in groups.items()]
