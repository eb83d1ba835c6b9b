"""What is shown of a robot stands where the simulation has it; sphere probes lie in its shapes and cover them."""

from types import SimpleNamespace

import mujoco
import newton
import numpy as np
import pytest
import trimesh
import warp as wp
from scipy.spatial import ConvexHull

from sim.robots.find import get_robot
from sim.robots.model import build_robot
from sim.robots.probes import CAPSULE_SAG, MAX_MESH_PROBES, hull_probes, make_probes, shape_strips
from sim.robots.skeleton import Skeleton
from tests.kernels import oracle
from tests.kernels.states import random_states
from tests.sim.dogs import KINDS, with_mesh, write_dog


def to_matrix(quaternion_wxyz):
    return oracle.rotation_matrix(np.roll(quaternion_wxyz, -1))


def test_a_shipped_robot_shows_the_look_of_every_body_and_all_its_touches(robot):
    """No shape that collides is seen; each role shows its touch, feet by what is where they are."""
    skeleton = Skeleton(robot)
    model = skeleton.model
    touches = skeleton.touches
    assert {model.geom_bodyid[geom] - 1 for geom in touches} == set(range(skeleton.num_bodies))
    for column, name in enumerate(robot.geom_names):
        touching = model.geom(name)
        shapes = [geom for geom, columns in touches.items() if column in columns]
        assert touching.id not in touches and {model.geom_bodyid[geom] for geom in shapes} == set(touching.bodyid)
        distance = min(np.linalg.norm(model.geom_pos[geom] - touching.pos) for geom in shapes)
        assert distance < (0.01 if name in robot.foot_geoms else 0.12)
    if robot.name == "anymal":  # a shank's touch is not its foot's
        assert all(len(columns) <= 1 for columns in touches.values())


@pytest.mark.parametrize("kind", [*KINDS, "anymal", "cassie"])
def test_shapes_stand_where_the_simulation_has_them(tmp_path, kind):
    """By their names in the simulation's own model, in poses of every joint."""
    robot = get_robot(str(with_mesh(tmp_path, kind)) if kind in KINDS else kind)
    skeleton = Skeleton(robot)
    rows = np.float64(random_states(3, robot.num_joints)[0])
    builder = build_robot(robot)
    positions, quaternions = skeleton.body_poses(rows)
    names = builder.shape_label
    with wp.ScopedDevice("cpu"):
        model = builder.finalize()
        state = model.state()
    for row, position, quaternion in zip(rows, positions, quaternions, strict=True):
        state.joint_q.assign(row[[0, 1, 2, 4, 5, 6, 3, *range(7, len(row))]].astype(np.float32))
        newton.eval_fk(model, state.joint_q, model.joint_qd, state)
        for name in (*robot.limb_geoms, *robot.foot_geoms):
            shape, geom = names.index(name), skeleton.model.geom(name)
            pose = wp.transform(*state.body_q.numpy()[builder.shape_body[shape]]) * builder.shape_transform[shape]
            body = geom.bodyid[0] - 1
            turn = to_matrix(quaternion[body])
            np.testing.assert_allclose(position[body] + turn @ geom.pos, np.array(pose.p), atol=1e-5)
            expected = oracle.rotation_matrix(np.array(pose.q))
            np.testing.assert_allclose(turn @ to_matrix(geom.quat), expected, atol=1e-5)


BOX = '<geom type="box" size=".1 .2 .3" rgba="1 0 0 1"/>'
LOOK = f'<mujoco><worldbody><body name="{{}}">{BOX}</body></worldbody></mujoco>'


def seen_shapes(dog, body):
    """Types of what is seen of a body, and what touches they show."""
    shapes = [geom for geom in dog.touches if dog.model.body(dog.model.geom_bodyid[geom]).name == body]
    return [(mujoco.mjtGeom(dog.model.geom_type[geom]).name[7:], dog.touches[geom]) for geom in shapes]


def test_what_is_seen_of_a_users_robot(tmp_path):
    """A look beside its file, else a URDF's visuals and what touches nothing in an MJCF, else all it has."""
    file = write_dog(tmp_path, **KINDS["urdf"])
    model = file.with_suffix(".urdf")
    visual = '<visual><geometry><box size="0.1 0.2 0.3"/></geometry></visual>'
    model.write_text(model.read_text().replace('<link name="FL_thigh">', f'<link name="FL_thigh">{visual}'))
    robot = get_robot(str(file))
    thigh, other, third = ((robot.geom_names.index(f"{leg}_thigh"),) for leg in ("FL", "FR", "HR"))
    dog = Skeleton(robot)
    assert seen_shapes(dog, "FL_thigh") == [("BOX", thigh)] and dog.model.geom("FL_thigh").type == [3]  # a capsule
    assert seen_shapes(dog, "FR_thigh") == [("CAPSULE", other)]
    file.with_suffix(".look.xml").write_text(LOOK.format("HR_thigh"))
    dog = Skeleton(robot)
    assert seen_shapes(dog, "HR_thigh") == [("BOX", third)]
    shape, color = dog.shape(next(geom for geom, columns in dog.touches.items() if columns == third))
    assert color.tolist() == [1.0, 0.0, 0.0] and shape.extents.tolist() == pytest.approx([0.2, 0.4, 0.6])
    file = with_mesh(tmp_path / "more", "mjcf")
    model = file.with_suffix(".xml")
    cover = '<geom type="mesh" mesh="trunk" contype="0" conaffinity="0"/><geom name="trunk" size="0.1"'
    model.write_text(model.read_text().replace('<geom name="trunk" type="mesh" mesh="trunk"', cover, 1))
    assert seen_shapes(Skeleton(get_robot(str(file))), "trunk") == [("MESH", (0,))]


def test_a_look_of_no_body_of_the_robot_is_named(tmp_path):
    file = write_dog(tmp_path, **KINDS["mjcf"])
    for text, reason in ((LOOK.format("tail"), "tail"), ("<mujoco><worldbody>", "XML")):
        file.with_suffix(".look.xml").write_text(text)
        with pytest.raises(ValueError, match=rf"dog\.look\.xml.*{reason}"):
            Skeleton(get_robot(str(file)))


SHAPES = {  # sizes as MuJoCo has them, and what that is along x, y and z after the turn [m]
    "sphere": (".2", (0.4, 0.4, 0.4)),
    "capsule": (".1 .3", (0.2, 0.8, 0.2)),
    "ellipsoid": (".1 .2 .3", (0.4, 0.6, 0.2)),
    "cylinder": (".1 .3", (0.2, 0.6, 0.2)),
    "box": (".1 .2 .3", (0.4, 0.6, 0.2)),
}


@pytest.mark.parametrize("kind", SHAPES)
def test_a_shape_has_its_size_and_stands_where_it_should(tmp_path, kind):
    file = write_dog(tmp_path, **KINDS["mjcf"])
    sizes, extents = SHAPES[kind]
    shape = f'type="{kind}" size="{sizes}" pos=".3 -.2 .1" quat=".5 .5 -.5 .5"'  # turns y to x, z to y, x to z
    file.with_suffix(".look.xml").write_text(LOOK.format("trunk").replace('type="box" size=".1 .2 .3"', shape))
    dog = Skeleton(get_robot(str(file)))
    (geom,) = (geom for geom in dog.touches if dog.model.geom_bodyid[geom] == 1)
    mesh = dog.shape(geom)[0]
    np.testing.assert_allclose(mesh.extents, extents, rtol=0.03)  # a sphere has corners
    np.testing.assert_allclose(mesh.bounds.mean(axis=0), [0.3, -0.2, 0.1], atol=1e-6)
    assert mesh.volume > 0.0  # faces look outward


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
    strips, tolerance = hull_probes(np.asarray(vertices, dtype=np.float64).tobytes())
    centres, radii = spheres(strips)
    assert tolerance <= max_tolerance * (1 + 1e-6) and len(radii) <= MAX_MESH_PROBES
    assert tolerance == pytest.approx(max_tolerance) or name == "base"
    hull = ConvexHull(vertices)
    faces = trimesh.convex.convex_hull(vertices).sample(6000, seed=1)
    edges = hull.points[hull.simplices[:, [0, 1, 2, 0]]]
    gap = uncovered(np.vstack([faces, np.linspace(edges[:, :3], edges[:, 1:], 9).reshape(-1, 3)]), strips)
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


def test_a_mesh_is_scaled_collides_as_its_hull_and_needs_a_volume():
    hollow = SimpleNamespace(vertices=np.vstack([CORNERS, CORNERS / 2]))
    strips = shape_strips(newton.GeoType.MESH, np.array([0.2, 0.1, 0.05]), hollow)
    expected = hull_probes((CORNERS * [0.2, 0.1, 0.05]).tobytes())[0]
    np.testing.assert_array_equal(spheres(strips)[0], spheres(expected)[0])
    with pytest.raises(ValueError, match="volume"):
        hull_probes((CORNERS * [1.0, 1.0, 0.0]).tobytes())


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
