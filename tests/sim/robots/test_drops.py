"""Robots dropped in any orientation onto every kind of ground, and a foot at speed onto an edge."""

import dataclasses

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from sim.crossing import CAPACITY_OVERFLOWS
from sim.robots.model import build_robot
from sim.robots.probes import measure_extents
from sim.terrains.bank import make_heights
from sim.terrains.hand_crafted import CROSSING_TYPES, SPACING, crossing_terrain
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.kernels import oracle
from tests.sim.scenes import FLAT, NODE_X, Stepper, free_body, lying, positions, put, simulate, standing, velocities

DROPS = 40


def above_ground(robot, grids, rng):
    """Default poses in random orientations, too high to touch the highest ground around."""
    q = np.zeros((len(grids), 7 + robot.num_joints))
    q[:, :2] = rng.uniform([4.5, 1.5], [11.5, 6.5], (len(q), 2))
    q[:, 3:7] = Rotation.random(len(q), rng).as_quat()
    q[:, 7:] = robot.default_joint_pos
    ((_, reach),) = measure_extents(build_robot(robot), [robot.default_joint_pos])
    for row, grid in zip(q, grids, strict=True):
        i, j = round(row[1] / SPACING), round(row[0] / SPACING)
        row[2] = grid[max(i - 16, 0) : i + 17, max(j - 16, 0) : j + 17].max() + reach
    return q


def gaps(sim, grids):
    """Smallest gap between the surface and any probe of each robot (negative: inside) [m]."""
    probes = sim.probes
    poses = sim.body_q.numpy()
    counts = np.diff(probes.strip_start.numpy())
    body = np.repeat(probes.bundle_body.numpy(), np.diff(probes.strip_start.numpy()[probes.bundle_start.numpy()]))
    radii = np.repeat(probes.strip_radius.numpy(), counts)
    gap = np.full(sim.num_envs, np.inf)
    for env, (pose, grid) in enumerate(zip(poses[:, body], grids, strict=True)):
        centres = pose[..., :3] + Rotation.from_quat(pose[..., 3:]).apply(probes.position.numpy())
        for centre, radius in zip(centres, radii, strict=True):
            gap[env] = min(gap[env], oracle.nearest_on_surface(grid, SPACING, centre, radius + 0.05)[0] - radius)
    return gap


def test_fallen_robots_lie_on_the_surface_and_nothing_overflows(robot, device):
    # Hard-random gene terrains and every hand-crafted kind at its hardest.
    hand_crafted = [crossing_terrain(kind, 9, 22) for kind in CROSSING_TYPES]
    grids = np.concatenate([make_heights(SUPER_GAUSSIAN.hard_random(4, 21)), hand_crafted])
    grids = grids[np.arange(DROPS) % len(grids)]
    sim = simulate(robot, grids, device)
    put(sim, above_ground(robot, grids, np.random.default_rng(23)))

    def watch():
        assert not (sim.overflow.numpy() & CAPACITY_OVERFLOWS).any()
        assert sim.contacts.count.numpy().max() <= robot.nconmax
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


def test_a_foot_at_3_m_per_s_does_not_pass_through_a_step_edge(device, tmp_path):
    # A riser of 0.2 m in the cell from x = 8 to x = 8.05, hit from all sides, at and round its upper edge and its face.
    radius = 0.03
    speed = 3.0
    height = 0.2
    grid = np.broadcast_to(np.where(NODE_X > 8.02, height, 0.0), (161, 321))
    approach = np.radians([-90, -75, -60, -45, -30, -15, 0, 15])  # downward (-90) to forward and slightly up
    target = np.array([[8.05, 0.2], [8.045, 0.19], [8.03, 0.12], [8.01, 0.05], [8.07, 0.2]])
    aim = np.repeat(target, len(approach), axis=0)
    angle = np.tile(approach, len(target))
    direction = np.column_stack([np.cos(angle), np.zeros(len(angle)), np.sin(angle)])
    sim = simulate(free_body(tmp_path, f'type="sphere" size="{radius}"', mass=0.588), [grid] * len(aim), device)
    q = lying(len(aim), 0, 4, 0)
    qd = np.zeros((len(aim), 6))
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


def test_a_robot_of_many_joints_rests_on_the_ground_by_mujoco_warps_step(tmp_path, device):
    # One joint follows another, which our step does not know; with more than 32 dofs theirs has a sparse Jacobian.
    robot = free_body(tmp_path, 'type="box" size="0.1 0.1 0.05"', mass=1.0)
    names = tuple(f"j{k}" for k in range(30))
    body = '<body name="{0}"><joint name="{0}" axis="0 0 1"/><geom size="0.01" mass="0.01"/></body>'
    text = robot.model_file.read_text().replace("</body>", f"{''.join(map(body.format, names))}</body>")
    follows = '<equality><joint joint1="j0" joint2="j1"/></equality></mujoco>'
    robot.model_file.write_text(text.replace("</mujoco>", follows))
    gains = dict.fromkeys(("stiffness", "damping"), (1.0,) * 30)
    robot = dataclasses.replace(robot, joint_names=names, default_joint_pos=(0.0,) * 30, **gains)
    sim = simulate(robot, [FLAT], device)
    put(sim, standing(robot, 1, z=0.06))
    Stepper(sim).run(0.5)
    assert positions(sim)[0, 2] == pytest.approx(0.05, abs=2e-3)
