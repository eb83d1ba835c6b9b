"""The training reward: what it is computed from, what a crossing is paid and until when."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from kernels.episode import Outcome
from sim.robots.training import RewardCfg, TrainingCfg
from sim.simulation import Reward
from sim.terrains.terrains import Terrains
from tests.sim.policies import stand
from tests.sim.scenes import FLAT, crossing, positions, put, spike

NOTHING = {field.name: 0.0 for field in fields(RewardCfg)}
DT = 0.02


def reward_only(robot, only_positive=False, **weights):
    """A robot whose training pays for some terms alone."""
    return replace(robot, training=TrainingCfg(rewards=RewardCfg(**NOTHING | weights), only_positive=only_positive))


@pytest.fixture(scope="module")
def tracker(anymal):
    """Paid for its velocity alone."""
    return reward_only(anymal, tracking_lin_vel=1.0)


def rewarded(robot, device, policy=stand, **more):
    """By default robots that begin at rest."""
    ranges = ("start_position_range", "start_yaw_range", "start_joint_range", "start_velocity_range")
    return crossing(robot, device, policy, **dict.fromkeys(ranges, 0.0) | {"reward": True} | more)


def test_after_the_goal_the_command_is_to_stand_and_rewards_go_on(tracker, device):
    # At the goal with the first physics step; the first command was to walk, the 29 after it to stand:
    # .02 s * (exp(-2.25) + 29) = .582.
    rollout = rewarded(tracker, device, start=(14.3, 4.0))
    result = rollout.evaluate(Terrains(heights=FLAT[None], seeds=np.array([1])))
    assert result.reached_goal.all()
    np.testing.assert_allclose(result.duration_s, tracker.physics_dt, atol=1e-6)
    assert result.physics_steps == 120
    np.testing.assert_allclose(result.reward, DT * (math.exp(-2.25) + 29), rtol=0.01)
    assert (positions(rollout.sim)[:, 2] < 1.0).all()  # it stands there, and is not parked


@pytest.mark.parametrize("start", [2.0, 14.0])
def test_a_base_collision_costs_its_price_once_and_nothing_is_paid_after_it(anymal, device, start):
    # The same robots with 0.8 s and with 1.6 s: all have fallen on the spike before, from the start and at the goal.
    # -200 a second for the one control step: -4; for its velocity a robot is paid at most 1 a second before.
    robot, totals = reward_only(anymal, only_positive=True, termination=-200.0, tracking_lin_vel=1.0), []
    for duration in (0.8, 1.6):
        rollout = rewarded(robot, device, start=(start, 4.0), max_duration_s=duration)
        result = rollout.evaluate(Terrains(heights=spike(start)[None], seeds=np.array([1])))
        assert (result.base_collision if start == 2.0 else result.reached_goal).all()
        assert result.physics_steps < 160  # it was noticed that nobody earns any more
        totals.append(result.reward)
    np.testing.assert_array_equal(totals[0], totals[1])
    assert ((totals[0] > -4.0) & (totals[0] < -3.2)).all()


def test_an_invalid_crossing_has_no_reward_and_an_invalid_stand_ends_it(tracker, device):
    rollout = rewarded(tracker, device, num_terrains=2, replicas=2)

    def break_one(share):
        step = round(30 * share)  # of 0.6 s
        q, episode = np.array(rollout.sim.joint_q.numpy()), rollout.episode.numpy()
        if step == 10:
            q[episode == 0, 8] = np.nan  # still on its way
            q[episode == 2, :2] = 14.0, 4.0  # at the goal from now on
        if step == 20:
            q[episode == 2, 8] = np.nan
        put(rollout.sim, q)

    result = rollout.evaluate(Terrains(heights=np.stack([FLAT, FLAT]), seeds=np.arange(2)), progress=break_one)
    assert result.outcome[:, 0].tolist() == [Outcome.INVALID, Outcome.GOAL]
    assert np.isnan(result.reward[0, 0]) and np.isfinite(result.reward.ravel()[1:]).all()
    # 11 steps told to walk, 9 told to stand, and then no more.
    assert result.reward[1, 0] == pytest.approx(DT * (11 * math.exp(-2.25) + 9), rel=0.05)


def test_asking_for_the_reward_changes_nothing_else(anymal):
    """Bit for bit on the CPU: one goes past the goal, one meets a spike, one walks, and so without the reward."""
    results = []
    for reward in (False, True):
        rollout = rewarded(
            anymal, "cpu", anymal.policy_file, num_terrains=2, replicas=3, start=(13.3, 4.0), start_position_range=0.1,
            start_velocity_range=0.2, start_joint_range=0.2, max_duration_s=1.2, reward=reward,
        )  # fmt: skip
        results.append(rollout.evaluate(Terrains(heights=np.stack([FLAT, spike(13.3)]), seeds=np.array([5, 6]))))
    without, paid = results
    assert len(np.unique(without.outcome)) >= 2 and without.reached_goal.any()
    for field in ("penalties", "outcome", "fallen", "duration_s", "final_position"):
        np.testing.assert_array_equal(getattr(without, field), getattr(paid, field))
    assert without.reward is None and np.isfinite(paid.reward).all()


def test_a_robots_settings_reach_the_kernels(eight, robot):
    soft = replace(robot.training, soft_joint_limit=0.9)
    motion = Reward(eight, soft, eight.make_step(None, None), falls=()).motion
    steady = {name for name, flag in zip(robot.joint_names, motion.joint_is_steady.numpy(), strict=True) if flag}
    hips = {f"hip_{joint}_{side}" for joint in ("abduction", "rotation") for side in ("left", "right")}
    assert steady == (hips if robot.name == "cassie" else set())
    assert motion.step.force_limit == robot.contact_force_limit and motion.dt == pytest.approx(0.02)
    lower, upper = motion.joint_lower.numpy(), motion.joint_upper.numpy()
    # Cassie's abduction spans -.2618 to .3927, ANYmal's -.72 to .49; its other joints turn freely.
    middle, half = {"anymal": (-0.115, 0.605), "cassie": (0.06545, 0.32725)}[robot.name]
    np.testing.assert_allclose([lower[0], upper[0]], [middle - 0.9 * half, middle + 0.9 * half], atol=1e-6)
    assert ((lower[1:3] < -1e9).all() and (upper[1:3] > 1e9).all()) == (robot.name == "anymal")
    assert np.isfinite(lower).all() and np.isfinite(upper).all()
    np.testing.assert_allclose(motion.default_joint_pos.numpy(), robot.default_joint_pos, rtol=1e-6)
