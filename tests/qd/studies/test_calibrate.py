import json
from pathlib import Path

import numpy as np
import pytest

from qd.studies.calibrate import Calibrate, penalty_scales
from sim.robots.identity import identity
from tests.qd import stand_in
from tests.qd.stand_in import make_result


def test_scales_by_hand():
    # yaw_rate occurs in all four episodes: mean (1 + 3 + 2 + 2) / 4 = 2; vel_x in two of four, which is not less than
    # half: mean over all, 8 / 4 = 2; vel_y in one of four, so it is 0 in over half: mean over the others, 6
    result = make_result([[[1, 2, 6], [3, 6, 0]], [[2, 0, 0], [2, 0, 0]]])
    assert penalty_scales(result) == {"yaw_rate": 2.0, "vel_x": 2.0, "vel_y": 6.0}


def test_invalid_episodes_are_left_out():
    result = make_result([[[1, 2], [np.nan, np.nan], [3, 2]]], invalid=[[False, True, False]])
    assert penalty_scales(result) == {"yaw_rate": 2.0, "vel_x": 2.0}


def test_a_penalty_that_never_occurs_is_named():
    with pytest.raises(ValueError, match="penalty 'vel_x' is 0 in all 2 episodes"):
        penalty_scales(make_result([[[1, 0], [3, 0]]]))


def test_no_valid_episode():
    with pytest.raises(ValueError, match="no episode was valid"):
        penalty_scales(make_result([[[1, 1]]], invalid=[[True]]))


@pytest.fixture
def any_policy(monkeypatch):
    monkeypatch.setattr("qd.workers.evaluator.check_policy", lambda *_: None)


def test_the_file_is_what_the_robot_reads(tmp_path, any_policy, monkeypatch):
    from sim.robots.robot import RobotCfg, get_robot

    out = tmp_path / "anymal.scales.json"
    Calibrate(device="cpu", terrains=12, replicas=4, out=out).execute(open_evaluator=stand_in.open_stand_in)
    monkeypatch.setattr(RobotCfg, "scales_file", property(lambda self: out))
    content = json.loads(out.read_text())
    assert get_robot("anymal").read_penalty_scales() == tuple(content["scales"].values())
    assert (content["terrains"], content["episodes"], content["invalid_episodes"], content["seed"]) == (12, 48, 0, 0)
    assert set(content) >= {"command", "commit", "device", "versions", "seed", "date", "share_of_episodes_with"}
    robot = get_robot("anymal")
    assert identity(robot, robot.policy_file).items() <= content.items()
    assert (content["space"], content["crossing"]["speed"]) == ("super_gaussian", 0.75)


def test_mistakes_are_found_before_the_work(tmp_path, any_policy):
    with pytest.raises(ValueError, match="unknown robot 'dog': expected one of anymal"):
        Calibrate(robot="dog").execute(open_evaluator=stand_in.open_stand_in)
    with pytest.raises(ValueError, match="cannot write to /proc/missing: "):
        Calibrate(device="cpu", out=Path("/proc/missing/scales.json")).execute(open_evaluator=stand_in.open_stand_in)
    with pytest.raises(ValueError, match="is a directory, expected a file to write: name a file in it"):
        Calibrate(device="cpu", out=tmp_path).execute(open_evaluator=stand_in.open_stand_in)
    with pytest.raises(ValueError, match="terrains must be at least 1, got 0"):
        Calibrate(device="cpu", terrains=0).execute(open_evaluator=stand_in.open_stand_in)
    with pytest.raises(ValueError, match=r"those of its shipped controller, got another one .* name a file"):
        Calibrate(device="cpu", policy="mine.pt").execute(open_evaluator=stand_in.open_stand_in)
