"""The simulation as a machine: torques, steps, randomisation and errors."""

import gc
from functools import partial
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

from sim.crossing import GROUND_FRICTION, SolverCfg
from sim.device import resolve_device
from sim.simulation import Simulation
from sim.terrains.bank import TerrainBank
from tests.sim.scenes import GAINS, Stepper, put, standing


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
    mixed = sim.dynamics.surfaces.friction.numpy()
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


def test_no_garbage_is_collected_while_a_graph_is_recorded_and_a_spoilt_one_is_recorded_again(device):
    # Python collects garbage at any time, and freeing what holds memory of the GPU can spoil a recording.
    collects = []

    def launch(spoilt=(), error=RuntimeError):
        collects.append(gc.isenabled())
        if len(collects) in spoilt:
            raise error("CUDA graph capture failed.")

    sim = SimpleNamespace(device=device)
    Simulation.capture(sim, partial(launch, [2]))
    assert collects == [False] * 3 and gc.isenabled()
    for spoilt, error in (([5, 6], RuntimeError), ([8], ValueError)):
        with pytest.raises(error, match="capture failed"):
            Simulation.capture(sim, partial(launch, spoilt, error))
        assert gc.isenabled()
    assert len(collects) == 8
