"""Evaluations from end to end on short crossings: tables, rates, what goes on after a stop, errors before any work."""

import hashlib
import json
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.archive import write_archive
from qd.commands import Evaluate
from qd.evaluate import evaluate as evaluation
from qd.evaluate.evaluate import SetsCfg, cross_sets, evaluate_rates, evaluate_tables, sizes_for
from qd.evaluate.labels import FROM_ARCHIVE, SETS
from qd.evaluate.sets import make_sets, split_elites
from qd.workers.evaluator import Compute, EvaluatorCfg
from sim.crossing import CrossingCfg
from sim.files.command import run_command
from sim.files.records import robot_digest
from sim.robots.find import get_robot
from sim.rollout import Rollout
from tests.qd.stand_in import Stub
from tests.train.archives import make_archive
from tests.train.starts import write_trained

PROTOTYPE = "tests.sim.policies:stretch"
STANDER = "tests.sim.policies:stand"
CONTROLLERS = {"base": STANDER, "C-G": PROTOTYPE}
CPU = Compute()


class Crosser:
    """Crosses in this process for a fraction of a second; counts, and may be stopped after so many lots."""

    def __init__(self, stop_after: int = 1000) -> None:
        self.opened: list[EvaluatorCfg] = []
        self.lots: list[tuple[str, int]] = []
        self.stop_after = stop_after

    @contextmanager
    def open(self, cfg: EvaluatorCfg):
        self.opened.append(cfg)
        crossing = CrossingCfg(
            max_duration_s=0.1, start=(13.6, 4.0), reward=cfg.reward, penalties_from_s=cfg.penalties_from_s
        )
        rollout = Rollout(
            get_robot(cfg.robot), cfg.policy, num_terrains=cfg.num_terrains, num_replicas=cfg.num_replicas,
            device=cfg.device, cfg=crossing,
        )  # fmt: skip

        def evaluate(terrains, seeds, progress=None):
            if len(self.lots) == self.stop_after:
                raise KeyboardInterrupt
            self.lots.append((cfg.policy, len(seeds)))
            return rollout.evaluate(terrains, seeds, progress=progress)

        yield Stub(evaluate)


def write_elites(path: Path, count: int, *, robot: str = "anymal", seed: int = 0) -> Path:
    """An archive file of made-up elites."""
    archive = make_archive(count, robot=robot, seed=seed)
    write_archive(path, replace(archive, robot_sha256=robot_digest(get_robot(robot))))
    return path


@pytest.fixture
def archive(tmp_path, monkeypatch):
    """An archive of 30 elites in a folder to work in."""
    monkeypatch.chdir(tmp_path)
    return write_elites(tmp_path / "archive.npz", 30)


def tables_of(anymal, crosser=None, controllers=None, **changes):
    cfg = SetsCfg(**{"terrains": 2, "episodes": 2, **changes})
    opened = (crosser or Crosser()).open
    return evaluate_tables(anymal, controllers or CONTROLLERS, cfg, compute=CPU, open_evaluator=opened)


def test_the_tables_from_end_to_end(anymal, archive, capsys):
    crosser = Crosser()
    report = tables_of(anymal, crosser, archive=archive, terrains=4)
    written = json.loads(Path("runs/anymal-tables/tables.json").read_text())
    assert written == json.loads(json.dumps(report))
    assert Path("runs/anymal-tables/tables.png").stat().st_size > 10_000
    for key in ("command", "commit", "sources_sha256", "dirty", "device", "versions", "seed", "date"):
        assert key in written, key
    assert list(written["success"]) == ["hand_crafted", "hard_random", "generated", "generated_far"]
    for name in ("success", "goal", "reward"):
        assert all(list(row) == ["base", "C-G"] for row in written[name].values())
        assert all(len(limits) == 2 for row in written["intervals"][name].values() for limits in row.values())
    assert list(written["penalties"]["generated"]["C-G"]) == list(anymal.penalties)
    assert written["archive"] == {
        "path": str(archive), "elites": 30, "iterations": 3, "train": 22, "validation": 2, "test": 6,
    }  # fmt: skip
    assert (written["part"], written["independent"]) == ("test", None)
    assert written["terrains"] == {"hand_crafted": 4, "hard_random": 4, "generated": 4, "generated_far": 2}
    assert written["archive_sha256"] == hashlib.sha256(archive.read_bytes()).hexdigest()
    assert written["controllers"]["C-G"]["policy"] == PROTOTYPE
    held_out = set(split_elites(make_archive(30)).test[:4].tolist())
    groups = written["traversable"]["generated"]
    assert set(groups["crossed"]["terrains"]) | set(groups["never_crossed"]["terrains"]) == held_out
    # Each controller crossed three sets, in one simulation since they are of one size; the far ones are among them.
    assert crosser.lots == [(STANDER, 4)] * 3 + [(PROTOTYPE, 4)] * 3 and len(crosser.opened) == 2
    assert all(cfg.reward for cfg in crosser.opened)
    # Nobody falls in a tenth of a second; it is 0.4 m to the goal.
    assert "base on hand_crafted: goal " in capsys.readouterr().out and set(
        report["success"]["generated"].values()
    ) == {1.0}


def test_all_controllers_meet_the_same_terrains_and_starts(anymal, archive):
    # The same controller under two names: whatever is drawn is drawn alike. The second finds what the first crossed.
    crosser = Crosser()
    report = tables_of(anymal, crosser, controllers={"a": STANDER, "b": STANDER}, archive=archive)
    for name in ("success", "goal", "fallen", "reward", "penalties"):
        assert all(row["a"] == row["b"] for row in report[name].values())
    assert report["reward"]["hand_crafted"]["a"] > 0.0 and len(crosser.lots) == 3


def test_elites_of_another_search_are_a_set_of_their_own(anymal, archive, tmp_path):
    other = write_elites(tmp_path / "other.npz", 9, seed=1)
    report = tables_of(anymal, archive=archive, independent=other, terrains=3)
    assert list(report["goal"]) == list(SETS) and report["terrains"]["generated_independent"] == 3
    about = report["independent"]
    assert (about["path"], about["elites"], about["search_seed"]) == (str(other), 9, None)
    assert about["sha256"] == hashlib.sha256(other.read_bytes()).hexdigest()
    assert report["traversable"].keys() == set(FROM_ARCHIVE)
    alone = tables_of(anymal, independent=other, names=("generated_independent",))
    assert list(alone["goal"]) == ["generated_independent"] and alone["archive"] is None
    # Elites of a search that was trained on share ancestors with all of it, whichever are drawn.
    policy = write_trained(tmp_path, make_archive(9, seed=1).genes[:1])
    with pytest.raises(ValueError, match=r"C-G .* 1 of the 9"):
        tables_of(anymal, controllers={"C-G": str(policy)}, independent=other)


@pytest.mark.parametrize("part", ["test", "validation"])
def test_controllers_are_not_tested_on_what_they_were_trained_on(anymal, archive, tmp_path, part):
    split = split_elites(make_archive(30))
    policy = write_trained(tmp_path, make_archive(30).genes[getattr(split, part)[:1]])
    for names in ((), ("generated_far", "generated")):
        with pytest.raises(ValueError, match=rf"C-G .* 1 of the \d elites .* {part}"):
            tables_of(anymal, controllers={"C-G": str(policy)}, archive=archive, part=part, names=names)
    assert not Path("runs").exists()


def test_settings_are_chosen_on_terrains_that_are_not_reported(anymal, archive):
    report = tables_of(anymal, archive=archive, part="validation", names=("generated",), terrains=4)
    assert [file.name for file in sorted(Path("runs/anymal-tables").glob("*.json"))] == ["validation.json"]
    groups = report["traversable"]["generated"]
    numbers = groups["crossed"]["terrains"] + groups["never_crossed"]["terrains"]
    assert report["part"] == "validation"
    assert set(numbers) == set(split_elites(make_archive(30)).validation.tolist())


@pytest.mark.slow
def test_a_stopped_evaluation_goes_on(anymal, archive):
    stopped, again = Crosser(stop_after=4), Crosser()
    with pytest.raises(KeyboardInterrupt):
        tables_of(anymal, stopped, archive=archive)
    assert not Path("runs/anymal-tables/tables.json").exists()
    report = tables_of(anymal, again, archive=archive)
    assert len(stopped.lots) == 4 and again.lots == [(PROTOTYPE, 2)] * 2
    done = Crosser()
    assert tables_of(anymal, done, archive=archive)["reward"] == report["reward"] and not done.opened
    more = Crosser()  # one controller more crosses alone
    tables_of(anymal, more, controllers={**CONTROLLERS, "C-X": "tests.sim.policies:sway"}, names=("hard_random",))
    assert more.lots == [("tests.sim.policies:sway", 2)]


def test_the_far_set_is_part_of_the_generated_one_and_the_same_alone(anymal, tmp_path):
    rewards = []
    for names in (["generated", "generated_far"], ["generated_far"]):
        sets = make_sets(names, 6, 0, archive=make_archive(30))
        results = cross_sets(
            {"base": PROTOTYPE}, sets, robot=anymal, compute=CPU, episodes=4, reward=True,
            cache=tmp_path / str(len(names)), open_evaluator=Crosser().open,
        )  # fmt: skip
        rewards.append(results["generated_far"]["base"].reward)
    assert rewards[0].shape == (2, 4)
    np.testing.assert_array_equal(*rewards)


def test_rates_of_one_controller(anymal, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    crosser = Crosser()
    given = {"compute": CPU, "terrains": 3, "episodes": 1}
    report = evaluate_rates(anymal, STANDER, **given, open_evaluator=crosser.open)
    # Under runs/, never under results/, where the published ones stand; another controller has a file of its own.
    written = json.loads(Path("runs/anymal-tests.sim.policies-stand-rates.json").read_text())
    assert written == json.loads(json.dumps(report))
    assert report["hand_crafted"]["success_rate"] == 1.0 and report["hard_random"]["episodes"] == 3
    assert set(report["hand_crafted"]["by_type"]) == {"slope", "rough_slope", "stairs_up_down"}
    assert report["hard_random"]["by_level"] is None
    # Velocity errors count from 2 s on, which no episode here reaches.
    assert {cfg.penalties_from_s for cfg in crosser.opened} == {2.0} and report["flat"]["episodes"] == 0
    evaluate_rates(anymal, str(anymal.policy_file), **given, open_evaluator=Crosser().open)
    assert Path("runs/anymal-rates.json").exists()


def test_sizes(capsys):
    full, small = (300, 20), (24, 4)
    assert sizes_for(Compute("cuda:1"), None, None, full=full, small=small) == (300, 20)
    assert sizes_for(CPU, 5, None, full=full, small=small) == (5, 4)
    assert sizes_for(CPU, None, 7, full=full, small=small) == (24, 7)
    assert capsys.readouterr().out == ""
    assert sizes_for(CPU, None, None, full=full, small=small) == (24, 4)
    assert "300 x 20" in capsys.readouterr().out
    with pytest.raises(ValueError, match="episodes"):
        sizes_for(CPU, None, 0, full=full, small=small)


@pytest.mark.parametrize(
    ("flags", "field"),
    [
        (["--sets", "easy"], "easy"),
        (["--archive", "cassie.npz"], "cassie"),
        (["--part", "validation", "--independent", "archive.npz"], "independent"),
        (["--policies", "a=none.pt"], "none.pt"),
        (["--policies", "C-G=shipped", "C-G@1=shipped"], "C-G@1"),
        (["--policy", "x.pt", "--sets", "hard_random"], "--policies"),
        (["--space", "moon"], "moon"),
        (["--terrains", "0"], "terrains"),
        (["--pack", "anymal", "--policies", "a=shipped"], "--pack"),
    ],
)
def test_errors_come_before_any_work_in_one_line(archive, flags, field, monkeypatch, capsys):
    monkeypatch.setattr(evaluation, "cross_sets", None)
    write_elites(Path("cassie.npz"), 9, robot="cassie")
    assert run_command(Evaluate, ["--device", "cpu", "--terrains", "2", *flags], name="evaluate") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith("error: ") and field in line
    assert not Path("runs").exists()


def test_the_command_hands_its_flags_on(archive, monkeypatch):
    given = {}
    monkeypatch.setattr(evaluation, "evaluate_tables", lambda *args, **named: given.update(args=args, **named))
    monkeypatch.setattr(evaluation, "evaluate_rates", lambda *args, **named: given.update(args=args, **named))
    flags = ["--sets", "hard_random, generated", "--archive", "archive.npz", "--seed", "3", "--device", "cpu"]
    assert run_command(Evaluate, flags, name="evaluate") == 0
    robot, controllers, cfg = given["args"]
    assert (robot.name, list(controllers), cfg.names, cfg.seed) == ("anymal", ["base"], ("hard_random", "generated"), 3)
    assert run_command(Evaluate, ["--space", "course", "--robot", "cassie", "--device", "cpu"], name="evaluate") == 0
    assert given["args"][0].name == "cassie" and given["space"] == "course"
