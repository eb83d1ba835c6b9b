"""State and contacts in mujoco_warp's data, against float64 formulas, with joints and bodies in another order."""

import numpy as np
import pytest
import warp as wp

from kernels.contact import Contacts, Surfaces
from kernels.coordinates import (
    Delay,
    SolverContacts,
    SolverState,
    contacts_to_solver,
    forces_from_solver,
    from_solver,
    poses_from_solver,
    to_solver,
)
from kernels.ground import FIRM
from sim.mujoco_c.model import to_mujoco
from tests.kernels.states import filled, random_states

ENVS = 5
COM = (0.03, -0.02, 0.1)
TOO_MANY, GROUND = 8, 9
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


@pytest.fixture
def contacts():
    """Of two robots with room for two contacts: one and, of three, two."""
    return filled(
        Contacts, count=[1, 3], shape=[[1, 0], [0, 1]], friction=[[0.5, 9], [1, 0.25]],
        point=np.float32([[[1, 2, 3], [0, 0, 0]], [[4, 5, 6], [7, 8, 9]]]), distance=[[-0.01, 9], [-0.02, -0.03]],
        normal=np.float32([[[0, 0, 1], [0, 0, 0]], [[0, 0.8, 0.6], [0.6, 0, 0.8]]]),
        time_constant=[[0.03, 9], [FIRM, 0.015]], force=np.zeros((2, 2, 3)),
    )  # fmt: skip


@pytest.fixture
def stock():
    """Room for four contacts in two worlds, the rows of which have the forces 1, 2, ... and 11, 12, ..."""
    return filled(
        SolverContacts, count=[4], worldid=[-1] * 4, geom=[[-1, -1]] * 4, dist=[0] * 4, pos=np.zeros((4, 3)),
        frame=np.zeros((4, 3, 3)), dim=[0] * 4, friction=np.zeros((4, 5)), solref=np.zeros((4, 2)),
        solimp=np.zeros((4, 5)), efc_address=np.zeros((4, 4)), efc_force=np.add.outer([0, 10], np.arange(1, 7)),
        overflow=[5, 5], too_many=TOO_MANY, ground=GROUND, slot=[[-1, -1]] * 2,
    )  # fmt: skip


def test_contacts_have_the_friction_and_softness_of_their_ground(contacts, stock):
    # Shape 0 has stiffness and damping, on firm ground too; 0.02 s is not exceeded by 0.015 s: softer ground counts.
    surfaces = filled(
        Surfaces, geom=[4, 7], body=[1, 2], condim=[3, 4], friction=[[[0.8, 0.8, 0.1, 0.2, 0.2]] * 2],
        solref=[[[-500, -30], [0.02, 1.5]]], solimp=[[[0.7, 0.9, 0.1, 0.5, 2.0]] * 2],
    )  # fmt: skip
    contacts_to_solver(contacts, surfaces, stock)
    found = {name: getattr(stock, name).numpy() for name in SolverContacts.vars if name not in ("too_many", "ground")}
    slots = found["slot"][[0, 1, 1], [0, 0, 1]]
    assert found["count"][0] == 3 and sorted(slots) == [0, 1, 2]
    assert found["overflow"].tolist() == [0, TOO_MANY]
    expected = {
        "worldid": [0, 1, 1], "geom": [[GROUND, 7], [GROUND, 4], [GROUND, 7]], "dist": [-0.01, -0.02, -0.03],
        "pos": [[1, 2, 3], [4, 5, 6], [7, 8, 9]], "dim": [4, 3, 4], "efc_address": [[-1] * 4] * 3,
        "friction": [[factor * 0.8, factor * 0.8, 0.1, 0.2, 0.2] for factor in (0.5, 1, 0.25)],
        "solref": [[0.03, 1.0], [-500, -30], [0.02, 1.5]],
        "solimp": [[0.9, 0.9, 0.1, 0.5, 2.0]] + [[0.7, 0.9, 0.1, 0.5, 2.0]] * 2,
    }  # fmt: skip
    for name, values in expected.items():
        np.testing.assert_allclose(found[name][slots], np.float32(values), rtol=1e-6, err_msg=name)
    frame = found["frame"][slots]
    np.testing.assert_array_equal(frame[:, 0], contacts.normal.numpy()[[0, 1, 1], [0, 0, 1]])
    np.testing.assert_allclose(frame @ frame.transpose(0, 2, 1), [np.eye(3)] * 3, atol=1e-6)
    np.testing.assert_allclose(np.linalg.det(frame), 1.0, rtol=1e-6)


def test_forces_of_contacts_are_put_together_from_their_rows(contacts, stock):
    # Normal along world y, tangents along z and x. The first robot's has rows 3 to 5; of the other's, one has row 1
    # without friction, and one is not active.
    contacts.force.fill_(wp.vec3(7.0))
    stock.slot.assign(np.int32([[2, -1], [0, 1]]))
    stock.frame.assign(np.float32([[[0, 1, 0], [0, 0, 1], [1, 0, 0]]] * 4))
    stock.dim.assign(np.int32([1, 3, 4, 0]))
    stock.efc_address.assign(np.int32([[1, -1, -1, -1], [-1] * 4, [2, 3, 4, 5], [0] * 4]))
    forces_from_solver(stock, contacts)
    np.testing.assert_array_equal(contacts.force.numpy()[0], [[5, 3, 4], [7, 7, 7]])
    np.testing.assert_array_equal(contacts.force.numpy()[1], [[0, 12, 0], [0, 0, 0]])
