"""Raw penalties and contact forces: float64 oracle, hand-computed steps, contracts."""

import numpy as np
import pytest
import warp as wp

from kernels.penalties import BASE, FOOT, LIMB, SolverContacts, add_penalties, sum_geom_forces
from sim.mujoco_c.model import step_penalties, to_mujoco
from tests.kernels.states import filled, random_states, upright

ROLES = [BASE, LIMB, LIMB, FOOT, FOOT]
BASE_COM = (0.05, -0.02, 0.1)
LIMIT = 500.0
DT = 0.005


def sums_after(states, command, forces, *, counted=None, sums=None):
    """Penalty sums after adding a physics step."""
    num_envs = len(command)
    out = wp.array(np.zeros((num_envs, 6), np.float32) if sums is None else sums)
    arrays = [wp.array(np.float32(array)) for array in (*states, command)]
    on_geoms, roles = wp.array(np.float32(forces), dtype=wp.vec3), wp.array(ROLES, dtype=int)
    counted = wp.array(np.ones(num_envs, int) if counted is None else counted, dtype=int)
    add_penalties(*arrays[:2], wp.vec3(*BASE_COM), arrays[2], on_geoms, roles, LIMIT, DT, counted, out)
    return out.numpy()


def random_forces(num_envs, num_geoms, seed=0):
    """Forces from none through 0.1 N touches to beyond the limit, some nearly horizontal."""
    rng = np.random.default_rng(seed)
    forces = rng.normal(size=(num_envs, num_geoms, 3)) * 10 ** rng.uniform(-2, 3, (num_envs, num_geoms, 1))
    forces[..., 2] *= rng.choice([1.0, 0.05], (num_envs, num_geoms))
    return np.float32(forces * rng.choice([0.0, 1.0], (num_envs, num_geoms, 1)))


def test_parity_with_the_oracle():
    states, forces = random_states(200, 3), random_forces(200, 5)
    command = np.float32(np.random.default_rng(1).uniform(-1, 1, (200, 3)))
    plain, feet = to_mujoco(*states, np.array(BASE_COM)), np.array(ROLES) == FOOT
    exact = (np.float64(command), np.float64(forces))
    expected = step_penalties(plain.qpos, plain.qvel, *exact, feet=feet, force_limit=LIMIT)
    np.testing.assert_allclose(sums_after(states, command, forces), DT * expected, rtol=1e-5, atol=1e-7)


@pytest.mark.parametrize(
    ("forces", "contact_force", "stumble", "collision"),
    [
        # Feet of 600 N and 500.5 N against a limit of 500: (100 + 0.5) * 0.005 = 0.5025. Norms, in any direction.
        ({3: (0, 0, 600), 4: (300.3, 0, 400.4)}, 0.5025, 0, 0),
        # Sideways 5.1 to 1: stumble, once for both feet. 5 to 1 exactly and below is none.
        ({3: (51, 0, 10), 4: (0, -51, -10)}, 0, 0.005, 0),
        ({3: (50, 0, 10), 4: (30, 39.9, 10)}, 0, 0, 0),
        # Base and one limb touch harder than 0.1 N, the other limb with 0.09 N: 2 * 0.005.
        ({0: (0, 0, 0.2), 1: (0.11, 0, 0), 2: (0, 0, 0.09)}, 0, 0, 0.01),
        # A foot never collides; base and limbs have no force limit and do not stumble.
        ({0: (900, 0, 0), 3: (0, 0, 400)}, 0, 0, 0.005),
        ({}, 0, 0, 0),
    ],
)
def test_contact_penalties_by_hand(forces, contact_force, stumble, collision):
    on_geoms = np.zeros((1, 5, 3))
    for geom, force in forces.items():
        on_geoms[0, geom] = force
    sums = sums_after(upright(1, 3), [[0, 0, 0]], on_geoms)
    np.testing.assert_allclose(sums[0, 3:], [contact_force, stumble, collision], atol=1e-6)


def test_steps_that_do_not_count_add_nothing():
    states, forces = random_states(4, 3), random_forces(4, 5)
    before = np.random.default_rng(0).random((4, 6)).astype(np.float32)
    after = sums_after(states, np.zeros((4, 3)), forces, counted=[0, 1, 0, 1], sums=before)
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    assert (after[[1, 3], :3] > before[[1, 3], :3]).all()


def test_wrong_number_of_columns_is_named():
    with pytest.raises(ValueError, match="sums_out"):
        sums_after(upright(2, 3), np.zeros((2, 3)), np.zeros((2, 5, 3)), sums=np.zeros((2, 5), np.float32))


def geom_forces(*, count, capacity, column_of_geom, num_geoms):
    """Two worlds; contact k is on geom k of world k % 2, with forces 10 k + (1, 2, 3) along its normal and tangents."""
    contacts = filled(
        SolverContacts,
        count=[count],
        capacity=capacity,
        world=[0, 1, 0, 1],
        geom=[[9, k] for k in range(4)],
        frame=np.float32([[[0, 1, 0], [0, 0, 1], [1, 0, 0]]] * 4),  # normal along world y, tangents along z and x
        # World 0 has contacts 0 and 2 in rows 0.. and 3..; world 1 contact 1 in rows 0.., and contact 3 is inactive.
        efc_address=[[0, 1, 2], [0, 1, 2], [3, 4, 5], [-1] * 3],
        efc_force=[[1, 2, 3, 21, 22, 23], [11, 12, 13, 0, 0, 0]],
    )
    out = wp.full((2, num_geoms), wp.vec3(7.0), dtype=wp.vec3)
    sum_geom_forces(contacts, wp.array(column_of_geom, dtype=int), out)
    return out.numpy()


def test_contact_forces_of_one_geom_add_up_and_others_are_left_out():
    # Contact 0: 1 N along y, 2 N along z, 3 N along x; contact 2 likewise 21, 22, 23; contact 1 11, 12, 13. Geoms 0 and
    # 2 share column 1, geom 1 has column 2.
    forces = geom_forces(count=4, capacity=4, column_of_geom=[1, 2, 1, 0] + [-1] * 6, num_geoms=3)
    expected = np.zeros((2, 3, 3))
    expected[0, 1], expected[1, 2] = (26, 22, 24), (13, 11, 12)
    np.testing.assert_allclose(forces, expected, atol=1e-6)


@pytest.mark.parametrize(("count", "capacity"), [(2, 4), (900, 2)])
def test_only_contacts_that_exist_are_read(count, capacity):
    # Contact 2 is stale in the first case, and beyond the capacity in the second, whose count ran on past it.
    forces = geom_forces(count=count, capacity=capacity, column_of_geom=[0, 1, 2, 3] + [-1] * 6, num_geoms=4)
    assert forces[0, 0, 1] == 1
    assert not forces[0, 2].any()
