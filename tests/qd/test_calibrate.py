"""Penalty scales from episodes by hand, and how many terrains are crossed for them."""

import json
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.calibrate import calibrate, measured
from qd.workers.evaluator import Compute
from qd.workers.invalid import AllInvalidError
from sim.files.records import identity
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.qd import stand_in
from tests.qd.stand_in import Stub, make_result

ROBOT = get_robot("anymal")


@pytest.fixture(autouse=True)
def any_policy(monkeypatch):
    monkeypatch.setattr("qd.calibrate.check_policy", lambda *_: None)


def crossed(penalties, late, invalid=None):
    """Episodes on one terrain; (R, P), (R,) and (R,)."""
    return make_result([penalties], late=[late], invalid=None if invalid is None else [invalid])


def test_scales_are_means_over_failing_episodes():
    # 100 episodes fail with 1, 4 and 100 with 3, 0: means 2 and 2. That 300 reach the goal with 9, 8 changes nothing.
    rows = [[1, 4]] * 100 + [[3, 0]] * 100 + [[9, 8]] * 300
    numbers = measured(crossed(rows, [True] * 200 + [False] * 300))
    assert numbers["scales"] == {"yaw_rate": 2.0, "vel_x": 2.0} and numbers["scaled_by"] == "failing"
    assert numbers["share_of_episodes_with"] == {"yaw_rate": 1.0, "vel_x": 0.5}


def test_with_fewer_than_200_failing_episodes_scales_are_means_over_all():
    # One of the 200 is invalid: 199 of 1, 4 fail, 199 reach the goal with 3, 8. Means (1 + 3) / 2 and (4 + 8) / 2.
    rows = [[1, 4]] * 199 + [[np.nan, np.nan]] + [[3, 8]] * 199
    numbers = measured(crossed(rows, [True] * 200 + [False] * 199, invalid=[False] * 199 + [True] + [False] * 199))
    assert numbers["scales"] == {"yaw_rate": 2.0, "vel_x": 6.0} and numbers["scaled_by"] == "all"
    assert (numbers["episodes"], numbers["invalid_episodes"], numbers["failing_episodes"]) == (399, 1, 199)


def test_a_penalty_that_never_occurs_in_a_failing_episode_has_no_scale():
    rows = [[1, 0]] * 200 + [[1, 5]]
    assert measured(crossed(rows, [True] * 200 + [False]))["scales"] == {"yaw_rate": 1.0}


class Robots:
    """The stand-in, whose result is changed; notes how many terrains it crosses each time; then Ctrl-C."""

    def __init__(self, change=lambda result: result, stop_after=None):
        self.change, self.stop_after, self.counts = change, stop_after, []

    @contextmanager
    def __call__(self, cfg):
        def evaluate(genes, seeds, progress=None):
            if self.stop_after is not None and sum(self.counts) >= self.stop_after:
                raise KeyboardInterrupt
            self.counts.append(len(genes))
            return self.change(stand_in.evaluate(genes, seeds, cfg.num_replicas))

        yield Stub(evaluate)


def failing(share):
    """Changes a result so that a share of each terrain's episodes misses the goal."""

    def change(result):
        late = np.arange(result.invalid.shape[1]) < share * result.invalid.shape[1]
        outcome = np.where(late, Outcome.TIME_OUT, Outcome.GOAL).astype(np.uint8)
        return replace(result, outcome=np.broadcast_to(outcome, result.invalid.shape).copy())

    return change


def calibrated(out, robots, **changes):
    values = {"compute": Compute(workers="1"), "out": out, "cache": out.parent / "crossings", **changes}
    return calibrate(ROBOT, open_evaluator=robots, **values)


def test_the_file_is_what_the_robot_reads(tmp_path, monkeypatch):
    out = tmp_path / "anymal.scales.json"
    calibrated(out, Robots(), terrains=12, most_terrains=12, replicas=4)
    monkeypatch.setattr(RobotCfg, "scales_file", property(lambda self: out))
    content = json.loads(out.read_text())
    assert ROBOT.read_penalty_scales() == tuple(content["scales"].values())
    assert (content["terrains"], content["episodes"], content["invalid_episodes"], content["seed"]) == (12, 48, 0, 0)
    assert set(content) >= {"command", "commit", "device", "versions", "seed", "date", "share_of_episodes_with"}
    assert identity(ROBOT, ROBOT.policy_file).items() <= content.items()
    assert (content["space"], content["crossing"]["speed"]) == ("super_gaussian", 0.75)


def test_terrains_are_added_until_200_episodes_failed(tmp_path):
    # 8 terrains x 20 episodes, of which a quarter fails: 40 after 8 terrains, 200 after 40.
    out, robots = tmp_path / "scales.json", Robots(failing(0.25))
    calibrated(out, robots, terrains=8)
    content = json.loads(out.read_text())
    assert sum(robots.counts) == content["terrains"] == 40
    assert (content["failing_episodes"], content["scaled_by"]) == (200, "failing")
    genes = SUPER_GAUSSIAN.hard_random(40, 0)
    whole = failing(0.25)(stand_in.evaluate(genes, np.random.SeedSequence(0).generate_state(40, np.uint32), 20))
    means = whole.penalties[~whole.reached_goal].mean(axis=0)
    np.testing.assert_array_equal(list(content["scales"].values()), means)


def test_a_controller_that_seldom_fails_is_scaled_by_all_episodes(tmp_path, capsys):
    # One of 20 fails: 8, 16 and, as no more are drawn, 20 terrains; 20 failures of 400 episodes.
    content = calibrated(tmp_path / "scales.json", Robots(failing(0.05)), terrains=8, most_terrains=20)
    assert (content["terrains"], content["failing_episodes"], content["scaled_by"]) == (20, 20, "all")
    assert "only 20 did not reach the goal" in capsys.readouterr().out


def test_what_was_crossed_before_a_stop_is_not_crossed_again(tmp_path):
    stopped, rest = Robots(failing(0.2), stop_after=21), Robots(failing(0.2))
    with pytest.raises(KeyboardInterrupt):
        calibrated(tmp_path / "scales.json", stopped, terrains=20)
    again = calibrated(tmp_path / "scales.json", rest, terrains=20)
    assert sum(stopped.counts) + sum(rest.counts) == again["terrains"] == 60
    whole = calibrated(tmp_path / "whole.json", Robots(failing(0.2)), terrains=20, cache=None)
    assert again["scales"] == whole["scales"]
    other = Robots()
    calibrated(tmp_path / "scales.json", other, terrains=20, most_terrains=20, seed=1)
    assert sum(other.counts) == 20


def test_an_absent_penalty_shows_early_and_the_scales_of_the_others_are_kept(tmp_path, capsys):
    out = tmp_path / "scales.json"
    without = Robots(lambda result: replace(result, penalties=result.penalties * (np.arange(6) > 0)))
    with pytest.raises(ValueError, match="yaw_rate"):
        calibrated(out, without, terrains=40, most_terrains=40)
    assert "In the first 320 episodes yaw_rate never occurred." in capsys.readouterr().out
    assert list(json.loads(out.read_text())["scales"]) == list(stand_in.PENALTIES[1:])


def test_where_nothing_is_valid_the_first_few_end_it(tmp_path):
    robots = Robots(lambda result: make_result(result.penalties, invalid=np.ones(result.invalid.shape, bool)))
    with pytest.raises(AllInvalidError):
        calibrated(tmp_path / "scales.json", robots)
    assert sum(robots.counts) == 16


def test_mistakes_are_found_before_the_work(tmp_path):
    nobody = Robots(stop_after=0)
    for out, named in ((Path("/proc/missing/scales.json"), "/proc/missing"), (tmp_path, str(tmp_path))):
        with pytest.raises(ValueError, match=named):
            calibrated(out, nobody, cache=None)
    with pytest.raises(ValueError, match="terrains"):
        calibrated(tmp_path / "scales.json", nobody, terrains=0)
    with pytest.raises(ValueError, match="out"):
        calibrate(ROBOT, "mine.pt", compute=Compute(), open_evaluator=nobody)
