"""The crossing: how episodes end, what they cost, what the training reward is computed from and pays until when."""

import math
from dataclasses import fields, replace

import numpy as np
import pytest

from kernels.episode import Invalidity, Outcome
from sim.robots.training import RewardCfg, TrainingCfg
from sim.rollout import Rollout
from sim.simulation import Reward
from sim.terrains.hand_crafted import crossing_terrain
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains
from tests.sim.policies import Remembers, stand
from tests.sim.scenes import FLAT, crossing, positions, put, spike

TERRAINS, REPLICAS = 4, 4


@pytest.fixture(scope="module")
def rollout(anymal, device):
    return crossing(anymal, device, anymal.policy_file, num_terrains=TERRAINS)


def test_a_robot_that_stands_times_out(anymal, device):
    # "Success" without the goal: the full time, no collision, upright, still at the start.
    result = crossing(anymal, device).evaluate(Terrains(heights=FLAT[None], seeds=np.array([1])))
    assert (result.outcome == Outcome.TIME_OUT).all()
    assert not (result.base_collision | result.reached_goal | result.invalid | result.fallen).any()
    np.testing.assert_allclose(result.duration_s, 0.6, atol=1e-6)
    assert result.physics_steps == 120
    np.testing.assert_allclose(result.final_position[..., :2], [[[2, 4]] * 4], atol=0.25)
    # Standing still against a command of 0.75 m/s for 0.6 s costs 0.75^2 x 0.6 = 0.34 (m/s)^2 s in vel_x, a bit more or
    # less since it starts with up to 0.2 m/s.
    np.testing.assert_allclose(result.penalties[0, :, result.penalty_names.index("vel_x")], 0.34, atol=0.1)


def test_the_shipped_controller_walks_to_the_edge_of_the_goal(robot, device):
    terrains = np.stack([FLAT, crossing_terrain("stairs_up_down", 4, 3)])
    rollout = Rollout(robot, robot.policy_file, num_terrains=2, replicas=4, device=device)
    result = rollout.evaluate(Terrains(heights=terrains, seeds=np.array([1, 2], np.uint32)))
    assert result.reached_goal.all() and not result.fallen.any()
    # 11.5 m at 0.75 m/s: it keeps up with its command, and does not run ahead of it.
    assert ((result.duration_s > 14.0) & (result.duration_s < 18.0)).all()
    # A physics step of .005 s takes it in by 1 cm at most.
    distance = np.linalg.norm(result.final_position[..., :2] - [14.0, 4.0], axis=-1)
    assert ((distance > 0.49) & (distance < 0.5)).all()


def test_a_robot_whose_legs_whip_as_it_falls_has_failed(cassie, device):
    # On this terrain all eight fall, and two of them swing an ankle at more than 100 rad/s before the pelvis is down.
    rollout = Rollout(cassie, cassie.policy_file, num_terrains=1, replicas=8, device=device)
    result = rollout.evaluate(Terrains(genes=SUPER_GAUSSIAN.hard_random(300, 0)[7:8], seeds=np.array([7], np.uint32)))
    assert result.base_collision.sum() >= 6 and not result.invalid.any()


def test_a_robot_has_fallen_that_tilts_by_more_than_60_degrees(anymal, device):
    # High above the ground, turned at every control step: in the last one it turns by less than a degree more.
    flyer = crossing(anymal, device, max_duration_s=0.1, poll_every_s=0.02)
    tilt = np.deg2rad([0.0, 58.0, 62.0, 180.0])

    def turn(share):
        q, own = positions(flyer.sim), tilt[flyer.episode.numpy()]  # of each robot's episode
        q[:, 2], q[:, 3:7] = 5.0, 0.0
        q[:, 3], q[:, 6] = np.sin(own / 2), np.cos(own / 2)
        put(flyer.sim, q)

    result = flyer.evaluate(Terrains(heights=FLAT[None], seeds=np.array([1])), progress=turn)
    assert result.fallen.tolist() == [[False, False, True, True]]
    assert (result.outcome == Outcome.TIME_OUT).all()  # tilt alone ends nothing


def test_robots_that_are_done_wait_above_the_ground(anymal, device):
    # One starts at the goal, the other walks on: the first is over at once and touches nothing from then on.
    rollout = crossing(anymal, device, replicas=2, num_terrains=2, start=(2.0, 4.0), goal_radius=0.5)
    rollout.put(Terrains(heights=np.stack([FLAT, FLAT]), seeds=np.arange(2)))
    q, first = positions(rollout.sim), rollout.episode.numpy() == 0
    q[first, :2] = 14.0, 4.0
    put(rollout.sim, q)
    for _ in range(25):
        rollout.control_step()
    height = positions(rollout.sim)[:, 2]
    assert first.sum() == 1 and height[first] > 49.9 and (height[~first] < 1.0).all()
    forces = np.linalg.norm(rollout.sim.geom_force.numpy(), axis=(1, 2))
    assert forces[first] == 0.0 and (forces[~first] > 100.0).all()


def test_a_broken_state_is_invalid_and_harms_nobody_else(rollout):
    rough, seeds = [crossing_terrain(kind, 9, 2) for kind in ("stairs_up_down", "boxes", "noise")], np.arange(TERRAINS)
    grids = np.stack([FLAT, *rough])
    shares = []
    clean = rollout.evaluate(Terrains(heights=grids, seeds=seeds), progress=shares.append)
    assert shares == [5 * k / 30 for k in range(1, 7)]  # at every poll

    def break_one(share):
        values = np.array(rollout.sim.joint_qd.numpy())
        values[rollout.episode.numpy() == 6, 8] = 3000.0  # terrain 1, replica 2
        rollout.sim.joint_qd.assign(values)

    result = rollout.evaluate(Terrains(heights=grids, seeds=seeds), progress=break_one)
    expected = np.zeros((TERRAINS, REPLICAS), bool)
    expected[1, 2] = True
    np.testing.assert_array_equal(result.invalid, expected)
    np.testing.assert_array_equal(result.invalidity, np.where(expected, Invalidity.SPEED, Invalidity.NONE))
    assert np.isnan(result.penalties[1, 2]).all()
    assert np.isfinite(result.penalties[~expected]).all()
    # The step that broke is the first after the first poll at 0.1 s.
    assert result.duration_s[1, 2] == pytest.approx(0.105, abs=0.0051)
    if rollout.sim.device == "cpu":
        for name in ("penalties", "outcome", "fallen", "duration_s", "final_position"):
            np.testing.assert_array_equal(getattr(result, name)[~expected], getattr(clean, name)[~expected])


def test_actions_that_are_not_finite_make_their_episodes_invalid_in_the_step_they_act_in(anymal, device):
    # The 51st control step begins at 1 s; its first physics step of 0.005 s is judged invalid. Clipping made a limit of
    # NaN once: robots threw themselves about, and fell as others do.
    rollout = crossing(anymal, device, Remembers(most=50), max_duration_s=1.2)
    result = rollout.evaluate(Terrains(heights=FLAT[None], seeds=np.array([1])))
    assert (result.invalidity == Invalidity.ACTION).all() and result.invalid.all()
    np.testing.assert_allclose(result.duration_s, 1.005, atol=1e-6)


def test_wrong_input_is_named(rollout):
    for num_terrains, num_seeds, field in ((5, 5, "terrains"), (0, 0, "terrains"), (4, 3, "seeds")):
        with pytest.raises(ValueError, match=field):
            rollout.evaluate(Terrains(heights=np.zeros((num_terrains, 64)), seeds=np.arange(num_seeds)))


DT = 0.02


def reward_only(robot, only_positive=False, **weights):
    """A robot whose training pays for some terms alone."""
    nothing = {field.name: 0.0 for field in fields(RewardCfg)}
    return replace(robot, training=TrainingCfg(rewards=RewardCfg(**nothing | weights), only_positive=only_positive))


def rewarded(robot, device, policy=stand, **more):
    """By default robots that begin at rest."""
    ranges = ("start_position_range", "start_yaw_range", "start_joint_range", "start_velocity_range")
    return crossing(robot, device, policy, **dict.fromkeys(ranges, 0.0) | {"reward": True} | more)


def test_after_the_goal_the_command_is_to_stand_and_rewards_go_on(anymal, device):
    # At the goal with the first physics step; the first command was to walk, the 29 after it to stand:
    # .02 s * (exp(-2.25) + 29) = .582.
    rollout = rewarded(reward_only(anymal, tracking_lin_vel=1.0), device, start=(14.3, 4.0))
    result = rollout.evaluate(Terrains(heights=FLAT[None], seeds=np.array([1])))
    assert result.reached_goal.all()
    np.testing.assert_allclose(result.duration_s, anymal.physics_dt, atol=1e-6)
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


def test_an_invalid_crossing_has_no_reward_and_an_invalid_stand_ends_it(anymal, device):
    rollout = rewarded(reward_only(anymal, tracking_lin_vel=1.0), device, num_terrains=2, replicas=2)

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
