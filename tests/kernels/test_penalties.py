"""Raw penalties: float64 oracle, hand-computed steps, contracts."""

import numpy as np
import pytest
import warp as wp

from kernels.penalties import BASE, FOOT, LIMB, PENALTIES, add_penalties, penalty_columns
from kernels.state import RobotStep
from sim.mujoco_c.model import step_penalties, to_mujoco
from tests.kernels.states import filled, random_states, upright

ROLES = [BASE, LIMB, LIMB, FOOT, FOOT]
BASE_COM = (0.05, -0.02, 0.1)
LIMIT = 500.0
DT = 0.005


def sums_after(states, command, forces, *, counted=None, sums=None):
    """Penalty sums after adding a physics step."""
    num_envs = len(command)
    step = filled(
        RobotStep, joint_q=states[0], joint_qd=states[1], base_com=BASE_COM, command=np.float32(command),
        geom_force=np.float32(forces), geom_role=ROLES, force_limit=LIMIT,
    )  # fmt: skip
    out = wp.array(np.zeros((num_envs, len(PENALTIES)), np.float32) if sums is None else sums)
    counted = wp.array(np.ones(num_envs, int) if counted is None else counted, dtype=int)
    add_penalties(step, DT, counted, out)
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
    columns = penalty_columns(["contact_force", "stumble", "collision"])
    np.testing.assert_allclose(sums[0, columns], [contact_force, stumble, collision], atol=1e-6)


def test_steps_that_do_not_count_add_nothing():
    states, forces = random_states(4, 3), random_forces(4, 5)
    before = np.random.default_rng(0).random((4, len(PENALTIES))).astype(np.float32)
    after = sums_after(states, np.zeros((4, 3)), forces, counted=[0, 1, 0, 1], sums=before)
    np.testing.assert_array_equal(after[[0, 2]], before[[0, 2]])
    velocities = penalty_columns(["yaw_rate", "vel_x", "vel_y"])
    assert (after[[1, 3]] > before[[1, 3]])[:, velocities].all()
