"""Episodes queued for fewer robots: the same as with one robot each, bit for bit on the CPU."""

import dataclasses

import numpy as np
import pytest
import torch

from kernels.episode import Outcome
from sim.crossing import CrossingCfg
from sim.policy.loaders import load_policy
from sim.rollout import Rollout
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrain import crossing_terrain
from tests.sim.policies import stretch
from tests.sim.scenes import FLAT, spike

REPLICAS = 4
ARRAYS = ("penalties", "outcome", "invalidity", "fallen", "duration_s", "final_position", "reward")
SEEDS = np.array([5, 6, 7, 8, 9], np.uint32)


def pit():
    """Level ground up to x = 13.3 m, then three metres down."""
    heights = np.zeros_like(FLAT)
    heights[:, 266:] = -3.0
    return heights


GRIDS = np.stack(
    [FLAT, np.roll(spike(), 210, axis=1), crossing_terrain("boxes", 9, 1), pit(), crossing_terrain("noise", 9, 2)]
)
# Begun 1 m before the edge of the goal, a walk of two seconds has every end there is.
NEAR = CrossingCfg(start=(12.5, 4.0), max_duration_s=2.4, poll_every_s=0.2)


class FearsDepth:
    """The shipped controller, but NaN where some of the height scan is at its limit: before the pit."""

    def __init__(self, robot, device):
        self.walker = load_policy(robot.policy_file, robot, device)

    def __call__(self, row):
        deep = (row[:, 48:] >= 5.0).float().mean(dim=1, keepdim=True)
        return torch.where((deep > 0.0) & (deep < 0.5), torch.nan, self.walker(row))


def rollout_of(robot, num_envs, policy=None, cfg=NEAR, device="cpu", num_terrains=5):
    return Rollout(
        robot, policy or FearsDepth(robot, device), num_terrains=num_terrains, num_replicas=REPLICAS, device=device,
        num_envs=num_envs, cfg=cfg,
    )  # fmt: skip


def same(one, other, own=slice(None)):
    for name in ARRAYS:
        expected, got = getattr(one, name), getattr(other, name)
        assert (expected is None) == (got is None)
        if expected is not None:
            np.testing.assert_array_equal(expected[own], got, err_msg=name)


@pytest.mark.parametrize("reward", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_any_number_of_robots_runs_the_same_episodes(robot, reward):
    cfg = dataclasses.replace(NEAR, reward=reward)
    alone = rollout_of(robot, None, cfg=cfg).evaluate(GRIDS, SEEDS)
    ends = {Outcome.GOAL, Outcome.BASE_COLLISION, Outcome.INVALID}
    assert ends <= set(alone.outcome.ravel().tolist()), alone.outcome
    assert len(np.unique(alone.duration_s)) > 8
    for num_envs in (4, 7, 19):
        queued = rollout_of(robot, num_envs, cfg=cfg).evaluate(GRIDS, SEEDS)
        same(alone, queued)
        assert queued.robot_steps == num_envs * queued.physics_steps
        assert queued.physics_steps >= alone.physics_steps


def test_lots_run_into_each_other(anymal):
    """Three terrains fit; lots of two run round the ring, and robots go on with the next while one ends."""
    rollout = rollout_of(anymal, 5, num_terrains=3)
    expected = rollout_of(anymal, None).evaluate(GRIDS, SEEDS)
    rollout.put(GRIDS[:2], SEEDS[:2])
    rollout.put(GRIDS[2:3], SEEDS[2:3])
    assert rollout.num_free == 0
    with pytest.raises(ValueError, match="1 to 0 at once here, got 2"):
        rollout.put(GRIDS[:2], SEEDS[:2])
    first = rollout.take()
    rollout.put(GRIDS[3:], SEEDS[3:])  # in the slots of the first lot
    rest = [rollout.take(), rollout.take()]
    for own, got in zip((slice(0, 2), slice(2, 3), slice(3, 5)), (first, *rest), strict=True):
        same(expected, got, own)
    # No step is counted twice: what the three took together is what was made, of which episodes to the end of their
    # last control step were busy.
    robot_steps = sum(one.robot_steps for one in (first, *rest))
    used = sum(np.ceil(one.duration_s / anymal.control_dt - 1e-3).sum() for one in (first, *rest)) * anymal.decimation
    assert sum(one.busy_steps for one in (first, *rest)) == used
    assert 0.5 * robot_steps < used <= robot_steps
    assert all(0.0 <= one.idle_share <= 1.0 for one in (first, *rest))
    with pytest.raises(RuntimeError, match="nothing under way"):
        rollout.take()
    same(expected, rollout.evaluate(GRIDS[3:], SEEDS[3:]), slice(3, 5))


def test_genes_and_heights_share_the_ring(anymal):
    genes = SUPER_GAUSSIAN.hard_random(2, 0)
    rollout = rollout_of(anymal, 5, num_terrains=3)
    lots = [(genes[:1], SEEDS[:1]), (GRIDS[1:3], SEEDS[1:3]), (genes, SEEDS[:2])]  # the last lie round the ring's end
    for terrains, seeds in lots[:2]:
        rollout.put(terrains, seeds)
    results = [rollout.take()]
    with pytest.raises(ValueError, match="1 to 1 at once here, got 2"):
        rollout.put(*lots[2])
    results.append(rollout.take())
    rollout.put(GRIDS[:1], SEEDS[:1])
    rollout.put(*lots[2])
    rollout.take()
    results.append(rollout.take())
    for (terrains, seeds), got in zip(lots, results, strict=True):
        same(rollout_of(anymal, None).evaluate(terrains, seeds), got)


def test_lots_in_which_robots_go_on_after_the_goal(anymal):
    cfg = dataclasses.replace(NEAR, reward=True)
    expected = rollout_of(anymal, None, cfg=cfg).evaluate(GRIDS, SEEDS)
    rollout = rollout_of(anymal, 6, cfg=cfg, num_terrains=4)
    lots = slice(0, 2), slice(2, 4), slice(4, 5)
    for own in lots[:2]:
        rollout.put(GRIDS[own], SEEDS[own])
    results = [rollout.take()]
    rollout.put(GRIDS[lots[2]], SEEDS[lots[2]])  # where robots of the first lot stood
    results += [rollout.take(), rollout.take()]
    for own, got in zip(lots, results, strict=True):
        same(expected, got, own)
        assert 0.0 <= got.idle_share <= 1.0
    # A robot at the goal stands there and is paid: it does not wait. It has more steps than its crossing.
    assert sum(one.busy_steps for one in results) * anymal.physics_dt > sum(one.duration_s.sum() for one in results)


def test_a_world_that_broke_is_whole_for_the_next_episode(anymal):
    """Every robot's first episode ends in a state that is not finite; no later one differs by that."""
    alone = rollout_of(anymal, None).evaluate(GRIDS, SEEDS)
    rollout = rollout_of(anymal, 4)
    rollout.put(GRIDS[:1], SEEDS[:1])
    rollout.control_step()
    for array in (rollout.sim.joint_qd, rollout.sim.solver.mjw_data.qacc_warmstart):
        array.fill_(np.nan)
    assert (rollout.take().outcome == Outcome.INVALID).all()
    same(alone, rollout.evaluate(GRIDS, SEEDS))


def test_more_may_be_put_in_while_one_waits(anymal):
    rollout, put = rollout_of(anymal, 4, num_terrains=2), []

    def put_more(share):
        if not put:
            put.append(rollout.put(GRIDS[1:2], SEEDS[1:2]))

    rollout.put(GRIDS[:1], SEEDS[:1])
    expected = rollout_of(anymal, None).evaluate(GRIDS, SEEDS)
    same(expected, rollout.take(put_more), slice(0, 1))
    same(expected, rollout.take(), slice(1, 2))


class CountsByRow:
    """Walks a little differently with every step of an episode."""

    def __init__(self):
        self.steps = None

    def reset(self, rows):
        if self.steps is None:
            self.steps = torch.zeros(len(rows), device=rows.device)
        self.steps[rows] = 0

    def __call__(self, row):
        self.steps += 1
        return stretch(row) + 0.02 * self.steps[:, None].remainder(10)


class CountsTogether(CountsByRow):
    """The same, and forgets all robots or none."""

    resets = 0

    def reset(self):
        self.steps, self.resets = None, self.resets + 1

    def __call__(self, row):
        super().reset(torch.zeros(len(row), dtype=torch.bool, device=row.device))
        return super().__call__(row)


def test_a_policy_that_remembers_begins_every_episode_anew(anymal):
    cfg = dataclasses.replace(NEAR, start=(2.0, 4.0), max_duration_s=1.0)
    expected = rollout_of(anymal, None, CountsTogether(), cfg).evaluate(GRIDS, SEEDS)
    forgetful = rollout_of(anymal, None, stretch, cfg).evaluate(GRIDS, SEEDS)
    assert not np.array_equal(expected.penalties, forgetful.penalties)
    for num_envs in (4, 7, 20):
        same(expected, rollout_of(anymal, num_envs, CountsByRow(), cfg).evaluate(GRIDS, SEEDS))


def test_a_policy_that_cannot_forget_single_robots_lets_them_begin_together(anymal):
    cfg = dataclasses.replace(NEAR, start=(2.0, 4.0), max_duration_s=1.0)
    expected = rollout_of(anymal, None, CountsTogether(), cfg).evaluate(GRIDS, SEEDS)
    policy = CountsTogether()
    rollout = rollout_of(anymal, 7, policy, cfg)
    rollout.put(GRIDS[:3], SEEDS[:3])
    rollout.put(GRIDS[3:], SEEDS[3:])
    same(expected, rollout.take(), slice(0, 3))
    same(expected, rollout.take(), slice(3, 5))
    assert policy.resets == 3  # 20 episodes on 7 robots: 7, 7, 6


def test_a_failure_leaves_a_rollout_that_works(anymal):
    rollout = rollout_of(anymal, 6)

    def stop(share):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rollout.evaluate(GRIDS, SEEDS, progress=stop)
    same(rollout_of(anymal, None).evaluate(GRIDS, SEEDS), rollout.evaluate(GRIDS, SEEDS))


def test_never_more_robots_than_episodes(anymal):
    assert rollout_of(anymal, 1000, stretch).num_envs == 20
    with pytest.raises(ValueError, match="num_envs must be positive, got 5, 4 and 0"):
        rollout_of(anymal, 0, stretch)


def test_a_gpus_robots_run_the_same_episodes(anymal, device):
    """With the same starts to the bit; what follows differs by rounding, since a GPU adds in any order."""
    cfg = dataclasses.replace(NEAR, max_duration_s=0.2, poll_every_s=0.1)
    alone, queued = (
        rollout_of(anymal, num_envs, cfg=cfg, device=device).evaluate(GRIDS[[0, 2, 4]], SEEDS[:3])
        for num_envs in (None, 5)
    )
    np.testing.assert_array_equal(alone.outcome, queued.outcome)
    np.testing.assert_allclose(alone.final_position, queued.final_position, atol=2e-3)


@pytest.mark.parametrize(
    "failure",
    [
        RuntimeError("Failed to allocate 6000000000 bytes on device 'cuda:0'"),
        torch.cuda.OutOfMemoryError("CUDA out of memory. Tried to allocate 20.00 GiB"),
        MemoryError(),
    ],
)
def test_what_does_not_fit_the_device_is_said(anymal, monkeypatch, failure):
    def fail(*args, **kwargs):
        raise failure

    monkeypatch.setattr("sim.rollout.TerrainBank", fail)
    with pytest.raises(ValueError, match=r"20 robots and 5 terrains at once need more memory than cpu has.*--num-envs"):
        rollout_of(anymal, None, stretch)
