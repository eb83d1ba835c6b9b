"""Probes of meshes: inside the convex hull, everywhere near its surface, and as good as the same body of primitives."""

import mujoco
import newton
import numpy as np
import pytest
from scipy.spatial import ConvexHull, Delaunay

from sim.robots.model import build_robot
from sim.robots.probes import MAX_MESH_PROBES, MESH_TOLERANCE, SMALL_MESH_SHARE, hull_probes, shape_strips
from sim.terrain import SPACING
from tests.sim.scenes import Stepper, free_body, lying, positions, put, simulate, slope, velocities

CORNERS = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) / 2.0
WEDGE = np.array([[0, 0, 0], [0.2, 0, 0], [0, 0.1, 0], [0.2, 0.1, 0], [0.2, 0, 0.06], [0.2, 0.1, 0.06]])


def ball(count, size):
    points = np.random.default_rng(0).normal(size=(count, 3))
    return points / np.linalg.norm(points, axis=1, keepdims=True) * np.array(size) / 2


MESHES = {
    "base": CORNERS * [0.6, 0.3, 0.2],
    "shank": CORNERS * [0.03, 0.03, 0.3],
    "plate": CORNERS * [0.3, 0.1, 0.02],
    "wedge": WEDGE,
    "tetrahedron": np.array([[0, 0, 0], [0.1, 0, 0], [0, 0.1, 0], [0, 0, 0.1]]),
    "foot": ball(400, [0.06, 0.06, 0.04]),
    "thigh, not at its origin": np.add(ball(3000, [0.1, 0.06, 0.3]), [0.4, -0.2, 0.7]),
    "hollow": np.vstack([CORNERS * [0.2, 0.2, 0.2], CORNERS * [0.1, 0.1, 0.1]]),
}


@pytest.fixture(params=MESHES)
def vertices(request):
    return MESHES[request.param]


def spheres(strips):
    """Centres (n, 3) and radii (n,)."""
    radii = np.concatenate([np.full(len(strip.centres), strip.radius) for strip in strips])
    return np.concatenate([strip.centres for strip in strips]), radii


def on_surface(vertices, count=6000):
    """Points all over the hull's faces, half of them on its edges and corners."""
    hull, rng = ConvexHull(vertices), np.random.default_rng(1)
    triangles = hull.points[hull.simplices]
    area = np.linalg.norm(np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0]), axis=1)
    chosen = triangles[rng.choice(len(triangles), count, p=area / area.sum())]
    weights = rng.dirichlet(np.ones(3), count)
    weights[: count // 2, 0] = 0.0
    weights /= weights.sum(axis=1, keepdims=True)
    return np.vstack([np.einsum("nk,nkj->nj", weights, chosen), hull.points[hull.vertices]])


def test_no_point_of_the_surface_is_farther_out_than_the_tolerance(vertices):
    probes = hull_probes(vertices)
    centres, radii = spheres(probes.strips)
    points = on_surface(vertices)
    gap = np.min([np.linalg.norm(points - c, axis=1) - r for c, r in zip(centres, radii, strict=True)], axis=0)
    assert gap.max() <= probes.tolerance
    assert gap.max() > 0.3 * probes.tolerance, "far more probes than it takes"


def test_no_probe_sticks_out(vertices):
    centres, radii = spheres(hull_probes(vertices).strips)
    planes = ConvexHull(vertices).equations
    assert (centres @ planes[:, :3].T + planes[:, 3] + radii[:, None]).max() < 1e-6


def test_the_tolerance_is_what_is_stated(vertices):
    # 1 cm, of a small mesh a twelfth of its longest side; more only where 400 probes do not do.
    probes = hull_probes(vertices)
    count = sum(len(strip.centres) for strip in probes.strips)
    stated = min(MESH_TOLERANCE, SMALL_MESH_SHARE * np.ptp(vertices, axis=0).max())
    assert count <= MAX_MESH_PROBES
    if len(vertices) == 8 and np.ptp(vertices, axis=0).max() > 0.5:
        assert stated < probes.tolerance <= 0.025
    else:
        assert probes.tolerance == pytest.approx(stated)


def test_rows_are_what_the_contact_kernel_takes_them_for(vertices):
    # It bounds a row by its ends, the radius and the spread, and makes three contacts of it at most.
    strips = hull_probes(vertices).strips
    assert 3 * len(strips) <= 30
    for strip in strips:
        line = strip.centres[-1] - strip.centres[0]
        length = max(float(line @ line), 1e-12)
        share = np.clip((strip.centres - strip.centres[0]) @ line / length, 0, 1)
        off = np.linalg.norm(strip.centres - strip.centres[0] - share[:, None] * line, axis=1)
        assert off.max() == pytest.approx(strip.spread, abs=1e-9)


def test_a_hollow_mesh_collides_as_its_hull():
    outer = hull_probes(CORNERS * 0.2)
    hollow = hull_probes(MESHES["hollow"])
    np.testing.assert_array_equal(spheres(outer.strips)[0], spheres(hollow.strips)[0])


def test_a_mesh_is_scaled():
    class Mesh:
        vertices = CORNERS

    strips = shape_strips(newton.GeoType.MESH, np.array([0.2, 0.1, 0.05]), Mesh())
    low, high = spheres(strips)[0].min(0), spheres(strips)[0].max(0)
    assert (high - low < [0.2, 0.1, 0.05]).all() and (high - low > 0.5 * np.array([0.2, 0.1, 0.05])).all()


@pytest.mark.parametrize("flat", [CORNERS * [1, 1, 0], CORNERS[:3], np.zeros((5, 3))])
def test_a_mesh_without_volume_is_refused(flat):
    with pytest.raises(ValueError, match=r"no volume.*expected a solid"):
        hull_probes(flat)


def mesh_body(folder, vertices, mass=2.0):
    """A free body whose only geom is a mesh, as a robot of one body."""
    robot = free_body(folder, 'type="mesh" mesh="shape"', mass=mass)
    points = " ".join(f"{value:.9f}" for value in np.ravel(vertices))
    text = robot.model_file.read_text().replace(
        "<worldbody>", f'<asset><mesh name="shape" vertex="{points}"/></asset><worldbody>'
    )
    robot.model_file.write_text(text)
    return robot


def test_a_mesh_is_one_shape_of_the_model(tmp_path):
    builder = build_robot(mesh_body(tmp_path, CORNERS * 0.1))
    assert builder.shape_count == 1
    assert builder.body_mass[0] == pytest.approx(2.0)


def test_a_dropped_mesh_comes_to_rest_as_the_same_box(device, tmp_path):
    # A box of 0.2 x 0.12 x 0.08 m, as a mesh and as a primitive, dropped on each of its faces on level ground.
    size = np.array([0.2, 0.12, 0.08])
    poses = np.vstack(
        [lying(1, 8, 4, 0.3), lying(1, 8, 4, 0.3, (1, 0, 0), np.pi / 2), lying(1, 8, 4, 0.3, (0, 1, 0), np.pi / 2)]
    )
    half = " ".join(map(str, size / 2))
    rest = []
    for robot in (
        mesh_body(tmp_path / "mesh", CORNERS * size),
        free_body(tmp_path / "box", f'type="box" size="{half}"', mass=2.0),
    ):
        sim = simulate(robot, [slope()] * 3, device)
        put(sim, poses)
        Stepper(sim).run(2.0)
        assert np.abs(velocities(sim)).max() < 0.02
        rest.append(positions(sim))
    for mesh, box, thickness in zip(*rest, size[[2, 1, 0]], strict=True):
        assert mesh[2] == pytest.approx(box[2], abs=1e-3)
        assert mesh[2] == pytest.approx(thickness / 2, abs=2e-3)
        assert abs(np.dot(mesh[3:7], box[3:7])) > 0.9999  # lying flat, as the box does


def test_no_edge_slips_between_the_probes(device, tmp_path):
    # Ridges of one node, as sharp as the grid makes them, under a lying plate at twelve places: a ridge enters its hull
    # by no more than the tolerance and what the contacts give.
    size = MESHES["plate"]
    height, num = 0.3, 12
    grid = np.zeros((161, 321), np.float32)
    grid[:, [158, 162]] = height
    sim = simulate(mesh_body(tmp_path, size, mass=1.0), [grid] * num, device)
    q = lying(num, 8, 4, height + 0.012)
    q[:, 0] += np.linspace(-0.02, 0.02, num)
    put(sim, q)
    Stepper(sim).run(1.0)
    hull = Delaunay(size)
    tolerance = hull_probes(size).tolerance
    for row in positions(sim):
        assert row[2] > height - tolerance
        # Points of both ridges, lowered by the tolerance and 2 mm: outside of the plate, seen from the plate.
        ridge = np.array(
            [
                [column * SPACING, 4 + y, height - tolerance - 0.002]
                for column in (158, 162)
                for y in np.linspace(-0.05, 0.05, 21)
            ]
        )
        rotation = np.zeros(9)
        mujoco.mju_quat2Mat(rotation, row[[6, 3, 4, 5]])
        local = (ridge - row[:3]) @ rotation.reshape(3, 3)
        assert (hull.find_simplex(local) < 0).all()


def test_a_sliding_mesh_moves_as_the_same_box(device, tmp_path):
    # On slopes of 24 and 28 degrees, steeper than friction of 0.3 holds (17 degrees): about 0.25 and 0.39 m in 0.6 s.
    size, angles = np.array([0.2, 0.12, 0.06]), np.radians([24.0, 28.0])
    ends = []
    for robot in (
        mesh_body(tmp_path / "mesh", CORNERS * size),
        free_body(tmp_path / "box", f'type="box" size="{" ".join(map(str, size / 2))}"', mass=2.0),
    ):
        robot.model_file.write_text(robot.model_file.read_text().replace('friction="0.5"', 'friction="0.3"'))
        sim = simulate(robot, [slope(angle) for angle in angles], device)
        q = np.vstack([lying(1, 8, 4, 0.0, (0, -1, 0), angle) for angle in angles])
        q[:, :3] += 0.0305 * np.column_stack([-np.sin(angles), 0 * angles, np.cos(angles)])
        put(sim, q)
        Stepper(sim).run(0.6)
        ends.append(positions(sim))
    moved = np.linalg.norm(ends[1][:, :3] - q[:, :3], axis=1)
    assert (moved > [0.2, 0.3]).all()
    assert (np.linalg.norm(ends[0][:, :3] - ends[1][:, :3], axis=1) < 0.01 * moved).all()
