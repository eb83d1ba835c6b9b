"""The observation row and the action, against a float64 oracle and by hand."""

import numpy as np
import pytest
import warp as wp

from kernels.observation import Noise, Sensors, apply_action, write_observation
from kernels.state import RobotStep
from sim.mujoco_c.model import observations, to_mujoco
from tests.kernels.states import filled, make_terrain, random_states, rough, upright

BASE_COM = (-0.02, 0.01, 0.03)


def make_sensors(num_joints, scan):
    x, y = np.reshape(scan, (-1, 2)).T
    default = np.linspace(-0.5, 0.5, num_joints)
    return filled(Sensors, default_joint_pos=default, scan_x=x, scan_y=y)


def observe(states, command, last_action, terrain_of_env, grids, scan):
    num_envs, num_joints = np.shape(last_action)
    out = wp.zeros((num_envs, 12 + 3 * num_joints + len(scan)), dtype=float)
    names = ("joint_q", "joint_qd", "command", "action")
    state = {name: np.float32(array) for name, array in zip(names, (*states, command, last_action), strict=True)}
    on, seed = wp.array(terrain_of_env, dtype=int), wp.array([0], dtype=int)
    step, sensors = filled(RobotStep, base_com=BASE_COM, **state), make_sensors(num_joints, scan)
    write_observation(step, on, make_terrain(grids), sensors, Noise(), seed, out)
    return out.numpy()


def random_case(num_envs, num_joints, num_scan, num_terrains=2, seed=0):
    rng = np.random.default_rng(seed)
    grids = np.stack([rough(161, 321, 0.3, seed=k) for k in range(num_terrains)])
    scan = rng.uniform(-0.8, 0.8, (num_scan, 2)).astype(np.float32)
    command, action = rng.uniform(-1, 1, (num_envs, 3)), rng.normal(size=(num_envs, num_joints))
    terrain_of_env = rng.integers(0, num_terrains, num_envs)
    states = random_states(num_envs, num_joints, seed)
    return states, np.float32(command), np.float32(action), terrain_of_env, grids, scan


@pytest.mark.parametrize(("num_envs", "num_joints", "num_scan"), [(40, 12, 187), (7, 0, 0)])
def test_parity_with_the_oracle(num_envs, num_joints, num_scan):
    states, command, action, terrain_of_env, grids, scan = random_case(num_envs, num_joints, num_scan)
    got = observe(states, command, action, terrain_of_env, grids, scan)
    default = np.float64(np.float32(np.linspace(-0.5, 0.5, num_joints)))
    plain = to_mujoco(*states, np.array(BASE_COM))
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


def act(action, num_joints=2, scale=0.5):
    action = np.float32(action)
    last = wp.zeros((len(action), num_joints), dtype=float)
    targets = wp.full((len(action), 7 + num_joints), 9.0, dtype=float)
    apply_action(wp.array(action), make_sensors(num_joints, []), scale, last, targets)
    return last.numpy(), targets.numpy()


def test_action_by_hand():
    # Default pose (-0.5, 0.5), half a radian per unit; actions are clipped at 100, and what is not finite is no limit.
    last, targets = act([[0.2, -1], [300, -300], [np.nan, np.inf]])
    np.testing.assert_array_equal(last, np.float32([[0.2, -1], [100, -100], [np.nan, np.nan]]))
    np.testing.assert_allclose(targets[:, 7:], [[-0.4, 0], [49.5, -49.5], [np.nan, np.nan]], atol=1e-6)
    assert (targets[:, :7] == 9).all()  # the base's columns are not targets
