"""Single free bodies on terrain: edges hold them."""

import numpy as np

from sim.terrain import SPACING
from tests.kernels import oracle
from tests.sim.scenes import NODE_X, Stepper, free_body, lying, positions, put, simulate


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
