"""Height grids on the device: sampling, block maxima, and the exact nearest surface point of a sphere.

A terrain is a triangulated grid: node ``(row, col)`` stands at ``x = col * spacing``, ``y = row * spacing``, and every
cell is cut along the diagonal from its (low x, high y) to its (high x, low y) corner; MuJoCo's heightfield along the
other one (:mod:`sim.terrains.maps.heightmap` hands it the same surface). Beyond the grid the height of the nearest edge
node continues.
"""

import warp as wp

from kernels.launch import kernel_over

BLOCK = 4
"""Cells along each side of a block of the ceiling grid."""

_FAR = wp.constant(1.0e6)
_ON_SURFACE = wp.constant(1.0e-5)


@wp.struct
class Terrain:
    """Height grids of all terrains, heights [m], with block maxima for early outs."""

    heights: wp.array3d[float]
    """Node heights [m], shape (num_terrains, nrow, ncol)."""
    ceilings: wp.array3d[float]
    """Highest node of each ``BLOCK`` x ``BLOCK`` cells [m], shape (num_terrains, block rows, block cols)."""
    spacing: float
    """Distance of neighbouring nodes [m]."""


@wp.struct
class SurfacePoint:
    """Nearest surface point of a query point."""

    distance: float
    """Signed distance [m]: negative where the query point lies below the surface; 1e6 where nothing is near."""
    normal: wp.vec3
    """Unit vector from the surface to the query point (reversed below the surface), world frame."""


@wp.func
def node_height(terrain: Terrain, t: int, row: int, col: int) -> float:
    """Height [m] of a node; indices beyond the grid take the nearest edge node."""
    i = wp.clamp(row, 0, terrain.heights.shape[1] - 1)
    j = wp.clamp(col, 0, terrain.heights.shape[2] - 1)
    return terrain.heights[t, i, j]


@wp.func
def height_at(terrain: Terrain, t: int, x: float, y: float) -> float:
    """Height [m] of the triangulated surface at world-local (x, y) [m]."""
    u = x / terrain.spacing
    v = y / terrain.spacing
    col = int(wp.floor(u))
    row = int(wp.floor(v))
    fx = u - float(col)
    fy = v - float(row)
    h10 = node_height(terrain, t, row, col + 1)
    h01 = node_height(terrain, t, row + 1, col)
    if fx + fy < 1.0:
        h00 = node_height(terrain, t, row, col)
        return h00 + (h10 - h00) * fx + (h01 - h00) * fy
    h11 = node_height(terrain, t, row + 1, col + 1)
    return h11 + (h01 - h11) * (1.0 - fx) + (h10 - h11) * (1.0 - fy)


@wp.func
def normal_at(terrain: Terrain, t: int, x: float, y: float) -> wp.vec3:
    """Upward unit normal of the triangle under world-local (x, y) [m]."""
    col = int(wp.floor(x / terrain.spacing))
    row = int(wp.floor(y / terrain.spacing))
    h10 = node_height(terrain, t, row, col + 1)
    h01 = node_height(terrain, t, row + 1, col)
    if x / terrain.spacing - float(col) + y / terrain.spacing - float(row) < 1.0:
        h00 = node_height(terrain, t, row, col)
        return wp.normalize(wp.vec3(h00 - h10, h00 - h01, terrain.spacing))
    h11 = node_height(terrain, t, row + 1, col + 1)
    return wp.normalize(wp.vec3(h01 - h11, h10 - h11, terrain.spacing))


@wp.func
def ceiling_over(terrain: Terrain, t: int, lower: wp.vec2, upper: wp.vec2) -> float:
    """Upper bound [m] of the surface over the world-local rectangle ``lower .. upper`` [m]."""
    size = terrain.spacing * float(BLOCK)
    last_row = terrain.ceilings.shape[1] - 1
    last_col = terrain.ceilings.shape[2] - 1
    row0 = wp.clamp(int(wp.floor(lower[1] / size)), 0, last_row)
    row1 = wp.clamp(int(wp.floor(upper[1] / size)), 0, last_row)
    col0 = wp.clamp(int(wp.floor(lower[0] / size)), 0, last_col)
    col1 = wp.clamp(int(wp.floor(upper[0] / size)), 0, last_col)
    highest = float(-1.0e6)
    for row in range(row0, row1 + 1):
        for col in range(col0, col1 + 1):
            highest = wp.max(highest, terrain.ceilings[t, row, col])
    return highest


@wp.func
def nearest_on_triangle(p: wp.vec3, a: wp.vec3, b: wp.vec3, c: wp.vec3) -> wp.vec3:
    """Point of the triangle ``abc`` nearest to ``p`` (Ericson, Real-Time Collision Detection, 5.1.5)."""
    ab = b - a
    ac = c - a
    pa = p - a
    along_ab_a = wp.dot(ab, pa)
    along_ac_a = wp.dot(ac, pa)
    if along_ab_a <= 0.0 and along_ac_a <= 0.0:
        return a
    pb = p - b
    along_ab_b = wp.dot(ab, pb)
    along_ac_b = wp.dot(ac, pb)
    if along_ab_b >= 0.0 and along_ac_b <= along_ab_b:
        return b
    weight_c = along_ab_a * along_ac_b - along_ab_b * along_ac_a
    if weight_c <= 0.0 and along_ab_a >= 0.0 and along_ab_b <= 0.0:
        return a + ab * (along_ab_a / (along_ab_a - along_ab_b))
    pc = p - c
    along_ab_c = wp.dot(ab, pc)
    along_ac_c = wp.dot(ac, pc)
    if along_ac_c >= 0.0 and along_ab_c <= along_ac_c:
        return c
    weight_b = along_ab_c * along_ac_a - along_ab_a * along_ac_c
    if weight_b <= 0.0 and along_ac_a >= 0.0 and along_ac_c <= 0.0:
        return a + ac * (along_ac_a / (along_ac_a - along_ac_c))
    weight_a = along_ab_b * along_ac_c - along_ab_c * along_ac_b
    beyond_b = along_ac_b - along_ab_b
    beyond_c = along_ab_c - along_ac_c
    if weight_a <= 0.0 and beyond_b >= 0.0 and beyond_c >= 0.0:
        return b + (c - b) * (beyond_b / (beyond_b + beyond_c))
    total = weight_a + weight_b + weight_c
    return a + ab * (weight_b / total) + ac * (weight_c / total)


@wp.func
def nearest_surface_point(terrain: Terrain, t: int, p: wp.vec3, reach: float) -> SurfacePoint:
    """Nearest point of the triangulated surface within ``reach`` [m] of ``p`` (world-local), exact over all cells.

    Below the surface by more than ``reach`` the distance to the triangle straight above is returned instead.
    """
    point = SurfacePoint()
    point.normal = wp.vec3(0.0, 0.0, 1.0)
    point.distance = _FAR
    if reach > terrain.spacing:  # over so many cells that they have fewer ceilings
        beside = wp.vec2(reach, reach)
        middle = wp.vec2(p[0], p[1])
        if p[2] - reach >= ceiling_over(terrain, t, middle - beside, middle + beside):
            return point
    row0 = int(wp.floor((p[1] - reach) / terrain.spacing))
    row1 = int(wp.floor((p[1] + reach) / terrain.spacing))
    col0 = int(wp.floor((p[0] - reach) / terrain.spacing))
    col1 = int(wp.floor((p[0] + reach) / terrain.spacing))
    nearest = wp.vec3(p[0], p[1], p[2] + _FAR)
    least = float(_FAR)  # squared distance
    for row in range(row0, row1 + 1):
        y = float(row) * terrain.spacing
        across = wp.max(wp.max(y - p[1], p[1] - y - terrain.spacing), 0.0)
        h10 = node_height(terrain, t, row, col0)
        h11 = node_height(terrain, t, row + 1, col0)
        for col in range(col0, col1 + 1):
            h00 = h10
            h01 = h11
            h10 = node_height(terrain, t, row, col + 1)
            h11 = node_height(terrain, t, row + 1, col + 1)
            above = p[2] - wp.max(wp.max(h00, h10), wp.max(h01, h11))
            if above < reach:
                x = float(col) * terrain.spacing
                along = wp.max(wp.max(x - p[0], p[0] - x - terrain.spacing), 0.0)
                above = wp.max(above, 0.0)
                if across * across + along * along + above * above <= least:  # else all of the cell is farther
                    low_high = wp.vec3(x, y + terrain.spacing, h01)
                    high_low = wp.vec3(x + terrain.spacing, y, h10)
                    first = nearest_on_triangle(p, wp.vec3(x, y, h00), high_low, low_high)
                    high_high = wp.vec3(x + terrain.spacing, y + terrain.spacing, h11)
                    second = nearest_on_triangle(p, high_high, low_high, high_low)
                    if wp.length_sq(p - first) < least:
                        least = wp.length_sq(p - first)
                        nearest = first
                    if wp.length_sq(p - second) < least:
                        least = wp.length_sq(p - second)
                        nearest = second
    if least == _FAR:
        return point
    distance = wp.length(p - nearest)
    point.distance = distance
    height = height_at(terrain, t, p[0], p[1])
    if p[2] < height:
        if distance > reach:
            point.normal = normal_at(terrain, t, p[0], p[1])
            point.distance = (p[2] - height) * point.normal[2]
            return point
        point.distance = -distance
    if distance > _ON_SURFACE:
        point.normal = (p - nearest) / point.distance
    else:
        point.normal = normal_at(terrain, t, p[0], p[1])
    return point


@kernel_over("ceilings_out")
def max_blocks(heights: wp.array3d[float], ceilings_out: wp.array3d[float]):
    """Grid (num_terrains, block rows, block cols): the highest node [m] of each block, shape :func:`ceiling_shape`."""
    t, block_row, block_col = wp.tid()
    highest = float(-1.0e6)
    for i in range(BLOCK + 1):
        for j in range(BLOCK + 1):
            row = wp.min(block_row * BLOCK + i, heights.shape[1] - 1)
            col = wp.min(block_col * BLOCK + j, heights.shape[2] - 1)
            highest = wp.max(highest, heights[t, row, col])
    ceilings_out[t, block_row, block_col] = highest


def ceiling_shape(num_terrains: int, nrow: int, ncol: int) -> tuple[int, int, int]:
    """Shape of the ceiling grid of ``num_terrains`` grids of ``nrow`` x ``ncol`` nodes."""
    return num_terrains, -(-(nrow - 1) // BLOCK), -(-(ncol - 1) // BLOCK)
