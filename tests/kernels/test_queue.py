"""The queue of episodes: each is run once, and what came of it stands in a row of its own."""

import numpy as np
import pytest
import warp as wp

from kernels.episode import Outcome, make_episodes
from kernels.queue import make_queue, make_ready, turn_over
from kernels.rewards import Rewards, make_rewards

SLOTS, REPLICAS = 3, 4


class Robots:
    """Robots without physics: what a test says of their episodes is what happened."""

    def __init__(self, num_envs, *, rewarded=False):
        self.queue = make_queue(num_envs, SLOTS, REPLICAS, 2, rewarded=rewarded, device=str(wp.get_device()))
        self.queue.seed.assign(np.uint32([10, 11, 2**32 - 1]))
        self.episodes = make_episodes(num_envs)
        self.rewards = make_rewards(num_envs, 1, 1) if rewarded else Rewards()
        self.sums = wp.full((num_envs, 2), 7.0, dtype=float)
        self.terrain = wp.full(num_envs, 99, dtype=int)

    def turn(self):
        turn_over(self.episodes.outcome, self.rewards, self.episodes, self.sums, self.terrain, self.queue)
        running = self.queue.episode_of_env.numpy() >= 0
        self.episodes.outcome.assign(np.where(running, Outcome.RUNNING, Outcome.TIME_OUT).astype(np.int32))
        return self.queue.episode_of_env.numpy().copy()

    def end(self, envs, outcome=Outcome.GOAL):
        now = self.episodes.outcome.numpy().copy()
        now[envs] = outcome
        self.episodes.outcome.assign(now)


@pytest.mark.parametrize("num_envs", [1, 5, 12])
def test_every_episode_is_run_once(num_envs):
    robots, taken, rng = Robots(num_envs), [], np.random.default_rng(num_envs)
    make_ready(SLOTS * REPLICAS, robots.queue)
    for _ in range(200):
        rows = robots.turn()
        taken += rows[robots.queue.begins.numpy() != 0].tolist()
        running = np.flatnonzero(rows >= 0)
        if len(running) == 0:
            break
        robots.end(rng.choice(running, rng.integers(1, len(running) + 1), replace=False))
    assert sorted(taken) == list(range(12))
    assert robots.queue.num_ended.numpy().tolist() == [4, 4, 4]
    assert (robots.queue.outcome.numpy() == Outcome.GOAL).all()


def test_robots_that_find_nothing_wait_and_take_what_comes_later():
    robots = Robots(4)
    make_ready(2, robots.queue)
    rows = robots.turn()
    assert sorted(rows) == [-1, -1, 0, 1] and robots.queue.begins.numpy().sum() == 2
    for _ in range(3):  # they ask again and again
        assert (robots.turn() == rows).all() and not robots.queue.begins.numpy().any()
    make_ready(1, robots.queue)
    later = robots.turn()
    assert sorted(later) == [-1, 0, 1, 2]
    assert robots.queue.begins.numpy().tolist() == (later == 2).astype(int).tolist()


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
    assert robots.queue.counts.numpy()[1] == 11


def test_the_steps_of_robots_with_an_episode_are_counted():
    robots = Robots(4)
    make_ready(2, robots.queue)
    rows = robots.turn()  # no step yet
    assert not robots.queue.busy.numpy().any()
    for _ in range(3):
        robots.turn()
    assert robots.queue.busy.numpy().tolist() == np.where(rows >= 0, 3, 0).tolist()
    robots.end(np.flatnonzero(rows >= 0))
    robots.turn()  # the step in which an episode ended counts, one of waiting does not
    robots.turn()
    assert robots.queue.busy.numpy().tolist() == np.where(rows >= 0, 4, 0).tolist()


def test_what_came_of_an_episode_stands_in_its_row():
    robots = Robots(2, rewarded=True)
    make_ready(3, robots.queue)
    rows = robots.turn()
    assert (robots.sums.numpy() == 0.0).all()  # a new episode has cost nothing
    assert (robots.terrain.numpy() == rows // REPLICAS).all()
    first, second = np.argsort(rows)
    robots.sums.assign(np.float32([[1.5, 2.5], [3.5, 4.5]]))
    robots.episodes.steps.assign([30, 40])
    robots.rewards.total.assign(np.float32([0.25, 0.5]))
    pose = np.zeros((2, 7), np.float32)
    pose[:, 0] = [8.0, 9.0]
    robots.episodes.final_pose.assign(pose)
    robots.end([second], Outcome.OUT)
    rows = robots.turn()
    queue = robots.queue
    assert queue.outcome.numpy()[1] == Outcome.OUT and queue.steps.numpy()[1] == [30, 40][second]
    assert queue.penalty_sums.numpy()[1].tolist() == [[1.5, 2.5], [3.5, 4.5]][second]
    assert queue.reward.numpy()[1] == [0.25, 0.5][second]
    assert queue.final_pose.numpy()[1, 0] == [8.0, 9.0][second]
    assert queue.num_ended.numpy().tolist() == [1, 0, 0] and not queue.steps.numpy()[[0, 2]].any()
    # The robot goes on with the third, from nothing; the other keeps what it has so far.
    assert rows[second] == 2 and rows[first] == 0
    assert robots.sums.numpy()[second].tolist() == [0.0, 0.0]
    assert robots.sums.numpy()[first].tolist() == [[1.5, 2.5], [3.5, 4.5]][first]
