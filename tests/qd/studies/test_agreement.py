"""How far rates lie from those of finer contact and of MuJoCo C: numbers by hand, what is crossed, stops, refusals."""

import dataclasses
import json
import os
from contextlib import contextmanager
from types import SimpleNamespace

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.archive import write_archive
from qd.studies.agreement import Agreement, Drawn, TerrainSet, drawn, report_of
from qd.workers import evaluator
from qd.workers.evaluator import EvaluatorCfg
from qd.workers.invalid import AllInvalidError
from sim.files.command import Interrupted, run_command
from sim.robots.robot import get_robot
from sim.space import SUPER_GAUSSIAN
from tests.builders import small_archive
from tests.qd import stand_in

WAYS = ("search", "again", "resolved", "mujoco_c", "mujoco_c_resolved")


def arrivals(*counts):
    """Outcomes of 4 episodes a terrain, of which so many arrive and the others are out of time."""
    return np.where(np.arange(4) < np.array(counts)[:, None], np.uint8(Outcome.GOAL), np.uint8(Outcome.TIME_OUT))


def not_crossed(*counts):
    """Likewise, for terrains of which the last is not crossed."""
    found = arrivals(*counts)
    found[-1] = Outcome.RUNNING
    return found


def test_sets_and_failing_elites_by_hand():
    genes = np.zeros((2, 64), np.float32)
    sets = {"hard_random": TerrainSet(number=[0, 1], genes=genes), "elites": TerrainSet(number=[7, 3], genes=genes)}
    who = Drawn(
        robot=get_robot("anymal"), policy="p", space=SUPER_GAUSSIAN, source="runs/x", sets=sets, seed=0, mujoco_c=1
    )
    assert who.in_mujoco_c.tolist() == [True, False, True, False]
    outcome = {
        "search": arrivals(4, 2, 1, 0),  # both elites fail
        "again": arrivals(4, 4, 2, 0),  # half arrive on the first: it does not fail again
        "resolved": arrivals(3, 2, 1, 1),
        "mujoco_c": arrivals(4, 2, 0, 0),
        "mujoco_c_resolved": np.concatenate([not_crossed(2, 0), not_crossed(0, 0)]),
    }
    report = report_of(who, outcome, seed=0)
    assert [report[key] for key in ("failing", "failing_again", "failing_resolved")] == [2, 1, 2]
    # 1 and .5 against .75 and .5; .25 and 0 against .25 and .25
    assert (
        report["hard_random"]["resolved"]["goal_bias"] == report["hard_random"]["resolved"]["goal_difference"] == 0.125
    )
    assert report["elites"]["resolved"]["goal_bias"] == -0.125
    assert report["elites"]["again"]["goal_difference"] == 0.125
    assert report["elites"]["resolved"]["success_bias"] == 0.0
    # terrains that were crossed in both: 1 against .5 by the search's settings, .75 against .5 by resolved contact
    assert [report["hard_random"][name]["terrains"] for name in ("mujoco_c", "mujoco_c_resolved")] == [2, 1]
    assert report["hard_random"]["mujoco_c_resolved"]["goal_bias"] == 0.5
    assert report["hard_random"]["both_resolved"]["goal_bias"] == 0.25
    assert report["elites"]["number"] == [7, 3]
    assert report["elites"]["rates"]["mujoco_c_resolved"]["goal"] == [0.0, None]


@pytest.fixture
def run(tmp_path, monkeypatch):
    """A run of five elites; controllers are not tried."""
    monkeypatch.setattr("qd.studies.agreement.check_policy", lambda *_: None)
    folder = tmp_path / "run"
    folder.mkdir()
    write_archive(folder / "archive.npz", small_archive(5))
    return folder


def opener(calls, change=lambda result, call: result):
    """Opens the stand-in; notes how many terrains were crossed, and whether with contact resolved."""

    @contextmanager
    def opened(cfg):
        def evaluate(genes, seeds, progress=None):
            calls.append((len(genes), cfg.resolved))
            return change(stand_in.evaluate(genes, seeds, cfg.num_replicas), len(calls))

        yield evaluate

    return opened


def in_plain_mujoco(asked, stop_after=99):
    """Stands for MuJoCo C: nobody arrives. Notes step, time constant, seeds and number of terrains."""

    def cross(robot, policy, heights, seeds, *, num_episodes, device, processes, time_constant_s, ground, crossed):
        asked.append((robot.physics_dt, time_constant_s, len(heights), seeds.tolist(), processes))
        for terrain in range(len(heights)):
            if terrain == stop_after:
                raise KeyboardInterrupt
            crossed(terrain, SimpleNamespace(outcome=np.full(num_episodes, Outcome.TIME_OUT, np.uint8)))

    return cross


def command(folder, **changes):
    given = {"run": folder, "terrains": 20, "elites": 4, "episodes": 4, "mujoco_c": 2, "device": "cpu"}
    return Agreement(**{"out": folder / "agreement.json", **given, **changes})


def test_what_is_crossed_how_often_and_from_which_starts(run, monkeypatch, capsys):
    calls, asked = [], []
    monkeypatch.setattr("sim.mujoco_c.crossing.cross_plain", in_plain_mujoco(asked))
    asks = command(run, workers="3")
    asks.execute(open_evaluator=opener(calls))
    # 24 terrains, 16 at a time: twice at the search's settings, once with contact resolved
    assert calls == [(16, False), (8, False)] * 2 + [(16, True), (8, True)]
    second = drawn(asks).seeds("again")
    assert len(set(second) | set(drawn(asks).seeds("search"))) == 48
    starts = second[[0, 1, 20, 21]].tolist()  # the first two of each set
    assert asked == [(0.005, None, 4, starts, 3), (0.001, 0.003, 4, starts, 3)]
    report = json.loads((run / "agreement.json").read_text())
    for name, count in (("hard_random", 20), ("elites", 4)):
        own = report[name]
        # The stand-in knows genes and seeds alone: the same second starts give the same rates.
        assert own["again"] == own["resolved"] and own["again"]["terrains"] == count
        assert own["rates"]["search"] != own["rates"]["again"] == own["rates"]["resolved"]
        assert own["mujoco_c"]["terrains"] == own["both_resolved"]["terrains"] == 2
        assert own["mujoco_c"]["goal_bias"] == pytest.approx(np.mean(own["rates"]["search"]["goal"][:2]))
    assert report["source"] == run.name and report["episodes"] == 4 and report["robot"] == "anymal"
    assert report.keys() >= {"command", "commit", "device", "versions", "seed", "date", "robot_sha256", "policy_sha256"}
    assert report["invalid_episodes"] == dict.fromkeys(WAYS, 0)
    assert not (run / "agreement.part.npz").exists()
    shown = capsys.readouterr().out
    assert "hard-random terrains (20): contact resolved\n  success" in shown and "elites (2): MuJoCo C\n" in shown
    assert f"failing elites: {report['failing']} in the first episodes" in shown


def test_terrains_are_drawn_by_the_seed_and_not_by_rates(run):
    elites = drawn(command(run)).sets["elites"]
    archive = small_archive(5)
    np.testing.assert_array_equal(elites.genes, archive.genes[elites.number])
    assert len(set(elites.number)) == 4
    drawn_by = [tuple(drawn(command(run, seed=seed)).sets["elites"].number) for seed in range(8)]
    assert drawn_by[0] == tuple(elites.number) and len(set(drawn_by)) > 4
    assert set().union(*drawn_by) == set(range(5))
    more = drawn(command(run, terrains=7, elites=5))
    assert sorted(more.sets["elites"].number) == list(range(5))
    few = drawn(command(run, terrains=7, elites=0, run=None))
    np.testing.assert_array_equal(few.sets["hard_random"].genes, more.sets["hard_random"].genes)
    assert few.source is None and list(few.sets) == ["hard_random"]


def test_what_was_crossed_before_a_stop_is_not_crossed_again(run, monkeypatch):
    def stopped(result, call):
        if call == 4:
            raise KeyboardInterrupt
        return result

    asked, calls = [], []
    monkeypatch.setattr("sim.mujoco_c.crossing.cross_plain", in_plain_mujoco(asked, stop_after=3))
    with pytest.raises(Interrupted, match=r"kept in .*agreement\.part\.npz.*The same command goes on"):
        command(run).execute(open_evaluator=opener(calls, stopped))
    calls.clear()
    with pytest.raises(Interrupted):  # three terrains into MuJoCo C
        command(run).execute(open_evaluator=opener(calls))
    assert calls == [(8, False), (16, True), (8, True)] and len(asked) == 1
    calls.clear()
    monkeypatch.setattr("sim.mujoco_c.crossing.cross_plain", in_plain_mujoco(asked))
    report = command(run).execute(open_evaluator=opener(calls))
    assert calls == [] and [count for _, _, count, _, _ in asked] == [4, 1, 4]
    whole = command(run, out=run / "whole.json").execute(open_evaluator=opener([]))
    assert {name: report[name] for name in ("hard_random", "elites", "failing")} == {
        name: whole[name] for name in ("hard_random", "elites", "failing")
    }


@pytest.mark.parametrize("change", [{"seed": 1}, {"episodes": 8}, {"elites": 3}])
def test_what_was_kept_for_other_crossings_is_not_taken(run, change):
    def stopped(result, call):
        if call == 3:
            raise KeyboardInterrupt
        return result

    calls = []
    with pytest.raises(Interrupted):
        command(run, mujoco_c=0).execute(open_evaluator=opener(calls, stopped))
    calls.clear()
    command(run, mujoco_c=0, **change).execute(open_evaluator=opener(calls))
    assert len(calls) == 6


def test_named_terrains_are_crossed_alone(run, capsys):
    report = command(run, run=None, genes=run / "archive.npz", elite="3 1", mujoco_c=0).execute(
        open_evaluator=opener(calls := [])
    )
    assert calls == [(2, False), (2, False), (2, True)]
    assert report["hard_random"] is report["elites"] is None and report["named"]["number"] == [3, 1]
    assert report["named"]["mujoco_c"]["terrains"] == 0 and report["named"]["mujoco_c"]["goal_bias"] is None
    shown = capsys.readouterr().out
    assert "failing named terrains: 0 in the first episodes" in shown and "MuJoCo C\n" not in shown
    (row,) = [line for line in shown.splitlines() if line.split()[:1] == ["3"]]
    assert row.split()[-2:] == ["-", "-"]  # not crossed in MuJoCo C


def test_where_nothing_is_valid_the_first_part_ends_it(run):
    def nothing(result, call):
        return stand_in.make_result(result.penalties, invalid=np.ones(result.invalid.shape, bool))

    calls = []
    with pytest.raises(AllInvalidError, match=r"all 64 episodes are invalid.*goes on"):
        command(run).execute(open_evaluator=opener(calls, nothing))
    assert calls == [(16, False)] and not list(run.glob("agreement*"))


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"terrains": 0, "elites": 0, "run": None}, "there must be terrains to cross, got none: give --terrains"),
        ({"elites": 0}, "is for its elites, got --elites 0 too"),
        ({"elite": "1"}, "--elite '1' names terrains of a file: give the file too"),
        ({"terrains": -1, "episodes": 0}, "terrains must be at least 0, got -1; episodes must be at least 1"),
        ({"robot": "cassie"}, "is of anymal, got --robot cassie"),
    ],
)
def test_contradictions_are_refused_before_the_work(run, changes, reason):
    calls = []
    with pytest.raises(ValueError, match=reason):
        command(run, **changes).execute(open_evaluator=opener(calls))
    assert calls == []


def test_archives_that_cannot_be_crossed_are_refused(run, tmp_path, monkeypatch):
    with pytest.raises(ValueError, match=r"--genes .* names the terrains, got --run|is for its elites, got --genes"):
        command(run, genes=run / "archive.npz").execute(open_evaluator=opener([]))
    with pytest.raises(ValueError, match=r"archive\.npz has no elite 9: expected all, or numbers of 0 to 4"):
        command(run, run=None, genes=run / "archive.npz", elite="9").execute(open_evaluator=opener([]))
    write_archive(run / "archive.npz", dataclasses.replace(small_archive(5), robot_sha256="0" * 64))
    with pytest.raises(ValueError, match="have changed since"):
        command(run).execute(open_evaluator=opener([]))
    write_archive(run / "archive.npz", small_archive(0))
    with pytest.raises(ValueError, match=r"has no elites: let its search go on .* or leave elites out"):
        command(run).execute(open_evaluator=opener([]))
    monkeypatch.chdir(tmp_path)
    with pytest.raises(FileNotFoundError, match=r"no archive of anymal .*; --elites 0 crosses hard-random"):
        command(run, run=None).execute(open_evaluator=opener([]))


def test_a_robot_that_mujoco_cannot_read_may_be_compared_without_it(run, monkeypatch):
    def unreadable(robot, heights):
        raise ValueError("robot 'x': write such a file for it")

    monkeypatch.setattr("sim.mujoco_c.model.crossing_model", unreadable)
    with pytest.raises(ValueError, match="write such a file for it, or leave MuJoCo C out with --mujoco-c 0"):
        command(run).execute(open_evaluator=opener([]))
    assert command(run, mujoco_c=0).execute(open_evaluator=opener([]))["elites"]["resolved"]["terrains"] == 4


def test_an_evaluator_may_resolve_contact(monkeypatch):
    built = []
    monkeypatch.setattr("sim.rollout.Rollout", lambda robot, policy, **more: built.append((robot, more["solver"])))
    cfg = EvaluatorCfg(robot="anymal", policy="p", num_terrains=1, num_replicas=4)
    for resolved in (False, True):
        evaluator.build_rollout(dataclasses.replace(cfg, resolved=resolved), 1)
    (robot, solver), (fine, fine_solver) = built
    assert (robot.physics_dt, robot.decimation, solver.time_constant_s) == (0.005, 4, None)
    assert (fine.physics_dt, fine.decimation, fine_solver.time_constant_s) == (0.001, 20, 0.003)


def test_the_command_refuses_in_one_line(run, capsys):
    assert run_command(Agreement, ["--device", "cpu", "--run", str(run / "none")], name="agreement") == 2
    error = capsys.readouterr().err
    assert error.startswith("error: ") and error.count("\n") == 1 and os.fspath(run / "none") in error


@pytest.mark.slow
def test_flat_ground_is_crossed_in_every_way(tmp_path):
    np.savez(tmp_path / "flat.npz", genes=np.zeros((2, 64), np.float32))
    out = tmp_path / "agreement.json"
    flags = {"device": "cpu", "workers": "1", "episodes": 2, "mujoco_c": 1}
    report = Agreement(genes=tmp_path / "flat.npz", elite="1", out=out, **flags).execute()
    assert report["named"]["rates"] == {way: {"success": [1.0], "goal": [1.0]} for way in WAYS}
    assert (report["failing"], report["failing_again"], report["failing_resolved"]) == (0, 0, 0)
