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


# Courses, element after element as a builder would lay them; numbers of the ranges are written out again.
NODES = 20  # a metre
RANGES = {
    "flat": [(0, 0), {"whole": (0, 60)}, (0, 0), (0, 0)],
    "ramp": [(1 / 12, 1 / 3), {"whole": (16, 48)}, (0, 0), (-1, 1)],
    "cross_slope": [(1 / 48, 1 / 3), {"whole": (30, 60)}, (0, 0), (-1, 1)],
    "sill": [(0.013, 0.15), {"whole": (1, 3)}, (0, 0), (0, 0)],
    "rail": [(0.02, 0.172), {"whole": (0, 1)}, (0, 0), (0, 0)],
    "kerb": [(0.03, 0.25), (0, 0), (0, 0), (-1, 1)],
    "step": [(0.1, 0.4), (0, 0), (0, 0), (-1, 1)],
    "stairs": [(0.12, 0.22), (0.22, 0.35), {"whole": (2, 8)}, (-1, 1)],
    "pallet": [(0.1, 0.16), {"whole": (16, 24)}, {"whole": (1, 2)}, (0, 0)],
    "ditch": [(0.05, 0.8), {"whole": (2, 16)}, (0, 0), (0, 0)],
    "bridge": [(0.2, 0.8), {"whole": (16, 40)}, {"whole": (6, 20)}, {"whole": (-10, 10)}],
    "stones": [(0.2, 0.6), {"whole": (20, 48)}, {"whole": (4, 8)}, {"whole": (2, 6)}],
    "rubble": [(0.03, 0.2), {"whole": (16, 48)}, {"whole": (2, 8)}, (-0.5, 0.5)],
}
KINDS = tuple(RANGES)


def value(gene, span):
    share = (min(max(float(gene), -1.0), 1.0) + 1.0) / 2.0
    if isinstance(span, dict):
        low, high = span["whole"]
        return min(low + int(share * (high - low + 1)), high)
    return span[0] + share * (span[1] - span[0])


def gene(wanted, span):
    """The gene of a value; of a whole number the middle of its share."""
    if isinstance(span, dict):
        low, high = span["whole"]
        return 2 * (wanted - low + 0.5) / (high - low + 1) - 1
    return 2 * (wanted - span[0]) / (span[1] - span[0]) - 1 if span[1] > span[0] else 0.0


def element(kind, *, lead=4, size=None, length=None, detail=None, turn=None):
    """Six genes of one element; what is not given is at the low end of its range."""
    given = [size, length, detail, turn]
    parameters = [-1.0 if value is None else gene(value, span) for value, span in zip(given, RANGES[kind], strict=True)]
    kinds = {"whole": (0, len(KINDS) - 1)}
    return [gene(KINDS.index(kind), kinds), gene(lead, {"whole": (4, 16)}), *parameters]


def course(*elements):
    """Genes of a course: these elements, then flat ground."""
    flat = element("flat", length=0)
    return np.float32([*elements, *[flat] * (6 - len(elements))]).reshape(1, 36)


def course_heights(genes):
    """Heights of one course [m], shape (161, 321)."""
    grid, ground = np.zeros((161, 321)), 0.0
    for _, col, patch in patches(genes):
        end = col + patch.shape[1]
        grid[:, col:end] = ground + patch
        ground += patch[80, -1]
        grid[:, end:] = ground
    return grid


def patches(genes):
    """Each element that fits: its number, the node before it, and its heights over the ground there."""
    col = 80
    for number, own in enumerate(np.asarray(genes, float).reshape(6, 6)):
        kind = KINDS[value(own[0], {"whole": (0, 12)})]
        size, length, detail, turn = (value(g, span) for g, span in zip(own[2:], RANGES[kind], strict=True))
        col = min(col + value(own[1], {"whole": (4, 16)}), 240)
        patch = patch_of(kind, size, length, detail, turn, 240 - col)
        if patch is not None:
            yield number, col, patch
            col += patch.shape[1] - 1


def patch_of(kind, size, length, detail, turn, room):
    """Heights of an element over the ground before it, from its last node to the first behind; None: no room."""
    sign = 1 if turn >= 0 else -1
    if kind == "flat":
        return np.zeros((161, min(length, room) + 1))
    if kind in ("kerb", "step"):
        return None if room < 1 else np.tile([0, sign * size], (161, 1))
    if kind == "stairs":
        for steps in range(detail, 1, -1):
            risers = [int(np.floor(k * length * NODES + 0.501)) for k in range(steps)]
            if risers[-1] + 1 <= room:
                nodes = np.arange(risers[-1] + 2)
                return np.tile(sign * size * sum((nodes > riser).astype(float) for riser in risers), (161, 1))
        return None
    faces = 2 if kind in ("sill", "rail", "pallet") else 0
    length = min(length, room - faces)
    if length < RANGES[kind][1]["whole"][0]:
        return None
    patch, y = np.zeros((161, length + faces + 1)), np.arange(161) / NODES - 4
    level = {"sill": 1, "rail": 1, "pallet": detail, "ditch": -1, "bridge": -1, "stones": -1}
    inside = patch[:, 1:-1]
    inside[:] = size * level.get(kind, 0)
    if kind == "ramp":
        patch[:] = sign * size * np.arange(length + 1) / NODES
    elif kind == "cross_slope":
        along = np.arange(length + 1)
        shape = np.minimum(1, 3 * np.minimum(along, length - along) / length)
        patch[:] = sign * size * np.clip(y, -2, 2)[:, None] * shape
    elif kind == "bridge":
        left = 80 + turn - detail // 2
        inside[left : left + detail + 1] = 0
    elif kind == "stones":
        pitch = detail + turn
        for number, first in enumerate(range(turn, length, pitch)):
            shift = number % 2 * (pitch // 2)
            for row in range(80 - detail // 2 - shift - 40 * pitch, 161, pitch):
                patch[max(row, 0) : max(row + detail + 1, 0), first : min(first + detail, length - 1) + 1] = 0
    elif kind == "rubble":
        scattered = (np.arange(length - 1) // detail * 73856093) ^ (np.arange(161)[:, None] // detail * 19349663)
        scattered = ((scattered ^ scattered >> 13) * 1540483477) & 0xFFFFFFFF
        phase = ((scattered ^ scattered >> 15) & 0xFFFFFF) / 2**24 + turn
        inside[:] = size * abs(2 * (phase % 1) - 1)
    return patch
