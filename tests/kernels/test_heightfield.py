"""Ceiling and nearest point of the triangulated surface against the float64 oracle."""

import numpy as np
import pytest
import warp as wp

from kernels.heightfield import SurfacePoint, Terrain, ceiling_over, nearest_surface_point
from sim.mujoco_c.model import surface_heights
from tests.kernels import oracle
from tests.kernels.states import SPACING, make_terrain, rough


def surface_normal(grid, x, y):
    """Upward unit normal of the triangle at one (x, y), 5e-5 m or more from its edges."""
    along_x = surface_heights(grid, x + 1e-5, y) - surface_heights(grid, x - 1e-5, y)
    along_y = surface_heights(grid, x, y + 1e-5) - surface_heights(grid, x, y - 1e-5)
    normal = np.array([-along_x, -along_y, 2e-5])
    return normal / np.linalg.norm(normal)


@wp.kernel
def _sample_kernel(terrain: Terrain, points: wp.array[wp.vec3], reach: float, nearest_out: wp.array[SurfacePoint]):
    k = wp.tid()
    nearest_out[k] = nearest_surface_point(terrain, 0, points[k], reach)


@wp.kernel
def _ceiling_kernel(terrain: Terrain, lower: wp.array[wp.vec2], upper: wp.array[wp.vec2], out: wp.array[float]):
    k = wp.tid()
    out[k] = ceiling_over(terrain, 0, lower[k], upper[k])


def sample(terrain, points, reach):
    out = wp.zeros(len(points), dtype=SurfacePoint)
    wp.launch(_sample_kernel, len(points), [terrain, wp.array(np.float32(points), dtype=wp.vec3), reach, out])
    return out.numpy()["distance"], out.numpy()["normal"]


def scatter(nrow, ncol, count):
    """Points over and up to 0.3 m beyond the grid, none closer than 1e-3 cells to an edge where the normal jumps."""
    rng = np.random.default_rng(5)
    low, high = [-0.3, -0.3, -0.4], [(ncol - 1) * SPACING + 0.3, (nrow - 1) * SPACING + 0.3, 0.4]
    points = np.float32(rng.uniform(low, high, (4 * count, 3)))
    fraction = (points[:, :2] / SPACING) % 1
    edges = np.column_stack([fraction, 1 - fraction, np.abs(1 - fraction.sum(1))])
    return points[(edges > 1e-3).all(1)][:count]


@pytest.mark.parametrize("reach", [0.03, 0.1])
def test_nearest_point(reach):
    grid = rough(33, 49)
    points = scatter(33, 49, 400)
    distance, direction = sample(make_terrain(grid[None]), points, reach)
    near = 0
    for p, got, normal in zip(np.float64(points), distance, np.float64(direction), strict=True):
        expected, _ = oracle.nearest_on_surface(grid, SPACING, p, reach)
        if abs(expected) < reach - 1e-4:
            near += 1
            assert got == pytest.approx(expected, abs=1e-5)
            landed, _ = oracle.nearest_on_surface(grid, SPACING, p - got * normal, reach)
            assert abs(landed) < 1e-5
            assert np.linalg.norm(normal) == pytest.approx(1, abs=1e-5)
        elif expected == np.inf:
            assert got > reach - 1e-4
        elif expected == -np.inf:  # deep inside: the plane of the triangle straight above
            plane = surface_normal(grid, *p[:2])
            depth = (p[2] - surface_heights(grid, *p[:2])) * plane[2]
            assert got == pytest.approx(depth, abs=1e-5)
            np.testing.assert_allclose(normal, plane, atol=1e-5)
    assert near > 8


@pytest.mark.parametrize(("nrow", "ncol"), [(161, 321), (2, 2), (10, 18)])
def test_ceiling_is_an_upper_bound(nrow, ncol):
    grid = rough(nrow, ncol)
    rng = np.random.default_rng(0)
    size = np.array([ncol - 1, nrow - 1]) * SPACING
    lower = np.float32(rng.uniform(-1, size + 1, (300, 2)))
    upper = np.float32(lower + rng.uniform(0, 0.9, (300, 2)))
    out = wp.zeros(300, dtype=float)
    corners = [wp.array(corner, dtype=wp.vec2) for corner in (lower, upper)]
    wp.launch(_ceiling_kernel, dim=300, inputs=[make_terrain(grid[None]), *corners], outputs=[out])
    for low, high, ceiling in zip(np.float64(lower), np.float64(upper), out.numpy(), strict=True):
        # The highest surface point over a rectangle is bounded by the nodes of the cells it overlaps.
        first, last = np.floor(low / SPACING).astype(int), np.ceil(high / SPACING).astype(int)
        cols = np.clip(np.arange(first[0], last[0] + 1), 0, ncol - 1)
        rows = np.clip(np.arange(first[1], last[1] + 1), 0, nrow - 1)
        assert ceiling >= grid[np.ix_(rows, cols)].max() - 1e-6
