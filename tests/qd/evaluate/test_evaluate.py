"""Evaluations from end to end over made-up crossings, and what is refused before any work."""

import hashlib
import json
from pathlib import Path

import numpy as np
import pytest

from qd.commands import EvaluateCommand
from qd.evaluate import evaluate as evaluation
from qd.evaluate.evaluate import evaluate_rates, evaluate_tables
from qd.evaluate.labels import SETS, SetsCfg
from qd.evaluate.sets import split_elites
from qd.evaluate.tables import is_regression
from qd.search.archive import write_archive
from sim.files.command import run_command
from tests.builders import make_archive
from tests.qd.robots import Robots
from tests.qd.searches import crossing_by
from tests.qd.stand_in import PENALTIES, compute_by
from tests.train.conftest import write_trained

STAND, STRETCH = "tests.sim.policies:stand", "tests.sim.policies:stretch"


def write_elites(path, count, *, robot="anymal", seed=0):
    """An archive file of made-up elites."""
    write_archive(path, make_archive(count, robot=robot, seed=seed))
    return path


@pytest.fixture
def archive(tmp_path, monkeypatch):
    """An archive of 30 elites in a folder to work in."""
    monkeypatch.chdir(tmp_path)
    return write_elites(tmp_path / "archive.npz", 30)


def arrives(cfg, terrains, seeds):
    return np.zeros(len(seeds), bool)


def tables_of(anymal, robots, controllers, **changes):
    cfg = SetsCfg(**{"terrains": 4, "episodes": 2, **changes})
    return evaluate_tables(anymal, controllers, cfg, compute=compute_by(robots))


def test_the_tables_from_end_to_end(anymal, archive, tmp_path):
    independent = write_elites(tmp_path / "other.npz", 9, seed=1)
    robots = Robots(lambda cfg, terrains, seeds: np.full(len(seeds), cfg.policy == STAND))
    controllers = {"base": STAND, "C-G": STRETCH}
    report = tables_of(anymal, robots, controllers, archive=archive, independent=independent)
    written = json.loads(Path("runs/anymal-tables/tables.json").read_text())
    assert written == json.loads(json.dumps(report))
    assert {"command", "commit", "sources_sha256", "device", "versions", "seed", "date"} <= written.keys()
    assert list(written["goal"]) == list(SETS)
    assert all(row == {"base": 0.0, "C-G": 1.0} for row in written["goal"].values())
    assert list(written["penalties"]["generated"]["C-G"]) == list(PENALTIES)
    assert written["terrains"] == dict.fromkeys(SETS, 4) | {"generated_far": 2}
    parts = {"train": 22, "validation": 2, "test": 6}
    assert written["archive"] == {"path": str(archive), "elites": 30, "iterations": 3, **parts}
    assert written["archive_sha256"] == hashlib.sha256(archive.read_bytes()).hexdigest()
    assert written["controllers"]["C-G"]["policy"] == STRETCH
    about = written["independent"]
    assert (about["path"], about["elites"], about["search_seed"]) == (str(independent), 9, None)
    assert about["sha256"] == hashlib.sha256(independent.read_bytes()).hexdigest()
    mended = written["differences"]["generated"]["base -> C-G"]["mended"]["terrains"]
    assert mended == sorted(split_elites(make_archive(30)).test[:4].tolist())
    # Each controller crossed four sets, in one simulation a size; the far elites are among the generated ones.
    assert [cfg.policy for cfg, _ in robots.crossed] == [STAND] * 16 + [STRETCH] * 16
    assert all(cfg.reward and cfg.replicas == 2 for cfg in robots.opened) and not is_regression(report)


@pytest.mark.parametrize("where", ["test", "independent"])
def test_controllers_are_not_tested_on_what_they_were_trained_on(anymal, archive, tmp_path, where):
    other = make_archive(9, seed=1)
    if where == "independent":  # whichever elite it is: it shares ancestors with all
        given, trained_on = {"independent": write_elites(tmp_path / "other.npz", 9, seed=1)}, other.genes[:1]
    else:
        split = split_elites(make_archive(30))
        given, trained_on = {"archive": archive}, make_archive(30).genes[split.test[:1]]
    with pytest.raises(ValueError, match="C-G"):
        tables_of(anymal, Robots(arrives), {"C-G": str(write_trained(tmp_path, trained_on))}, **given)
    assert not Path("runs").exists()


def test_rates_of_one_controller(anymal, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robots = Robots(arrives)
    given = {"compute": compute_by(robots), "terrains": 3, "episodes": 1}
    report = evaluate_rates(anymal, STAND, **given)
    # Under runs/, never under results/, where the published ones stand; another controller has a file of its own.
    written = json.loads(Path("runs/anymal-tests.sim.policies-stand-rates.json").read_text())
    assert written == json.loads(json.dumps(report))
    assert report["hand_crafted"]["goal_rate"] == 1.0 and report["hard_random"]["episodes"] == 3
    assert set(report["hand_crafted"]["by_type"]) == {"slope", "rough_slope", "stairs_up_down"}
    # Velocity errors count from 2 s on: 1 (m/s)^2 s in 13 of 15 s.
    assert {cfg.penalties_from_s for cfg in robots.opened} == {2.0}
    assert report["flat"]["vx_error_mean"] == pytest.approx((1 / 13) ** 0.5)
    evaluate_rates(anymal, str(anymal.policy_file), **given)
    assert Path("runs/anymal-rates.json").exists()


@pytest.mark.parametrize(
    ("flags", "field"),
    [
        (["--archive", "cassie.npz"], "cassie"),
        (["--policies", "a=none.pt"], "none.pt"),
        (["--policies", "C-G=shipped", "C-G@1=shipped"], "C-G@1"),
        (["--policy", "x.pt", "--sets", "hard_random"], "--policies"),
        (["--pack", "anymal", "--policies", "a=shipped"], "--pack"),
        (["--fail-under", "0.9"], "--fail-under"),
        (["--policies", "old=shipped", "new=C-G.pt", "--archive", "archive.npz", "--sets", "hard_random"], "--sets"),
        (["--policies", "old=shipped", "new=C-G.pt"], "--archive"),  # else it would exit with 0 whatever was broken
    ],
)
def test_errors_come_before_any_work_in_one_line(archive, flags, field, monkeypatch, capsys):
    monkeypatch.setattr(evaluation, "cross_sets", None)
    write_elites(Path("cassie.npz"), 9, robot="cassie")
    assert run_command(EvaluateCommand, ["--device", "cpu", "--terrains", "2", *flags], name="evaluate") == 2
    (line,) = capsys.readouterr().err.splitlines()
    assert field in line and not Path("runs").exists()


@pytest.mark.parametrize(("worse", "status"), [("new", 1), ("old", 0)])
def test_a_regression_is_a_goal_rate_below_that_of_before(archive, worse, status):
    policies = {"new": STAND, "old": STRETCH}
    robots = Robots(lambda cfg, terrains, seeds: np.full(len(seeds), cfg.policy == policies[worse]))
    flags = ["--policies", *map("=".join, policies.items()), "--archive", "archive.npz", "--terrains", "4"]
    with crossing_by(robots):
        assert run_command(EvaluateCommand, [*flags, "--device", "cpu"], name="evaluate") == status
    report = json.loads(Path("runs/anymal-tables/compared.json").read_text())
    assert list(report["controllers"]) == ["old", "new"] and list(report["goal"]) == ["elites"]
