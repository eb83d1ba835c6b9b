"""Curriculum, masked restart, commands and pushes."""

import numpy as np
import pytest
import warp as wp

from kernels.heightfield import Terrain, ceiling_shape
from kernels.restart import command_episodes, promote_episodes, remember_steps, restart_episodes
from kernels.rewards import make_feet
from kernels.start import StartRanges
from kernels.training import End, Rules, make_episodes
from sim.crossing import CrossingCfg, make_task
from sim.robots.robot import get_robot

NUM_JOINTS = 2
DEFAULT_POSE = (0.5, -1.0)
NUM_LEVELS, NUM_COLUMNS = 4, 3


def make_rules(**changes):
    rules = Rules()
    values = {
        "num_levels": NUM_LEVELS, "num_columns": NUM_COLUMNS, "promotion_distance": 4.0, "demotion_time_s": 10.0,
        "command_steps": 500, "lin_vel_x": (-1.0, 1.0), "lin_vel_y": (-0.5, 0.5), "min_speed": 0.2, "yaw_gain": 0.5,
        "max_yaw_rate": 1.0, "push_steps": 0, "push_speed": 1.0,
    }  # fmt: skip
    for name, value in {**values, **changes}.items():
        setattr(rules, name, value)
    return rules


def make_batch(num_envs, *, end=End.TIME_OUT, level=0, column=0, count=0):
    full = np.full(num_envs, 1, np.int32)
    episodes = make_episodes(
        full * column, full * level, num_joints=NUM_JOINTS, observation_size=4, first_count=count, device="cpu"
    )
    episodes.end.assign(np.broadcast_to(np.int32(end), num_envs))
    return episodes


def rows(num_envs, width, value=0.0):
    return wp.array(np.full((num_envs, width), value, np.float32), dtype=float)


def promoted(walked, speed, *, level=1, end=End.TIME_OUT, count=0):
    """Level and terrain of one environment after an episode."""
    num_envs = len(np.atleast_1d(walked))
    episodes = make_batch(num_envs, end=end, level=level, column=2, count=count)
    episodes.start.assign(np.full((num_envs, 2), 5.0, np.float32))
    joint_q = np.full((num_envs, 7 + NUM_JOINTS), 5.0, np.float32)
    joint_q[:, 1] += walked
    command = np.zeros((num_envs, 3), np.float32)
    command[:, 0] = speed
    episodes.command.assign(command)
    terrain = wp.full(num_envs, 99, dtype=int)
    promote_episodes(wp.array(joint_q, dtype=float), make_rules(), terrain, episodes)
    return episodes.level.numpy(), terrain.numpy()


def test_level_goes_up_down_or_stays():
    # Commanded .3 m/s: 3 m are due.
    levels, terrain = promoted([4.1, 3.9, 3.1, 2.9, 0.0], 0.3)
    assert levels.tolist() == [2, 1, 1, 0, 0]
    assert terrain.tolist() == [level * NUM_COLUMNS + 2 for level in levels]
    assert promoted(0.0, 0.0)[0] == [1]  # told to stand


def test_walking_far_counts_before_lagging_behind():
    assert promoted(4.1, 1.0)[0] == [2]


def test_level_zero_is_the_lowest():
    assert promoted(0.0, 1.0, level=0)[0] == [0]


def test_past_the_last_level_any_level_follows():
    levels = promoted(np.full(400, 5.0), 1.0, level=NUM_LEVELS - 1)[0]
    counts = np.bincount(levels, minlength=NUM_LEVELS)
    assert counts.shape == (NUM_LEVELS,) and (counts > 60).all()  # 100 expected, standard deviation 8.7


def test_running_and_invalid_episodes_keep_their_level():
    levels, terrain = promoted([9.0, 9.0], 0.3, end=[End.RUNNING, End.INVALID])
    assert levels.tolist() == [1, 1]
    assert terrain.tolist() == [99, NUM_COLUMNS + 2]


def make_terrain():
    """Terrain 0 is flat; terrain 1 has one node of 0.7 m at (8.2, 4)."""
    heights = np.zeros((2, 161, 321), np.float32)
    heights[1, 80, 164] = 0.7
    terrain = Terrain()
    terrain.heights = wp.array(heights, dtype=float)
    terrain.ceilings = wp.zeros(ceiling_shape(2, 161, 321), dtype=float)
    terrain.spacing = 0.05
    return terrain


def restart(num_envs, end, *, terrain_of_env=0, count=0):
    ranges = StartRanges()
    ranges.position, ranges.position_range, ranges.yaw_range = (8.0, 4.0), 1.0, np.pi
    ranges.joint_scale_range, ranges.velocity_range = 0.5, 0.5
    ranges.base_height, ranges.footprint = 0.6, (0.5, 0.5)
    episodes = make_batch(num_envs, end=end, count=count)
    for array in (episodes.last_action, episodes.steps, episodes.total_reward):
        array.fill_(3)
    feet = make_feet(num_envs, 1, "cpu")
    feet.air_time.fill_(3.0)
    feet.touched.fill_(1)
    joint_q, joint_qd = rows(num_envs, 7 + NUM_JOINTS, 3.0), rows(num_envs, 6 + NUM_JOINTS, 3.0)
    index = wp.array(np.broadcast_to(np.int32(terrain_of_env), num_envs), dtype=int)
    pose = wp.array(DEFAULT_POSE, dtype=float)
    com = wp.vec3(0.1, 0.0, 0.0)
    restart_episodes(index, make_terrain(), ranges, com, pose, joint_q, joint_qd, feet, episodes)
    return joint_q.numpy(), joint_qd.numpy(), feet, episodes


def test_running_episodes_are_left_alone():
    joint_q, joint_qd, feet, episodes = restart(3, [End.TILT, End.RUNNING, End.TIME_OUT])
    assert (joint_q[1] == 3.0).all() and (joint_qd[1] == 3.0).all()
    for array in (episodes.last_action, episodes.steps, episodes.total_reward, feet.air_time):
        values = array.numpy().reshape(3, -1)
        assert (values[1] == 3).all() and (values[[0, 2]] == 0).all()
    assert feet.touched.numpy().ravel().tolist() == [0, 1, 0]
    assert (joint_q[[0, 2]] != 3.0).all()


def test_starts_fill_their_ranges():
    joint_q, joint_qd, _, episodes = restart(2000, End.TIME_OUT)
    yaw = 2.0 * np.arctan2(joint_q[:, 5], joint_q[:, 6])
    origin_vel = joint_qd[:, :3] - np.cross(
        joint_qd[:, 3:6], 0.1 * np.stack([np.cos(yaw), np.sin(yaw), 0 * yaw], axis=1)
    )
    drawn = {
        "x": (joint_q[:, 0], 7.0, 9.0),
        "y": (joint_q[:, 1], 3.0, 5.0),
        "yaw": (yaw, -np.pi, np.pi),
        "joint 0": (joint_q[:, 7], 0.25, 0.75),
        "joint 1": (joint_q[:, 8], -1.5, -0.5),
        "velocity": (origin_vel, -0.5, 0.5),
        "rates": (joint_qd[:, 3:6], -0.5, 0.5),
    }
    for name, (values, low, high) in drawn.items():
        margin = 0.01 * (high - low)
        assert values.min() >= low - 1e-5 and values.max() <= high + 1e-5, name
        assert values.min() < low + margin and values.max() > high - margin, name
        assert abs(values.mean() - 0.5 * (low + high)) < 0.03 * (high - low), name
    np.testing.assert_allclose(joint_q[:, 2], 0.6, atol=1e-6)
    np.testing.assert_array_equal(joint_q[:, 3:5], 0.0)
    np.testing.assert_array_equal(joint_qd[:, 6:], 0.0)
    np.testing.assert_array_equal(episodes.start.numpy(), joint_q[:, :2])


def test_base_stands_above_the_highest_ground_beneath():
    joint_q = restart(500, End.TIME_OUT, terrain_of_env=1)[0]
    near = (np.abs(joint_q[:, 0] - 8.2) < 0.5) & (np.abs(joint_q[:, 1] - 4.0) < 0.5)
    far = (np.abs(joint_q[:, 0] - 8.2) > 0.55) | (np.abs(joint_q[:, 1] - 4.0) > 0.55)
    assert near.any() and far.any()
    np.testing.assert_allclose(joint_q[near, 2], 1.3, atol=1e-6)
    np.testing.assert_allclose(joint_q[far, 2], 0.6, atol=1e-6)


def test_random_numbers_depend_on_counter_and_environment_alone():
    once, again = restart(4, End.TIME_OUT, count=7)[0], restart(4, End.TIME_OUT, count=7)[0]
    np.testing.assert_array_equal(once, again)
    alone = restart(4, [End.RUNNING, End.RUNNING, End.TILT, End.RUNNING], count=7)[0]
    np.testing.assert_array_equal(alone[2], once[2])
    assert len(np.unique(np.concatenate([once[:, 0], restart(4, End.TIME_OUT, count=8)[0][:, 0]]))) == 8


def command(num_envs=1, *, steps=0, yaw=0.0, heading=None, before=(0.0, 0.0, 0.0), count=0, place=(0.0, 0.0), **rules):
    """Commands, joint velocities and episodes after the launch."""
    episodes = make_batch(num_envs, end=End.RUNNING, count=count)
    episodes.steps.assign(np.broadcast_to(np.int32(steps), num_envs))
    episodes.command.assign(np.tile(np.float32(before), (num_envs, 1)))
    if heading is not None:
        episodes.heading.fill_(heading)
    joint_q = np.zeros((num_envs, 7 + NUM_JOINTS), np.float32)
    joint_q[:, :2] = place
    joint_q[:, 5], joint_q[:, 6] = np.sin(yaw / 2), np.cos(yaw / 2)
    joint_qd = rows(num_envs, 6 + NUM_JOINTS, 9.0)
    command_episodes(make_rules(**rules), wp.array(joint_q, dtype=float), joint_qd, episodes)
    return episodes.command.numpy(), joint_qd.numpy(), episodes


def test_commands_fill_their_ranges_and_slow_ones_are_zero():
    commands, _, episodes = command(4000)
    speed = np.linalg.norm(commands[:, :2], axis=1)
    assert (speed[speed > 0] > 0.2).all()
    # A disc of radius .2 in the rectangle of 2 x 1: pi * .04 / 2 = 6.3 %, standard deviation .4 %.
    assert abs((speed == 0).mean() - 0.0628) < 0.015
    for values, bound in ((commands[:, 0], 1.0), (commands[:, 1], 0.5), (episodes.heading.numpy(), np.pi)):
        assert -bound <= values.min() < -0.99 * bound and 0.99 * bound < values.max() <= bound


@pytest.mark.parametrize(("steps", "drawn"), [(0, True), (499, False), (500, True), (501, False), (1000, True)])
def test_commands_are_drawn_when_due(steps, drawn):
    commands, _, _ = command(steps=steps, before=(0.123, 0.0, 0.0))
    assert (commands[0, 0] != np.float32(0.123)) == drawn


@pytest.mark.parametrize(
    ("heading", "yaw", "rate"),
    [(0.6, 0.2, 0.2), (0.2, 0.6, -0.2), (3.0, -3.0, -0.14159), (2.5, 0.0, 1.0), (-2.5, 0.0, -1.0)],
)
def test_heading_becomes_a_yaw_rate_the_short_way_round(heading, yaw, rate):
    commands, _, _ = command(steps=1, heading=heading, yaw=yaw)
    assert commands[0, 2] == pytest.approx(rate, abs=1e-4)


@pytest.mark.parametrize(
    ("place", "yaw", "expected"),
    [
        ((2.0, 4.0), 0.0, (0.75, 0.0, 0.0)),
        # The goal lies to the left of a robot that looks along x: turn left, at most 1 rad/s.
        ((14.0, 0.0), 0.0, (0.0, 0.75, 0.5 * np.pi / 2)),
        ((14.0, 8.0), np.pi / 2, (-0.75, 0.0, -1.0)),
    ],
)
def test_a_crossing_robot_is_told_to_go_to_its_goal(place, yaw, expected):
    task = make_task(CrossingCfg(), get_robot("anymal"))
    commands, _, episodes = command(steps=0, heading=0.3, yaw=yaw, place=place, crosses=1, crossing=task)
    if abs(expected[2]) == 1.0:  # straight behind: either way round is the short one
        commands[0, 2] = -abs(commands[0, 2])
    np.testing.assert_allclose(commands[0], expected, atol=1e-6)
    assert episodes.heading.numpy().tolist() == [np.float32(0.3)]  # nothing is drawn


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


def test_no_pushes_when_told_so():
    assert (command(5, steps=1, push_steps=0)[1] == 9.0).all()


def test_remembering_a_step():
    episodes = make_batch(2, count=41)
    episodes.last_action.assign(np.float32([[1, 2], [3, 4]]))
    joint_qd = wp.array(np.arange(16, dtype=np.float32).reshape(2, 8), dtype=float)
    remember_steps(joint_qd, episodes)
    assert episodes.previous_action.numpy().tolist() == [[1, 2], [3, 4]]
    assert episodes.previous_joint_vel.numpy().tolist() == [[6, 7], [14, 15]]
    assert episodes.counter.numpy().tolist() == [42]
