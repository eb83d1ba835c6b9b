"""Single free bodies on terrain: edges hold them, friction is what the file says."""

import numpy as np
import pytest

from sim.terrain import SPACING
from tests.kernels import oracle
from tests.sim.scenes import NODE_X, Stepper, free_body, lying, positions, put, simulate, slope, velocities

GRAVITY = 9.81


def test_a_foot_at_3_m_per_s_does_not_pass_through_a_step_edge(device, tmp_path):
    # A riser of 0.2 m in the cell from x = 8 to x = 8.05, hit from all sides, at and round its upper edge and its face.
    radius, speed, height = 0.03, 3.0, 0.2
    grid = np.broadcast_to(np.where(NODE_X > 8.02, height, 0.0), (161, 321))
    approach = np.radians([-90, -75, -60, -45, -30, -15, 0, 15])  # downward (-90) to forward and slightly up
    target = np.array([[8.05, 0.2], [8.045, 0.19], [8.03, 0.12], [8.01, 0.05], [8.07, 0.2]])
    aim, angle = np.repeat(target, len(approach), axis=0), np.tile(approach, len(target))
    direction = np.column_stack([np.cos(angle), np.zeros(len(angle)), np.sin(angle)])
    sim = simulate(free_body(tmp_path, f'type="sphere" size="{radius}"', mass=0.588), [grid] * len(aim), device)
    q, qd = lying(len(aim), 0, 4, 0), np.zeros((len(aim), 6))
    rng = np.random.default_rng(0)
    start = rng.uniform(0.1, 0.115, len(aim))[:, None]  # a step is 0.015 m: every phase of touching is met
    q[:, [0, 2]] = aim - start * direction[:, [0, 2]]
    qd[:, :3] = speed * direction
    outside = np.array([oracle.nearest_on_surface(grid, SPACING, row[:3], 0.3)[0] > radius for row in q])
    assert outside.sum() > 30
    put(sim, q, qd)
    deepest = np.full(len(aim), np.inf)

    def watch():
        for env in np.flatnonzero(outside):
            centre = positions(sim)[env, :3]
            deepest[env] = min(deepest[env], oracle.nearest_on_surface(grid, SPACING, centre, 0.1)[0])

    Stepper(sim, 1).run(0.1, watch)
    assert (deepest[outside] < radius).all(), "some never touched"
    assert (deepest[outside] > 0).all(), f"centre inside the ground: {deepest[outside].min()}"


@pytest.mark.parametrize("heading", [0.0, 0.25, 0.5], ids=["along x", "diagonally", "along y"])
def test_friction_holds_at_08_and_slides_at_12_of_its_angle(device, tmp_path, heading):
    # Whatever the direction: a friction pyramid would give way at 0.75 of the angle across its axes.
    friction = 0.5
    angles = np.arctan(friction) * np.array([0.8, 0.9, 1.2, 1.3])
    rise = np.array([np.cos(np.pi * heading), np.sin(np.pi * heading)])  # the ground rises this way
    grids = [slope(*np.arctan(np.tan(a) * rise)) for a in angles]
    block = free_body(tmp_path, 'type="box" size="0.05 0.05 0.03"', mass=2.0, friction=friction)
    sim = simulate(block, grids, device)
    q = np.concatenate([lying(1, 8, 4, 0, (rise[1], -rise[0], 0), a) for a in angles])
    up = np.array([oracle.rotation_matrix(row[3:7])[:, 2] for row in q])
    q[:, :3] += 0.03 * up
    put(sim, q)
    stepper = Stepper(sim)
    stepper.run(0.2)
    before = positions(sim)
    speed = np.linalg.norm(velocities(sim)[:, :3], axis=1)
    stepper.run(1.0)
    moved = np.linalg.norm(positions(sim)[:, :3] - before[:, :3], axis=1)
    # Held: it creeps a little, as MuJoCo's soft friction does. Sliding: s = v t + g (sin a - mu cos a) t^2 / 2.
    assert (moved[:2] < 0.01).all(), moved
    expected = speed[2:] + GRAVITY * (np.sin(angles[2:]) - friction * np.cos(angles[2:])) / 2
    np.testing.assert_allclose(moved[2:], expected, rtol=0.08 if device.startswith("cuda") else 0.05)
    # Held blocks lie flat.
    tilted = np.array([oracle.rotation_matrix(row[3:7])[:, 2] for row in positions(sim)])
    np.testing.assert_allclose((tilted * up).sum(1)[:2], 1, atol=1e-4)
