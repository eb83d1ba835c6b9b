"""Observation, action, and the state in mujoco_warp's data, against float64 formulas and by hand."""

import numpy as np
import pytest
import warp as wp

from kernels.coordinates import Delay, SolverState, from_solver, to_solver
from kernels.observation import Sensors, apply_action, write_observation
from kernels.state import RobotStep
from sim.mujoco_c.model import Starts, observations
from tests.kernels.states import filled, make_terrain, random_states, rough, upright

BASE_COM = (-0.02, 0.01, 0.03)


def make_sensors(num_joints, scan):
    x, y = np.reshape(scan, (-1, 2)).T
    return filled(Sensors, default_joint_pos=np.linspace(-0.5, 0.5, num_joints), scan_x=x, scan_y=y)


def observe(states, command, last_action, terrain_of_env, grids, scan):
    num_envs, num_joints = np.shape(last_action)
    out = wp.zeros((num_envs, 12 + 3 * num_joints + len(scan)), dtype=float)
    names = ("joint_q", "joint_qd", "command", "action")
    state = {name: np.float32(array) for name, array in zip(names, (*states, command, last_action), strict=True)}
    on, seed = wp.array(terrain_of_env, dtype=int), wp.array([0], dtype=int)
    step, sensors = filled(RobotStep, base_com=BASE_COM, **state), make_sensors(num_joints, scan)
    write_observation(step, on, make_terrain(grids), sensors, None, None, seed, out)
    return out.numpy()


@pytest.mark.parametrize(("num_envs", "num_joints", "num_scan"), [(40, 12, 187), (7, 0, 0)])
def test_parity_with_the_oracle(num_envs, num_joints, num_scan):
    rng = np.random.default_rng(0)
    grids = np.stack([rough(161, 321, 0.3, seed=k) for k in range(2)])
    states, scan = random_states(num_envs, num_joints), np.float32(rng.uniform(-0.8, 0.8, (num_scan, 2)))
    command, action = np.float32(rng.uniform(-1, 1, (num_envs, 3))), np.float32(rng.normal(size=(num_envs, num_joints)))
    terrain_of_env = rng.integers(0, 2, num_envs)
    got = observe(states, command, action, terrain_of_env, grids, scan)
    default = np.float64(np.float32(np.linspace(-0.5, 0.5, num_joints)))
    plain = Starts.of_newton(*states, np.array(BASE_COM))
    for env in range(num_envs):
        one = (array[env : env + 1] for array in (plain.qpos, plain.qvel, command, action))
        grid = np.float64(grids[terrain_of_env[env]])
        [expected] = observations(grid, *one, default_joint_pos=default, scan=scan)
        split = len(expected) - num_scan
        np.testing.assert_allclose(got[env, :split], expected[:split], atol=1e-5)
        # A scan point is off by 1e-6 m in float32 where cells are as steep as 12 to 1, times 5.
        np.testing.assert_allclose(got[env, split:], expected[split:], atol=3e-4)


def test_the_scan_is_clipped_at_a_metre_and_a_wild_state_gives_a_bounded_row():
    # 0.5 m below the base is the zero: a base at 3 m sees (3 - 0.5) -> 1 m, times 5; one at -2 m sees -1 m.
    q, qd = upright(3, 1)
    q[:, 2], qd[2] = [3.0, -2.0, 1.2], 1e6
    rows = observe((q, qd), np.zeros((3, 3)), np.zeros((3, 1)), [0, 0, 0], np.zeros((1, 9, 9)), [(0, 0)])
    np.testing.assert_allclose(rows[:, -1], [5.0, -5.0, 3.5], atol=1e-5)
    assert np.abs(rows[2]).max() == 100


def test_action_by_hand():
    # Default pose (-0.5, 0.5), half a radian per unit; actions are clipped at 100, and what is not finite is no limit.
    action, last = wp.array(np.float32([[0.2, -1], [300, -300], [np.nan, np.inf]])), wp.zeros((3, 2), dtype=float)
    columns = wp.full((3, 9), 9.0, dtype=float)
    apply_action(action, make_sensors(2, []), 0.5, last, columns)
    targets = columns.numpy()
    np.testing.assert_array_equal(last.numpy(), np.float32([[0.2, -1], [100, -100], [np.nan, np.nan]]))
    np.testing.assert_allclose(targets[:, 7:], [[-0.4, 0], [49.5, -49.5], [np.nan, np.nan]], atol=1e-6)
    assert (targets[:, :7] == 9).all()  # the base's columns are not targets


# In mujoco_warp's data joints are in another order.
ENVS = 5
COLUMNS, FOLLOWED = (9, 7, 8), (8, -1, 7, 9)


@pytest.fixture
def solver():
    """The data of five robots with three joints and four actuators, all of it -5."""
    return filled(
        SolverState,
        **{name: np.full((ENVS, width), -5.0) for name, width in (("qpos", 10), ("qvel", 9), ("ctrl", 4))},
        **{"base_com": BASE_COM, "column_of_joint": COLUMNS, "target_of_actuator": FOLLOWED},
    )


@pytest.fixture
def written(solver):
    q, qd = random_states(ENVS, 3)
    targets = q + np.float32(1.0)
    to_solver(*(wp.array(rows, dtype=float) for rows in (q, qd, targets)), Delay(), solver)
    return q, qd, targets


def test_coordinates_and_velocities_are_those_of_mujoco(solver, written):
    q, qd, _ = written
    expected = Starts.of_newton(q, qd, np.float64(BASE_COM))
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
