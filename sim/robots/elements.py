"""Elements of MuJoCo's specifications and compiled models."""

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

mj: Any = mujoco
"""MuJoCo, whose stubs lack most types."""


def joint_names(model: Any) -> tuple[str, ...]:
    """Names of a compiled robot's joints without that of its base."""
    return tuple(model.joint(k).name for k in range(1, model.njnt))


def touching_geoms(*bodies: Any) -> list[Any]:
    """Geoms of bodies that touch the ground, body by body."""
    return [geom for body in bodies for geom in body.geoms if geom.contype or geom.conaffinity]


def read_mesh(model: Any, geom: int) -> tuple[NDArray[np.float32], NDArray[np.int32]]:
    """Vertices [m] and faces of a compiled geom that is a mesh, shapes (num_vertices, 3) and (num_faces, 3)."""
    mesh = model.mesh(model.geom_dataid[geom])
    vertices = model.mesh_vert[int(mesh.vertadr[0]) :][: int(mesh.vertnum[0])]
    faces = model.mesh_face[int(mesh.faceadr[0]) :][: int(mesh.facenum[0])]
    return vertices, faces


def rotation_matrix(quaternion: NDArray[np.float64]) -> NDArray[np.float64]:
    """Rotation matrix of a quaternion w x y z, shape (3, 3)."""
    matrix = np.zeros(9)
    mj.mju_quat2Mat(matrix, np.asarray(quaternion, dtype=np.float64))
    return matrix.reshape(3, 3)
