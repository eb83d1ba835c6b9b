"""State in mujoco_warp's data, against float64 formulas, with joints and bodies in another order."""

import numpy as np
import pytest
import warp as wp

from kernels.coordinates import Delay, SolverState, from_solver, poses_from_solver, to_solver
from sim.mujoco_c.model import to_mujoco
from tests.kernels.states import filled, random_states

ENVS = 5
COM = (0.03, -0.02, 0.1)
COLUMNS, FOLLOWED, BODIES = (9, 7, 8), (8, -1, 7, 9), (2, 1)


@pytest.fixture
def solver():
    """The data of five robots with three joints, four actuators and two bodies, all of it -5."""
    return filled(
        SolverState,
        **{name: np.full((ENVS, width), -5.0) for name, width in (("qpos", 10), ("qvel", 9), ("ctrl", 4))},
        xpos=np.zeros((ENVS, 3, 3)),
        xquat=np.zeros((ENVS, 3, 4)),
        column_of_joint=COLUMNS,
        target_of_actuator=FOLLOWED,
        column_of_body=BODIES,
        base_com=COM,
    )


@pytest.fixture
def written(solver):
    q, qd = random_states(ENVS, 3)
    targets = q + np.float32(1.0)
    to_solver(*(wp.array(rows, dtype=float) for rows in (q, qd, targets)), Delay(), solver)
    return q, qd, targets


def test_coordinates_and_velocities_are_those_of_mujoco(solver, written):
    q, qd, _ = written
    expected = to_mujoco(q, qd, np.float64(COM))
    order = np.argsort(COLUMNS)
    np.testing.assert_array_equal(solver.qpos.numpy()[:, :7], np.float32(expected.qpos[:, :7]))
    np.testing.assert_array_equal(solver.qpos.numpy()[:, 7:], q[:, 7:][:, order])
    np.testing.assert_allclose(solver.qvel.numpy()[:, :6], expected.qvel[:, :6], atol=3e-6)
    np.testing.assert_array_equal(solver.qvel.numpy()[:, 6:], qd[:, 6:][:, order])
    assert np.abs(expected.qvel[:, :3] - qd[:, :3]).max() > 0.05  # else the mass centre would not count


def test_actuators_without_a_target_keep_their_control(solver, written):
    expected = np.where(np.array(FOLLOWED) < 0, -5.0, written[2][:, np.array(FOLLOWED)])
    np.testing.assert_array_equal(solver.ctrl.numpy(), np.float32(expected))


def test_state_is_read_back(solver, written):
    q, qd, _ = written
    now = wp.zeros(q.shape, dtype=float), wp.zeros(qd.shape, dtype=float)
    from_solver(solver, *now)
    np.testing.assert_array_equal(now[0].numpy(), q)
    np.testing.assert_allclose(now[1].numpy(), qd, atol=3e-6)


def test_poses_are_those_of_the_bodies_with_quaternions_turned_round(solver):
    rng = np.random.default_rng(1)
    positions, rotations = rng.normal(size=(ENVS, 3, 3)), rng.normal(size=(ENVS, 3, 4))
    solver.xpos.assign(np.float32(positions))
    solver.xquat.assign(np.float32(rotations))
    poses = wp.zeros((ENVS, 2), dtype=wp.transform)
    poses_from_solver(solver, poses)
    expected = np.concatenate([positions, rotations[..., [1, 2, 3, 0]]], axis=-1)[:, list(BODIES)]
    np.testing.assert_array_equal(poses.numpy(), np.float32(expected))
