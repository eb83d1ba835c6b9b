"""Meshes to sphere probes: balls that touch the mesh's convex hull from inside, close enough to feel every edge."""

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError

from sim.robots.strip import Strip

MESH_TOLERANCE = 0.01
"""Farthest that a point of a hull's surface may lie outside of the nearest probe [m], unless the mesh is small."""
SMALL_MESH_SHARE = 1.0 / 12.0
"""For a small mesh the tolerance is this share of its longest side."""
MAX_MESH_PROBES = 400
"""Probes of one mesh; one that would need more is covered as closely as these reach."""
MAX_PROBE_RADIUS = 0.1
"""Largest probe radius [m]."""
_WIDE = 0.1  # a wider mesh lies on two rows of probes, left and right [m]
_SAMPLES_PER_TOLERANCE = 2.0
_GROWTH = 1.25

_Array = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class HullProbes:
    """The probes of one mesh."""

    strips: tuple[Strip, ...]
    """Rows of probes of one radius, in order along the mesh's longest side; not straight."""
    tolerance: float
    """Every point of the hull's surface lies at most this far outside of the nearest probe [m]; no probe sticks out."""


@dataclass(frozen=True, kw_only=True)
class _Hull:
    """A convex hull as the half spaces ``normal . x <= offset``."""

    triangles: _Array
    """Corners, shape (num_triangles, 3, 3) [m]."""
    normal: _Array
    """Outward unit normals, shape (num_planes, 3)."""
    offset: _Array
    """Distances from the origin [m], shape (num_planes,)."""

    def inradius(self) -> float:
        """Radius of the largest ball about the middle of the hull's volume [m]."""
        corners = self.triangles - self.triangles.mean(axis=(0, 1))
        volume = np.abs(np.linalg.det(corners))
        middle = np.average(corners.sum(axis=1) / 4.0, axis=0, weights=volume) + self.triangles.mean(axis=(0, 1))
        return float((self.offset - self.normal @ middle).min())


def _hull_of(vertices: _Array) -> _Hull:
    try:
        hull = ConvexHull(vertices)
    except QhullError:
        raise ValueError(
            f"a mesh of {len(vertices)} vertices has no volume, so no probes: expected a solid; replace it in the "
            "robot's file by a solid one or a box"
        ) from None
    planes = np.unique(np.round(hull.equations, 9), axis=0)  # facets of one face share their plane
    return _Hull(triangles=hull.points[hull.simplices], normal=planes[:, :3], offset=-planes[:, 3])


def _surface_samples(triangles: _Array, spacing: float) -> _Array:
    """Points on the triangles, corners included: none of a triangle is farther than spacing / sqrt(3) from the next."""
    samples: list[_Array] = []
    for a, b, c in triangles:
        longest = max(np.linalg.norm(b - a), np.linalg.norm(c - b), np.linalg.norm(a - c))
        count = max(1, int(np.ceil(longest / spacing)))
        i, j = np.meshgrid(np.arange(count + 1), np.arange(count + 1), indexing="ij")
        inside = i + j <= count
        u, v = i[inside, None] / count, j[inside, None] / count
        samples.append(a + u * (b - a) + v * (c - a))
    return np.unique(np.round(np.concatenate(samples), 7), axis=0).astype(np.float64)


def _ball_at(point: _Array, hull: _Hull, radii: _Array, most: float) -> tuple[_Array, float]:
    """The largest inscribed ball of one of the falling ``radii`` that comes as near to a surface point as ``most``.

    Its centre lies on the way inward from the point, as far in as a ball of that radius needs.
    """
    clearance = hull.offset - hull.normal @ point
    touching = clearance < 0.25 * most
    inward = -hull.normal[touching].sum(axis=0)
    inward /= np.linalg.norm(inward)
    rate = -hull.normal @ inward  # how fast each plane is left behind, or neared
    leaves, nears = rate > 1e-9, rate < -1e-9
    beside = float(clearance[~leaves & ~nears].min(initial=np.inf))
    for radius in radii[radii <= beside + 1e-9]:
        depth = float(((radius - clearance[leaves]) / rate[leaves]).max())
        limit = float(((radius - clearance[nears]) / rate[nears]).min(initial=np.inf))
        if depth <= limit and depth - radius <= most:
            return point + depth * inward, float(radius)
    return point, 0.0  # a tip sharper than any of the balls


def _cover(hull: _Hull, tolerance: float) -> tuple[_Array, _Array] | None:
    """Balls, (n, 3) and (n,), with every sample of the surface near enough to one; None if it takes too many."""
    spacing = tolerance / _SAMPLES_PER_TOLERANCE
    samples = _surface_samples(hull.triangles, spacing)
    goal = tolerance - spacing / np.sqrt(3.0)
    largest = min(hull.inradius(), MAX_PROBE_RADIUS)
    radii = largest * 0.5 ** np.arange(max(1.0, np.ceil(np.log2(8.0 * largest / tolerance))))
    squares = (samples * samples).sum(axis=1)
    gap = np.full(len(samples), np.inf)
    centres: list[_Array] = []
    found: list[float] = []
    while gap.max() > goal:
        if len(found) == MAX_MESH_PROBES:
            return None
        centre, radius = _ball_at(samples[gap.argmax()], hull, radii, 0.9 * goal)
        centres.append(centre)
        found.append(radius)
        apart = np.sqrt(np.maximum(squares - 2.0 * samples @ centre + centre @ centre, 0.0))
        gap = np.minimum(gap, apart - radius)
    return np.array(centres), np.array(found)


def _rows(centres: _Array, radii: _Array, corners: _Array) -> list[Strip]:
    """Balls in rows: of one radius, in order along the longest side, and left and right apart where that is wide.

    Contacts are made of the ends and the deepest of a row, so rows bound their number.
    """
    middle = corners.mean(axis=0)
    _, _, axes = np.linalg.svd(corners - middle, full_matrices=False)
    along, across = (centres - middle) @ axes[0], (centres - middle) @ axes[1]
    side = np.sign(across) if np.ptp((corners - middle) @ axes[1]) > _WIDE else np.zeros(len(centres))
    side[side == 0.0] = 1.0
    strips = []
    for radius in np.unique(radii)[::-1]:
        for lane in np.unique(side):
            chosen = np.flatnonzero((radii == radius) & (side == lane))
            row = centres[chosen[np.argsort(along[chosen], kind="stable")]]
            if len(row):
                strips.append(Strip(centres=row, radius=float(radius), spread=_spread(row)))
    return strips


def _spread(row: _Array) -> float:
    """How far points lie from the straight line between the first and the last of them [m]."""
    line = row[-1] - row[0]
    length = float(line @ line)
    share = np.clip((row - row[0]) @ line / length, 0.0, 1.0) if length > 0.0 else np.zeros(len(row))
    return float(np.linalg.norm(row - row[0] - share[:, None] * line, axis=1).max())


@lru_cache(maxsize=64)
def _probes_of(content: bytes) -> HullProbes:
    vertices = np.frombuffer(content).reshape(-1, 3)
    hull = _hull_of(vertices)
    corners = np.unique(hull.triangles.reshape(-1, 3), axis=0)
    tolerance = min(MESH_TOLERANCE, SMALL_MESH_SHARE * float(np.ptp(corners, axis=0).max()))
    while (found := _cover(hull, tolerance)) is None:
        tolerance *= _GROWTH
    return HullProbes(strips=tuple(_rows(*found, corners)), tolerance=tolerance)


def hull_probes(vertices: _Array) -> HullProbes:
    """Probes of a mesh's convex hull, which is what it collides as, whatever is hollow in it.

    Args:
        vertices: Shape (num_vertices, 3) [m].

    Raises:
        ValueError: If they span no volume.
    """
    return _probes_of(np.ascontiguousarray(vertices, dtype=np.float64).tobytes())
