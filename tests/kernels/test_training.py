"""What training adds to episodes: levels, commands and pushes, the seeds of starts, and statistics."""

import numpy as np
import pytest
import warp as wp

from kernels.episode import Outcome, Task, make_episodes
from kernels.rewards import make_rewards
from kernels.state import RobotStep
from kernels.training import (
    STATISTICS,
    Rules,
    command_episodes,
    make_training,
    promote_episodes,
    record_steps,
    seed_restarts,
)
from sim.crossing import CrossingCfg, make_task
from sim.robots.find import get_robot
from tests.kernels.states import filled

NUM_JOINTS = 2
NUM_LEVELS, NUM_COLUMNS = 4, 3
UPRIGHT = (0.0, 0.0, 0.6, 0.0, 0.0, 0.0, 1.0, 0.1)


def make_rules(**changes):
    values = {
        "num_levels": NUM_LEVELS, "num_columns": NUM_COLUMNS, "promotion_distance": 4.0, "demotion_time_s": 10.0,
        "command_steps": 500, "lin_vel_x": (-1.0, 1.0), "lin_vel_y": (-0.5, 0.5), "min_speed": 0.2, "push_steps": 0,
        "push_speed": 1.0, "overflow_mask": ~(512 | 1024),
    }  # fmt: skip
    return filled(Rules, **values | changes)


def make_batch(num_envs, *, outcome=Outcome.TIME_OUT, level=0, column=0, count=0):
    """Episodes and what training keeps beside them."""
    full = np.full(num_envs, 1, np.int32)
    sizes = {"num_joints": NUM_JOINTS, "observation_size": 4, "first_count": count, "device": str(wp.get_device())}
    training, episodes = make_training(full * column, full * level, **sizes), make_episodes(num_envs)
    episodes.outcome.assign(np.broadcast_to(np.int32(outcome), num_envs))
    return episodes, training


def promoted(walked, speed, *, level=1, outcome=Outcome.TIME_OUT, count=0):
    """Level and terrain of one environment after an episode."""
    num_envs = len(np.atleast_1d(walked))
    episodes, training = make_batch(num_envs, outcome=outcome, level=level, column=2, count=count)
    episodes.start.assign(np.full((num_envs, 2), 5.0, np.float32))
    joint_q = np.full((num_envs, 7 + NUM_JOINTS), 5.0, np.float32)
    joint_q[:, 1] += walked
    command = np.zeros((num_envs, 3), np.float32)
    command[:, 0] = speed
    training.command.assign(command)
    terrain = wp.full(num_envs, 99, dtype=int)
    promote_episodes(wp.array(joint_q, dtype=float), episodes, make_rules(), terrain, training)
    return training.level.numpy(), terrain.numpy()


def test_level_goes_up_down_or_stays():
    # Commanded .3 m/s: 3 m are due.
    levels, terrain = promoted([4.1, 3.9, 3.1, 2.9, 0.0], 0.3)
    assert levels.tolist() == [2, 1, 1, 0, 0]
    assert terrain.tolist() == [level * NUM_COLUMNS + 2 for level in levels]
    assert promoted(0.0, 0.0)[0] == [1]  # told to stand
    assert promoted(4.1, 1.0)[0] == [2]  # far, though less than is due
    assert promoted(0.0, 1.0, level=0)[0] == [0]
    levels, terrain = promoted([9.0, 9.0], 0.3, outcome=[Outcome.RUNNING, Outcome.INVALID])
    assert levels.tolist() == [1, 1]  # both keep their level
    assert terrain.tolist() == [99, NUM_COLUMNS + 2]


def test_past_the_last_level_any_level_follows():
    levels = promoted(np.full(400, 5.0), 1.0, level=NUM_LEVELS - 1)[0]
    counts = np.bincount(levels, minlength=NUM_LEVELS)
    assert counts.shape == (NUM_LEVELS,) and (counts > 60).all()  # 100 expected, standard deviation 8.7


def test_starts_are_drawn_from_counter_and_environment_alone():
    seeds = []
    for count in (7, 7, 8):
        episodes, training = make_batch(4, count=count)
        seed_restarts(training, episodes)
        seeds.append(episodes.rng.numpy().tolist())
    assert seeds[0] == seeds[1] and len({*seeds[1], *seeds[2]}) == 8


def command(num_envs=1, *, steps=0, yaw=0.0, heading=None, count=0, position=(0.0, 0.0), task=None, **rules):
    """Commands, joint velocities and headings after the launch."""
    task = task or filled(Task, yaw_gain=0.5, max_yaw_rate=1.0)
    episodes, training = make_batch(num_envs, outcome=Outcome.RUNNING, count=count)
    episodes.steps.assign(np.broadcast_to(np.int32(steps), num_envs))
    if heading is not None:
        training.heading.fill_(heading)
    joint_q = np.zeros((num_envs, 7 + NUM_JOINTS), np.float32)
    joint_q[:, :2] = position
    joint_q[:, 5], joint_q[:, 6] = np.sin(yaw / 2), np.cos(yaw / 2)
    joint_qd = wp.full((num_envs, 6 + NUM_JOINTS), 9.0, dtype=float)
    command_episodes(wp.array(joint_q, dtype=float), episodes, make_rules(**rules), task, joint_qd, training)
    return training.command.numpy(), joint_qd.numpy(), training.heading.numpy()


def test_commands_fill_their_ranges_and_slow_ones_are_zero():
    commands, _, headings = command(4000)
    speed = np.linalg.norm(commands[:, :2], axis=1)
    assert (speed[speed > 0] > 0.2).all()
    # A disc of radius .2 in the rectangle of 2 x 1: pi * .04 / 2 = 6.3 %, standard deviation .4 %.
    assert abs((speed == 0).mean() - 0.0628) < 0.015
    for values, bound in ((commands[:, 0], 1.0), (commands[:, 1], 0.5), (headings, np.pi)):
        assert -bound <= values.min() < -0.99 * bound and 0.99 * bound < values.max() <= bound


@pytest.mark.parametrize(
    ("heading", "yaw", "rate"),
    [(0.6, 0.2, 0.2), (0.2, 0.6, -0.2), (3.0, -3.0, -0.14159), (2.5, 0.0, 1.0), (-2.5, 0.0, -1.0)],
)
def test_heading_becomes_a_yaw_rate_the_short_way_round(heading, yaw, rate):
    commands, _, _ = command(steps=1, heading=heading, yaw=yaw)
    assert commands[0, 2] == pytest.approx(rate, abs=1e-4)


def test_a_crossing_robot_is_commanded_to_its_goal():
    # The goal lies to the left of a robot that looks along x: turn left by half of 90 degrees a second.
    task = make_task(CrossingCfg(), get_robot("anymal"))
    commands, _, headings = command(steps=0, heading=0.3, position=(14.0, 0.0), crosses=1, task=task)
    np.testing.assert_allclose(commands[0], (0.0, 0.75, 0.5 * np.pi / 2), atol=1e-6)
    assert headings.tolist() == [np.float32(0.3)]  # nothing is drawn


def test_each_environment_is_pushed_once_an_interval():
    interval, num_envs = 20, 30
    pushed = np.zeros((interval, num_envs), bool)
    for count in range(interval):
        _, joint_qd, _ = command(num_envs, steps=1, count=count, push_steps=interval)
        pushed[count] = (joint_qd[:, :2] != 9.0).all(axis=1)
        assert (np.abs(joint_qd[pushed[count], :2]) <= 1.0).all()
        assert (joint_qd[:, 2:] == 9.0).all() and (joint_qd[~pushed[count]] == 9.0).all()
    assert (pushed.sum(axis=0) == 1).all()
    assert pushed.sum(axis=1).max() < num_envs / 2  # not all at once
    assert (command(5, steps=1, push_steps=0)[1] == 9.0).all()


def test_statistics_add_up():
    outcome = [Outcome.RUNNING, Outcome.TIME_OUT, Outcome.TILT, Outcome.INVALID]
    episodes, training = make_batch(4, outcome=outcome)
    rewards = make_rewards(4, NUM_JOINTS, 1, str(wp.get_device()))
    episodes.steps.assign(np.array([5, 1000, 20, 30], np.int32))
    rewards.total.assign(np.float32([11, 22, 33, 44]))
    training.command.assign(np.float32([[0.3, 0.4, 0.2]] * 4))
    step = filled(
        RobotStep, joint_q=[UPRIGHT] * 3 + [(*UPRIGHT[:7], np.nan)], joint_qd=np.zeros((4, 7)), base_com=(0, 0, 0),
        overflow=[1, 512 | 1024, 0, 2 | 512],
    )  # fmt: skip
    record_steps(step, make_rules(), episodes, rewards, training)
    assert training.ended.numpy().tolist() == outcome
    sums = dict(zip(STATISTICS, training.statistics.numpy().sum(0), strict=True))
    expected = {
        "steps": 4, "episodes": 3, "time_out": 1, "base_collision": 0, "tilt": 1, "invalid": 1, "goal": 0,
        "out": 0, "overflow": 2,
        "episode_steps": 1050, "episode_reward": 99,
        "lin_vel_error": 3 * 0.5,  # hypot(.3, .4), of the three that are valid
        "yaw_rate_error": 3 * 0.2,
    }  # fmt: skip
    for name, value in expected.items():
        np.testing.assert_allclose(sums[name], value, rtol=1e-6, err_msg=name)
