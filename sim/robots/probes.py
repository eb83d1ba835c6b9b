"""Collision shapes as strips of sphere probes, so close that no terrain edge slips through; meshes as convex hulls."""

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from functools import lru_cache
from typing import Any, NamedTuple

import newton
import numpy as np
import warp as wp
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, QhullError
from scipy.spatial.transform import Rotation

from kernels.contact import Probes
from sim.crossing import CrossingCfg
from sim.device import host_device
from sim.robots.robot import RobotCfg

_DRAWS = 64  # of start poses
_BUNDLE = 32  # strips at most, few enough that one thread looks at all where they are near the ground
_vec3: Any = wp.vec3


class Strip(NamedTuple):
    """A row of equal spheres on one shape, straight except on meshes."""

    centres: np.ndarray  # centres in the shape's frame [m], shape (num_probes, 3), in order along the strip
    radius: float  # probe radius [m]
    spread: float = 0.0  # farthest that a centre lies from the straight line between the first and the last one [m]


_MESH_TOLERANCE = 0.01  # farthest that a point of a hull's surface may lie outside of the nearest probe [m]
_SMALL_MESH_SHARE = 1.0 / 12.0  # of a small mesh's longest side, its tolerance
_MAX_PROBE_RADIUS = 0.1  # [m]
MAX_MESH_PROBES = 400  # probes of one mesh; one that would need more is covered as closely as these reach
_WIDE = 0.1  # a wider mesh lies on two rows of probes, left and right [m]
_SAMPLES_PER_TOLERANCE = 2.0
_GROWTH = 1.25

_Array = NDArray[np.float64]


def _inscribe_ball(point: _Array, planes: _Array, radii: _Array, max_depth: float) -> tuple[_Array, float]:
    """Centre and radius of the first of the falling ``radii`` whose inscribed ball is so near to a surface point."""
    normal = planes[:, :3]
    clearance = -planes[:, 3] - normal @ point
    inward = -normal[clearance < 0.25 * max_depth].sum(axis=0)
    inward /= np.linalg.norm(inward)
    rate = -normal @ inward  # clearance that a plane gains a metre inward
    leaves, nears = rate > 1e-9, rate < -1e-9
    largest = float(clearance[~leaves & ~nears].min(initial=np.inf))
    for radius in radii[radii <= largest + 1e-9]:
        depth = float(((radius - clearance[leaves]) / rate[leaves]).max())
        limit = float(((radius - clearance[nears]) / rate[nears]).min(initial=np.inf))
        if depth <= limit and depth - radius <= max_depth:
            return point + depth * inward, float(radius)
    return point, 0.0  # a tip sharper than any of the balls


def _cover(triangles: _Array, planes: _Array, inradius: float, tolerance: float) -> tuple[_Array, _Array] | None:
    """Balls, (n, 3) and (n,), with every sample of the surface near enough to one; None if it takes too many."""
    spacing = tolerance / _SAMPLES_PER_TOLERANCE
    points = []  # of each triangle, none farther than spacing / sqrt(3) from the next, corners included
    for a, b, c in triangles:
        longest = max(np.linalg.norm(b - a), np.linalg.norm(c - b), np.linalg.norm(a - c))
        count = max(1, int(np.ceil(longest / spacing)))
        steps = np.arange(count + 1)
        u, v = np.argwhere(steps[:, None] + steps <= count).T[..., None] / count
        points.append(a + u * (b - a) + v * (c - a))
    samples = np.unique(np.round(np.concatenate(points), 7), axis=0).astype(np.float64)
    goal = tolerance - spacing / np.sqrt(3.0)
    largest = min(inradius, _MAX_PROBE_RADIUS)
    radii = largest * 0.5 ** np.arange(max(1.0, np.ceil(np.log2(8.0 * largest / tolerance))))
    squares, gap = (samples * samples).sum(axis=1), np.full(len(samples), np.inf)
    balls: list[tuple[_Array, float]] = []
    while gap.max() > goal:
        if len(balls) == MAX_MESH_PROBES:
            return None
        centre, radius = _inscribe_ball(samples[gap.argmax()], planes, radii, 0.9 * goal)
        balls.append((centre, radius))
        distance = np.sqrt(np.maximum(squares - 2.0 * samples @ centre + centre @ centre, 0.0))
        gap = np.minimum(gap, distance - radius)
    centres, chosen_radii = zip(*balls, strict=True)
    return np.array(centres), np.array(chosen_radii)


def _rows(centres: _Array, radii: _Array, corners: _Array) -> Iterator[Strip]:
    """Balls in rows of one radius along the longest side: contacts are made of a row's ends and its deepest ball."""
    middle = corners.mean(axis=0)
    _, _, axes = np.linalg.svd(corners - middle, full_matrices=False)
    along, across = ((centres - middle) @ axis for axis in axes[:2])
    side = np.sign(across) if np.ptp((corners - middle) @ axes[1]) > _WIDE else np.zeros(len(centres))
    side[side == 0.0] = 1.0
    for radius, lane in itertools.product(np.unique(radii)[::-1], np.unique(side)):
        chosen = np.flatnonzero((radii == radius) & (side == lane))
        if len(chosen):
            row = centres[chosen[np.argsort(along[chosen], kind="stable")]]
            line = row[-1] - row[0]
            length = float(line @ line) or 1.0
            share = np.clip((row - row[0]) @ line / length, 0.0, 1.0)
            spread = float(np.linalg.norm(row - row[0] - share[:, None] * line, axis=1).max())
            yield Strip(centres=row, radius=float(radius), spread=spread)


@lru_cache(maxsize=64)
def hull_probes(vertices: bytes) -> tuple[list[Strip], float]:
    """Probes in the convex hull of vertices [m], float64 (num_vertices, 3), and how far outside its surface lies."""
    try:
        hull = ConvexHull(np.frombuffer(vertices).reshape(-1, 3))
    except QhullError:
        raise ValueError("its mesh must have a volume: replace it in the robot's file by a solid or a box") from None
    planes = np.unique(np.round(hull.equations, 9), axis=0)  # outward normal . x <= -offset; facets of a face share one
    triangles = hull.points[hull.simplices]
    centred = triangles - triangles.mean(axis=(0, 1))
    volume = np.abs(np.linalg.det(centred))
    middle = np.average(centred.sum(axis=1) / 4.0, axis=0, weights=volume) + triangles.mean(axis=(0, 1))
    inradius = float((-planes[:, 3] - planes[:, :3] @ middle).min())  # of the largest ball about the hull's middle
    corners = np.unique(triangles.reshape(-1, 3), axis=0)
    tolerance = min(_MESH_TOLERANCE, _SMALL_MESH_SHARE * float(np.ptp(corners, axis=0).max()))
    while (balls := _cover(triangles, planes, inradius, tolerance)) is None:
        tolerance *= _GROWTH
    return [*_rows(*balls, corners)], tolerance


MAX_SAG = 0.005  # deepest that a sharp ridge may sink between two neighbouring probes of a box or cylinder [m]
CAPSULE_SAG = 0.0005  # deepest that it may sink between those of a capsule, by which limbs hang on edges [m]
_MAX_EDGE_RADIUS = 0.02  # largest probe radius on boxes and cylinders, whose edges the probes round off [m]
_MAX_SIDE = 10.0  # longest side of a shape [m]; a longer one is in other units


def _max_spacing(radius: float, max_sag: float = MAX_SAG) -> float:
    """Largest distance of neighbouring probes between which a sharp ridge sinks at most so deep [m]."""
    sag = min(max_sag, radius)  # of two spheres at distance s it is r - sqrt(r^2 - s^2 / 4)
    return 2.0 * float(np.sqrt(2.0 * radius * sag - sag * sag))


def _line(low: float, high: float, spacing: float) -> _Array:
    return np.linspace(low, high, int(np.ceil((high - low) / spacing - 1e-9)) + 1)


def _along_z(x: float, y: float, z: _Array) -> _Array:
    return np.stack([np.full_like(z, x), np.full_like(z, y), z], axis=1)


def capsule_strips(radius: float, half_height: float) -> list[Strip]:
    """One strip along the axis (z); exact at the caps."""
    spacing = _max_spacing(radius, CAPSULE_SAG)
    return [Strip(centres=_along_z(0.0, 0.0, _line(-half_height, half_height, spacing)), radius=radius)]


def box_strips(*half: float) -> Iterator[Strip]:
    """Strips under the whole surface of a box, along its longest side; edges are rounded by at most 2 cm."""
    radius = min(_MAX_EDGE_RADIUS, *half)
    spacing = _max_spacing(radius)
    # Contacts are made of the ends of a strip, so the fewer strips, the fewer contacts of a box that lies.
    order = [*np.argsort(half, kind="stable")]
    thin, middle, along = (_line(-half[k] + radius, half[k] - radius, spacing) for k in order)
    back = np.argsort(order)
    for px, py in itertools.product(thin, middle):
        is_rim = px in thin[[0, -1]] or py in middle[[0, -1]]
        # Inside the cross-section only the two end faces have a surface.
        for row in [along] if is_rim else [along[:1], along[-1:]]:
            yield Strip(centres=_along_z(float(px), float(py), row)[:, back], radius=radius)


def cylinder_strips(radius: float, half_height: float) -> Iterator[Strip]:
    """Strips along the axis (z) round the mantle, and rings of single probes on the two end faces."""
    probe = min(_MAX_EDGE_RADIUS, radius, half_height)
    spacing = _max_spacing(probe)
    z = _line(-half_height + probe, half_height - probe, spacing)
    for ring, ring_radius in enumerate(_line(0.0, radius - probe, spacing)[::-1]):
        count = max(1, int(np.ceil(2.0 * np.pi * ring_radius / spacing)))
        for angle in np.arange(count) * 2.0 * np.pi / count:
            x, y = (float(ring_radius * f(angle)) for f in (np.cos, np.sin))
            for row in [z] if ring == 0 else [z[:1], z[-1:]]:
                yield Strip(centres=_along_z(x, y, row), radius=probe)


_PRIMITIVES: dict[newton.GeoType, tuple[int, Callable[..., Iterable[Strip]]]] = {
    newton.GeoType.SPHERE: (1, lambda radius: [Strip(centres=np.zeros((1, 3)), radius=radius)]),
    newton.GeoType.CAPSULE: (2, capsule_strips),
    newton.GeoType.CYLINDER: (2, cylinder_strips),
    newton.GeoType.BOX: (3, box_strips),
}  # how many sizes a primitive has, and its strips


def shape_strips(shape_type: newton.GeoType, scale: np.ndarray, mesh: Any = None) -> list[Strip]:
    """Strips of one collision shape of Newton's scale, in the shape's frame; a mesh collides as its convex hull."""
    num_sizes, make_strips = _PRIMITIVES.get(shape_type, (0, None))
    sizes = np.asarray(scale, dtype=np.float64)[:num_sizes]
    is_mesh = shape_type == newton.GeoType.MESH
    vertices = np.asarray(mesh.vertices, dtype=np.float64) * scale if is_mesh else np.zeros((1, 3))
    if not (np.isfinite(vertices).all() and (sizes > 0.0).all()):
        raise ValueError(f"its sizes must be positive numbers, got {', '.join(f'{size:g}' for size in sizes)} m")
    longest = max(2.0 * sizes.max(initial=0.0), float(np.ptp(vertices, axis=0).max()))
    if not longest <= _MAX_SIDE:
        raise ValueError(f"it is {longest:g} m long, more than {_MAX_SIDE:g} m: give lengths in m, a mesh its scale")
    if is_mesh:
        return hull_probes(vertices.tobytes())[0]
    if make_strips is None:
        kind = newton.GeoType(shape_type).name
        raise ValueError(f"it must be a SPHERE, CAPSULE, BOX, CYLINDER or MESH, got {kind}: replace it in the file")
    return [*make_strips(*map(float, sizes))]


def make_probes(builder: newton.ModelBuilder) -> Probes:
    """Sphere probes of all collision shapes of one robot, on the current device."""
    strips: list[tuple[int, Strip]] = []
    problems: list[str] = []
    for k in range(builder.shape_count):
        scale = np.asarray(builder.shape_scale[k])
        try:
            added = shape_strips(newton.GeoType(builder.shape_type[k]), scale, builder.shape_source[k])
            strips += [(k, strip) for strip in added]
        except ValueError as error:
            problems.append(f"geom {builder.shape_label[k]}: {error}")
    if problems:
        raise ValueError("; ".join(problems))
    poses: Any = builder.shape_transform
    centres = [[wp.transform_point(poses[k], _vec3(*centre)) for centre in strip.centres] for k, strip in strips]
    shape, radius = [k for k, _ in strips], [strip.radius for _, strip in strips]
    body = [builder.shape_body[k] for k in shape]
    runs = (list(run) for _, run in itertools.groupby(range(len(body)), body.__getitem__))
    bundles = [first for run in runs for first in run[::_BUNDLE]] + [len(body)]  # neighbours on one body
    balls = [_bounding_ball(centres[a:b], radius[a:b]) for a, b in itertools.pairwise(bundles)]
    probes = Probes()
    probes.position = wp.array([centre for strip in centres for centre in strip], dtype=wp.vec3)
    probes.strip_start = wp.array(np.cumsum([0] + [len(strip) for strip in centres]), dtype=int)
    probes.strip_radius = wp.array(radius, dtype=float)
    probes.strip_spread = wp.array([strip.spread for _, strip in strips], dtype=float)
    probes.strip_shape = wp.array(shape, dtype=int)
    probes.bundle_start = wp.array(bundles, dtype=int)
    probes.bundle_body = wp.array([body[first] for first in bundles[:-1]], dtype=int)
    probes.bundle_ball = wp.array(balls, dtype=wp.vec4)
    return probes


def _bounding_ball(strips: Sequence[Sequence[Any]], radii: Sequence[float]) -> tuple[float, ...]:
    """Middle and radius of a ball that holds strips of spheres [m]."""
    points = np.array([centre for strip in strips for centre in strip], dtype=np.float64)
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    reach = np.linalg.norm(points - middle, axis=1) + np.repeat(radii, [len(strip) for strip in strips])
    return *map(float, middle), float(reach.max()) + 1e-6


def start_height(robot: RobotCfg, builder: newton.ModelBuilder) -> float:
    """Height of the base at which a crossing, whose joints start about their angles, has no foot in the ground [m]."""
    spread = CrossingCfg().start_joint_range
    scale = np.random.default_rng(0).uniform(1.0 - spread, 1.0 + spread, (_DRAWS, robot.num_joints))
    scale[0] = 1.0
    extents = measure_extents(builder, scale * robot.default_joint_pos)
    lowest_foot = min(bottoms[name] for bottoms, _ in extents for name in robot.foot_geoms)
    return float(np.ceil(-1e3 * lowest_foot - 1e-3) / 1e3)


def measure_extents(builder: newton.ModelBuilder, poses: Any) -> Iterator[tuple[dict[str, float], float]]:
    """Lowest point of each geom, and the farthest of all, from the upright base [m] in poses of shape (num_joints,)."""
    with wp.ScopedDevice(host_device()):
        model, probes = builder.finalize(), make_probes(builder)
        state: Any = model.state()
        counts = np.diff(probes.strip_start.numpy())
        radius, shape = (np.repeat(values.numpy(), counts) for values in (probes.strip_radius, probes.strip_shape))
        names = np.array(builder.shape_label)[shape]
        body = np.array(builder.shape_body)[shape]
        points = probes.position.numpy()
        for pose in poses:
            state.joint_q.assign(np.array([0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0, *pose], dtype=np.float32))
            newton.eval_fk(model, state.joint_q, state.joint_qd, state)
            body_poses = state.body_q.numpy()[body]
            centres = body_poses[:, :3] + Rotation.from_quat(body_poses[:, 3:]).apply(points)
            bottom = centres[:, 2] - radius
            reach = float((np.linalg.norm(centres, axis=1) + radius).max())
            yield {name: float(bottom[names == name].min()) for name in dict.fromkeys(names.tolist())}, reach
