"""Level ground before all else: what is measured of a user's robot, what time it gets, and who is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.evaluate.level import give_time, measure_level_ground, report_level_ground
from qd.workers.crosser import Crosser
from sim.robots.find import get_robot
from tests.qd import stand_in
from tests.qd.robots import Robots
from tests.qd.stand_in import compute_by
from tests.sim.dogs import CONTROLLER, write_toml

POSE = "default_joint_pos = {'.*hip' = 0.6, '.*knee' = -1.2}\n"


@pytest.fixture
def dog(tmp_path, monkeypatch):
    """Makes a robot.toml with more lines, and a controller."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "trot.py").write_text(CONTROLLER)
    return lambda more="": get_robot(str(write_toml(tmp_path / "dog", POSE + more)))


def robots(x, *, time_s=20.0, goals=20):
    """Robots that end at ``x`` after ``time_s``; so many of 20 have reached the goal, the others are out of time."""

    def rule(cfg, heights, seeds):
        result = stand_in.evaluate(heights, seeds, cfg.replicas)
        outcome = np.where(np.arange(cfg.replicas) < goals, Outcome.GOAL, Outcome.TIME_OUT).astype(np.uint8)
        end = np.broadcast_to(np.array([x, 4.0, 0.3], np.float32), result.final_position.shape).copy()
        time = np.full_like(result.duration_s, time_s)
        return replace(result, final_position=end, outcome=outcome[None], duration_s=time)

    return Robots(rule)


# The start is at x = 2 m, the goal at 14 m; at x = 12 m, 10 m are done.
@pytest.mark.parametrize(
    ("more", "x", "time_s", "expected"),
    [
        ("", 12.0, 20.0, 30.0),  # 0.5 m/s: 24 s, times 1.25
        ("", 12.0, 10.0, 20.0),  # 1 m/s: 15 s are less than 20 s
        ("", 2.0 + 0.14 * 20.0, 20.0, 20.0),  # 0.14 m/s: it does not walk
        ("", -3.0, 20.0, 20.0),  # away from the goal
        ("max_duration_s = 25.0\n", 12.0, 20.0, 25.0),  # the user's
        ("max_duration_s = 25.0  # 12 m at 0.600 m/s, times 1.25\n", 12.0, 20.0, 30.0),  # of another contract
    ],
)
def test_a_slow_controller_gets_the_time_that_it_needs(dog, more, x, time_s, expected):
    robot = dog(more)
    longer = give_time(robot, "trot.py:Trot", compute_by(robots(x, time_s=time_s)))
    assert longer.max_duration_s == expected and longer == get_robot(robot.spec)


def test_level_ground_is_measured_once_a_robot_and_controller(dog):
    robot, opened = dog(), robots(12.0)
    for mujoco_c, simulations in ((False, 1), (False, 1), (True, 2), (True, 2)):
        with Crosser(robot, compute_by(opened)) as crosser:
            walks = measure_level_ground(crosser, "trot.py:Trot", mujoco_c=mujoco_c)
        assert len(opened.opened) == simulations
    assert walks["searched"] == walks["mujoco_c"]
    (file,) = robot.home.glob("*.level.json")
    content = json.loads(file.read_text())
    assert (content["flat_goal"], content["flat_goal_mujoco_c"], content["flat_episodes"]) == (1.0, 1.0, 20)
    assert content["flat_speed"] == pytest.approx(0.5)
    report_level_ground(replace(robot, speed=0.5), "trot.py:Trot", compute_by(opened))  # another robot
    assert len(opened.opened) == 3


@pytest.mark.parametrize(("goals", "fails"), [(18, False), (17, True)])
def test_a_controller_that_does_not_cross_level_ground_is_refused(dog, anymal, capsys, goals, fails):
    robot, compute = dog(), compute_by(robots(12.0, goals=goals))
    if fails:
        with pytest.raises(ValueError, match="max_duration_s"):
            report_level_ground(robot, "trot.py:Trot", compute, must_walk=True)
    else:
        report_level_ground(robot, "trot.py:Trot", compute, must_walk=True)
    report_level_ground(robot, "trot.py:Trot", compute)
    assert ("not walk" in capsys.readouterr().out) == fails
    report_level_ground(anymal, "missing.pt", compute, must_walk=True)  # a shipped robot: nothing is measured
