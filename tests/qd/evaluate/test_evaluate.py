"""The evaluation command: the paper's tables from end to end on short crossings, what goes on after a kill, errors."""

import hashlib
import json
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
import torch

from qd.archive import write_archive
from qd.evaluate.crossings import cross_all
from qd.evaluate.evaluate import Evaluate, evaluate_rates, evaluate_tables, evaluator_of
from qd.evaluate.sets import FROM_ARCHIVE, SETS, make_sets, split_elites
from qd.workers.evaluator import EvaluatorCfg
from sim.crossing import CrossingCfg
from sim.files.command import run_command, split_words
from sim.policy.spec import about_controllers, controller_hash, controllers_of
from sim.robots.robot import get_robot
from sim.rollout import Rollout
from tests.train.archives import make_archive
from tests.train.starts import write_trained

PROTOTYPE = "tests.sim.policies:stretch"
STANDER = "tests.sim.policies:stand"


class Crossings:
    """Crosses in this process for a fraction of a second; counts, and may be killed after so many sets."""

    def __init__(self, die_after: int = 1000) -> None:
        self.opened: list[EvaluatorCfg] = []
        self.sets: list[tuple[str, int]] = []
        self.die_after = die_after

    @contextmanager
    def open(self, cfg: EvaluatorCfg):
        self.opened.append(cfg)
        rollout = Rollout(
            get_robot(cfg.robot), cfg.policy, num_terrains=cfg.num_terrains, num_replicas=cfg.num_replicas,
            device=cfg.device, cfg=CrossingCfg(max_duration_s=0.1, start=(13.6, 4.0), reward=cfg.reward),
        )  # fmt: skip

        def evaluate(terrains, seeds, progress=None):
            if len(self.sets) == self.die_after:
                raise KeyboardInterrupt
            self.sets.append((cfg.policy, len(seeds)))
            return rollout.evaluate(terrains, seeds, progress=progress)

        yield evaluate


@pytest.fixture
def archive(tmp_path):
    run = tmp_path / "run"
    run.mkdir()
    write_archive(run / "archive.npz", make_archive(30))
    return run


def config(tmp_path, **changes):
    values = {
        "policies": (f"base={STANDER}", f"C-G={PROTOTYPE}"), "device": "cpu", "terrains": 2, "episodes": 2,
        "run_dir": tmp_path / "tables",
    }  # fmt: skip
    return Evaluate(**values | changes)


def test_the_tables_from_end_to_end(tmp_path, archive, capsys):
    crossings = Crossings()
    report = evaluate_tables(config(tmp_path, archive=archive, terrains=4), open_evaluator=crossings.open)
    written = json.loads((tmp_path / "tables" / "tables.json").read_text())
    assert written == json.loads(json.dumps(report))
    assert (tmp_path / "tables" / "tables.png").stat().st_size > 10_000
    for key in ("command", "commit", "device", "versions", "seed", "date"):
        assert key in written, key
    assert list(written["success"]) == ["hand_crafted", "hard_random", "generated", "generated_far"]
    for name in ("success", "goal", "reward"):
        assert all(list(row) == ["base", "C-G"] for row in written[name].values())
        assert all(len(limits) == 2 for row in written["intervals"][name].values() for limits in row.values())
    assert list(written["penalties"]["generated"]["C-G"]) == list(get_robot("anymal").penalties)
    assert written["archive"] == {
        "path": str(archive), "elites": 30, "iterations": 3, "train": 22, "validation": 2, "test": 6, "split_seed": 0,
    }  # fmt: skip
    assert (written["part"], written["independent"], written["resolved"], written["mujoco_c"]) == ("test", *[None] * 3)
    assert written["terrains"] == {"hand_crafted": 4, "hard_random": 4, "generated": 4, "generated_far": 2}
    assert written["archive_sha256"] == hashlib.sha256((archive / "archive.npz").read_bytes()).hexdigest()
    assert written["controllers"]["C-G"]["policy"] == PROTOTYPE
    held_out = set(split_elites(make_archive(30), "anymal").test[:4].tolist())
    groups = written["traversable"]["generated"]
    assert set(groups["crossed"]["terrains"]) | set(groups["never_crossed"]["terrains"]) == held_out
    # Each controller crossed three sets, in one simulation since they are of one size; the far ones are among them.
    assert crossings.sets == [(STANDER, 4)] * 3 + [(PROTOTYPE, 4)] * 3 and len(crossings.opened) == 2
    assert all(cfg.reward for cfg in crossings.opened)
    said = capsys.readouterr().out
    assert "base on hand_crafted: goal " in said and "no base collision 1.000" in said and "written to" in said


def test_all_controllers_meet_the_same_terrains_and_starts(tmp_path, archive):
    # The same controller under two names: whatever is drawn is drawn alike.
    cfg = config(tmp_path, policies=(f"a={STANDER} b={STANDER}",), archive=archive)
    report = evaluate_tables(cfg, open_evaluator=Crossings().open)
    for name in ("success", "goal", "fallen", "reward", "penalties"):
        assert all(row["a"] == row["b"] for row in report[name].values())
    assert report["reward"]["hand_crafted"]["a"] > 0.0


def test_elites_of_another_search_are_a_set_of_their_own(tmp_path, archive, capsys):
    other = tmp_path / "other"
    other.mkdir()
    write_archive(other / "archive.npz", make_archive(9, seed=1))
    report = evaluate_tables(
        config(tmp_path, archive=archive, independent=other, terrains=4), open_evaluator=Crossings().open
    )
    assert list(report["goal"]) == list(SETS) and report["terrains"]["generated_independent"] == 4
    about = report["independent"]
    assert (about["path"], about["elites"], about["search_seed"]) == (str(other), 9, None)
    assert about["sha256"] == hashlib.sha256((other / "archive.npz").read_bytes()).hexdigest()
    assert report["traversable"].keys() == set(FROM_ARCHIVE)
    assert "generated_independent: 4 terrains x 2 episodes" in capsys.readouterr().out
    alone = evaluate_tables(
        config(tmp_path, independent=other, sets=("generated_independent",)), open_evaluator=Crossings().open
    )
    assert list(alone["goal"]) == ["generated_independent"] and alone["archive"] is None


def test_a_controller_that_was_trained_on_the_other_search_is_refused(tmp_path, archive):
    other = make_archive(9, seed=1)
    write_archive(tmp_path / "other.npz", other)
    policy = write_trained(tmp_path, other.genes[:1])  # which may not be among those drawn
    cfg = config(tmp_path, policies=(f"C-G={policy}",), archive=archive, independent=tmp_path / "other.npz")
    with pytest.raises(ValueError, match=r"C-G was trained on 1 of the 9 elites of --independent .*other.npz: give a"):
        evaluate_tables(cfg, open_evaluator=None)  # pyright: ignore[reportArgumentType] - nothing is crossed


def test_settings_are_chosen_on_terrains_that_are_not_reported(tmp_path, archive, capsys):
    split = split_elites(make_archive(30), "anymal")
    cfg = config(tmp_path, archive=archive, part="validation", terrains=4)
    report = evaluate_tables(cfg, open_evaluator=Crossings().open)
    assert (tmp_path / "tables" / "validation.json").exists() and not (tmp_path / "tables" / "tables.json").exists()
    assert report["part"] == "validation" and report["terrains"]["generated"] == 2
    groups = report["traversable"]["generated"]
    assert set(groups["crossed"]["terrains"] + groups["never_crossed"]["terrains"]) == set(split.validation.tolist())
    assert "Validation terrains, to choose settings by." in capsys.readouterr().out
    policy = write_trained(tmp_path, make_archive(30).genes[split.validation[:1]])
    with pytest.raises(ValueError, match=r"on 1 of the 2 elites .* for validation: .* must be trained anew"):
        evaluate_tables(
            config(tmp_path, policies=(f"C-G={policy}",), archive=archive, part="validation"),
            open_evaluator=None,  # pyright: ignore[reportArgumentType] - nothing is crossed
        )
    assert Evaluate(part="validation").makes_tables and not Evaluate().makes_tables


def test_rates_of_one_controller_go_under_runs(tmp_path, monkeypatch, capsys):
    # Never under results/, where the published ones stand.
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("qd.evaluate.evaluate.open_evaluator", Crossings().open)
    report = evaluate_rates(Evaluate(policy=STANDER, device="cpu", terrains=2, episodes=1))
    # A controller other than the shipped one has a file of its own.
    written = "runs/anymal-tests.sim.policies-stand-rates.json"
    assert json.loads(Path(written).read_text()) == json.loads(json.dumps(report))
    assert set(report) >= {"hand_crafted", "hard_random", "flat", "command", "commit", "seed"}
    assert f"written to {written}" in capsys.readouterr().out
    shipped = evaluate_rates(Evaluate(device="cpu", terrains=2, episodes=1))
    assert json.loads(Path("runs/anymal-rates.json").read_text()) == json.loads(json.dumps(shipped))


@pytest.mark.slow
def test_a_killed_evaluation_goes_on(tmp_path, archive, capsys):
    cfg = config(tmp_path, archive=archive)
    killed = Crossings(die_after=4)
    with pytest.raises(KeyboardInterrupt):
        evaluate_tables(cfg, open_evaluator=killed.open)
    assert not (tmp_path / "tables" / "tables.json").exists()
    again = Crossings()
    report = evaluate_tables(cfg, open_evaluator=again.open)
    assert len(killed.sets) == 4 and again.sets == [(PROTOTYPE, 2)] * 2
    assert "4 of 6 crossings of a set are kept from before" in capsys.readouterr().out
    at_once = evaluate_tables(
        config(tmp_path, archive=archive, run_dir=tmp_path / "other"), open_evaluator=Crossings().open
    )
    for name in ("success", "goal", "reward", "penalties", "intervals", "differences", "traversable"):
        assert report[name] == at_once[name]
    done = Crossings()
    evaluate_tables(cfg, open_evaluator=done.open)
    assert not done.opened


def test_one_controller_more_crosses_alone(tmp_path):
    cfg = config(tmp_path, policies=(f"base={STANDER}",), sets=("hard_random",))
    evaluate_tables(cfg, open_evaluator=Crossings().open)
    more = Crossings()
    report = evaluate_tables(config(tmp_path, sets=("hard_random",)), open_evaluator=more.open)
    assert more.sets == [(PROTOTYPE, 2)]
    assert list(report["differences"]["hard_random"]) == ["base -> C-G"]


def test_sets_of_one_space_share_a_simulation_that_has_room_for_the_largest(tmp_path):
    found = make_archive(5)  # one elite is held out
    sets = make_sets(["hard_random", "generated"], 3, 0, archive=found, split=split_elites(found, "anymal"))
    crossings = Crossings()
    evaluator = EvaluatorCfg(robot="anymal", policy="", num_terrains=9, num_replicas=2, reward=True)
    results = cross_all({"base": STANDER}, sets, evaluator, tmp_path, open_evaluator=crossings.open)
    assert [cfg.num_terrains for cfg in crossings.opened] == [3]
    assert results["hard_random"]["base"].outcome.shape == (3, 2)
    assert results["generated"]["base"].outcome.shape == (1, 2)


def test_the_far_set_is_part_of_the_generated_one_and_the_same_alone(tmp_path):
    found = make_archive(30)
    split = split_elites(found, "anymal")
    evaluator = EvaluatorCfg(robot="anymal", policy="", num_terrains=9, num_replicas=4, reward=True)
    rewards = []
    for names in (["generated", "generated_far"], ["generated_far"]):
        sets = make_sets(names, 6, 0, archive=found, split=split)
        kept = tmp_path / str(len(names))
        crossings = Crossings()
        results = cross_all({"base": PROTOTYPE}, sets, evaluator, kept, open_evaluator=crossings.open)
        assert len(crossings.sets) == 1
        rewards.append(results["generated_far"]["base"].reward)
    assert rewards[0].shape == (2, 4)
    np.testing.assert_array_equal(*rewards)


def test_controllers_are_named():
    robot = get_robot("anymal")
    assert controllers_of((), robot) == {"base": str(robot.policy_file)}
    named = controllers_of(("base=shipped C-HC=a dir/x.pt", "C-G=m.n:f"), robot)  # as make hands over, and the shell
    assert named == {"base": str(robot.policy_file), "C-HC": "a dir/x.pt", "C-G": "m.n:f"}
    assert split_words(["generated, hard_random"]) == ["generated", "hard_random"]


@pytest.mark.skipif(torch.cuda.is_available(), reason="the sizes of a machine without a GPU")
def test_sizes(capsys):
    def size(**given):
        flags = Evaluate(device="cpu", **given)
        chosen = evaluator_of(flags, get_robot(flags.robot))
        return chosen.num_terrains, chosen.num_replicas

    assert size(sets=("hard_random",)) == (24, 4)
    assert "24 terrains x 4 episodes a set instead of 300 x 20" in capsys.readouterr().out
    assert size(robot="cassie", sets=("hard_random",)) == (24, 4)
    assert "instead of 180 x 20" in capsys.readouterr().out
    assert size(terrains=5) == (5, 4) and size(episodes=7, policies=("a=b",)) == (24, 7)
    assert capsys.readouterr().out == ""


@pytest.mark.parametrize(
    ("flags", "message"),
    [
        (
            ["--sets", "easy"],
            "sets must be some of hand_crafted, hard_random, generated, generated_far, generated_independent, got easy",
        ),
        (["--sets", "generated_independent"], "give its run (--independent RUN)"),
        (["--independent", "{folder}/none"], "no archive at {folder}/none"),
        (["--independent", "{folder}/cassie"], "must be of robot 'anymal', got one of 'cassie'"),
        (["--archive", "{folder}/good", "--independent", "{folder}/good"], "must share no elite with --archive"),
        (["--part", "validation", "--independent", "{folder}/good"], "no setting is chosen by them"),
        (
            ["--sets", "generated"],
            "generated is made of elites: give the run that found them (--archive ",
        ),
        (["--sets", "hard_random hard_random"], "each set may be named once"),
        (["--archive", "{folder}/none"], "no archive at {folder}/none"),
        (["--archive", "{folder}/cassie"], "must be of robot 'anymal', got one of 'cassie'"),
        (["--archive", "{folder}/empty"], "needs at least 5 elites, got 0"),
        (["--archive", "{folder}/few"], "needs at least 5 elites, got 4"),
        (["--archive", "{folder}/noise"], "must be the archive of a search, but it is damaged"),
        (["--archive", "{folder}/good", "--split-seed", "-1"], "split_seed must be at least 0, got -1"),
        (["--policies", "a=shipped", "a=shipped"], "different names, got 'a' twice"),
        (["--policies", "shipped"], "policies must be NAME=FILE each, .* got 'shipped'"),
        (["--policies", "a="], "policies must be NAME=FILE each, .* got 'a='"),
        (["--policies", "../a=shipped"], "policies must be NAME=FILE each"),
        (["--policies", "a={folder}/none.pt"], "policy '{folder}/none.pt': no such file"),
        (["--policies", "a=sim/robots/anymal.xml"], "is neither a checkpoint"),
        (
            ["--policies", "base=shipped", "C-G={folder}/small.pt"],
            "maps 48 observations to 12 actions, but robot 'anymal'",
        ),
        (["--policy", "x.pt", "--sets", "hard_random"], "give --policies own=x.pt instead of --policy"),
        (["--sets", "hard_random", "--robot", "spot"], "unknown robot 'spot'"),
        (["--sets", "hard_random", "--terrains", "0"], "terrains must be at least 1, got 0"),
        (["--sets", "hard_random", "--episodes", "-2"], "episodes must be at least 1, got -2"),
        (["--sets", "hard_random", "--seed", "-3"], "seed must be at least 0, got -3"),
        (["--sets", "hard_random", "--out", "{folder}/tables.png"], "out must be a file named *.json"),
        (["--sets", "hard_random", "--out", "/proc/nowhere/t.json"], "cannot write to /proc/nowhere"),
        (["--sets", "hard_random", "--run-dir", "/proc/nowhere"], "cannot write to /proc/nowhere"),
        (["--sets", "hard_random", "--device", "cuda"], "no CUDA device was found"),
        (["--terrains", "0"], "terrains must be at least 1, got 0"),  # of the base evaluation too
    ],
)
@pytest.mark.skipif(torch.cuda.is_available(), reason="one of the errors is the absence of CUDA")
def test_errors_come_before_any_work_in_one_line(flags, message, tmp_path, monkeypatch, capsys):
    for name, elites, robot in (
        ("good", 30, "anymal"),
        ("cassie", 30, "cassie"),
        ("empty", 0, "anymal"),
        ("few", 4, "anymal"),
    ):
        (tmp_path / name).mkdir()
        write_archive(tmp_path / name / "archive.npz", make_archive(elites, robot=robot))
    (tmp_path / "noise").mkdir()
    (tmp_path / "noise" / "archive.npz").write_bytes(b"noise")
    layers = {"mlp.0.weight": torch.zeros(12, 48), "mlp.0.bias": torch.zeros(12)}
    torch.save({"actor_state_dict": layers}, tmp_path / "small.pt")
    # Crossing anything would fail with another error.
    monkeypatch.setattr("qd.evaluate.evaluate.open_evaluator", None)
    monkeypatch.setattr("qd.evaluate.crossings.cross_all", None)
    flags = [flag.format(folder=tmp_path) for flag in flags]
    home = [] if "--run-dir" in flags else ["--run-dir", str(tmp_path / "tables")]
    device = [] if "--device" in flags else ["--device", "cpu"]
    assert run_command(Evaluate, [*flags, *home, *device], name="evaluate") == 2
    lines = capsys.readouterr().err.splitlines()  # with a warning of archives made by hand
    error = [line for line in lines if "Warp" not in line and "names no hash" not in line]
    assert len(error) == 1 and error[0].startswith("error: ")
    for part in message.format(folder=tmp_path).split(".*"):
        assert part.strip() in error[0]


def test_a_robot_without_scales_is_told_how_to_get_them(tmp_path, monkeypatch):
    monkeypatch.setattr("sim.robots.robot._ROBOTS_DIR", Path(tmp_path))
    with pytest.raises(ValueError, match=r"no penalty scales of robot 'anymal'.*calibrate --robot anymal"):
        evaluate_tables(config(tmp_path), open_evaluator=Crossings().open)


def test_ctrl_c_says_how_to_go_on(tmp_path, monkeypatch, capsys):
    def stop(cfg):
        raise KeyboardInterrupt

    monkeypatch.setattr("qd.evaluate.evaluate.evaluate_tables", stop)
    assert run_command(Evaluate, ["--device", "cpu", "--sets", "hard_random"], name="evaluate") == 130
    said = capsys.readouterr().err
    assert "Stopped; what is crossed is kept" in said and "the same command" in said.lower()


def test_the_robots_own_controller_is_named_shipped_wherever_it_lies():
    robot = get_robot("cassie")
    about = about_controllers(controllers_of(("base=shipped", f"other={STANDER}"), robot), robot)
    assert {who: one["policy"] for who, one in about.items()} == {"base": "shipped", "other": STANDER}
    assert about["base"]["sha256"] == controller_hash(str(robot.policy_file))
