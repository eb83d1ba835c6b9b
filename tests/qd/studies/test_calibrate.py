import json
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.studies.calibrate import Calibrate, penalty_scales
from qd.workers.invalid import AllInvalidError
from sim.files.command import Interrupted
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


def test_a_penalty_that_never_occurs_has_no_scale():
    assert penalty_scales(make_result([[[1, 0], [3, 0]]])) == {"yaw_rate": 2.0}


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


def opener(change, calls):
    """Opens an evaluator whose penalties are changed; notes how many terrains it crossed each time."""

    @contextmanager
    def opened(cfg):
        def evaluate(genes, seeds, progress=None):
            calls.append((len(genes), cfg.num_replicas))
            return change(stand_in.evaluate(genes, seeds, cfg.num_replicas), len(calls))

        yield evaluate

    return opened


def without_yaw_rate(result, call):
    return replace(result, penalties=result.penalties * (np.arange(6) > 0))


def test_a_look_first_says_that_a_penalty_did_not_occur_and_the_others_are_kept(tmp_path, any_policy, capsys):
    # 40 terrains x 20 episodes: a look at 16 x 5 of them, then 16, 16 and 8 at a time. The scales of the other five
    # penalties fit a robot that is not punished for the first.
    out, calls = tmp_path / "scales.json", []
    with pytest.raises(ValueError, match=f"yaw_rate: 0 in all 800 valid episodes.*{out}"):
        Calibrate(device="cpu", terrains=40, out=out).execute(open_evaluator=opener(without_yaw_rate, calls))
    assert calls == [(16, 5), (16, 20), (16, 20), (8, 20)]
    assert "Penalty 'yaw_rate' is 0 in all 80 of them" in capsys.readouterr().out
    assert list(json.loads(out.read_text())["scales"]) == list(stand_in.PENALTIES[1:])


def test_where_nothing_is_valid_the_look_ends_it(tmp_path, any_policy):
    def nothing(result, call):
        return make_result(result.penalties, invalid=np.ones(result.invalid.shape, bool))

    calls = []
    with pytest.raises(AllInvalidError, match=r"all 80 episodes are invalid \(80 non-finite state\)"):
        Calibrate(device="cpu", out=tmp_path / "scales.json").execute(open_evaluator=opener(nothing, calls))
    assert calls == [(16, 5)]


def test_what_was_crossed_before_a_stop_is_not_crossed_again(tmp_path, any_policy):
    def stopped(result, call):
        if call == 4:  # after the look and two turns
            raise KeyboardInterrupt
        return result

    out, calls = tmp_path / "scales.json", []
    calibrate = Calibrate(device="cpu", terrains=40, out=out)
    with pytest.raises(Interrupted, match=r"kept in .*scales\.part\.npz.*goes on"):
        calibrate.execute(open_evaluator=opener(stopped, calls))
    calls.clear()
    calibrate.execute(open_evaluator=opener(lambda result, call: result, calls))
    assert calls == [(8, 20)] and not (tmp_path / "scales.part.npz").exists()
    whole = tmp_path / "whole.json"
    Calibrate(device="cpu", terrains=40, out=whole).execute(open_evaluator=stand_in.open_stand_in)
    assert json.loads(out.read_text())["scales"] == json.loads(whole.read_text())["scales"]


def test_kept_crossings_of_another_seed_are_not_taken(tmp_path, any_policy):
    calls = []
    with pytest.raises(Interrupted):
        Calibrate(device="cpu", terrains=40, out=tmp_path / "a.json").execute(open_evaluator=opener(stop_at_3, calls))
    calls.clear()
    again = Calibrate(device="cpu", terrains=40, seed=1, out=tmp_path / "a.json")
    again.execute(open_evaluator=opener(lambda result, call: result, calls))
    assert calls == [(16, 5), (16, 20), (16, 20), (8, 20)]


def stop_at_3(result, call):
    if call == 3:
        raise KeyboardInterrupt
    return result


def test_a_scale_of_few_episodes_is_told(tmp_path, any_policy, capsys):
    def rare(result, call):
        rows = np.arange(result.penalties.shape[0] * result.penalties.shape[1]).reshape(result.invalid.shape)
        result.penalties[..., 4] = rows < 29  # of 48 episodes; the look is left out where there are so few
        return result

    out = tmp_path / "scales.json"
    Calibrate(device="cpu", terrains=12, replicas=4, out=out).execute(open_evaluator=opener(rare, []))
    assert "of 29 episodes alone" in capsys.readouterr().out


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
