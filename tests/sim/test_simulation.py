"""The simulation as a machine: torques, steps, randomisation and errors."""

import newton
import numpy as np
import pytest
import warp as wp
from scipy.spatial.transform import Rotation

from sim.bank import TerrainBank
from sim.crossing import GROUND_FRICTION, SolverCfg
from sim.device import resolve_device
from sim.simulation import Simulation
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.sim.scenes import GAINS, Stepper, positions, put, standing, velocities


def flatten(sim):
    sim.bank.set_heights(np.zeros(sim.bank.heights.shape, np.float32))


def step(sim, count=1):
    with wp.ScopedDevice(sim.device):
        for _ in range(count):
            sim.physics_step()
        sim.read_geom_forces()


def test_torque_is_the_pd_law_and_clamped(eight, robot):
    # In the air, at rest, on ANYmal: 80 N m/rad * 0.5 rad = 40 N m; at 5 rad the 80 N m limit. Moving at 3 rad/s:
    # 40 - 2 * 3 = 34.
    flatten(eight)
    kp, kd, limit = map(np.array, GAINS[robot.name])
    q, qd = standing(robot, 8, z=3.0), np.zeros((8, 18))
    qd[2, 6:] = 3.0
    put(eight, q, qd)
    targets = q.copy()
    targets[0, 7:] += 0.5
    targets[1, 7:] -= 5.0
    targets[2, 7:] += 0.5
    eight.targets.assign(np.float32(targets))
    step(eight)
    torque = np.array(eight.joint_torque.numpy())
    np.testing.assert_allclose(torque[0, 6:], 0.5 * kp, rtol=1e-4)
    np.testing.assert_allclose(torque[1, 6:], -limit, rtol=1e-4)
    np.testing.assert_allclose(torque[2, 6:], 0.5 * kp - 3.0 * kd, rtol=1e-3)
    np.testing.assert_allclose(torque[3, 6:], 0, atol=1e-3)
    assert not torque[:, :6].any()  # nothing drives the base


def tell_newton(sim, contacts):
    """Writes the contacts that were found as Newton keeps them."""
    contacts.clear()  # so that it sees that they are others
    found = {name: getattr(sim.contacts, name).numpy() for name in ("shape", "point", "normal", "distance")}
    env, slot = np.nonzero(np.arange(sim.contacts.shape.shape[1]) < sim.contacts.count.numpy()[:, None])
    shape, point, normal, distance = (found[name][env, slot] for name in found)
    shapes = sim.model.shape_body.numpy()
    shape = int(np.flatnonzero(shapes >= 0)[0]) + env * len(sim.geom_of_shape) + shape
    poses = sim.body_q.numpy().reshape(-1, 7)[shapes[shape]]
    half = 0.5 * distance[:, None] * normal
    on_robot = Rotation.from_quat(poses[:, 3:]).inv().apply(point + half - poses[:, :3])
    zeros = np.zeros((len(env), 3))
    columns = {"shape0": np.full(len(env), np.flatnonzero(shapes < 0)[0]), "shape1": shape, "point0": point - half,
               "point1": on_robot, "normal": normal, "offset0": zeros, "offset1": zeros, "margin0": zeros[:, 0],
               "margin1": zeros[:, 0]}  # fmt: skip
    for name, values in columns.items():
        array = getattr(contacts, f"rigid_contact_{name}")
        whole = array.numpy().copy()
        whole[: len(env)] = values
        array.assign(whole)
    contacts.rigid_contact_count.fill_(len(env))


def test_a_step_is_newtons(eight, robot):
    # Ours is our own from the contacts' mixed properties on. Newton does it in its own way, by mujoco_warp.
    eight.bank.set_genes(SUPER_GAUSSIAN.hard_random(8, 3))
    put(eight, standing(robot, 8, z=robot.default_base_height + 0.4, x=7.0))
    contacts, touched = newton.Contacts(eight.contacts.shape.size, 0, device=eight.device), 0
    for _ in range(60):
        before = positions(eight), velocities(eight), np.array(eight.solver.mjw_data.qacc_warmstart.numpy())
        step(eight)
        ours = positions(eight), velocities(eight), np.array(eight.body_q.numpy())
        touched += int(eight.contacts.count.numpy().sum())
        eight.joint_q.assign(np.float32(before[0]))
        eight.joint_qd.assign(np.float32(before[1]))
        eight.solver.mjw_data.qacc_warmstart.assign(before[2])
        eight.refresh()
        np.testing.assert_allclose(ours[2], eight.body_q.numpy(), atol=3e-6)  # poses of the step's beginning
        tell_newton(eight, contacts)
        eight.solver.step(eight._state, eight._state, eight._control, contacts, robot.physics_dt)
        np.testing.assert_allclose(ours[0], positions(eight), atol=1e-5)
        np.testing.assert_allclose(ours[1], velocities(eight), atol=2e-3)
    assert touched > 100


def test_friction_and_mass_of_each_robot(anymal, device):
    # Three robots on the same ground: they weigh 47.13, 52.13 and 57.13 kg, and every contact has its robot's friction.
    bank = TerrainBank(1, device=device)
    friction, mass = np.array([0.5, 0.9, 1.25]), np.array([-5.0, 0.0, 5.0])
    sim = Simulation(anymal, bank, np.zeros(3, int), friction=friction, added_base_mass=mass)
    put(sim, standing(anymal, 3, z=0.6))
    stepper, forces = Stepper(sim), np.zeros((3, 3))
    stepper.run(4.0)
    stepper.run(0.4, lambda: np.add(forces, np.array(sim.geom_force.numpy()).sum(1) / 20, out=forces))
    np.testing.assert_allclose(forces[:, 2], (52.13 + mass) * 9.81, rtol=0.01)
    mixed = sim._dynamics.surfaces.friction.numpy()
    np.testing.assert_allclose(
        mixed[..., :2], np.broadcast_to(friction[:, None, None], mixed[..., :2].shape), rtol=1e-5
    )
    assert friction.min() > GROUND_FRICTION


def test_solver_options_arrive(anymal, device):
    bank = TerrainBank(1, device=device)
    sim = Simulation(anymal, bank, np.zeros(1, int), cfg=SolverCfg(iterations=7, ls_iterations=13))
    assert (sim.solver.mjw_model.opt.iterations, sim.solver.mjw_model.opt.ls_iterations) == (7, 13)


@pytest.mark.parametrize(
    ("terrains", "added_base_mass", "field"),
    [
        ([0, 2], None, "terrain_of_env"),
        ([0, 0], np.array([0.0, -60.0]), "added_base_mass"),  # more than the base has
    ],
)
def test_what_cannot_be_simulated_is_named(anymal, device, terrains, added_base_mass, field):
    with pytest.raises(ValueError, match=field):
        Simulation(anymal, TerrainBank(2, device=device), np.array(terrains), added_base_mass=added_base_mass)


def test_devices():
    expected, missing = ("cuda:0", "cuda:99") if wp.is_cuda_available() else ("cpu", "cuda")
    assert (resolve_device("cpu"), resolve_device(None)) == ("cpu", expected)
    for name in ("tpu", missing):
        with pytest.raises(ValueError, match=f"device .{name}"):
            resolve_device(name)
