"""Penalty scales from episodes by hand, and how many terrains are crossed for them."""

import json
from dataclasses import replace

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.check import calibrate, find_fitting_height, measure_scales
from sim.controllers.spec import controller_identity
from sim.robots.find import get_robot, read_penalty_scales
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.qd import stand_in
from tests.qd.robots import Robots
from tests.qd.stand_in import compute_by, make_result

ROBOT = get_robot("anymal")


def crossed(penalties, late, invalid=None):
    """Episodes on one terrain; (R, P), (R,) and (R,)."""
    return make_result([penalties], late=[late], invalid=None if invalid is None else [invalid])


def test_scales_are_means_over_failing_episodes_or_over_all_if_under_200_fail():
    # 100 episodes fail with 1, 4 and 100 with 3, 0: means 2 and 2. That 300 reach the goal with 9, 8 changes nothing.
    rows = [[1, 4]] * 100 + [[3, 0]] * 100 + [[9, 8]] * 300
    numbers = measure_scales(crossed(rows, [True] * 200 + [False] * 300))
    assert numbers["scales"] == {"yaw_rate": 2.0, "vel_x": 2.0} and numbers["scaled_by"] == "failing"
    assert numbers["share_of_episodes_with"] == {"yaw_rate": 1.0, "vel_x": 0.5}
    # One of the 200 is invalid: 199 of 1, 4 fail, 199 reach the goal with 3, 8. Means (1 + 3) / 2 and (4 + 8) / 2.
    rows = [[1, 4]] * 199 + [[np.nan, np.nan]] + [[3, 8]] * 199
    invalid = [False] * 199 + [True] + [False] * 199
    numbers = measure_scales(crossed(rows, [True] * 200 + [False] * 199, invalid))
    assert numbers["scales"] == {"yaw_rate": 2.0, "vel_x": 6.0} and numbers["scaled_by"] == "all"
    assert (numbers["episodes"], numbers["invalid_episodes"], numbers["failing_episodes"]) == (399, 1, 199)


def robots(change=lambda result: result, **kwargs):
    """The stand-in, whose result is changed."""
    return Robots(lambda cfg, genes, seeds: change(stand_in.evaluate(genes, seeds, cfg.replicas)), **kwargs)


def failing(share):
    """Changes a result so that a share of each terrain's episodes misses the goal."""

    def change(result):
        late = np.arange(result.invalid.shape[1]) < share * result.invalid.shape[1]
        outcome = np.where(late, Outcome.TIME_OUT, Outcome.GOAL).astype(np.uint8)
        return replace(result, outcome=np.broadcast_to(outcome, result.invalid.shape).copy())

    return change


@pytest.fixture(autouse=True)
def scales(tmp_path, monkeypatch):
    """File of the robot's scales."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(RobotCfg, "scales_file", tmp_path / "scales.json")
    return tmp_path / "scales.json"


def calibrated(opened, terrains, replicas=20):
    return calibrate(ROBOT, str(ROBOT.policy_file), compute=compute_by(opened), terrains=terrains, replicas=replicas)


def test_the_file_is_what_the_robot_reads(scales):
    calibrated(robots(), 12, replicas=4)
    content = json.loads(scales.read_text())
    assert read_penalty_scales(ROBOT) == tuple(content["scales"].values())
    assert (content["terrains"], content["episodes"], content["invalid_episodes"], content["seed"]) == (60, 240, 0, 0)
    assert controller_identity(ROBOT, ROBOT.policy_file).items() <= content.items()
    assert (content["space"], content["crossing"]["speed"]) == ("super_gaussian", 0.75)


def test_terrains_are_added_until_200_episodes_failed_and_a_stop_loses_nothing():
    # 8 terrains x 20 episodes, of which a quarter fails: 40 after 8 terrains, 200 after 40.
    stopped, rest = (robots(failing(0.25), stop_after=count) for count in (20, None))
    with pytest.raises(KeyboardInterrupt):
        calibrated(stopped, 8)
    content = calibrated(rest, 8)
    assert len(stopped.seeds) + len(rest.seeds) == content["terrains"] == 40 and rest.seeds
    assert (content["failing_episodes"], content["scaled_by"]) == (200, "failing")
    genes = SUPER_GAUSSIAN.hard_random(40, 0)
    whole = failing(0.25)(stand_in.evaluate(genes, np.random.SeedSequence(0).generate_state(40, np.uint32), 20))
    means = whole.penalties[~whole.reached_goal].mean(axis=0)
    np.testing.assert_array_equal(list(content["scales"].values()), means)


def test_a_penalty_that_never_occurs_is_refused_once_all_scales_are_written(scales):
    without = robots(lambda result: replace(result, penalties=result.penalties * (np.arange(6) > 0)))
    with pytest.raises(ValueError, match="yaw_rate"):
        calibrated(without, 20)
    assert list(json.loads(scales.read_text())["scales"]) == list(stand_in.PENALTIES[1:])


@pytest.mark.parametrize(("crossed_up_to", "expected"), [(0.30, 0.25), (0.11, 0.1), (0.04, 0.04), (0.001, 0.02)])
def test_terrain_is_as_high_as_the_controller_crosses_it_mostly(crossed_up_to, expected):
    heights = []

    class Crosses:
        def cross(self, policy, terrains, *, replicas, label):
            heights.append(terrains.space.height)
            result = stand_in.evaluate(terrains.genes, terrains.seeds, replicas)
            return failing(0.0 if heights[-1] <= crossed_up_to else 0.5)(result)

    height, share = find_fitting_height(Crosses(), "policy.pt")
    assert height == expected and (share >= 0.8) == (height <= crossed_up_to)
    assert heights[0] == 0.25 and len(heights) <= 5
