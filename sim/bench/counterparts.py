"""The kernels' work in torch, as it is best written there: dense, batched over environments, without host decisions.

Pure functions of tensors, so that the same function runs eagerly in a CUDA graph and through ``torch.compile``.
Shapes: E environments, T terrains, S strips, P probes, J joints, G geoms. Contact stands in
:mod:`sim.bench.contact_counterpart`.
"""

import torch
from torch import Tensor

from kernels.observation import (
    ANG_VEL_SCALE,
    JOINT_VEL_SCALE,
    LIN_VEL_SCALE,
    OBSERVATION_LIMIT,
    SCAN_OFFSET,
    SCAN_SCALE,
)
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
    num_rows, num_cols = heights.shape[1:]
    terrain = terrain_of_env.view(-1, *[1] * (row.ndim - 1)).long()
    index = (terrain * num_rows + row.clamp(0, num_rows - 1)) * num_cols + col.clamp(0, num_cols - 1)
    return heights.view(-1)[index]


def surface(heights: Tensor, terrain_of_env: Tensor, spacing: float, x: Tensor, y: Tensor) -> tuple[Tensor, ...]:
    """Height [m] of the triangulated surface at points (E, N), and its slopes along x and y there."""
    u, v = x / spacing, y / spacing
    col, row = u.floor(), v.floor()
    fx, fy = u - col, v - row
    low = fx + fy < 1.0
    row, col = row.long(), col.long()
    h10 = node_heights(heights, terrain_of_env, row, col + 1)
    h01 = node_heights(heights, terrain_of_env, row + 1, col)
    corner = (~low).long()
    h = node_heights(heights, terrain_of_env, row + corner, col + corner)  # the triangle's right angle
    rise_x = torch.where(low, h10 - h, h - h01)
    rise_y = torch.where(low, h01 - h, h - h10)
    return h + rise_x * (fx - corner) + rise_y * (fy - corner), rise_x / spacing, rise_y / spacing


def scan(
    joint_q: Tensor, terrain_of_env: Tensor, heights: Tensor, scan_x: Tensor, scan_y: Tensor, spacing: float
) -> Tensor:
    """Height scan as in the observation row, shape (E, scan points)."""
    qx, qy, qz, qw = joint_q[:, 3:7].unbind(1)
    yaw = torch.atan2(2.0 * (qw * qz + qx * qy), 1.0 - 2.0 * (qy * qy + qz * qz))[:, None]
    cos, sin = yaw.cos(), yaw.sin()
    x = joint_q[:, 0:1] + cos * scan_x - sin * scan_y
    y = joint_q[:, 1:2] + sin * scan_x + cos * scan_y
    ground = surface(heights, terrain_of_env, spacing, x, y)[0]
    return (joint_q[:, 2:3] - SCAN_OFFSET - ground).clamp(-1.0, 1.0) * SCAN_SCALE


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
    columns = [
        lin_vel * LIN_VEL_SCALE,
        ang_vel * ANG_VEL_SCALE,
        rotate_inverse(joint_q[:, 3:7], down.expand_as(lin_vel)),
        command * command_scale,
        joint_q[:, 7:] - default_joint_pos,
        joint_qd[:, 6:] * JOINT_VEL_SCALE,
        last_action,
        scan(joint_q, terrain_of_env, heights, scan_x, scan_y, spacing),
    ]
    return torch.cat(columns, dim=1).clamp_(-OBSERVATION_LIMIT, OBSERVATION_LIMIT)


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
            (ang_vel[:, 2] - command[:, 2]).abs(),
            (lin_vel[:, 0] - command[:, 0]).abs(),
            (lin_vel[:, 1] - command[:, 1]).abs(),
            (size[:, feet] - force_limit).clamp(min=0.0).sum(1),
            (sideways > STUMBLE_RATIO * force_of_foot[..., 2].abs()).any(1).float(),
            (size[:, base_and_limbs] > COLLISION_FORCE).sum(1).float(),
        ],
        dim=1,
    )
    return sums + dt * (counted != 0)[:, None] * step


def geom_forces(
    count: Tensor, world: Tensor, geom: Tensor, frame: Tensor, efc_address: Tensor, efc_force: Tensor,
    column_of_geom: Tensor, num_geoms: int,
) -> Tensor:  # fmt: skip
    """Contact force on each geom (E, G, 3) [N]: rows to forces for the whole buffer, then one scatter.

    How many contacts there are is known on the device alone, so every slot is computed. Those without a contact add
    zero to places spread over the result: adding them all to one place would queue them up.
    """
    capacity, num_envs = len(world), len(efc_force)
    slot = torch.arange(capacity, device=world.device)
    column = column_of_geom[geom[:, 1].clamp(0, len(column_of_geom) - 1).long()]
    row = efc_address[:, 0]
    exists = (slot < count) & (row >= 0) & (column >= 0)
    env = world.masked_fill(~exists, 0).long()
    first = row.masked_fill(~exists, 0).long()
    local = efc_force.view(-1)[(env * efc_force.shape[1] + first)[:, None] + torch.arange(3, device=world.device)]
    force = (frame * local[:, :, None]).sum(1).masked_fill(~exists[:, None], 0.0)
    place = torch.where(exists, env * num_geoms + column, slot % (num_envs * num_geoms))
    total = torch.zeros((num_envs * num_geoms, 3), device=world.device)
    return total.index_add_(0, place, force).view(num_envs, num_geoms, 3)
