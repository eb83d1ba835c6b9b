import json
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.studies.calibrate import Calibrate, Crossed, penalty_scales
from qd.workers.invalid import AllInvalidError
from sim.files.command import Interrupted
from sim.files.records import identity
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.qd import stand_in
from tests.qd.stand_in import make_result


def crossed(penalties, reached, invalid=None):
    """Episodes on one terrain; (R, P), (R,) and (R,)."""
    penalties = np.asarray([penalties], float)
    return Crossed(
        penalties=penalties,
        invalidity=np.zeros((1, len(reached)), np.uint8) if invalid is None else np.uint8([invalid]),
        reached_goal=np.array([reached], bool),
        penalty_names=stand_in.PENALTIES[: penalties.shape[2]],
    )


def test_scales_are_means_over_failing_episodes():
    # 100 episodes fail with 1, 4 and 100 with 3, 0: means 2 and 2. That 300 reach the goal with 9, 8 changes nothing.
    rows = [[1, 4]] * 100 + [[3, 0]] * 100 + [[9, 8]] * 300
    assert penalty_scales(crossed(rows, [False] * 200 + [True] * 300)) == {"yaw_rate": 2.0, "vel_x": 2.0}


def test_with_fewer_than_200_failing_episodes_scales_are_means_over_all():
    # One of the 200 is invalid: 199 of 1, 4 fail, 199 reach the goal with 3, 8. Means (1 + 3) / 2 and (4 + 8) / 2.
    rows = [[1, 4]] * 199 + [[np.nan, np.nan]] + [[3, 8]] * 199
    some = crossed(rows, [False] * 200 + [True] * 199, invalid=[0] * 199 + [2] + [0] * 199)
    assert penalty_scales(some) == {"yaw_rate": 2.0, "vel_x": 6.0}


def test_a_penalty_that_never_occurs_in_a_failing_episode_has_no_scale():
    rows = [[1, 0]] * 200 + [[1, 5]]
    assert penalty_scales(crossed(rows, [False] * 200 + [True])) == {"yaw_rate": 1.0}


@pytest.fixture
def any_policy(monkeypatch):
    monkeypatch.setattr("qd.workers.evaluator.check_policy", lambda *_: None)


def test_the_file_is_what_the_robot_reads(tmp_path, any_policy, monkeypatch):
    from sim.robots.find import get_robot
    from sim.robots.robot import RobotCfg

    out = tmp_path / "anymal.scales.json"
    Calibrate(device="cpu", terrains=12, most_terrains=12, replicas=4, out=out).execute(
        open_evaluator=stand_in.open_stand_in
    )
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
    with pytest.raises(ValueError, match=f"yaw_rate: 0 in all 311 episodes that did not reach.*{out}"):
        Calibrate(device="cpu", terrains=40, most_terrains=40, out=out).execute(
            open_evaluator=opener(without_yaw_rate, calls)
        )
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
    calibrate = Calibrate(device="cpu", terrains=40, most_terrains=40, out=out)
    with pytest.raises(Interrupted, match=r"kept in .*scales\.part\.npz.*goes on"):
        calibrate.execute(open_evaluator=opener(stopped, calls))
    calls.clear()
    calibrate.execute(open_evaluator=opener(lambda result, call: result, calls))
    assert calls == [(8, 20)] and not (tmp_path / "scales.part.npz").exists()
    whole = tmp_path / "whole.json"
    Calibrate(device="cpu", terrains=40, most_terrains=40, out=whole).execute(open_evaluator=stand_in.open_stand_in)
    assert json.loads(out.read_text())["scales"] == json.loads(whole.read_text())["scales"]


def fail(share):
    """Changes a result so that a share of each terrain's episodes misses the goal."""

    def change(result, call):
        missed = np.arange(result.invalid.shape[1]) < share * result.invalid.shape[1]
        return make_result(result.penalties, late=np.broadcast_to(missed, result.invalid.shape))

    return change


def test_terrains_are_added_until_200_episodes_failed(tmp_path, any_policy, capsys):
    # 8 terrains x 20 episodes, of which a quarter fails: 40 after 8 terrains, 200 after 40.
    out, calls = tmp_path / "scales.json", []
    Calibrate(device="cpu", terrains=8, out=out).execute(open_evaluator=opener(fail(0.25), calls))
    assert calls == [(8, 20)] * 5
    content = json.loads(out.read_text())
    assert (content["terrains"], content["episodes"], content["failing_episodes"]) == (40, 800, 200)
    assert content["scaled_by"] == "failing"
    said = capsys.readouterr().out
    assert "40 of 160 episodes did not reach the goal so far.\nCrossing 8 more hard-random terrains 20 times" in said
    assert "Means over 200 episodes that did not reach the goal, of 40 terrains" in said
    genes = SUPER_GAUSSIAN.hard_random(40, 0)
    whole = fail(0.25)(stand_in.evaluate(genes, np.random.SeedSequence(0).generate_state(40, np.uint32), 20), 0)
    means = whole.penalties[~whole.reached_goal].mean(axis=0)
    np.testing.assert_allclose(list(content["scales"].values()), means)


def test_a_controller_that_seldom_fails_is_scaled_by_all_episodes_and_told_so(tmp_path, any_policy, capsys):
    # One of 20 fails: 8, 16 and, as no more are drawn, 20 terrains; 20 failures of 400 episodes.
    out, calls = tmp_path / "scales.json", []
    Calibrate(device="cpu", terrains=8, most_terrains=20, out=out).execute(open_evaluator=opener(fail(0.05), calls))
    assert calls == [(8, 20), (8, 20), (4, 20)]
    content = json.loads(out.read_text())
    assert (content["terrains"], content["failing_episodes"], content["scaled_by"]) == (20, 20, "all")
    assert "Only 20 of 400 episodes did not reach the goal, expected at least 200" in capsys.readouterr().out


def test_a_stop_among_added_terrains_comes_to_the_same_scales(tmp_path, any_policy):
    def stopped(result, call):
        if call == 7:  # after the look, 16 and 4 terrains twice, and 16
            raise KeyboardInterrupt
        return fail(0.2)(result, call)

    # 4 of 20 episodes fail: 80 after 20 terrains, 160 after 40, 240 after 60. Stopped and resumed at 56, of which 200
    # and more have failed, it goes on to the end of the turn.
    out, calls = tmp_path / "scales.json", []
    calibrate = Calibrate(device="cpu", terrains=20, out=out)
    with pytest.raises(Interrupted):
        calibrate.execute(open_evaluator=opener(stopped, calls))
    calls.clear()
    calibrate.execute(open_evaluator=opener(fail(0.2), calls))
    assert calls == [(4, 20)]
    assert json.loads(out.read_text())["terrains"] == 60


def test_what_older_versions_kept_is_crossed_again(tmp_path, any_policy):
    calibrate, calls = Calibrate(device="cpu", terrains=40, most_terrains=40, out=tmp_path / "a.json"), []
    with pytest.raises(Interrupted):
        calibrate.execute(open_evaluator=opener(stop_at_3, calls))
    with np.load(tmp_path / "a.part.npz") as there:
        older = {name: there[name] for name in there.files if name != "reached_goal"}
    np.savez(tmp_path / "a.part.npz", **older)
    calls.clear()
    calibrate.execute(open_evaluator=opener(lambda result, call: result, calls))
    assert calls == [(16, 5), (16, 20), (16, 20), (8, 20)]


def test_kept_crossings_of_another_seed_are_not_taken(tmp_path, any_policy):
    calls = []
    with pytest.raises(Interrupted):
        Calibrate(device="cpu", terrains=40, most_terrains=40, out=tmp_path / "a.json").execute(
            open_evaluator=opener(stop_at_3, calls)
        )
    calls.clear()
    again = Calibrate(device="cpu", terrains=40, most_terrains=40, seed=1, out=tmp_path / "a.json")
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
    Calibrate(device="cpu", terrains=12, most_terrains=12, replicas=4, out=out).execute(open_evaluator=opener(rare, []))
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
