"""The queue of episodes: each is run once, round the ring; then a randomised start, and nothing is remembered."""

import numpy as np
import pytest
import warp as wp

from kernels.episode import Outcome, make_episodes
from kernels.observation import Sensors
from kernels.queue import clear_rows, make_queue, make_ready, restart_episodes, turn_over
from kernels.rewards import Rewards, make_rewards
from kernels.state import RobotStep
from sim.crossing import CrossingCfg, make_start_ranges
from tests.kernels import oracle
from tests.kernels.states import filled, make_terrain, rough

SLOTS, REPLICAS = 3, 4
BASE_COM = (-0.02, 0.01, 0.03)


class Robots:
    """Robots without physics: what a test says of their episodes is what happened."""

    def __init__(self, num_envs):
        self.queue = make_queue(num_envs, SLOTS, REPLICAS, 1, rewarded=False, device=str(wp.get_device()))
        self.episodes = make_episodes(num_envs)
        self.queue.seed.assign(np.arange(7, 7 + SLOTS, dtype=np.uint32))
        self.sums, self.terrain = wp.zeros((num_envs, 1)), wp.zeros(num_envs, dtype=int)

    def turn(self):
        turn_over(self.episodes.outcome, Rewards(), self.episodes, self.sums, self.terrain, self.queue)
        running = self.queue.episode_of_env.numpy() >= 0
        self.episodes.outcome.assign(np.where(running, Outcome.RUNNING, Outcome.TIME_OUT).astype(np.int32))
        return self.queue.episode_of_env.numpy().copy()

    def end(self, envs):
        now = self.episodes.outcome.numpy().copy()
        now[envs] = Outcome.GOAL
        self.episodes.outcome.assign(now)


@pytest.mark.parametrize("num_envs", [1, 5, 12])
def test_every_episode_is_run_once(num_envs):
    robots, taken, starts, rng = Robots(num_envs), [], {}, np.random.default_rng(num_envs)
    make_ready(SLOTS * REPLICAS, robots.queue)
    for _ in range(200):
        rows = robots.turn()
        starts |= dict(zip(rows.tolist(), robots.episodes.rng.numpy().tolist(), strict=True))
        taken += rows[robots.queue.begins.numpy() != 0].tolist()
        running = np.flatnonzero(rows >= 0)
        if len(running) == 0:
            break
        robots.end(rng.choice(running, rng.integers(1, len(running) + 1), replace=False))
    assert sorted(taken) == list(range(12))
    assert len({starts[row] for row in taken}) == 12  # each start is drawn from another state
    assert robots.queue.num_ended.numpy().tolist() == [4, 4, 4]
    assert (robots.queue.outcome.numpy() == Outcome.GOAL).all()


def test_rows_are_taken_round_the_ring():
    robots = Robots(5)
    for lot in range(7):  # five at a time of twelve rows: 0-4, 5-9, 10-2, 3-7, ...
        make_ready(5, robots.queue)
        rows = robots.turn()
        assert sorted(rows) == sorted((5 * lot + k) % 12 for k in range(5))
        robots.end(range(5))
    robots.turn()
    # 35 episodes on 3 terrains of 4: rows 0 to 10 were run three times, row 11 twice.
    assert robots.queue.num_ended.numpy().tolist() == [12, 12, 11]
    # The numbers do not grow for ever: of 30 taken before the last five, two whole rounds of 12 are taken off.
    assert robots.queue.ready.numpy()[0] == 11


def start(grids, replicas, anymal, outcome=None, rewards=None):
    """Joint coordinates and velocities and the episodes after a restart; all have ended unless ``outcome`` is given."""
    num_envs, joints = len(grids) * replicas, anymal.num_joints
    widths = {"joint_q": 7 + joints, "joint_qd": 6 + joints, "action": joints}
    step = filled(RobotStep, base_com=BASE_COM, **{n: np.full((num_envs, width), 3.0) for n, width in widths.items()})
    state = make_episodes(num_envs)
    state.steps.fill_(77)
    ended = np.full(num_envs, 1) if outcome is None else np.int32(outcome) != Outcome.RUNNING
    mask = wp.array(ended, dtype=int)
    terrain_of_env = wp.array(np.repeat(np.arange(len(grids)), replicas), dtype=int)
    sensors = filled(Sensors, default_joint_pos=anymal.default_joint_pos)
    ranges = make_start_ranges(CrossingCfg(), anymal)
    state.rng.assign(np.random.default_rng(0).integers(2**32, size=num_envs, dtype=np.uint32))
    terrain = make_terrain(grids)
    restart_episodes(mask, terrain_of_env, terrain, ranges, sensors, step, state, rewards or Rewards())
    q, qd, action = (getattr(step, name).numpy() for name in widths)
    assert (action == np.where(q[:, :1] == 3.0, 3.0, 0.0)).all()
    return q, qd, state


def test_running_episodes_are_left_alone(anymal):
    rewards = make_rewards(3, 12, 2)
    for array in (rewards.running, rewards.total, rewards.air_time, rewards.touched, rewards.terms):
        array.fill_(5)
    outcome = [Outcome.TILT, Outcome.RUNNING, Outcome.TIME_OUT]
    q, qd, state = start(np.zeros((1, 161, 321)), 3, anymal, outcome=outcome, rewards=rewards)
    assert (q[1] == 3.0).all() and (qd[1] == 3.0).all()
    assert (q[[0, 2], 0] != 3.0).all() and not qd[[0, 2], 6:].any()
    assert state.steps.numpy().tolist() == [0, 77, 0]
    assert rewards.running.numpy().tolist() == [1, 5, 1]
    for array in (rewards.total, rewards.air_time, rewards.touched):
        values = array.numpy().reshape(3, -1)
        assert (values[1] == 5).all() and (values[[0, 2]] == 0).all()
    assert (rewards.terms.numpy() == 5).all()  # sums over episodes


def test_starts_fill_their_ranges(anymal):
    q, qd, state = start(np.zeros((1, 161, 321)), 800, anymal)
    default = np.array(anymal.default_joint_pos)
    moving = default != 0
    com_arm = np.array([oracle.rotation_matrix(row[3:7]) @ BASE_COM for row in q])
    origin_velocity = qd[:, :3] - np.cross(qd[:, 3:6], com_arm)
    columns = {  # drawn quantity, middle, half width (definitions: a crossing)
        "x": (q[:, :1], 2, 0.1),
        "y": (q[:, 1:2], 4, 0.1),
        "yaw": (np.array([np.arctan2(*oracle.rotation_matrix(row[3:7])[[1, 0], :1]) for row in q]), 0, 0.2),
        "joints": (q[:, 7:][:, moving] / default[moving], 1, 0.2),
        "velocity": (origin_velocity, 0, 0.2),
        "angular velocity": (qd[:, 3:6], 0, 0.2),
    }
    for name, (drawn, middle, half) in columns.items():
        off = (drawn - middle) / half
        assert np.abs(off).max() < 1 + 1e-4, name
        assert off.max(axis=0).min() > 0.97, name  # 800 draws all below 0.97: chance 5e-6
        assert off.min(axis=0).max() < -0.97, name
        # The mean of 800 uniform draws is 0 +- 0.02; the draws of one column tell nothing of the next.
        assert np.abs(off.mean(axis=0)).max() < 0.1, name
    drawn = np.column_stack([values for values, _, _ in columns.values()])
    assert np.abs(np.corrcoef(drawn.T) - np.eye(drawn.shape[1])).max() < 0.2
    assert not q[:, 7:][:, ~moving].any()
    assert not qd[:, 6:].any()
    np.testing.assert_allclose(np.linalg.norm(q[:, 3:7], axis=1), 1, atol=1e-6)
    np.testing.assert_allclose(q[:, 2], anymal.default_base_height, atol=1e-6)
    assert (state.outcome.numpy() == Outcome.RUNNING).all()
    assert not state.steps.numpy().any()
    np.testing.assert_array_equal(state.start.numpy(), q[:, :2])


def test_the_start_stands_on_the_highest_ground_under_the_robot(anymal):
    grids = np.stack([rough(161, 321, 0.3, seed=k) for k in range(2)])
    q, _, _ = start(grids, 8, anymal)
    for env, row in enumerate(np.float64(q)):
        half = np.array(anymal.footprint)
        low, high = np.floor((row[:2] - half) / 0.05).astype(int), np.ceil((row[:2] + half) / 0.05).astype(int)
        ground = grids[env // 8, low[1] : high[1] + 1, low[0] : high[0] + 1].max()
        assert row[2] == pytest.approx(ground + anymal.default_base_height, abs=1e-6)


@pytest.mark.parametrize("columns", [2, 64, 1801])
def test_masked_rows_are_cleared_whole(columns):
    rows = wp.array(np.full((3, columns), np.nan, np.float32))
    clear_rows(wp.array([1, 0, 7], dtype=int), rows)
    assert not rows.numpy()[[0, 2]].any() and np.isnan(rows.numpy()[1]).all()
