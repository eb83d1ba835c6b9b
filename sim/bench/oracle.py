"""What the kernels compute, written a second time: float64 NumPy, straight from the definitions, slow and plain.

The tests and :mod:`sim.bench` hold the kernels against it; nothing here is shared with the kernels or ported from them.
Vectors are world-local unless a name ends in ``_b``.
"""

from typing import Any

import numpy as np

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
    height = np.zeros(np.broadcast_shapes(np.shape(x), np.shape(y)))
    for bump in np.clip(np.float64(genes), -1, 1).reshape(-1, 8):
        bounds = TABLE_I.values()
        values = [low + (gene + 1) / 2 * (high - low) for gene, (low, high) in zip(bump, bounds, strict=True)]
        mu_x, mu_y, sigma_x, sigma_y, p_x, p_y, theta, w = values
        x_rot = np.cos(theta) * (x - mu_x) - np.sin(theta) * (y - mu_y)
        y_rot = np.sin(theta) * (x - mu_x) + np.cos(theta) * (y - mu_y)
        height += (
            w * np.exp(-((np.abs(x_rot) / sigma_x) ** (2 * p_x))) * np.exp(-((np.abs(y_rot) / sigma_y) ** (2 * p_y)))
        )
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


def _area(u: Array, v: Array) -> Array:
    return u[..., 0] * v[..., 1] - u[..., 1] * v[..., 0]


def under(corners: Array, point: Array) -> Array:
    """Barycentric weights (num, 3) of the vertical through ``point`` in each triangle."""
    a, b, c = corners[:, 0, :2], corners[:, 1, :2], corners[:, 2, :2]
    q = np.float64(point)
    weights = np.stack([_area(b - q, c - q), _area(c - q, a - q), _area(a - q, b - q)], axis=1)
    return weights / _area(b - a, c - a)[:, None]


def surface_height(grid: Array, spacing: float, x: float, y: float) -> float:
    """Height of the triangulated surface at one (x, y)."""
    corners = triangles(grid, spacing, x, y, 0.0)
    weights = under(corners, (x, y))
    k = np.argmax(weights.min(axis=1))
    return float(weights[k] @ corners[k, :, 2])


def _nearest_on_segments(p: Array, start: Array, end: Array) -> Array:
    along = end - start
    share = np.clip(((p - start) * along).sum(1) / (along * along).sum(1), 0, 1)
    return start + share[:, None] * along


def nearest_on_surface(grid: Array, spacing: float, p: Array, reach: float) -> tuple[float, Array | None]:
    """Signed distance of ``p`` to the surface and the nearest point; (inf, None) if nothing is within ``reach``.

    Brute force: on every triangle near, the foot of the perpendicular where it falls inside, and the best of all edges.
    """
    p = np.float64(p)
    corners = triangles(grid, spacing, p[0], p[1], reach)
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    normals /= np.linalg.norm(normals, axis=1)[:, None]
    feet = p - ((p - corners[:, 0]) * normals).sum(1)[:, None] * normals
    inside = np.ones(len(corners), bool)
    for k in range(3):
        edge = corners[:, (k + 1) % 3] - corners[:, k]
        inside &= (np.cross(edge, feet - corners[:, k]) * normals).sum(1) >= 0
    edges = [_nearest_on_segments(p, corners[:, k], corners[:, (k + 1) % 3]) for k in range(3)]
    candidates = np.concatenate([feet[inside], *edges])
    distances = np.linalg.norm(candidates - p, axis=1)
    best = np.argmin(distances)
    below = p[2] < surface_height(grid, spacing, p[0], p[1])
    if distances[best] > reach:
        return (-np.inf if below else np.inf), None
    return (-distances[best] if below else distances[best]), candidates[best]


def rotation_matrix(quaternion_xyzw: Array) -> Array:
    """Matrix that turns base-frame vectors into the world frame."""
    x, y, z, w = np.float64(quaternion_xyzw) / np.linalg.norm(np.float64(quaternion_xyzw))
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    return np.eye(3) + 2 * w * cross + 2 * cross @ cross


def base_velocities(q: Array, qd: Array, base_com: Array) -> tuple[Array, Array]:
    """Base-frame velocity of the base link's origin, and base-frame angular velocity."""
    to_base = rotation_matrix(q[3:7]).T
    ang_vel_b = to_base @ np.float64(qd[3:6])
    return to_base @ np.float64(qd[:3]) - np.cross(ang_vel_b, base_com), ang_vel_b


def geom_forces(
    world: Array, column: Array, frame: Array, efc_address: Array, efc_force: Array,
    shape: tuple[int, int],
) -> Array:  # fmt: skip
    """Sum of contact forces on each geom, (num_envs, num_geoms, 3), each along its frame's normal and two tangents.

    ``column`` is the geom's column in the result, -1 for none; an ``efc_address`` below 0 is a contact without force.
    """
    total = np.zeros((*shape, 3))
    for c in np.flatnonzero((column >= 0) & (efc_address[:, 0] >= 0)):
        force = efc_force[world[c], efc_address[c, :3]].astype(np.float64)
        total[world[c], column[c]] += force @ frame[c].astype(np.float64)
    return total


def penalties(
    q: Array, qd: Array, base_com: Array, command: Array, forces: Array, feet: list[int],
    base_and_limbs: list[int], force_limit: float,
) -> Array:  # fmt: skip
    """The six raw penalties of one physics step, before times dt (definitions: raw penalties)."""
    lin_vel_b, ang_vel_b = base_velocities(q, qd, base_com)
    forces = np.float64(forces)
    sizes = np.linalg.norm(forces, axis=1)
    sideways = np.linalg.norm(forces[:, :2], axis=1)
    return np.array(
        [
            abs(ang_vel_b[2] - command[2]),
            abs(lin_vel_b[0] - command[0]),
            abs(lin_vel_b[1] - command[1]),
            np.maximum(0, sizes[feet] - force_limit).sum(),
            float((sideways[feet] > 5 * np.abs(forces[feet, 2])).any()),
            float((sizes[base_and_limbs] > 0.1).sum()),
        ]
    )


def yaw_of(quaternion_xyzw: Array) -> float:
    """Heading of the base's x axis."""
    forward = rotation_matrix(quaternion_xyzw)[:, 0]
    return np.arctan2(forward[1], forward[0])


def observation(
    q: Array, qd: Array, command: Array, last_action: Array, grid: Array, spacing: float,
    default_joint_pos: Array, scan: Array, base_com: Array,
) -> Array:  # fmt: skip
    """One observation row; ``scan`` (num_scan_points, 2) in the yaw frame."""
    num_joints = len(default_joint_pos)
    q, qd = np.float64(q), np.float64(qd)
    lin_vel_b, ang_vel_b = base_velocities(q, qd, base_com)
    gravity_b = rotation_matrix(q[3:7]).T @ [0, 0, -1]
    yaw = yaw_of(q[3:7])
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    ground = [surface_height(grid, spacing, *(q[:2] + turn @ point)) for point in scan]
    return np.concatenate(
        [
            2 * lin_vel_b,
            0.25 * ang_vel_b,
            gravity_b,
            np.asarray(command, np.float64) * [2, 2, 0.25],
            q[7:] - default_joint_pos,
            0.05 * qd[6 : 6 + num_joints],
            np.float64(last_action),
            5 * np.clip(q[2] - 0.5 - np.array(ground), -1, 1),
        ]
    )


def goal_command(
    position: Array, yaw: float, goal: Array, speed: float = 0.75, gain: float = 0.5, limit: float = 1.0
) -> Array:
    """Velocity toward the goal in the yaw frame, and the yaw rate that turns the robot to it."""
    to_goal = np.float64(goal) - position
    error = (np.arctan2(to_goal[1], to_goal[0]) - yaw + np.pi) % (2 * np.pi) - np.pi
    return np.array([speed * np.cos(error), speed * np.sin(error), np.clip(gain * error, -limit, limit)])
