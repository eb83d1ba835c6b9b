"""Robots dropped in any orientation onto every kind of ground.

On a GPU: ``FAULTLINE_DEVICE=cuda:0 FAULTLINE_DROPS=4096 pytest tests/sim/robots/test_drops.py -s``.
"""

import dataclasses
import os

import numpy as np
import pytest
import warp as wp

from kernels.contact import Probes
from kernels.heightfield import Terrain, nearest_surface_point
from sim.bank import TerrainBank
from sim.crossing import CrossingCfg, make_task
from sim.simulation import Simulation
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrain import CROSSING_TYPES, crossing_terrain
from tests.sim.scenes import positions, put, velocities

NUM_DROPS = int(os.environ.get("FAULTLINE_DROPS", "256"))
CLEARANCE = 0.3
SETTLE_S = 4.0
REACH = 0.3


@wp.struct
class Extremes:
    """What a world went through, shape (num_envs,) each; contacts of all worlds together, shape (1,)."""

    rows: wp.array[int]
    overflow: wp.array[int]
    contacts: wp.array[int]
    not_finite: wp.array[int]


@wp.kernel
def _note_extremes_kernel(
    rows: wp.array[int],
    overflow: wp.array[int],
    contact_count: wp.array[int],
    joint_q: wp.array2d[float],
    joint_qd: wp.array2d[float],
    extremes: Extremes,
):
    env = wp.tid()
    extremes.rows[env] = wp.max(extremes.rows[env], rows[env])
    extremes.overflow[env] = extremes.overflow[env] | overflow[env]
    wp.atomic_max(extremes.contacts, 0, contact_count[0])
    for k in range(joint_qd.shape[1]):
        if not (wp.isfinite(joint_q[env, k]) and wp.isfinite(joint_qd[env, k])):
            extremes.not_finite[env] = 1


@wp.kernel
def _measure_gaps_kernel(
    body_q: wp.array[wp.transform],
    bodies_per_env: int,
    terrain_of_env: wp.array[int],
    terrain: Terrain,
    probes: Probes,
    reach: float,
    gap_out: wp.array[float],
    height_out: wp.array[float],
):
    """Smallest gap between the surface and any probe (negative: inside), and the height of the lowest point."""
    env, strip = wp.tid()
    pose = body_q[env * bodies_per_env + probes.strip_body[strip]]
    for k in range(probes.strip_start[strip], probes.strip_start[strip + 1]):
        centre = wp.transform_point(pose, probes.position[k])
        nearest = nearest_surface_point(terrain, terrain_of_env[env], centre, reach)
        wp.atomic_min(gap_out, env, nearest.distance - probes.strip_radius[strip])
        wp.atomic_min(height_out, env, centre[2] - probes.strip_radius[strip])


def measure_gaps(sim):
    """Smallest gap [m] and height of the lowest point [m] of each robot."""
    out = [wp.full(sim.num_envs, 1e6, dtype=float, device=sim.device) for _ in range(2)]
    wp.launch(
        _measure_gaps_kernel,
        dim=(sim.num_envs, sim.probes.strip_radius.shape[0]),
        inputs=[sim._state.body_q, sim.layout.bodies_per_env, sim.terrain_of_env, sim.bank.terrain, sim.probes, REACH],
        outputs=out,
        device=sim.device,
    )
    return [np.array(array.numpy(), dtype=np.float64) for array in out]


def mixed_ground(num, device):
    """Hard-random gene terrains and every hand-crafted kind at its hardest, in turn."""
    bank = TerrainBank(4, device=device)
    bank.set_genes(SUPER_GAUSSIAN.hard_random(4, 21))
    crossings = [crossing_terrain(kind, 9, 22) for kind in CROSSING_TYPES]
    grids = np.concatenate([np.array(bank.heights.numpy()), np.stack(crossings)])
    return grids, np.arange(num) % len(grids)


def above_ground(sim, robot, rng):
    """Default poses in random orientations, the lowest point 0.3 m over the highest ground around."""
    num = sim.num_envs
    q = np.zeros((num, 7 + robot.num_joints))
    q[:, :2] = rng.uniform([4.5, 1.5], [11.5, 6.5], (num, 2))
    quaternion = rng.normal(size=(num, 4))
    q[:, 3:7] = quaternion / np.linalg.norm(quaternion, axis=1, keepdims=True)
    q[:, 7:] = robot.default_joint_pos
    put(sim, q)
    _, lowest = measure_gaps(sim)
    grids, terrain = sim.bank.heights.numpy(), sim.terrain_of_env.numpy()
    for env, (x, y) in enumerate(q[:, :2]):
        row, col = round(y / 0.05), round(x / 0.05)
        ground = grids[terrain[env], max(row - 16, 0) : row + 17, max(col - 16, 0) : col + 17].max()
        q[env, 2] = ground + CLEARANCE - lowest[env]
    return q


@pytest.fixture(scope="module")
def dropped(robot, device):
    """The simulation after all have fallen and come to rest, and what they went through."""
    grids, terrain_of_env = mixed_ground(NUM_DROPS, device)
    bank = TerrainBank(len(grids), device=device)
    bank.set_heights(grids)
    sim = Simulation(robot, bank, terrain_of_env)
    put(sim, above_ground(sim, robot, np.random.default_rng(23)))
    extremes = Extremes()
    for name in ("rows", "overflow", "not_finite"):
        setattr(extremes, name, wp.zeros(NUM_DROPS, dtype=int, device=device))
    extremes.contacts = wp.zeros(1, dtype=int, device=device)

    def launch():
        for _ in range(4):
            sim.physics_step()
            inputs = [sim.solver.mjw_data.nefc, sim.overflow, sim.contact_count, sim.joint_q, sim.joint_qd, extremes]
            wp.launch(_note_extremes_kernel, dim=NUM_DROPS, inputs=inputs, device=device)

    graph = sim.capture(launch)
    for _ in range(round(SETTLE_S / robot.control_dt)):
        sim.launch(graph)
    return sim, extremes


@pytest.mark.slow
def test_nothing_overflows(dropped, robot, capsys):
    sim, extremes = dropped
    rows, contacts = extremes.rows.numpy(), int(extremes.contacts.numpy()[0])
    report = (
        f"\n{NUM_DROPS} drops of {robot.name}: at most {rows.max()} constraint rows a world (njmax {robot.njmax}), "
        f"{contacts / NUM_DROPS:.1f} contacts a world on average at most (nconmax {robot.nconmax})"
    )
    with capsys.disabled():
        print(report)
    capacity = make_task(CrossingCfg(), robot).overflow_mask
    assert not (extremes.overflow.numpy() & capacity).any()
    assert rows.max() <= robot.njmax
    assert contacts <= sim.contact_capacity


def test_fallen_robots_lie_on_the_surface(dropped, robot):
    sim, _ = dropped
    gap, _ = measure_gaps(sim)
    inside = np.abs(positions(sim)[:, :2] - [8, 4]) < [8, 4]
    settled = np.abs(velocities(sim)[:, :6]).max(axis=1) < 0.5
    # On the sphere of its pelvis Cassie rolls on where the ground leans, and on its way takes off now and then.
    assert settled.mean() > {"anymal": 0.9, "cassie": 0.3}[robot.name]
    assert inside.all(axis=1).mean() > 0.9
    # No probe is deeper than 2 cm, and something touches.
    assert gap.min() > -0.02
    assert gap[settled].max() < 0.02


def test_too_few_constraint_rows_are_noticed(anymal, device):
    # The overflow bits are what episodes are judged by: with room for 12 rows a lying robot must set one.
    bank = TerrainBank(1, device=device)
    sim = Simulation(dataclasses.replace(anymal, njmax=12), bank, np.zeros(4, int))
    q = np.zeros((4, 19))
    q[:, :3], q[:, 6], q[:, 7:] = (8, 4, 0.3), 1, anymal.default_joint_pos
    put(sim, q)
    with wp.ScopedDevice(device):
        sim.physics_step()
    assert (sim.overflow.numpy() & make_task(CrossingCfg(), anymal).overflow_mask).all()
