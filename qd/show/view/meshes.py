"""Triangles that the viewer shows: a terrain coloured by height, a robot's bodies, and arrows.

Colours of vertices are in linear light, as glTF and the browser want them.
"""

from dataclasses import dataclass

import numpy as np
import trimesh
from numpy.typing import NDArray

from sim.robots.robot import RobotCfg
from sim.robots.skeleton import Skeleton
from sim.terrains.ground import GroundMaps
from sim.terrains.hand_crafted import SPACING
from sim.terrains.maps.hfield import surface_of
from sim.terrains.maps.picture import height_colors, tinted

_LINE_EVERY = 1.0  # [m]
_LINE_DARKNESS = 0.84
_SEGMENTS = 20  # round an arrow


@dataclass(frozen=True, kw_only=True)
class Part:
    """Shapes of one body that show the same touch, in its frame."""

    body: int
    touches: tuple[int, ...]
    """Columns of ``robot.geom_names``."""
    is_foot: bool
    mesh: trimesh.Trimesh


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
    return _joined([trimesh.Trimesh(vertices, faces, vertex_colors=colors, process=False)])


def _joined(meshes: list[trimesh.Trimesh]) -> trimesh.Trimesh:
    """One mesh of several."""
    mesh = trimesh.util.concatenate(meshes)
    assert isinstance(mesh, trimesh.Trimesh)
    _ = mesh.vertex_normals  # once computed, an export has them
    return mesh


def arrow_mesh() -> trimesh.Trimesh:
    """An arrow along z, 1 m long when it is not scaled."""
    shaft = trimesh.creation.cylinder(radius=0.02, segment=[[0.0, 0.0, 0.0], [0.0, 0.0, 0.75]], sections=_SEGMENTS)
    head = trimesh.creation.cone(radius=0.05, height=0.25, sections=_SEGMENTS)
    return _joined([shaft, head.apply_translation([0.0, 0.0, 0.75])])


def arrow_pose(begin: NDArray[np.floating], end: NDArray[np.floating]) -> tuple[NDArray[np.float64], float]:
    """Quaternion w x y z that turns z into the way from one point to another, and the length of that [m], not 0."""
    turn = trimesh.geometry.align_vectors([0.0, 0.0, 1.0], end - begin)
    return trimesh.transformations.quaternion_from_matrix(turn), float(np.linalg.norm(end - begin))


def robot_parts(skeleton: Skeleton, robot: RobotCfg) -> list[Part]:
    """The visible shapes of a robot."""
    groups = dict[tuple[int, tuple[int, ...]], list[trimesh.Trimesh]]()
    for geom, touches in skeleton.touches.items():
        body = int(skeleton.model.geom_bodyid[geom]) - 1
        shape, color = skeleton.shape(geom)
        groups.setdefault((body, touches), []).append(_mesh(shape.vertices, shape.faces, np.rint(255.0 * color)))
    first_foot = len(robot.geom_names) - len(robot.foot_geoms)
    return [
        Part(body=body, touches=touches, is_foot=max(touches, default=0) >= first_foot, mesh=_joined(meshes))
        for (body, touches), meshes in groups.items()
    ]
