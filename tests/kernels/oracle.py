"""Terrain and contact written a second time: float64 NumPy, from the definitions, slow and plain.

The tests hold the kernels against it, and against :mod:`sim.mujoco_c.model` for heights, observation, command and
penalties; nothing in either is shared with the kernels or ported from them. Vectors are world-local.
"""

from typing import Any

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from sim.mujoco_c.model import surface_heights

Array = Any  # an array, or a sequence of numbers: checked by what is computed

TABLE_I = {  # the paper's minimum and maximum of each parameter, in gene order
    "mu_x": (6, 10),
    "mu_y": (2, 6),
    "sigma_x": (0.5, 3),
    "sigma_y": (0.5, 3),
    "p_x": (1, 4),
    "p_y": (1, 4),
    "theta": (-np.pi, np.pi),
    "w": (-0.25, 0.25),
}


def mixture_height(genes: Array, x: Array, y: Array) -> Array:
    """The paper's equation 1 for one terrain: genes (8 * num_bumps,), heights of the shape of x and y."""
    low, high = np.array(list(TABLE_I.values())).T
    height = np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
    for bump in low + (np.clip(np.float64(genes), -1, 1).reshape(-1, 8) + 1) / 2 * (high - low):
        mu_x, mu_y, sigma_x, sigma_y, p_x, p_y, theta, w = bump
        x_rot = np.cos(theta) * (x - mu_x) - np.sin(theta) * (y - mu_y)
        y_rot = np.sin(theta) * (x - mu_x) + np.cos(theta) * (y - mu_y)
        height += w * np.exp(-(np.abs(x_rot / sigma_x) ** (2 * p_x)) - np.abs(y_rot / sigma_y) ** (2 * p_y))
    return height


def triangles(grid: Array, spacing: float, x: float, y: float, reach: float) -> Array:
    """Corners (num, 3, 3) of every surface triangle within ``reach`` of (x, y); edge heights continue outside.

    Each cell is cut from its (low x, high y) to its (high x, low y) corner; corners run counter-clockwise from above.
    """
    cols = np.arange(np.floor((x - reach) / spacing) - 1, np.floor((x + reach) / spacing) + 2).astype(int)
    rows = np.arange(np.floor((y - reach) / spacing) - 1, np.floor((y + reach) / spacing) + 2).astype(int)
    row, col = (index.ravel() for index in np.meshgrid(rows, cols, indexing="ij"))

    def node(i: Array, j: Array) -> Array:
        inside = np.clip(i, 0, grid.shape[0] - 1), np.clip(j, 0, grid.shape[1] - 1)
        return np.stack([j * spacing, i * spacing, np.float64(grid[inside])], axis=-1)

    low = np.stack([node(row, col), node(row, col + 1), node(row + 1, col)], axis=1)
    high = np.stack([node(row + 1, col + 1), node(row + 1, col), node(row, col + 1)], axis=1)
    return np.concatenate([low, high])


def nearest_on_surface(grid: Array, spacing: float, p: Array, reach: float) -> tuple[float, Array | None]:
    """Signed distance of ``p`` to the surface and the nearest point; (inf, None) if nothing is within ``reach``.

    Brute force: on every triangle near, and the best of all.
    """
    p = np.float64(p)
    corners = triangles(grid, spacing, p[0], p[1], reach)
    candidates = trimesh.triangles.closest_point(corners, np.tile(p, (len(corners), 1)))
    distances = np.linalg.norm(candidates - p, axis=1)
    best = np.argmin(distances)
    below = p[2] < surface_heights(grid, p[0], p[1])
    if distances[best] > reach:
        return (-np.inf if below else np.inf), None
    return (-distances[best] if below else distances[best]), candidates[best]


def rotation_matrix(quaternion_xyzw: Array) -> Array:
    """Matrix that turns base-frame vectors into the world frame."""
    return Rotation.from_quat(quaternion_xyzw).as_matrix()
