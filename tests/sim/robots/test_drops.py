"""Robots dropped in any orientation onto every kind of ground."""

import numpy as np
from scipy.spatial.transform import Rotation

from sim.bank import heights_of
from sim.crossing import CAPACITY_OVERFLOWS
from sim.robots.model import build_robot
from sim.robots.probes import extents
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrain import CROSSING_TYPES, SPACING, crossing_terrain
from tests.kernels import oracle
from tests.sim.scenes import Stepper, positions, put, simulate, velocities

DROPS = 40


def above_ground(robot, grids, rng):
    """Default poses in random orientations, too high to touch the highest ground around."""
    q = np.zeros((len(grids), 7 + robot.num_joints))
    q[:, :2] = rng.uniform([4.5, 1.5], [11.5, 6.5], (len(q), 2))
    q[:, 3:7] = Rotation.random(len(q), rng).as_quat()
    q[:, 7:] = robot.default_joint_pos
    ((_, reach),) = extents(build_robot(robot), [robot.default_joint_pos])
    for row, grid in zip(q, grids, strict=True):
        i, j = round(row[1] / SPACING), round(row[0] / SPACING)
        row[2] = grid[max(i - 16, 0) : i + 17, max(j - 16, 0) : j + 17].max() + reach
    return q


def gaps(sim, grids):
    """Smallest gap between the surface and any probe of each robot (negative: inside) [m]."""
    probes, poses = sim.probes, sim.body_q.numpy().reshape(sim.num_envs, -1, 7)
    counts = np.diff(probes.strip_start.numpy())
    body, radii = (np.repeat(getattr(probes, f"strip_{name}").numpy(), counts) for name in ("body", "radius"))
    gap = np.full(sim.num_envs, np.inf)
    for env, (pose, grid) in enumerate(zip(poses[:, body], grids, strict=True)):
        centres = pose[..., :3] + Rotation.from_quat(pose[..., 3:]).apply(probes.position.numpy())
        for centre, radius in zip(centres, radii, strict=True):
            gap[env] = min(gap[env], oracle.nearest_on_surface(grid, SPACING, centre, radius + 0.05)[0] - radius)
    return gap


def test_fallen_robots_lie_on_the_surface_and_nothing_overflows(robot, device):
    # Hard-random gene terrains and every hand-crafted kind at its hardest.
    hand_crafted = [crossing_terrain(kind, 9, 22) for kind in CROSSING_TYPES]
    grids = np.concatenate([heights_of(SUPER_GAUSSIAN.hard_random(4, 21)), hand_crafted])
    grids = grids[np.arange(DROPS) % len(grids)]
    sim = simulate(robot, grids, device)
    put(sim, above_ground(robot, grids, np.random.default_rng(23)))

    def watch():
        assert not (sim.overflow.numpy() & CAPACITY_OVERFLOWS).any()
        assert sim.solver.mjw_data.nefc.numpy().max() <= robot.njmax
        assert sim.contact_count.numpy()[0] <= sim.contact_capacity
        assert np.isfinite(velocities(sim)).all()

    Stepper(sim).run(4.0, watch)
    sim.refresh()
    settled = np.abs(velocities(sim)[:, :6]).max(axis=1) < 0.5
    # On the sphere of its pelvis Cassie rolls on where the ground leans, and on its way takes off now and then.
    assert settled.mean() > {"anymal": 0.85, "cassie": 0.25}[robot.name]
    assert (np.abs(positions(sim)[:, :2] - [8, 4]) < [8, 4]).all(axis=1).mean() > 0.85
    # No probe is deeper than 2 cm, and something touches.
    gap = gaps(sim, grids)
    assert gap.min() > -0.02
    assert gap[settled].max() < 0.02
