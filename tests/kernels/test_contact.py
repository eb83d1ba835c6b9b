"""Terrain contact of sphere probes: nothing invented, nothing missed, and records as the solver reads them."""

import numpy as np
import pytest
import warp as wp

from kernels.contact import ContactBuffer, Layout, Probes, collide_strips
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrain import SPACING, crossing_terrain
from tests.kernels import oracle
from tests.kernels.states import filled, make_terrain

RADII = (0.0175, 0.03, 0.06, 0.1)
UNDECIDED = 1e-5  # a sphere this close to touching may go either way in float32
FIRST_SHAPE, GROUND_SHAPE = 5, 2


def make_probes(strips, spread=0.0):
    """Strips as (centres (n, 3), radius), each on a body and a shape of its own; how far from straight they are [m]."""
    centres, numbers = [np.reshape(row, (-1, 3)) for row, _ in strips], np.arange(len(strips))
    return filled(
        Probes, position=np.concatenate(centres), strip_start=np.cumsum([0, *map(len, centres)]),
        strip_radius=[radius for _, radius in strips], strip_spread=np.full(len(strips), spread),
        strip_body=numbers, strip_shape=numbers,
    )  # fmt: skip


def make_buffer(capacity):
    vectors = dict.fromkeys(("point0", "point1", "normal", "offset0", "offset1"), np.zeros((capacity, 3)))
    numbers = dict.fromkeys(("shape0", "shape1", "margin0", "margin1"), np.full(capacity, -1))
    return filled(ContactBuffer, count=[0], **vectors, **numbers)


def make_layout(shapes, first_shape):
    return filled(
        Layout, bodies_per_env=shapes, shapes_per_env=shapes, first_shape=first_shape, ground_shape=GROUND_SHAPE
    )


def collide(poses, terrain_of_env, grids, strips, capacity=None, spread=0.0):
    """Contact records as a dict of arrays, plus ``env``, ``strip`` and the world ``centre`` and ``distance``."""
    num_envs = len(terrain_of_env)
    layout = make_layout(len(strips), FIRST_SHAPE)
    buffer = make_buffer(capacity or 3 * num_envs * len(strips))
    poses = np.float32(poses).reshape(-1, 7)
    world, on = wp.array(poses, dtype=wp.transform), wp.array(terrain_of_env, dtype=int)
    collide_strips(world, on, make_terrain(grids), make_probes(strips, spread), layout, buffer)
    count = int(buffer.count.numpy()[0])
    records = {name: getattr(buffer, name).numpy()[:count] for name in ContactBuffer.vars if name != "count"}
    records["count"] = count
    records["env"], records["strip"] = np.divmod(records["shape1"] - FIRST_SHAPE, len(strips))
    records["rotation"] = np.array([oracle.rotation_matrix(poses[k, 3:]) for k in records["shape1"] - FIRST_SHAPE])
    origin = np.float64(poses)[records["shape1"] - FIRST_SHAPE, :3]
    records["centre"] = origin + np.einsum("nij,nj->ni", records["rotation"].reshape(-1, 3, 3), records["point1"])
    records["distance"] = ((records["centre"] - records["point0"]) * records["normal"]).sum(1)
    return records


def hard_terrain(kind):
    if kind == "genes":
        x, y = np.arange(321)[None, :] * SPACING, np.arange(161)[:, None] * SPACING
        return np.float32(oracle.mixture_height(SUPER_GAUSSIAN.hard_random(1, 3)[0], x, y))
    return crossing_terrain(kind, 9, 4)


def sphere_poses(rng, grid, count):
    """Spheres about the surface (half of them between the lowest and highest node near), also beyond the grid."""
    poses = np.zeros((count, len(RADII), 7))
    poses[..., :2] = rng.uniform([3.0, -0.2], [13.0, 8.2], (count, len(RADII), 2))
    poses[: count // 10, :, 0] = rng.uniform(-0.3, 16.3, (count // 10, len(RADII)))
    for pose in poses.reshape(-1, 7):
        near = oracle.triangles(grid, SPACING, pose[0], pose[1], max(RADII))[..., 2]
        ground = oracle.surface_height(grid, SPACING, pose[0], pose[1])
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
    assert records["count"] == 1
    np.testing.assert_allclose(records["point1"][0], sagging[1], atol=1e-6)
    assert collide(poses, [0], flat, [(np.array(sagging), 0.05)])["count"] == 0


def test_strips_report_first_deepest_and_last():
    grid = hard_terrain("boxes")
    centres, radius = np.linspace([0, 0, -0.2], [0, 0, 0.2], 9), 0.04
    poses = sphere_poses(np.random.default_rng(8), grid, 100)[:, :1]
    records = collide(poses, np.zeros(100, int), grid[None], [(centres, radius)])
    touched = 0
    for env, pose in enumerate(np.float64(poses[:, 0])):
        world = pose[:3] + centres @ oracle.rotation_matrix(pose[3:]).T
        distance = np.array([oracle.nearest_on_surface(grid, SPACING, p, radius + UNDECIDED)[0] for p in world])
        if (np.abs(distance - radius) < UNDECIDED).any() or (np.sort(distance)[:2] == -np.inf).any():
            continue  # too close to call, or so deep that the depth is another definition
        touching, reported = np.flatnonzero(distance < radius), records["point1"][records["env"] == env]
        chosen = {int(np.argmin(np.abs(centres - point).sum(1))) for point in reported}
        assert len(reported) == len(chosen)
        if len(touching):
            touched += 1
            deepest = np.flatnonzero(distance < distance.min() + 2e-5)  # several where they are as deep
            assert chosen in [{touching[0], touching[-1], probe} for probe in deepest]
        else:
            assert not chosen
    assert touched > 20


def test_records_are_what_the_solver_reads():
    rng = np.random.default_rng(9)
    grid = hard_terrain("genes")
    poses = sphere_poses(rng, grid, 100)
    records = collide(poses, np.zeros(100, int), grid[None], [(rng.normal(0, 0.02, 3), radius) for radius in RADII])
    assert records["count"] > 50
    radius = np.array(RADII)[records["strip"]]
    assert (records["shape0"] == GROUND_SHAPE).all()
    assert (records["margin0"] == 0).all()
    assert not records["offset0"].any()
    np.testing.assert_array_equal(records["margin1"], np.float32(radius))
    np.testing.assert_allclose(np.linalg.norm(records["normal"], axis=1), 1, atol=1e-5)
    # offset1, turned into the world, leads from the centre to the sphere's lowest point against the normal.
    offset_w = np.einsum("nij,nj->ni", records["rotation"], records["offset1"])
    np.testing.assert_allclose(offset_w, -records["normal"] * radius[:, None], atol=1e-6)
    for point in records["point0"][np.abs(records["distance"]) < radius]:
        assert abs(oracle.nearest_on_surface(grid, SPACING, point, 0.05)[0]) < 1e-5


def test_contacts_past_the_capacity_are_counted_but_not_written():
    poses = np.tile([5, 4, 0.05, 0, 0, 0, 1], (6, 1))
    records = collide(poses, np.zeros(6, int), np.zeros((1, 161, 321)), [(np.zeros(3), 0.1)], capacity=4)
    assert records["count"] == 6
    assert (records["shape1"] >= FIRST_SHAPE).sum() == 4


def test_a_state_that_is_not_finite_touches_nothing():
    strip, flat = [(np.zeros(3), 0.1)], np.zeros((1, 161, 321))
    assert collide(np.full((2, 7), np.nan), np.zeros(2, int), flat, strip)["count"] == 0
    with pytest.raises(ValueError, match="body_q"):
        collide(np.zeros((3, 7)), np.zeros(4, int), flat, strip)
