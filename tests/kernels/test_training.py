"""Ends of training episodes and the statistics of training, against hand-made states."""

import numpy as np
import warp as wp

from kernels.penalties import BASE, FOOT
from kernels.training import STATISTICS, End, Rules, judge_steps, make_episodes, note_base_forces, record_steps

ROLES = [BASE, FOOT]
UPRIGHT = (0.0, 0.0, 0.6, 0.0, 0.0, 0.0, 1.0, 0.1)


def make_rules(*, crosses=0):
    rules = Rules()
    rules.crosses = crosses
    rules.crossing.goal = (14.0, 4.0)
    rules.crossing.goal_radius = 0.5
    rules.crossing.lower = (-2.0, -2.0)
    rules.crossing.upper = (18.0, 10.0)
    rules.max_steps = 1000
    rules.base_force = 1.0
    rules.max_gravity_z = -0.1
    rules.max_speed = 100.0
    rules.overflow_mask = ~(512 | 1024)
    return rules


def episodes_of(num_envs):
    return make_episodes(
        np.zeros(num_envs, np.int32), np.zeros(num_envs, np.int32), num_joints=1, observation_size=4, first_count=0,
        device="cpu",
    )  # fmt: skip


def tilted(angle):
    return (0.0, 0.0, 0.6, np.sin(angle / 2), 0.0, 0.0, np.cos(angle / 2), 0.1)


def judge(rows, *, velocity=0.0, base_force=0.0, steps=0, crosses=0):
    """End of each environment; arguments are one for all or one for each."""
    num_envs = len(rows)
    episodes = episodes_of(num_envs)
    episodes.steps.assign(np.broadcast_to(np.int32(steps), num_envs))
    joint_qd = np.zeros((num_envs, 7), np.float32)
    joint_qd[:, 3] = velocity
    force = np.zeros((num_envs, 2, 3), np.float32)
    force[:, 0, 1] = base_force
    force[:, 1, 2] = 500.0  # the foot's force ends nothing
    note_base_forces(wp.array(force, dtype=wp.vec3), wp.array(ROLES, dtype=int), episodes)
    joint_q = wp.array(np.float32(rows), dtype=float)
    judge_steps(joint_q, wp.array(joint_qd, dtype=float), make_rules(crosses=crosses), episodes)
    return episodes


def ends(*args, **kwargs):
    return [End(end) for end in judge(*args, **kwargs).end.numpy()]


def test_ends_at_their_thresholds():
    assert ends([UPRIGHT] * 2, base_force=[0.99, 1.01]) == [End.RUNNING, End.BASE_COLLISION]
    # The projected gravity's z is -cos(tilt): -0.1 at 84.3 degrees.
    assert ends([tilted(np.deg2rad(84.0)), tilted(np.deg2rad(84.6))]) == [End.RUNNING, End.TILT]
    assert ends([UPRIGHT] * 2, steps=[998, 999]) == [End.RUNNING, End.TIME_OUT]
    assert ends([UPRIGHT] * 2, velocity=[-99.9, -100.1]) == [End.RUNNING, End.INVALID]


def test_non_finite_states_are_invalid():
    broken = [(*UPRIGHT[:7], value) for value in (np.nan, np.inf, -np.inf)]
    assert ends(broken) == [End.INVALID] * 3
    assert ends([UPRIGHT], velocity=np.nan) == [End.INVALID]


def test_a_crossing_ends_at_the_goal_and_beyond_the_borders():
    places = [(13.4, 4.0), (13.6, 4.0), (14.0, 4.6), (-2.1, 4.0), (18.1, 4.0), (5.0, -2.1), (5.0, 10.1), (5.0, 9.9)]
    rows = [(*place, *UPRIGHT[2:]) for place in places]
    out = [End.OUT] * 4
    assert ends(rows, crosses=1) == [End.RUNNING, End.GOAL, End.RUNNING, *out, End.RUNNING]
    assert ends(rows) == [End.RUNNING] * 8
    assert ends([rows[1]], crosses=1, steps=999) == [End.GOAL]
    assert ends([rows[1]], crosses=1, base_force=5.0) == [End.BASE_COLLISION]


def test_the_gravest_end_wins():
    assert ends([tilted(np.pi)], base_force=5.0, steps=999) == [End.BASE_COLLISION]
    assert ends([tilted(np.pi)], steps=999) == [End.TILT]
    assert ends([tilted(np.pi)], base_force=5.0, velocity=200.0, steps=999) == [End.INVALID]


def test_steps_are_counted_and_validity_is_marked():
    episodes = judge([UPRIGHT, UPRIGHT], velocity=[0.0, np.nan], steps=[3, 4])
    assert episodes.steps.numpy().tolist() == [4, 5]
    assert episodes.valid.numpy().tolist() == [1, 0]


def test_a_touch_noted_within_a_step_ends_it_and_not_the_next():
    episodes = episodes_of(2)
    rows, roles = wp.array(np.float32([UPRIGHT] * 2), dtype=float), wp.array(ROLES, dtype=int)
    still, touched = np.zeros((2, 2, 3), np.float32), np.zeros((2, 2, 3), np.float32)
    touched[1, 0, 2] = 40.0  # on the base
    touched[0, 1, 2] = 500.0  # on a foot
    for force in (touched, still):
        note_base_forces(wp.array(force, dtype=wp.vec3), roles, episodes)
    assert episodes.base_force.numpy().tolist() == [0.0, 40.0]
    seen = []
    for _ in range(2):
        judge_steps(rows, wp.zeros((2, 7), dtype=float), make_rules(), episodes)
        seen.append([End(end) for end in episodes.end.numpy()])
    assert seen == [[End.RUNNING, End.BASE_COLLISION], [End.RUNNING] * 2]


def test_a_fall_is_a_collision_of_the_base_a_tilt_or_an_invalid_state():
    rows = [UPRIGHT, UPRIGHT, tilted(np.pi), UPRIGHT, (*UPRIGHT[:7], np.nan)]
    episodes = judge(rows, base_force=[0.0, 2.0, 0.0, 0.0, 2.0], steps=[3, 3, 3, 999, 3])
    assert [End(end) for end in episodes.end.numpy()] == [
        End.RUNNING, End.BASE_COLLISION, End.TILT, End.TIME_OUT, End.INVALID,
    ]  # fmt: skip
    assert episodes.fallen.numpy().tolist() == [0, 1, 1, 0, 1]


def test_statistics_add_up():
    episodes = episodes_of(4)
    episodes.end.assign(np.array([End.RUNNING, End.TIME_OUT, End.TILT, End.INVALID], np.int32))
    episodes.steps.assign(np.array([5, 1000, 20, 30], np.int32))
    episodes.reward.assign(np.float32([1, 2, 3, 4]))
    episodes.total_reward.assign(np.float32([10, 20, 30, 40]))
    episodes.command.assign(np.float32([[0.3, 0.4, 0.2]] * 4))
    joint_q = wp.array(np.float32([UPRIGHT] * 3 + [(*UPRIGHT[:7], np.nan)]), dtype=float)
    joint_qd = wp.zeros((4, 7), dtype=float)
    overflow = wp.array([1, 512 | 1024, 0, 2 | 512], dtype=int)
    record_steps(joint_q, joint_qd, wp.vec3(0.0), overflow, make_rules(), episodes)
    sums = dict(zip(STATISTICS, episodes.statistics.numpy().sum(0), strict=True))
    assert episodes.total_reward.numpy().tolist() == [11, 22, 33, 44]
    expected = {
        "steps": 4, "episodes": 3, "time_out": 1, "base_collision": 0, "tilt": 1, "invalid": 1, "overflow": 2,
        "episode_steps": 1050, "episode_reward": 99,
        "lin_vel_error": 3 * 0.5,  # hypot(.3, .4), of the three that are valid
        "yaw_rate_error": 3 * 0.2,
    }  # fmt: skip
    for name, value in expected.items():
        np.testing.assert_allclose(sums[name], value, rtol=1e-6, err_msg=name)
