import dataclasses
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kernels.episode import Outcome
from qd.show.view.scene import (
    arrow_mesh,
    find_marks,
    group_episodes,
    robot_shapes,
    set_arrow,
    trace_crossing,
    trace_paths,
)
from sim.robots.skeleton import Skeleton
from tests.qd.recordings import recording_of

FRAMES = 6


@pytest.fixture(scope="module")
def skeleton(anymal):
    return Skeleton(anymal)


@pytest.fixture(scope="module")
def recording():
    """Episodes of 6, 4 and 0 frames: 0.1 m along x a frame, turned left; penalty j grows by j + 1 a frame."""
    outcomes = [Outcome.BASE_COLLISION, Outcome.TIME_OUT, Outcome.INVALID]
    sums = 5.0 * np.tile(np.arange(1, 7), (3, 1))
    made = recording_of(outcomes, [2.5] * 3, penalties=sums, fallen=[True, False, False], frames=FRAMES)
    force = made.foot_force.copy()
    force[:, :, 1:, 0, 2] = 500.0
    return dataclasses.replace(
        made,
        num_frames=np.array([[FRAMES, 4, 0]]),
        base_quaternion=np.full_like(made.base_quaternion, np.sqrt(0.5)) * np.float32([1, 0, 0, 1]),
        foot_force=force,
        command=made.command + np.float32([0.75, 0.25, 0.5]),
    )


def test_an_episode_is_shown_as_it_was_recorded(skeleton, recording):
    names = recording.penalty_names[::-1]
    crossing = trace_crossing(recording, 0, skeleton, dict.fromkeys(names, 2.0))
    assert (len(crossing.positions), crossing.ending) == (FRAMES, "hits the ground after 0.1 s · fallen")
    np.testing.assert_allclose(crossing.positions[3, 0], [2.3, 4.0, 0.0], atol=1e-6)
    # penalty j sums j + 1 a frame; shown in the order asked for, divided by 2
    np.testing.assert_allclose(crossing.penalties[2], np.arange(len(names), 0, -1.0))
    first, last = crossing.forces[0], crossing.forces[4]
    assert (first[:, 0] == first[:, 1]).all()  # none at the start
    np.testing.assert_allclose(last[0, 1] - last[0, 0], [0.0, 0.0, 0.5])  # 500 N
    assert (last[1:, 0] == last[1:, 1]).all()
    assert [crossing.find_frame(time_s) for time_s in (0.0, 0.021, 99.0)] == [0, 1, FRAMES - 1]
    assert trace_crossing(recording, 2, skeleton, {}) is None  # it broke at once


def test_the_command_points_where_the_robot_is_told_to_go(skeleton, recording):
    begin, end = trace_crossing(recording, 0, skeleton, {}).command[0]
    # it looks along y: .75 forward is along y, .25 to its left against x
    np.testing.assert_allclose(end - begin, [-0.25, 0.75, 0.0], atol=1e-6)
    np.testing.assert_allclose(begin[:2], [2.0, 4.0], atol=1e-6)


def test_paths_of_all_episodes(recording):
    paths = trace_paths(recording, every=2)
    assert [len(points) for points, _ in paths] == [4, 3, 0]  # frames 0 2 4 5, and 0 2 3
    np.testing.assert_allclose(paths[1][0][:, 0], [2.0, 2.2, 2.3], atol=1e-6)


def test_marks_stand_where_things_happen_first():
    made = recording_of([Outcome.BASE_COLLISION, Outcome.GOAL], [6.0, 14.0])
    sums = np.zeros((1, 2, 21, 6), np.float32)
    sums[0, 0, 8:, 4] = 0.005  # a stumble in the control step before frame 8, 0.16 s
    sums[0, 0, 12:, 5] = 0.005
    quaternion = made.base_quaternion.copy()
    tilts = np.deg2rad(np.where(np.arange(21) < 15, 59.0, 61.0))
    quaternion[0, 0] = np.stack([np.cos(tilts / 2), np.sin(tilts / 2), 0 * tilts, 0 * tilts], axis=1)
    made = dataclasses.replace(made, penalties=sums, base_quaternion=quaternion)
    marks = find_marks(made, 0)
    assert [words for _, words in marks] == ["first stumble", "first collision", "fall", "end: hits the ground"]
    np.testing.assert_allclose([time_s for time_s, _ in marks], [0.16, 0.24, 0.30, 0.40])
    assert find_marks(made, 1) == ((pytest.approx(0.4), "end: reaches the goal"),)


def test_a_robot_that_gets_stuck_has_a_mark_where_it_stays():
    made = recording_of([Outcome.TIME_OUT], [6.0], penalties=np.zeros((1, 6)))  # 0.2 m a frame, from 2 m to 6 m
    # frame 19 lies within 0.3 m of the end
    assert find_marks(made, 0) == ((pytest.approx(0.38), "stuck"), (pytest.approx(0.40), "end: gets stuck"))


def test_episodes_are_offered_by_how_they_ended():
    outcomes = [Outcome.TIME_OUT, Outcome.GOAL, Outcome.TIME_OUT, Outcome.BASE_COLLISION]
    made = recording_of(outcomes, [6.0] * 4, fallen=[False, False, True, True])
    assert group_episodes(made) == [
        ("2 of 4: gets stuck", [(1, "episode 1: gets stuck"), (3, "episode 3: gets stuck · fallen")]),
        ("1 of 4: reaches the goal", [(2, "episode 2: reaches the goal")]),
        ("1 of 4: hits the ground", [(4, "episode 4: hits the ground · fallen")]),
    ]


def test_each_part_of_a_robot_shows_one_touch(robot):
    shapes = robot_shapes(Skeleton(robot), robot)
    assert len({(shape.body, shape.touches) for shape in shapes}) == len(shapes)
    assert {column for shape in shapes for column in shape.touches} == set(range(len(robot.geom_names)))
    foot = next(shape.mesh for shape in shapes if shape.is_foot)
    # Of ANYmal's 0.19, 0.19, 0.20 of 1, sRGB 0.19 is (.19 + .055 over 1.055) ** 2.4 = .030 of the light: 8 of 255.
    if robot.name == "anymal":
        assert foot.visual.vertex_colors[0].tolist() == [8, 8, 8, 255]


def test_an_arrow_points_from_its_beginning_to_its_end():
    begin, way = np.array([1.0, 2.0, 3.0]), np.array([0.3, -0.4, 1.2])
    arrow = SimpleNamespace()
    set_arrow(arrow, np.stack([begin, begin + way]))
    assert arrow.visible and arrow.position == (1.0, 2.0, 3.0)
    np.testing.assert_allclose(arrow_mesh().bounds[:, 2], [0.0, 1.0], atol=1e-6)
    turn = Rotation.from_quat(np.roll(arrow.wxyz, -1))
    np.testing.assert_allclose(turn.apply([0.0, 0.0, arrow.scale[2]]), way, atol=1e-5)
