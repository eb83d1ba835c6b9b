"""The kernels' work in torch, as it is best written there: dense, batched over environments, without host decisions.

Pure functions of tensors, so that the same function runs eagerly in a CUDA graph and through ``torch.compile``.
Shapes: E environments, T terrains, S strips, P probes, J joints, G geoms.
"""

from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
import torch
from torch import Tensor

from kernels import observation as columns
from kernels.penalties import COLLISION_FORCE, STUMBLE_RATIO


def rasterise(genes: Tensor, lower: Tensor, upper: Tensor, x: Tensor, y: Tensor) -> Tensor:
    """Heights [m], shape (T, len(y), len(x)), of genes (T, 8 * bumps) between the bounds (8,) of Table I.

    Everything that is the same for a row or a column of the grid is computed once for it; what is left a node and bump
    is an addition a rotated coordinate, two powers and an exponential, in place.
    """
    bumps = lower + (genes.clamp(-1.0, 1.0).view(len(genes), -1, len(lower)) + 1.0) * (0.5 * (upper - lower))
    mu_x, mu_y, sigma_x, sigma_y, p_x, p_y, theta, w = bumps[..., None].unbind(2)  # (T, bumps, 1) each
    cos, sin = theta.cos(), theta.sin()
    dx, dy = x - mu_x, y - mu_y  # (T, bumps, cols) and (T, bumps, rows)
    across_x, across_y = cos * dx / sigma_x, sin * dy / sigma_x
    along_x, along_y = sin * dx / sigma_y, cos * dy / sigma_y
    power_x, power_y, w = (2.0 * p_x)[..., None], (2.0 * p_y)[..., None], w[..., None]
    heights = torch.zeros((len(genes), len(y), len(x)), device=genes.device)
    for b in range(bumps.shape[1]):
        across = (across_x[:, b, None, :] - across_y[:, b, :, None]).abs_().pow_(power_x[:, b])
        along = (along_x[:, b, None, :] + along_y[:, b, :, None]).abs_().pow_(power_y[:, b])
        heights.addcmul_(across.add_(along).neg_().exp_(), w[:, b])
    return heights


def node_heights(heights: Tensor, terrain_of_env: Tensor, row: Tensor, col: Tensor) -> Tensor:
    """Heights [m] of nodes (E, ...), the nearest edge node's beyond the grid; ``heights`` is (T, rows, cols)."""
    terrain = terrain_of_env.view(-1, *[1] * (row.ndim - 1))
    return heights[terrain, row.clamp(0, heights.shape[1] - 1), col.clamp(0, heights.shape[2] - 1)]


def surface(heights: Tensor, terrain_of_env: Tensor, spacing: float, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    """Height [m] of the triangulated surface at points (E, N), and its slopes along x and y there."""
    u, v = x / spacing, y / spacing
    col, row = u.floor(), v.floor()
    fx, fy = u - col, v - row
    row, col = row.long(), col.long()
    h00, h10, h01, h11 = (node_heights(heights, terrain_of_env, row + k // 2, col + k % 2) for k in range(4))
    low_x, low_y, high_x, high_y = h10 - h00, h01 - h00, h11 - h01, h11 - h10
    # Of both triangles, since a compiler that asks twice which it is may round otherwise the second time.
    low = fx + fy < 1.0
    height = torch.where(low, h00 + low_x * fx + low_y * fy, h11 + high_x * (fx - 1.0) + high_y * (fy - 1.0))
    return height, torch.where(low, low_x, high_x) / spacing, torch.where(low, low_y, high_y) / spacing


def rotate_inverse(quaternion: Tensor, vector: Tensor) -> Tensor:
    """World vectors (E, 3) in the frames that the quaternions (E, 4), xyzw, turn into the world."""
    axis, w = quaternion[:, :3], quaternion[:, 3:]
    twice = 2.0 * torch.linalg.cross(axis, vector)
    return vector - w * twice + torch.linalg.cross(axis, twice)


def base_velocities(joint_q: Tensor, joint_qd: Tensor, base_com: Tensor) -> tuple[Tensor, Tensor]:
    """Velocity of the base link's origin and angular velocity, base frame, (E, 3) each."""
    rotation = joint_q[:, 3:7]
    ang_vel = rotate_inverse(rotation, joint_qd[:, 3:6])
    return rotate_inverse(rotation, joint_qd[:, :3]) - torch.linalg.cross(ang_vel, base_com.expand_as(ang_vel)), ang_vel


def observation(
    joint_q: Tensor, joint_qd: Tensor, command: Tensor, last_action: Tensor, terrain_of_env: Tensor, heights: Tensor,
    scan_x: Tensor, scan_y: Tensor, default_joint_pos: Tensor, base_com: Tensor, down: Tensor, command_scale: Tensor,
    spacing: float,
) -> Tensor:  # fmt: skip
    """The whole observation row without noise, shape (E, 12 + 3 J + scan points); ``down`` is (0, 0, -1)."""
    lin_vel, ang_vel = base_velocities(joint_q, joint_qd, base_com)
    qx, qy, qz, qw = joint_q[:, 3:7].unbind(1)
    yaw = torch.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))[:, None]
    cos, sin = yaw.cos(), yaw.sin()
    x = joint_q[:, 0:1] + cos * scan_x - sin * scan_y
    y = joint_q[:, 1:2] + sin * scan_x + cos * scan_y
    ground = surface(heights, terrain_of_env, spacing, x, y)[0]
    row = [
        lin_vel * columns.LIN_VEL_SCALE,
        ang_vel * columns.ANG_VEL_SCALE,
        rotate_inverse(joint_q[:, 3:7], down.expand_as(lin_vel)),
        command * command_scale,
        joint_q[:, 7:] - default_joint_pos,
        joint_qd[:, 6:] * columns.JOINT_VEL_SCALE,
        last_action,
        (joint_q[:, 2:3] - columns.SCAN_OFFSET - ground).clamp(-1.0, 1.0) * columns.SCAN_SCALE,
    ]
    return torch.cat(row, dim=1).clamp_(-columns.OBSERVATION_LIMIT, columns.OBSERVATION_LIMIT)


PENALTIES = ("yaw_rate", "vel_x", "vel_y", "contact_force", "stumble", "collision")  # columns of :func:`penalties`


def penalties(
    joint_q: Tensor, joint_qd: Tensor, base_com: Tensor, command: Tensor, geom_force: Tensor, feet: Tensor,
    base_and_limbs: Tensor, counted: Tensor, sums: Tensor, force_limit: float, dt: float,
) -> Tensor:  # fmt: skip
    """The penalty sums (E, 6) after one more physics step; ``feet`` and ``base_and_limbs`` are columns of geoms."""
    lin_vel, ang_vel = base_velocities(joint_q, joint_qd, base_com)
    force_of_foot, size = geom_force[:, feet], geom_force.norm(dim=2)
    sideways = force_of_foot[..., :2].norm(dim=2)
    step = torch.stack(
        [
            (ang_vel[:, 2] - command[:, 2]).square(),
            (lin_vel[:, 0] - command[:, 0]).square(),
            (lin_vel[:, 1] - command[:, 1]).square(),
            (size[:, feet] - force_limit).clamp(min=0.0).sum(1),
            (sideways > STUMBLE_RATIO * force_of_foot[..., 2].abs()).any(1).float(),
            (size[:, base_and_limbs] > COLLISION_FORCE).sum(1).float(),
        ],
        dim=1,
    )
    return sums + dt * (counted != 0)[:, None] * step


def geom_forces(count: Tensor, shape: Tensor, force: Tensor, column_of_shape: Tensor, num_geoms: int) -> Tensor:
    """Contact force on each geom (E, G, 3) [N] from those on contacts (E, C, 3): one scatter of all there is room for.

    How many contacts there are is known on the device alone, so every slot is computed. Those without a contact add
    zero to places spread over the result: adding them all to one place would queue them up.
    """
    num_envs, capacity = shape.shape
    slot = torch.arange(capacity, device=shape.device)
    column = column_of_shape[shape.clamp(0, len(column_of_shape) - 1).long()]
    exists = (slot < count[:, None]) & (column >= 0)
    env = torch.arange(num_envs, device=shape.device)[:, None]
    place = env * num_geoms + torch.where(exists, column, slot % num_geoms)
    total = torch.zeros((num_envs * num_geoms, 3), device=shape.device)
    total.index_add_(0, place.view(-1), force.masked_fill(~exists[..., None], 0.0).view(-1, 3))
    return total.view(num_envs, num_geoms, 3)


_FAR = 1.0e6
_ON_SURFACE = 1.0e-5


@dataclass(frozen=True, kw_only=True)
class ProbeTables:
    """The P probes and S strips of one robot as tensors, probes also grouped by radius: one radius, one window."""

    position: Tensor  # in the body's frame [m], (P, 3)
    body: Tensor  # (P,)
    radius: Tensor  # [m], (P,)
    groups: tuple[tuple[float, int, Tensor], ...]  # radius, cells along a side of its window, and its probes
    order: Tensor  # where each probe stands in the groups' probes one after another, (P,)
    strip_probes: Tensor  # of each strip in order, the last one repeated, (S, longest)
    strip_radius: Tensor  # [m], (S,)


def make_tables(probes: Any, spacing: float, device: torch.device) -> ProbeTables:
    """Tables of strips given as :class:`kernels.contact.Probes`."""
    names = ("position", "strip_start", "strip_radius", "bundle_start", "bundle_body")
    position, start, strip_radius, bundle_start, bundle_body = (getattr(probes, name).numpy() for name in names)
    lengths = np.diff(start)
    radius = np.repeat(strip_radius, lengths)
    groups = [np.flatnonzero(radius == value) for value in np.unique(radius)]
    windows = [int(np.ceil(2.0 * radius[group[0]] / spacing - 1e-6)) + 1 for group in groups]
    tensor = partial(torch.tensor, device=device)
    return ProbeTables(
        position=tensor(position),
        body=tensor(np.repeat(bundle_body, np.diff(start[bundle_start]))),
        radius=tensor(radius),
        groups=tuple((float(radius[g[0]]), window, tensor(g)) for g, window in zip(groups, windows, strict=True)),
        order=tensor(np.argsort(np.concatenate(groups))),
        strip_probes=tensor(np.minimum(start[:-1, None] + np.arange(lengths.max()), start[1:, None] - 1)),
        strip_radius=tensor(strip_radius),
    )


def rotation_matrices(quaternion: Tensor) -> Tensor:
    """Matrices (..., 3, 3) of unit quaternions (..., 4), xyzw."""
    x, y, z, w = quaternion.unbind(-1)
    rows = [
        1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y),
        2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x),
        2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y),
    ]  # fmt: skip
    return torch.stack(rows, dim=-1).unflatten(-1, (3, 3))


def _from_faces(h: Tensor, gap: Tensor, dx: Tensor, dy: Tensor, spacing: float, *, low: bool) -> Tensor:
    """Vectors from the feet of the perpendiculars on one triangle of each cell to the point, far where they miss it.

    ``h`` are the two nodes beside the right angle along x and y, ``gap`` the height over it, ``dx``, ``dy`` from it.
    """
    slope_x, slope_y = h[0] / spacing, h[1] / spacing
    along = (gap - slope_x * dx - slope_y * dy) / (slope_x * slope_x + slope_y * slope_y + 1.0)
    foot_x, foot_y = dx + along * slope_x, dy + along * slope_y  # from the right angle
    side = 1.0 if low else -1.0
    inside = (side * foot_x >= 0) & (side * foot_y >= 0) & (side * (foot_x + foot_y) <= spacing)
    vector = torch.stack([-along * slope_x, -along * slope_y, along], dim=-1)
    return vector.masked_fill(~inside[..., None], _FAR)


def _from_edges(dx: Tensor, dy: Tensor, dz: Tensor, edge_x: float, edge_y: float, edge_z: Tensor) -> Tensor:
    """Vectors from the nearest points of edges to the point, which lies ``dx, dy, dz`` from where the edges begin."""
    share = (dx * edge_x + dy * edge_y + dz * edge_z) / (edge_z * edge_z + (edge_x * edge_x + edge_y * edge_y))
    share = share.clamp(0.0, 1.0)
    return torch.stack([dx - share * edge_x, dy - share * edge_y, dz - share * edge_z], dim=-1)


def from_surface(
    heights: Tensor, terrain_of_env: Tensor, spacing: float, p: Tensor, radius: float, window: int
) -> Tensor:
    """Vector (E, N, 3) from the nearest surface point to each point (E, N, 3), exact within ``radius``.

    The nearest point lies on a face or an edge; every edge of the window is looked at once.
    """
    nodes = torch.arange(window + 1, device=p.device)
    row = ((p[..., 1] - radius) / spacing).floor().long()[..., None] + nodes
    col = ((p[..., 0] - radius) / spacing).floor().long()[..., None] + nodes
    h = node_heights(heights, terrain_of_env, row[..., :, None], col[..., None, :])  # (E, N, window + 1, window + 1)
    dx = (p[..., 0:1] - col * spacing)[..., None, :].expand_as(h)
    dy = (p[..., 1:2] - row * spacing)[..., :, None].expand_as(h)
    dz = p[..., 2, None, None] - h
    h00, h10, h01, h11 = h[..., :-1, :-1], h[..., :-1, 1:], h[..., 1:, :-1], h[..., 1:, 1:]
    corner, opposite = (..., slice(-1), slice(-1)), (..., slice(1, None), slice(1, None))
    top, right = (..., slice(1, None), slice(-1)), (..., slice(None), slice(-1))
    candidates = [
        _from_faces(torch.stack([h10 - h00, h01 - h00]), dz[corner], dx[corner], dy[corner], spacing, low=True),
        _from_faces(torch.stack([h11 - h01, h11 - h10]), dz[opposite], dx[opposite], dy[opposite], spacing, low=False),
        _from_edges(dx[right], dy[right], dz[right], spacing, 0.0, h[..., :, 1:] - h[..., :, :-1]),
        _from_edges(dx[..., :-1, :], dy[..., :-1, :], dz[..., :-1, :], 0.0, spacing, h[..., 1:, :] - h[..., :-1, :]),
        _from_edges(dx[top], dy[top], dz[top], spacing, -spacing, h10 - h01),
    ]
    vectors = torch.cat([candidate.flatten(2, 3) for candidate in candidates], dim=2)
    nearest = vectors.square().sum(-1).argmin(dim=2)
    return vectors.gather(2, nearest[..., None, None].expand(-1, -1, 1, 3)).squeeze(2)


def probe_centres(body_q: Tensor, tables: ProbeTables) -> Tensor:
    """World centres (E, P, 3) of all probes of bodies with poses (E, bodies, 7)."""
    rotation = rotation_matrices(body_q[..., 3:])  # (E, bodies, 3, 3)
    return body_q[:, tables.body, :3] + (rotation[:, tables.body] * tables.position[:, None, :]).sum(-1)


def probe_contacts(
    centre: Tensor, terrain_of_env: Tensor, heights: Tensor, spacing: float, tables: ProbeTables
) -> tuple[Tensor, Tensor]:
    """Signed distances (E, P) and normals (E, P, 3) of probes with world centres (E, P, 3), exact where they touch."""
    terrain = (heights, terrain_of_env, spacing)
    vectors = [from_surface(*terrain, centre[:, group], radius, window) for radius, window, group in tables.groups]
    vector = torch.cat(vectors, dim=1)[:, tables.order]
    ground, slope_x, slope_y = surface(*terrain, centre[..., 0], centre[..., 1])
    upward = torch.nn.functional.normalize(torch.stack([-slope_x, -slope_y, torch.ones_like(slope_x)], dim=-1), dim=-1)
    size, gap = vector.norm(dim=2), centre[..., 2] - ground
    below = gap < 0.0
    deep = below & (size > tables.radius)  # too deep for the window: straight up to the triangle above
    distance = torch.where(deep, gap * upward[..., 2], torch.where(below, -size, size))
    vertical = deep | (size <= _ON_SURFACE)
    normal = torch.where(vertical[..., None], upward, vector / distance.masked_fill(vertical, 1.0)[..., None])
    return distance, normal


def choose_probes(distance: Tensor, tables: ProbeTables) -> Tensor:
    """Deepest, first and last touching probe of each strip (E, S, 3), each once, -1 elsewhere."""
    depth = (tables.radius - distance)[:, tables.strip_probes]  # (E, S, longest)
    place = torch.arange(depth.shape[2], device=depth.device)
    itself = tables.strip_probes == tables.strip_probes[:, :1] + place  # not the last one repeated
    touching = (depth > 0.0) & itself
    deepest = depth.masked_fill(~itself, -_FAR).argmax(dim=2)
    first = place.expand_as(depth).masked_fill(~touching, len(place)).amin(dim=2)
    last = place.expand_as(depth).masked_fill(~touching, -1).amax(dim=2)
    any_touches = last >= 0
    chosen = [
        (tables.strip_probes[:, 0] + slot).masked_fill(~(any_touches & wanted), -1)
        for slot, wanted in ((deepest, any_touches), (first, first != deepest), (last, last != deepest))
    ]
    return torch.stack(chosen, dim=2)


def collide(
    body_q: Tensor, terrain_of_env: Tensor, heights: Tensor, spacing: float, tables: ProbeTables
) -> tuple[Tensor, ...]:
    """Contacts of every strip of robots with poses (E, bodies, 7), in slots for its deepest, first and last probe.

    Returns:
        Probe of each slot, -1 where there is no contact, (E, S, 3); points in the middle between the surfaces, normals,
        (E, S, 3, 3) each, and distances of the surfaces, (E, S, 3, 1), world frame.
    """
    centre = probe_centres(body_q, tables)
    distance, normal = probe_contacts(centre, terrain_of_env, heights, spacing, tables)
    chosen = choose_probes(distance, tables)
    probe = chosen.clamp(min=0)
    of_slot = torch.arange(len(probe), device=probe.device)[:, None, None], probe
    normal, distance = normal[of_slot], (distance[of_slot] - tables.strip_radius[:, None])[..., None]
    point = centre[of_slot] - normal * (0.5 * distance + tables.strip_radius[:, None, None])
    return chosen, point, normal, distance
