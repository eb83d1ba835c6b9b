"""Episodes queued for fewer robots: the same as with one robot each, bit for bit on the CPU."""

import dataclasses

import numpy as np
import pytest
import torch

from kernels.episode import Outcome
from sim.controllers.loaders import load_policy
from sim.crossing import CrossingCfg
from sim.rollout import Rollout
from sim.terrains.bank import make_heights
from sim.terrains.hand_crafted import crossing_terrain
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains
from tests.sim.policies import stretch
from tests.sim.scenes import FLAT, ONLY_ANYMAL, spike

REPLICAS = 4
SEEDS = np.array([5, 6, 7, 8, 9, 2**32 - 1], np.uint32)
GENES = SUPER_GAUSSIAN.hard_random(2, 0)
PIT = np.where(np.arange(321) >= 266, np.float32(-3.0), FLAT)  # level up to x = 13.3 m, then three metres down
BUMPS = make_heights(GENES)
GRIDS = np.stack([FLAT, spike(12.5), crossing_terrain("boxes", 9, 1), PIT, *BUMPS])
# Begun 1 m before the edge of the goal, a walk of two seconds has every end there is.
NEAR = CrossingCfg(start=(12.5, 4.0), poll_every_s=0.2)
FAR = dataclasses.replace(NEAR, start=(2.0, 4.0))


class FearsDepth:
    """The shipped controller, but NaN where some of the height scan is at its limit: before the pit."""

    def __init__(self, robot, device):
        self.walker = load_policy(robot.policy_file, robot, device)

    def __call__(self, row):
        deep = (row[:, 48:] >= 5.0).float().mean(dim=1, keepdim=True)
        return torch.where((deep > 0.0) & (deep < 0.5), torch.nan, self.walker(row))


def on_grids(rows):
    """Some of the grids, with their seeds."""
    return Terrains(heights=GRIDS[rows], seeds=SEEDS[rows])


def rollout_of(robot, num_envs, policy=None, cfg=NEAR, device="cpu", num_terrains=6, duration_s=2.4):
    return Rollout(
        dataclasses.replace(robot, max_duration_s=duration_s),
        policy or FearsDepth(robot, device), num_terrains=num_terrains, replicas=REPLICAS, device=device,
        num_envs=num_envs, cfg=cfg,
    )  # fmt: skip


@pytest.fixture(scope="module")
def alone(robot):
    """Every terrain crossed with one robot an episode."""
    return rollout_of(robot, None).evaluate(on_grids(slice(None)))


def check_same(expected, result, rows=slice(None)):
    for name in ("penalties", "outcome", "invalidity", "fallen", "duration_s", "final_position", "reward"):
        values = getattr(expected, name)
        values = None if values is None else values[rows]
        np.testing.assert_array_equal(values, getattr(result, name), err_msg=name)


def test_any_number_of_robots_runs_the_same_episodes_in_any_order(robot, alone):
    ends = {Outcome.GOAL, Outcome.BASE_COLLISION, Outcome.INVALID}
    assert ends <= set(alone.outcome.ravel().tolist()), alone.outcome
    assert len(np.unique(alone.duration_s)) > 8 and len(np.unique(alone.penalties[..., 0])) > 20
    queued, order = rollout_of(robot, 7), [2, 0, 5, 3, 1, 4]
    for rows in (slice(None), order, slice(3, 4)):
        result = queued.evaluate(on_grids(rows))
        check_same(alone, result, rows)
        assert result.robot_steps == 7 * result.physics_steps


@pytest.mark.parametrize("reward", [False, True])
def test_lots_run_into_each_other(anymal, reward):
    """Of five terrains that fit, lots take the next in a ring, and robots go on with the next lot while one ends."""
    cfg, lots = dataclasses.replace(NEAR, reward=reward), [slice(0, 2), slice(2, 3), slice(3, 4), slice(4, 6)]
    expected = rollout_of(anymal, None, cfg=cfg).evaluate(on_grids(slice(None)))
    rollout = rollout_of(anymal, 5, num_terrains=5, cfg=cfg)

    def put_third(share):
        if rollout.num_free == 2:
            rollout.put(on_grids(lots[2]))

    for rows in lots[:2]:
        rollout.put(on_grids(rows))
    results = [rollout.take(put_third)]
    assert rollout.num_free == 3
    rollout.put(Terrains(genes=GENES, seeds=SEEDS[lots[3]]))  # behind the others: in the last slot and in the first
    with pytest.raises(ValueError, match="terrains"):
        rollout.put(on_grids(slice(2)))
    results += [rollout.take() for _ in range(3)]
    for rows, result in zip(lots, results, strict=True):
        check_same(expected, result, rows)
        assert 0.0 <= result.idle_share <= 1.0
    # No step is counted twice: what all took together is what was made, of which episodes to the end of their last
    # control step were busy.
    # With a reward a robot stands at the goal and is paid, and is busy longer than it crosses.
    used = sum(np.ceil(result.duration_s / anymal.control_dt - 1e-3).sum() for result in results) * anymal.decimation
    busy, robot_steps = (sum(getattr(result, name) for result in results) for name in ("busy_steps", "robot_steps"))
    assert busy > used if reward else busy == used
    assert 0.5 * robot_steps < busy <= robot_steps
    with pytest.raises(RuntimeError):
        rollout.take()


@ONLY_ANYMAL
def test_a_world_that_broke_and_a_failure_leave_a_rollout_that_works(anymal, alone):
    """Every robot's first episode ends in a state that is not finite, then the host fails: no later episode differs."""
    rollout = rollout_of(anymal, 4)
    rollout.put(on_grids(slice(1)))
    rollout.control_step()
    for array in (rollout.sim.joint_qd, rollout.sim.solver.mjw_data.qacc_warmstart):
        array.fill_(np.nan)
    assert (rollout.take().outcome == Outcome.INVALID).all()

    def stop(share):
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        rollout.evaluate(on_grids(slice(2, 4)), progress=stop)
    check_same(alone, rollout.evaluate(on_grids(slice(3))), slice(0, 3))


def test_an_episode_that_begins_in_contact_forgets_what_its_world_did_before(anymal):
    """Feet begin in the ground, so that the solver's first step has contacts, for which it would start warm."""
    low, how = dataclasses.replace(anymal, default_base_height=0.5), {"cfg": FAR, "duration_s": 0.1}
    expected, queued = (rollout_of(low, num, stretch, **how).evaluate(on_grids(slice(2))) for num in (None, 1))
    check_same(expected, queued)


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


@pytest.mark.slow
def test_a_policy_that_remembers_begins_every_episode_anew(anymal):
    short = {"cfg": FAR, "duration_s": 1.0}
    expected = rollout_of(anymal, None, CountsTogether(), **short).evaluate(on_grids(slice(5)))
    forgetful = rollout_of(anymal, None, stretch, **short).evaluate(on_grids(slice(5)))
    assert not np.array_equal(expected.penalties, forgetful.penalties)
    check_same(expected, rollout_of(anymal, 7, CountsByRow(), **short).evaluate(on_grids(slice(5))))
    # One that cannot forget single robots lets them begin together.
    policy = CountsTogether()
    rollout = rollout_of(anymal, 7, policy, **short)
    rollout.put(on_grids(slice(3)))
    rollout.put(on_grids(slice(3, 5)))
    check_same(expected, rollout.take(), slice(0, 3))
    check_same(expected, rollout.take(), slice(3, 5))
    assert policy.resets == 3  # 20 episodes on 7 robots: 7, 7, 6


def test_never_more_robots_than_episodes(anymal):
    assert rollout_of(anymal, 1000, stretch).num_envs == 24
    with pytest.raises(ValueError, match="num_envs"):
        rollout_of(anymal, 0, stretch)


def test_a_gpus_robots_run_the_same_episodes(anymal, device):
    """To the bit on any number of its robots; with the same starts as a CPU's, after which both round differently."""
    cfg = dataclasses.replace(NEAR, poll_every_s=0.1)
    queued, other, cpu = (
        rollout_of(anymal, num_envs, cfg=cfg, device=where, duration_s=0.2).evaluate(on_grids(np.array([0, 2, 4])))
        for num_envs, where in ((5, device), (7, device), (None, "cpu"))
    )
    check_same(queued, other)
    np.testing.assert_array_equal(queued.outcome, cpu.outcome)
    np.testing.assert_allclose(queued.duration_s, cpu.duration_s, atol=1e-6)
    np.testing.assert_allclose(queued.final_position, cpu.final_position, atol=2e-3)
    columns = slice(0, 3)  # of velocities; forces differ sooner
    np.testing.assert_allclose(queued.penalties[..., columns], cpu.penalties[..., columns], rtol=0.02, atol=2e-3)


OUT_OF_MEMORY = [
    RuntimeError("Failed to allocate 6000000000 bytes on device 'cuda:0'"),  # as Warp says it
    torch.OutOfMemoryError("CUDA out of memory."),
    MemoryError(),
]


@pytest.mark.parametrize("failure", [*OUT_OF_MEMORY, RuntimeError("this controller is out of memory cells")])
def test_only_what_does_not_fit_the_device_is_said_so(anymal, monkeypatch, failure):
    def fail(*args, **kwargs):
        raise failure

    monkeypatch.setattr("sim.rollout.TerrainBank", fail)
    error, field = (ValueError, "num_envs") if failure in OUT_OF_MEMORY else (RuntimeError, "memory cells")
    with pytest.raises(error, match=field):
        rollout_of(anymal, None, stretch)
