"""The queue of episodes: each is run once, round the ring."""

import numpy as np
import pytest
import warp as wp

from kernels.episode import Outcome, make_episodes
from kernels.queue import make_queue, make_ready, turn_over
from kernels.rewards import Rewards

SLOTS, REPLICAS = 3, 4


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
    assert robots.queue.counts.numpy()[1] == 11
