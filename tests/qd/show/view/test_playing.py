import numpy as np
import pytest

from qd.show.view.playing import crossing_of, endings, moment_text, paths_of, rotated
from qd.show.view.plots import Curves, axes_svg
from sim.robots.skeleton import Skeleton
from tests.qd.show.view.made import FRAMES, make_recording


@pytest.fixture(scope="module")
def skeleton(robot):
    return Skeleton(robot)


@pytest.fixture(scope="module")
def recording(robot):
    seeds = np.array([1], np.uint32)
    return make_recording(robot, np.zeros((1, 64), np.float32), seeds=seeds, policy_sha256="0")


def test_an_episode_is_shown_as_it_was_recorded(robot, skeleton, recording):
    names = robot.penalties[::-1]
    crossing = crossing_of(recording, 0, skeleton, names, [2.0] * len(names))
    assert (crossing.num_frames, crossing.ending) == (FRAMES, "base collision · fallen")
    np.testing.assert_allclose(crossing.times_s, 0.02 * np.arange(FRAMES))
    np.testing.assert_allclose(crossing.positions[3, 0], [2.3, 4.0, 0.6], atol=1e-6)
    # penalty j sums j + 1 a frame; shown in the order asked for, divided by 2
    np.testing.assert_allclose(crossing.penalties[2], np.arange(len(names), 0, -1.0))
    first, last = crossing.forces[0], crossing.forces[4]
    assert (first[:, 0] == first[:, 1]).all()  # none at the start
    np.testing.assert_allclose(last[0, 1] - last[0, 0], [0.0, 0.0, 0.5])  # 500 N
    assert (last[1:, 0] == last[1:, 1]).all()
    assert crossing.force_newtons[4].tolist() == [500.0] + [0.0] * (len(robot.foot_geoms) - 1)


def test_the_command_points_where_the_robot_is_told_to_go(skeleton, recording):
    crossing = crossing_of(recording, 0, skeleton, (), ())
    begin, end = crossing.command[0]
    # it looks along y: .75 forward is along y, .25 to its left against x
    np.testing.assert_allclose(end - begin, [-0.25, 0.75, 0.0], atol=1e-6)
    np.testing.assert_allclose(begin[:2], [2.0, 4.0], atol=1e-6)
    text = moment_text(crossing, 0, ())
    assert "Command: 0.75, 0.25 m/s, 0.50 rad/s" in text and "base at 2.00, 4.00, 0.60 m" in text


def test_forces_begin_at_the_feet(robot, skeleton, recording):
    crossing = crossing_of(recording, 0, skeleton, (), ())
    foot = skeleton.geom(robot.foot_geoms[0])
    expected = crossing.positions[4, foot.body] + rotated(crossing.quaternions[4, foot.body], foot.position)
    np.testing.assert_allclose(crossing.forces[4, 0, 0], expected)


def test_an_episode_that_broke_at_once_has_nothing_to_show(skeleton, recording):
    assert crossing_of(recording, 1, skeleton, (), ()).ending == "out of time"
    assert crossing_of(recording, 2, skeleton, (), ()) is None


def test_ways_and_endings_of_all_episodes(recording):
    paths = paths_of(recording, every=2)
    assert [len(points) for points, _ in paths] == [4, 3, 0]  # frames 0 2 4 5, and 0 2 3
    np.testing.assert_allclose(paths[1][0][:, 0], [2.0, 2.2, 2.3], atol=1e-6)
    assert "1 base collision" in endings(recording) and "1 out of time" in endings(recording)
    assert "goal" not in endings(recording)


def test_the_mark_of_the_curves_moves_with_time():
    curves = Curves(np.array([0.0, 1.0, 2.0]), np.array([[0.0, 0.0], [1.0, 2.0], [4.0, 2.0]]), ("one", "<two>"))
    begin, end = curves.at(0.0), curves.at(2.0)
    assert begin != end and begin.count("<path") == 2
    assert "&lt;two&gt;" in begin and ">4<" in begin  # the largest sum


def test_the_plot_greys_what_ranges_leave_out(axes):
    everything = axes_svg(axes, np.arange(20), {}, picked=3)
    some = axes_svg(axes, np.array([1, 2]), {"goal_rate": (0.05, 0.1)}, picked=None)
    lines = lambda svg: svg.count("M") - svg.count("</text>M")  # noqa: E731  # a line an elite
    assert lines(everything) == 21 and lines(some) == 20
    assert everything.count("<rect") == 0 and some.count("<rect") == 1
    assert axes_svg(axes, np.array([], int), {}, None).count('stroke="#d8d8d8"') == 1
