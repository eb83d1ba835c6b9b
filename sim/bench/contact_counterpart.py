"""Terrain contact in torch: every probe against a fixed window of cells, then first, deepest and last of each strip."""

from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from sim.bench.counterparts import node_heights, surface

_FAR = 1.0e6
_ON_SURFACE = 1.0e-5


@dataclass(frozen=True, kw_only=True)
class ProbeTables:
    """The probes of one robot as tensors, grouped by radius: one radius, one size of window."""

    position: Tensor
    """Centres in their body's frame [m], shape (P, 3)."""
    body: Tensor
    """Body of each probe, shape (P,)."""
    radius: Tensor
    """Radius of each probe [m], shape (P,)."""
    groups: tuple[tuple[float, int, Tensor], ...]
    """Radius [m], cells along a side of its window, and the probes of that radius."""
    order: Tensor
    """Where each probe stands in the groups' probes one after another, shape (P,)."""
    strip_probes: Tensor
    """Probes of each strip in order, the last one repeated, shape (S, longest)."""
    strip_body: Tensor
    """Body of each strip, shape (S,)."""
    strip_radius: Tensor
    """Radius of each strip's probes [m], shape (S,)."""


def make_tables(
    position: np.ndarray, strip_start: np.ndarray, strip_radius: np.ndarray, strip_body: np.ndarray, *, spacing: float,
    device: torch.device,
) -> ProbeTables:  # fmt: skip
    """Tables of strips given as :class:`kernels.contact.Probes` gives them.

    Args:
        position: Probe centres in their body's frame [m], shape (P, 3).
        strip_start: First probe of each strip, and P, shape (S + 1,).
        strip_radius: Radius of each strip's probes [m], shape (S,).
        strip_body: Body of each strip, shape (S,).
        spacing: Distance of neighbouring nodes [m].
        device: Where to put the tables.
    """
    lengths = np.diff(strip_start)
    radius = np.repeat(strip_radius, lengths)
    probes = [np.flatnonzero(radius == value) for value in np.unique(radius)]
    padded = np.minimum(strip_start[:-1, None] + np.arange(lengths.max()), strip_start[1:, None] - 1)

    def tensor(array: np.ndarray) -> Tensor:
        return torch.tensor(array, device=device)

    return ProbeTables(
        position=tensor(position),
        body=tensor(np.repeat(strip_body, lengths)),
        radius=tensor(radius),
        groups=tuple(
            (float(radius[group[0]]), int(np.ceil(2.0 * radius[group[0]] / spacing - 1e-6)) + 1, tensor(group))
            for group in probes
        ),
        order=tensor(np.argsort(np.concatenate(probes))),
        strip_probes=tensor(padded),
        strip_body=tensor(strip_body),
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
    if low:
        inside = (foot_x >= 0) & (foot_y >= 0) & (foot_x + foot_y <= spacing)
    else:
        inside = (foot_x <= 0) & (foot_y <= 0) & (foot_x + foot_y >= -spacing)
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
    cells = torch.arange(window + 1, device=p.device)
    row = ((p[..., 1] - radius) / spacing).floor().long()[..., None] + cells
    col = ((p[..., 0] - radius) / spacing).floor().long()[..., None] + cells
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


def _pick(values: Tensor, probe: Tensor) -> Tensor:
    """Rows of (E, P, 3) or entries of (E, P) that belong to the chosen probes (E, S, 3)."""
    flat = probe.flatten(1)
    if values.ndim == 2:
        return values.gather(1, flat).view(probe.shape)
    return values.gather(1, flat[..., None].expand(-1, -1, 3)).view(*probe.shape, 3)


def probe_contacts(
    body_q: Tensor, rotation: Tensor, terrain_of_env: Tensor, heights: Tensor, spacing: float, tables: ProbeTables
) -> tuple[Tensor, Tensor, Tensor]:
    """World centres (E, P, 3), signed distances (E, P) and normals (E, P, 3) of all probes, exact where they touch."""
    centre = body_q[:, tables.body, :3] + (rotation[:, tables.body] * tables.position[:, None, :]).sum(-1)
    vectors = [
        from_surface(heights, terrain_of_env, spacing, centre[:, group], radius, window)
        for radius, window, group in tables.groups
    ]
    vector = torch.cat(vectors, dim=1)[:, tables.order]
    size = vector.norm(dim=2)
    ground, slope_x, slope_y = surface(heights, terrain_of_env, spacing, centre[..., 0], centre[..., 1])
    upward = torch.nn.functional.normalize(torch.stack([-slope_x, -slope_y, torch.ones_like(slope_x)], dim=-1), dim=-1)
    below, gap = centre[..., 2] < ground, centre[..., 2] - ground
    deep = below & (size > tables.radius)  # too deep for the window: straight up to the triangle above
    distance = torch.where(deep, gap * upward[..., 2], torch.where(below, -size, size))
    vertical = deep | (size <= _ON_SURFACE)
    normal = torch.where(vertical[..., None], upward, vector / distance.masked_fill(vertical, 1.0)[..., None])
    return centre, distance, normal


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
    """Contact records of every strip, dense: slots for the deepest, the first and the last probe that touch.

    Args:
        body_q: Poses (E, bodies, 7).
        terrain_of_env: Terrain of each environment, shape (E,).
        heights: Node heights [m], shape (T, rows, cols).
        spacing: Distance of neighbouring nodes [m].
        tables: The robot's probes.

    Returns:
        Probe of each slot, -1 where there is no contact, (E, S, 3); surface points in the world, probe centres in the
        body, normals in the world and offsets in the body, (E, S, 3, 3) each: what the kernel writes a record. Shapes
        and radii follow from the strip.
    """
    rotation = rotation_matrices(body_q[..., 3:])  # (E, bodies, 3, 3)
    centre, distance, normal = probe_contacts(body_q, rotation, terrain_of_env, heights, spacing, tables)
    chosen = choose_probes(distance, tables)
    probe = chosen.clamp(min=0)
    normal = _pick(normal, probe)
    point = _pick(centre, probe) - normal * _pick(distance, probe)[..., None]
    to_body = rotation[:, tables.strip_body][:, :, None]  # a world vector times it: its coordinates in the body
    offset = -tables.strip_radius[:, None, None] * (normal[..., None] * to_body).sum(-2)
    return chosen, point, tables.position[probe], normal, offset
