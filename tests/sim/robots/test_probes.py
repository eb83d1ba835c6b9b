"""Sphere probes of shapes and meshes: inside, everywhere near the surface, and close enough for a sharp ridge."""

from types import SimpleNamespace

import newton
import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from sim.robots.model import build_robot
from sim.robots.probes import CAPSULE_SAG, MAX_MESH_PROBES, hull_probes, make_probes, shape_strips

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2.0


def spheres(strips):
    """Centres (n, 3) and radii (n,)."""
    radii = np.concatenate([np.full(len(strip.centres), strip.radius) for strip in strips])
    return np.concatenate([strip.centres for strip in strips]), radii


def uncovered(points, strips):
    """How far the points, on the shape's surface, lie outside of the nearest probe."""
    centres, radii = spheres(strips)
    gap = np.full(len(points), np.inf)
    for centre, radius in zip(centres, radii, strict=True):
        gap = np.minimum(gap, np.linalg.norm(points - centre, axis=1) - radius)
    return gap


CAPSULES = [(0.0175, 0.1), (0.06, 0.04), (0.003, 0.2)]
BOXES = [(0.1, 0.1, 0.05), (0.3, 0.02, 0.15), (0.01, 0.01, 0.01)]
CYLINDERS = [(0.02, 0.0625), (0.1, 0.05), (0.25, 0.01)]
GeoType = newton.GeoType
PRIMITIVES = [
    *((GeoType.CAPSULE, size, trimesh.creation.capsule(radius=size[0], height=2 * size[1])) for size in CAPSULES),
    *((GeoType.BOX, size, trimesh.creation.box(2 * np.array(size))) for size in BOXES),
    *((GeoType.CYLINDER, size, trimesh.creation.cylinder(size[0], 2 * size[1], sections=99)) for size in CYLINDERS),
]


@pytest.mark.parametrize(("kind", "size", "shape"), PRIMITIVES)
def test_probes_cover_a_shape_and_none_sticks_out(kind, size, shape):
    strips = shape_strips(kind, np.array(size))
    centres, radii = spheres(strips)
    np.testing.assert_allclose((np.abs(centres) + radii[:, None]).max(axis=0), shape.extents / 2, rtol=4e-3)
    if kind == GeoType.CYLINDER:
        assert (np.linalg.norm(centres[:, :2], axis=1) + radii <= size[0] + 1e-9).all()
    # A needle between four probes, or a corner (rounded by (sqrt 3 - 1) r = 14.6 mm), is the worst case.
    max_gap = CAPSULE_SAG if kind == GeoType.CAPSULE else 0.0147
    assert uncovered(shape.sample(4000, seed=0), strips).max() <= max_gap + 1e-9
    for strip in strips:  # kernels.contact bounds a strip by its ends and takes first and last as its outermost
        extent = np.ptp(strip.centres, axis=0)
        assert (np.diff(strip.centres[:, extent.argmax()]) > 0).all() and np.sort(extent)[:2].max() < 1e-12
        if kind == GeoType.BOX and len(strip.centres) > 1:  # long rows make few contacts
            assert size[extent.argmax()] == max(size)


def ball(count, size):
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * np.array(size) / 2


# 1 cm, of a small mesh a twelfth of its longest side; more only where 400 probes do not do.
MESHES = {
    "base": (CORNERS * [0.6, 0.3, 0.2], 0.025),
    "shank": (CORNERS * [0.03, 0.03, 0.3], 0.01),
    "plate": (CORNERS * [0.3, 0.1, 0.02], 0.01),
    "tetrahedron": (np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]), 0.1 / 12),
    "thigh, not at its origin": (np.add(ball(300, [0.1, 0.06, 0.3]), [0.4, -0.2, 0.7]), 0.01),
}


@pytest.mark.parametrize("name", MESHES)
def test_mesh(name):
    vertices, max_tolerance = MESHES[name]
    strips, tolerance = hull_probes(vertices)
    centres, radii = spheres(strips)
    assert tolerance <= max_tolerance * (1 + 1e-6) and len(radii) <= MAX_MESH_PROBES
    assert tolerance == pytest.approx(max_tolerance) or name == "base"
    hull = ConvexHull(vertices)
    faces = trimesh.convex.convex_hull(vertices).sample(6000, seed=1)
    edges = hull.points[hull.simplices[:, [0, 1, 2, 0]]]
    between = np.linspace(edges[:, :3], edges[:, 1:], 9).reshape(-1, 3)
    gap = uncovered(np.vstack([faces, between]), strips)
    assert gap.max() <= tolerance
    assert gap.max() > 0.3 * tolerance, "far more probes than it takes"
    sticking_out = centres @ hull.equations[:, :3].T + hull.equations[:, 3] + radii[:, None]
    assert sticking_out.max() < 1e-6
    # The contact kernel bounds a row by its ends, the radius and the spread, and makes three contacts of it at most.
    assert len(strips) <= 10
    for strip in strips:
        line = strip.centres[-1] - strip.centres[0]
        if name != "tetrahedron":  # which has no longest side
            longest = np.ptp(vertices, axis=0).argmax()
            assert abs(line[longest]) >= 0.95 * np.ptp(strip.centres[:, longest])
        share = np.clip((strip.centres - strip.centres[0]) @ line / max(float(line @ line), 1e-12), 0, 1)
        off = np.linalg.norm(strip.centres - strip.centres[0] - share[:, None] * line, axis=1)
        assert off.max() == pytest.approx(strip.spread, abs=1e-9)


def test_a_mesh_is_scaled_and_collides_as_its_hull():
    hollow = SimpleNamespace(vertices=np.vstack([CORNERS, CORNERS / 2]))
    strips = shape_strips(newton.GeoType.MESH, np.array([0.2, 0.1, 0.05]), hollow)
    expected = hull_probes(CORNERS * [0.2, 0.1, 0.05])[0]
    np.testing.assert_array_equal(spheres(strips)[0], spheres(expected)[0])


def test_a_mesh_without_volume_is_refused():
    with pytest.raises(ValueError, match="volume"):
        hull_probes(CORNERS * [1, 1, 0])


def test_every_geom_of_a_robot_has_probes_on_its_body(robot):
    builder = build_robot(robot)
    probes = make_probes(builder)
    shapes, starts, first = (getattr(probes, name).numpy() for name in ("strip_shape", "strip_start", "bundle_start"))
    bodies = np.repeat(probes.bundle_body.numpy(), np.diff(first))
    ball = np.repeat(probes.bundle_ball.numpy(), np.diff(starts[first]), axis=0)
    radius = np.repeat(probes.strip_radius.numpy(), np.diff(starts))
    away = np.linalg.norm(probes.position.numpy() - ball[:, :3], axis=1) + radius
    assert (away <= ball[:, 3]).all()
    assert [builder.shape_label[shape] for shape in shapes] == builder.shape_label  # once: no cylinders, no boxes
    np.testing.assert_array_equal(bodies, np.array(builder.shape_body)[shapes])
    if robot.name == "cassie":
        # At r = .02 neighbours may be 2 sqrt(2 * .02 * .0005 - .0005^2) = .0089 m apart: 16 on a toe of .125 m.
        np.testing.assert_allclose(probes.strip_radius.numpy(), [0.25, 0.02, 0.02], atol=1e-6)
        assert np.diff(starts).tolist() == [1, 16, 16]
