"""The nearest point of the surface, and terrain contact of sphere probes: nothing invented, nothing missed."""

import numpy as np
import pytest
import warp as wp

import kernels.contact
from kernels.contact import Contacts, Poses, Probes, collide_strips, make_contacts, sum_forces
from kernels.ground import FIRM, PATCHES, Ground, make_ground
from kernels.heightfield import SurfacePoint, Terrain, ceiling_over, nearest_surface_point
from sim.mujoco_c.model import surface_heights
from sim.terrains.bank import make_heights
from sim.terrains.hand_crafted import SPACING, crossing_terrain
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.kernels import oracle
from tests.kernels.states import filled, make_terrain, rough

RADII = (0.0175, 0.03, 0.06, 0.1)
UNDECIDED = 1e-5  # a sphere this close to touching may go either way in float32
UNTOUCHED = -7


def make_probes(strips, spread=0.0, bundled=False):
    """Strips as (centres (n, 3), radius), each a shape of its own; how far from straight they are [m].

    Each is on a body of its own, or all are a bundle on the first one.
    """
    centres, numbers = [np.reshape(row, (-1, 3)) for row, _ in strips], np.arange(len(strips))
    bundles = [list(zip(centres, [radius for _, radius in strips], strict=True))]
    bundles = bundles if bundled else [[strip] for strip in bundles[0]]
    balls = []
    for bundle in bundles:
        middle = np.concatenate([row for row, _ in bundle]).mean(axis=0)
        reach = max(np.linalg.norm(row - middle, axis=1).max() + radius for row, radius in bundle)
        balls.append([*middle, reach + 1e-6])
    return filled(
        Probes, position=np.concatenate(centres), strip_start=np.cumsum([0, *map(len, centres)]),
        strip_radius=[radius for _, radius in strips], strip_spread=np.full(len(strips), spread), strip_shape=numbers,
        bundle_start=np.cumsum([0, *map(len, bundles)]), bundle_body=numbers[: len(bundles)], bundle_ball=balls,
    )  # fmt: skip


def collide(poses, terrain_of_env, grids, strips, spread=0.0, ground=None, bundled=False, parked=0, room=None):
    """Contacts of all robots as a dict of arrays, with ``env``, the probe's ``centre`` in its body, and ``touched``.

    The latter is on the ground. ``count`` is by robot; ``buffer`` has all.
    """
    poses = np.float32(poses).reshape(-1, len(strips), 7)
    buffer = make_contacts(len(poses), room or 3 * len(strips))
    buffer.count.fill_(5)  # of another step
    buffer.shape.fill_(UNTOUCHED)
    # In the solver's arrays the world comes first, bodies in the opposite order, and w first in quaternions.
    columns, wxyz = np.arange(len(strips), 0, -1), poses[..., [6, 3, 4, 5]]
    xpos, xquat = np.full((len(poses), 1 + len(strips), 3), np.nan), np.full((len(poses), 1 + len(strips), 4), np.nan)
    xpos[:, columns], xquat[:, columns] = poses[..., :3], wxyz
    world, on = filled(Poses, xpos=xpos, xquat=xquat, column_of_body=columns), wp.array(terrain_of_env, dtype=int)
    parked, probes = wp.array(np.full(len(poses), parked), dtype=int), make_probes(strips, spread, bundled)
    collide_strips(world, on, make_terrain(grids), probes, ground or Ground(), parked, buffer)
    count = buffer.count.numpy()
    env, slot = np.nonzero(np.arange(buffer.shape.shape[1]) < count[:, None])
    names = [name for name in Contacts.vars if name not in ("count", "force")]
    records = {name: getattr(buffer, name).numpy()[env, slot] for name in names}
    pose, half = np.float64(poses)[env, records["shape"]], 0.5 * records["distance"][:, None]
    radius = np.array([radius for _, radius in strips])[records["shape"]][:, None]
    # The point lies half way between the surfaces.
    centre = records["point"] + (half + radius) * records["normal"]
    records["centre"] = np.einsum("nji,nj->ni", oracle.rotation_matrix(pose[:, 3:]), centre - pose[:, :3])
    records["touched"] = records["point"] - half * records["normal"]
    return records | {"count": count, "env": env, "buffer": buffer}


BOXES, [BUMPS] = crossing_terrain("boxes", 9, 4), make_heights(SUPER_GAUSSIAN.hard_random(1, 3))


def sphere_poses(rng, grid, count):
    """Spheres about the surface (half of them between the lowest and highest node near), also beyond the grid."""
    poses = np.zeros((count, len(RADII), 7))
    poses[..., :2] = rng.uniform([3.0, -0.2], [13.0, 8.2], (count, len(RADII), 2))
    poses[: count // 10, :, 0] = rng.uniform(-0.3, 16.3, (count // 10, len(RADII)))
    for pose in poses.reshape(-1, 7):
        near = oracle.triangles(grid, SPACING, pose[0], pose[1], max(RADII))[..., 2]
        ground = surface_heights(grid, pose[0], pose[1])
        low, high = (near.min(), near.max()) if rng.random() < 0.5 else (ground, ground)
        pose[2] = rng.uniform(low - 0.05, high + 0.12)
    quaternion = rng.normal(size=(count, len(RADII), 4))
    poses[..., 3:] = quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True)
    return np.float32(poses)


def test_a_row_that_sags_is_looked_at_where_it_touches():
    # The ends of the row stand 0.5 m over the ground, its middle in it: only the spread says so.
    sagging = [[-0.3, 0, 0.5], [0, 0.2, 0.02], [0.3, 0, 0.5]]
    poses = np.float32([[8, 4, 0, 0, 0, 0, 1]])
    flat = np.zeros((1, 161, 321), np.float32)
    records = collide(poses, [0], flat, [(np.array(sagging), 0.05)], spread=0.52)
    assert records["count"].tolist() == [1]
    np.testing.assert_allclose(records["centre"][0], sagging[1], atol=1e-6)
    assert not collide(poses, [0], flat, [(np.array(sagging), 0.05)])["count"].any()


def test_how_many_threads_share_a_strip_changes_no_bit(device, monkeypatch):
    if device == "cpu":
        pytest.skip("a CPU has one thread for each")
    poses, row = sphere_poses(np.random.default_rng(8), BOXES, 100)[:, :1], np.linspace([0, 0, -0.2], [0, 0, 0.2], 9)
    found = []
    for most in (kernels.contact._MAX_THREADS, 0):  # 16 threads, and one
        monkeypatch.setattr(kernels.contact, "_MAX_THREADS", most)
        records = collide(poses, np.zeros(100, int), BOXES[None], [(row, 0.04)])
        order = np.lexsort((records["rank"], records["env"]))
        found.append({name: records[name][order] for name in ("env", "rank", "point", "normal", "distance")})
    assert len(found[0]["env"]) > 40
    for name, values in found[0].items():
        np.testing.assert_array_equal(values, found[1][name], err_msg=name)


def test_strips_report_first_deepest_and_last():
    grid = BOXES
    centres, radius = np.linspace([0, 0, -0.2], [0, 0, 0.2], 9), 0.04
    poses = sphere_poses(np.random.default_rng(8), grid, 100)[:, :1]
    records = collide(poses, np.zeros(100, int), grid[None], [(centres, radius)])
    touched = 0
    for env, pose in enumerate(np.float64(poses[:, 0])):
        world = pose[:3] + centres @ oracle.rotation_matrix(pose[3:]).T
        distance = np.array([oracle.nearest_on_surface(grid, SPACING, p, radius + UNDECIDED)[0] for p in world])
        if (np.abs(distance - radius) < UNDECIDED).any() or (np.sort(distance)[:2] == -np.inf).any():
            continue  # too close to call, or so deep that the depth is another definition
        touching, reported = np.flatnonzero(distance < radius), records["centre"][records["env"] == env]
        chosen = {int(np.argmin(np.abs(centres - point).sum(1))) for point in reported}
        assert len(reported) == len(chosen)
        if len(touching):
            touched += 1
            deepest = np.flatnonzero(distance < distance.min() + 2e-5)  # several where they are as deep
            assert chosen in [{touching[0], touching[-1], probe} for probe in deepest]
        else:
            assert not chosen
    assert touched > 20


def test_a_bundle_of_strips_touches_what_each_does_alone():
    grid, rng = BUMPS, np.random.default_rng(10)
    strips = [(rng.uniform(-0.3, 0.3, 3) + np.linspace([0, 0, -0.1], [0, 0, 0.1], 5), radius) for radius in RADII]
    poses, found = np.repeat(sphere_poses(rng, grid, 200)[:, :1], len(RADII), axis=1), []
    poses[..., 2] += np.float32(rng.uniform(0.0, 0.6, (200, 1)))
    for bundled in (False, True):
        records = collide(poses, np.zeros(200, int), grid[None], strips, bundled=bundled)
        columns = [records["env"], records["shape"], records["distance"], *records["point"].T, *records["normal"].T]
        found.append(np.array(sorted(np.stack(columns, axis=1).tolist())))
    assert len(found[0]) > 100 and (records["count"] == 0).sum() > 20
    np.testing.assert_array_equal(*found)


def test_contacts_are_what_the_solver_reads():
    rng = np.random.default_rng(9)
    grid = BUMPS
    poses = sphere_poses(rng, grid, 100)
    strips = [(rng.normal(0, 0.02, 3), radius) for radius in RADII]
    records = collide(poses, np.zeros(100, int), grid[None], strips)
    assert records["count"].sum() > 50
    np.testing.assert_allclose(np.linalg.norm(records["normal"], axis=1), 1, atol=1e-5)
    # The sphere's lowest point against the normal and the surface below it are as far apart as the distance says, with
    # the point in their middle: only then it is the probe's centre from which a radius and half of it lead there.
    centres, radius = np.array([centre for centre, _ in strips]), np.array(RADII)[records["shape"]]
    np.testing.assert_allclose(records["centre"], centres[records["shape"]], atol=3e-6)
    assert (records["distance"] < 0).all()
    for touched in records["touched"][np.abs(records["distance"] + radius) < radius]:
        assert abs(oracle.nearest_on_surface(grid, SPACING, touched, 0.05)[0]) < 1e-5
    assert (records["friction"] == 1).all() and (records["time_constant"] == FIRM).all()


def test_each_contact_has_the_ground_under_its_point():
    # Of two robots of two spheres the first stands on terrain 1. Patches are terrain, row, column; beyond the edge the
    # ground goes on.
    patches = [(1, 0, 1), (1, 1, 1), (0, 3, 7), (0, 3, 0)]
    points = [(3.02, 1.0), (3.06, 2.5), (15.92, 7.9), (-2.0, 9.0)]
    ground = make_ground(2, str(wp.get_device()))
    rng = np.random.default_rng(0)
    friction, tau = rng.uniform(0.15, 1, (2, *PATCHES)), rng.uniform(0.02, 0.06, (2, *PATCHES))
    tau[patches[0]] = FIRM
    ground.friction.assign(np.float32(friction))
    ground.time_constant.assign(np.float32(tau))
    poses = [[x, y, 0.05, 0, 0, 0, 1] for x, y in points]
    records = collide(poses, [1, 0], np.zeros((2, 161, 321)), [(np.zeros(3), 0.1)] * 2, ground=ground)
    order = np.argsort(2 * records["env"] + records["shape"])
    np.testing.assert_allclose(records["friction"][order], [friction[patch] for patch in patches], rtol=1e-6)
    np.testing.assert_allclose(records["time_constant"][order], [tau[patch] for patch in patches], rtol=1e-6)


def test_contacts_past_the_capacity_are_counted_but_not_written():
    # Robot 0 touches with three shapes, robot 1 with one, and has room for two.
    poses = np.tile([5, 4, 0.05, 0, 0, 0, 1], (2, 3, 1))
    poses[1, 1:, 2] = 1.0
    records = collide(poses, [0, 0], np.zeros((1, 161, 321)), [(np.zeros(3), 0.1)] * 3, room=2)
    first, second = records["buffer"].shape.numpy()
    assert records["count"].tolist() == [3, 1] and second.tolist() == [0, UNTOUCHED]
    assert len(set(first)) == 2 and (first >= 0).all()


def test_a_state_that_is_not_finite_touches_nothing_nor_does_a_parked_robot():
    strip, flat = [(np.zeros(3), 0.1)], np.zeros((1, 161, 321))
    low = np.tile([5, 4, 0.05, 0, 0, 0, 1], (2, 1))
    for parked in range(3):
        assert collide(low, np.zeros(2, int), flat, strip, parked=parked)["count"].tolist() == [int(parked < 2)] * 2
    assert not collide(np.full((2, 7), np.nan), np.zeros(2, int), flat, strip)["count"].any()


@pytest.mark.parametrize(
    ("count", "column_of_shape", "expected"),
    [
        # Shapes 0 and 2 share column 1, shape 1 has column 2, shape 3 has none.
        ([2, 2], [1, 2, 1, -1], {(0, 1): (22, 24, 26), (1, 2): (11, 12, 13)}),
        # Contacts 1, 2 and 3 are stale; then robot 0's count runs on past the capacity.
        ([1, 0], [0, 1, 2, 3], {(0, 0): (1, 2, 3)}),
        ([900, 0], [0, 1, 2, 3], {(0, 0): (1, 2, 3), (0, 2): (21, 22, 23)}),
    ],
)
def test_contact_forces_of_one_geom_add_up_and_others_are_left_out(count, column_of_shape, expected):
    # Two robots with room for two contacts; contact k is on shape k of robot k % 2, with 10 k + (1, 2, 3) N.
    force = [[(1, 2, 3), (21, 22, 23)], [(11, 12, 13), (31, 32, 33)]]
    contacts = filled(Contacts, count=count, rank=[[4, 1], [2, 3]], shape=[[0, 2], [1, 3]], force=np.float32(force))
    out = wp.full((2, 4), wp.vec3(7.0), dtype=wp.vec3)
    sum_forces(contacts, wp.array(column_of_shape, dtype=int), out)
    forces = out.numpy()
    assert {index: tuple(forces[index]) for index in map(tuple, np.argwhere(forces.any(axis=2)))} == expected


def test_contact_forces_add_up_in_one_order_wherever_they_lie():
    # Each row has the same twelve contacts, of two shapes, in another order; numbers of which sums round differently.
    rng = np.random.default_rng(3)
    force, shape = np.float32(rng.normal(size=(12, 3)) * 10.0 ** rng.uniform(-4, 4, (12, 1))), rng.integers(2, size=12)
    order = np.array([np.arange(12), *(rng.permutation(12) for _ in range(20))])
    contacts = filled(Contacts, count=np.full(21, 12), rank=3 * order, shape=shape[order], force=force[order])
    out = wp.zeros((21, 2), dtype=wp.vec3)
    sum_forces(contacts, wp.array([0, 1], dtype=int), out)
    for column, forces in enumerate(np.moveaxis(out.numpy(), 1, 0)):
        np.testing.assert_array_equal(forces, np.broadcast_to(forces[0], forces.shape))
        np.testing.assert_allclose(forces[0], force[shape == column].sum(axis=0), rtol=1e-4)
    rows = force[shape == 0]
    assert len({np.add.reduce(rng.permutation(rows)).tobytes() for _ in range(20)}) > 1  # else order did not matter


@wp.kernel
def _sample_kernel(terrain: Terrain, points: wp.array[wp.vec3], reach: float, nearest_out: wp.array[SurfacePoint]):
    k = wp.tid()
    nearest_out[k] = nearest_surface_point(terrain, 0, points[k], reach)


@wp.kernel
def _ceiling_kernel(terrain: Terrain, lower: wp.array[wp.vec2], upper: wp.array[wp.vec2], out: wp.array[float]):
    k = wp.tid()
    out[k] = ceiling_over(terrain, 0, lower[k], upper[k])


@pytest.mark.parametrize("reach", [0.03, 0.1])
def test_nearest_point(reach):
    # Points over and up to 0.3 m beyond the grid, none closer than 1e-3 cells to an edge where the normal jumps.
    grid, near = rough(33, 49), 0
    points = np.float32(np.random.default_rng(5).uniform([-0.3, -0.3, -0.4], [2.7, 1.9, 0.4], (1600, 3)))
    fraction = (points[:, :2] / SPACING) % 1
    edges = np.column_stack([fraction, 1 - fraction, np.abs(1 - fraction.sum(1))])
    points = points[(edges > 1e-3).all(1)][:400]
    out = wp.zeros(400, dtype=SurfacePoint)
    wp.launch(_sample_kernel, 400, [make_terrain(grid[None]), wp.array(points, dtype=wp.vec3), reach, out])
    nearest = out.numpy()
    for p, got, normal in zip(np.float64(points), nearest["distance"], np.float64(nearest["normal"]), strict=True):
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
            about = p[:2] + 1e-5 * np.array([[-1, 0], [1, 0], [0, -1], [0, 1]])
            west, east, south, north = surface_heights(grid, *about.T)
            plane = np.array([west - east, south - north, 2e-5])
            plane /= np.linalg.norm(plane)
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
