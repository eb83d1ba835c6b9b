"""The scripts that make published numbers: each runs as a trial, and the pages say what the files say."""

import importlib
import json
import re
import subprocess
import sys
import threading
import weakref
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from kernels.episode import PARKING_HEIGHT, Outcome
from qd.workers.evaluator import Compute
from results.make import archive, bare, common, docs, rounds, search, search_noise, speed, tables, train_speed
from sim.files.provenance import sources_sha256
from sim.rollout import Rollout
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from tests.qd.searches import rows_of, run, without_figures
from tests.qd.stand_in import Stub, make_result
from train.ppo.learner import Ranks

MAKE = Path(common.__file__).parent
SCRIPTS = (
    "base",
    "conditions",
    "dose",
    "minimal",
    "pack",
    "penalty_ratios",
    "search",
    "search_noise",
    "spaces",
    "speed",
    "tables",
)
"""Those that call all that the others call."""
FILES = {name: f"{name}.json" for name in SCRIPTS} | {"minimal": "archive/minimal.json", "pack": "pack/pack.json"}

GOAL, HIT, LATE, INVALID = Outcome.GOAL, Outcome.BASE_COLLISION, Outcome.TIME_OUT, Outcome.INVALID

OURS = np.uint8([[GOAL, GOAL, HIT, LATE], [HIT, HIT, HIT, INVALID], [INVALID] * 4, [GOAL] * 4])
THEIRS = np.uint8([[GOAL, LATE, LATE, LATE], [GOAL, HIT, HIT, HIT], [GOAL] * 4, [Outcome.RUNNING] * 4])


@contextmanager
def open_made_up(cfg):
    """Half of the episodes are too late, wherever they are."""

    def cross(terrains, seeds):
        rng, shape = np.random.default_rng(int(seeds[0])), (len(seeds), cfg.num_replicas)
        result = make_result(rng.uniform(0.5, 2.0, (*shape, 6)), late=rng.uniform(size=shape) < 0.5)
        return replace(result, reward=np.ones(shape) if cfg.reward else None)

    yield Stub(cross)


@pytest.mark.slow
@pytest.mark.parametrize("name", SCRIPTS)
def test_a_trial_writes_its_file(name, tmp_path, monkeypatch):
    script = importlib.import_module(f"results.make.{name}")
    monkeypatch.setattr(Compute, "open", lambda self, cfg: open_made_up(cfg))
    without_figures(monkeypatch)
    monkeypatch.setattr(speed, "open_evaluator", open_made_up)
    (tmp_path / "results").symlink_to(MAKE.parent)
    monkeypatch.chdir(tmp_path)  # made-up crossings are stored under runs/ here
    out = tmp_path / "anymal" / FILES[name]
    script.main(["--small", "--device", "cpu", "--out", str(out)])
    report = json.loads(out.read_text())
    assert {"command", "commit", "sources_sha256", "dirty", "device", "versions", "seed", "date"} <= report.keys()
    assert report["robot"] == "anymal" and report["sources_sha256"] == sources_sha256()


def test_a_search_goes_on_point_by_point_and_what_was_followed_is_kept(tmp_path, monkeypatch):
    monkeypatch.setattr(Compute, "open", lambda self, cfg: open_made_up(cfg))
    without_figures(monkeypatch)
    monkeypatch.chdir(tmp_path)
    words = ["--small", "--device", "cpu", "--out", str(tmp_path / "anymal/search.json")]
    script = common.parse(None, words, "search.json")
    run, cfg = tmp_path / "run", script.search_cfg()
    first = common.follow_search(script, run, cfg, [1, 2], ("episodes", "elites"))
    assert [row["episodes"] for row in first] == [cfg.episodes_per_iteration, 2 * cfg.episodes_per_iteration]
    again = common.follow_search(script, run, cfg, [1, 2, 3], ("episodes", "elites"))
    assert again[:2] == first and again[2]["iterations"] == 3
    monkeypatch.setattr(common, "search", None)  # nothing is left to do
    assert common.follow_search(script, run, cfg, [1, 2, 3], ("episodes", "elites")) == again


def test_what_todays_sources_have_judged_in_all_stages_is_read(tmp_path, monkeypatch):
    words = ["--small", "--device", "cpu", "--out", str(tmp_path / "anymal/rounds.json")]
    script, judged = common.parse(None, words, "rounds.json"), []
    monkeypatch.setattr(archive, "judge", lambda run, **_: judged.append(run) or SimpleNamespace(failing=np.zeros(1)))
    stages = {name: {"sources_sha256": sources_sha256()} for name in ("fresh", "resolved", "others", "varied")}
    of_others = {**stages, "fresh": {"sources_sha256": "of others"}}
    without = {name: origin for name, origin in stages.items() if name != "varied"}
    for by, passes in ((stages, 0), (of_others, 2), (without, 2), ({}, 2)):
        judged.clear()
        (tmp_path / "archive.json").write_text(json.dumps({"faults": 3, "judged_by": by}))
        assert archive.judge_with_specialist(script, tmp_path)["faults"] == 3 and judged == [tmp_path] * passes


def test_doses_are_the_bases_by_todays_sources(tmp_path):
    script = common.parse(None, ["--device", "cpu", "--out", str(tmp_path / "anymal/spaces.json")], "spaces.json")
    file, origin = tmp_path / "anymal/dose.json", {**script.origin, "sources_sha256": sources_sha256()}
    rows = [{"controller": one, "parameter": of} for one in ("base", "C-G") for of in ("push", "height")]
    file.write_text(json.dumps({**origin, "dose": rows}))
    assert [script.read_dose(conditions=one) for one in (True, False)] == [rows[:1], rows[1:2]]
    file.write_text(json.dumps({**origin, "seed": 1, "dose": rows}))
    with pytest.raises(ValueError, match="must be of today's sources"):
        script.read_dose(conditions=True)


def test_rounds_say_when_their_hardenings_were_made_and_when_the_file(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "results/anymal").mkdir(parents=True)
    made = {"command": "harden", "commit": "first", "date": "then", "device": "a GPU", "rounds": [{"faults": 3}]}
    monkeypatch.setattr(rounds, "harden_here", lambda script, name: made | {"seed": 5})
    monkeypatch.setattr(rounds, "train_at_once", lambda script: Path("at_once.pt"))
    monkeypatch.setattr(rounds, "last_policy", lambda script, name="hardening": Path("hardened.pt"))
    monkeypatch.setattr(rounds, "search_again", lambda script, name, policy, seed: {"of": name, "seed": seed})
    monkeypatch.setattr(rounds, "publish_controller", lambda script, policy, name: None)
    crossed = {}
    monkeypatch.setattr(rounds, "write_tables", lambda script, of: crossed.update({script.out.name: of}))
    monkeypatch.setenv("FAULTLINE_COMMIT", "second")
    report = rounds.main(["--device", "cpu"])
    of_hardening = {"command": "harden", "commit": "first", "device": "a GPU", "date": "then"}
    assert (report["commit"], report["seed"], report["rounds"]) == ("second", 0, [{"faults": 3}])
    assert report["hardenings"] == {"hardening": of_hardening, "again": of_hardening}
    assert [one["of"] for one in report["again_searches"]] == ["again"] * 3
    assert crossed == {"tables_at_once.json": {"at_once": "at_once.pt", "hardened": "hardened.pt"}}


def test_what_is_published_goes_with_its_archive(tmp_path):
    """What lies beside another archive is taken away; beside the same one it stays."""
    script = common.parse(None, ["--device", "cpu", "--out", str(tmp_path / "anymal/base.json")], "base.json")
    run, folder = tmp_path / "run", tmp_path / "published"
    for place in (run, folder):
        place.mkdir()
        (place / "archive.npz").write_text("one")
    (folder / "minimal.json").write_text("{}")
    script.publish(run, folder, ("archive.npz", "minimal.*"))
    assert (folder / "minimal.json").exists()
    (run / "archive.npz").write_text("another")
    script.publish(run, folder, ("archive.npz", "minimal.*"))
    assert not (folder / "minimal.json").exists() and (folder / "archive.npz").read_text() == "another"


def test_every_script_loads_and_is_listed():
    scripts = {file.stem for file in MAKE.glob("*.py")} - {"bare"}
    text = (MAKE / "all.sh").read_text()
    assert all(hasattr(importlib.import_module(f"results.make.{name}"), "main") for name in scripts - {"common"})
    assert [name for name in scripts if f" {name} " not in text and f"make.{name}" not in text] == []


def test_parts_run_side_by_side_on_all_gpus_each_once(tmp_path, monkeypatch):
    ran, both = [], threading.Barrier(4, timeout=10)

    def run(command, *, env, stdout, stderr, check):
        both.wait()  # four at once, two on each GPU
        ran.append((command[-1], env["CUDA_VISIBLE_DEVICES"]))
        assert command[:3] == [sys.executable, "-m", "results.make.some"] and command[3:-1] == ["--seed=3", "--parts"]
        stdout.write(b"done")
        return SimpleNamespace(returncode=int(command[-1] == "c 3"))

    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(common.wp, "get_cuda_devices", lambda: ["cuda:0", "cuda:1"])
    monkeypatch.setattr(sys.modules["__main__"], "__spec__", SimpleNamespace(name="results.make.some"))
    monkeypatch.setattr(subprocess, "run", run)
    parts = [f"{letter} {number}" for letter in "abcd" for number in (1, 2)]
    common.run_parts(["--seed=3"], parts, 2)
    assert sorted(part for part, _ in ran) == sorted(parts)
    assert [gpu for _, gpu in ran].count("0") == [gpu for _, gpu in ran].count("1") == 4
    assert len(list((tmp_path / "runs/make/logs").glob("*.log"))) == 8
    with pytest.raises(RuntimeError, match=r"^c 3 failed"):
        common.run_parts(["--seed=3"], ["a 1", "c 3", "a 2", "b 1"], 2)


def test_a_file_of_other_sources_or_of_a_trial_is_not_current(tmp_path):
    file, ours = tmp_path / "base.json", {"sources_sha256": sources_sha256()}
    assert not common.is_current(file)
    for content in (ours, {"sources_sha256": "0" * 64}, {**ours, "small": True}, [], None):
        file.write_text(json.dumps(content) if content is not None else "{")
        assert common.is_current(file) == (content == ours)


class Speed:
    """The script of speed.json with parts that count, on devices that need not be there."""

    def __init__(self, folder, monkeypatch):
        self.out, self.calls, self.patch = folder / "new" / "speed.json", [], monkeypatch
        for part in speed.PARTS:
            monkeypatch.setitem(speed.PARTS, part, lambda script, part=part: self.measure(part, script))

    def measure(self, part, script):
        self.calls.append(part)
        return {part: script.origin if part == "cpu" else len(self.calls)}

    def run(self, device, *words):
        """What it writes; device names are as a machine without them has them."""
        self.patch.setattr(common, "resolve_device", lambda name: name)
        report = speed.main(["--device", device, "--out", str(self.out), *words])
        assert report == json.loads(self.out.read_text())
        return report


@pytest.fixture
def speeds(tmp_path, monkeypatch):
    return Speed(tmp_path, monkeypatch)


def test_a_part_of_speed_is_measured_once(speeds):
    for words in (["cuda:0", "--parts", "curve"], ["cpu"], ["cuda:0", "--parts", "flat", "curve"], ["cpu"]):
        report = speeds.run(*words)
    assert speeds.calls == ["curve", "cpu", "flat"] == list(report["measured"])
    assert report | {"curve": 1, "flat": 3, "wide": None, "device": "cuda:0"} == report
    assert report["cpu"]["device"].startswith("CPU")


def test_speeds_of_two_gpus_or_seeds_or_of_a_trial_are_not_mixed(speeds):
    speeds.run("cpu")
    assert list(speeds.run("cuda:0", "--parts", "curve", "flat")["measured"]) == ["cpu", "curve", "flat"]
    report = speeds.run("cuda:1", "--parts", "flat")
    assert list(report["measured"]) == ["cpu", "flat"] and "curve" not in report and report["device"] == "cuda:1"
    assert list(speeds.run("cuda:1", "--parts", "curve", "--seed", "3")["measured"]) == ["curve"]
    assert list(speeds.run("cuda:1", "--parts", "wide", "--seed", "3", "--small")["measured"]) == ["wide"]
    assert list(speeds.run("cuda:1", "--parts", "flat", "--seed", "3")["measured"]) == ["flat"]


def test_a_part_that_fails_leaves_the_others(speeds, monkeypatch):
    before = speeds.run("cuda:0", "--parts", "curve")

    def fail(script):
        raise KeyboardInterrupt

    monkeypatch.setitem(speed.PARTS, "flat", fail)
    with pytest.raises(KeyboardInterrupt):
        speeds.run("cuda:0", "--parts", "flat", "curve")
    assert json.loads(speeds.out.read_text()) == before
    speeds.out.write_text("{")  # a broken file is made again
    assert list(speeds.run("cuda:0", "--parts", "curve")["measured"]) == ["curve"]


@pytest.mark.parametrize("words", [["cuda:0", "--parts", "cpu"], ["cpu", "--parts", "curve"]])
def test_a_part_is_measured_on_its_own_kind_of_device(speeds, words):
    with pytest.raises(ValueError, match="parts"):
        speeds.run(*words)


def test_sources_that_change_meanwhile_are_refused(speeds, monkeypatch):
    def edit(script):
        monkeypatch.setattr(common, "sources_sha256", lambda: "0" * 64)
        return {}

    monkeypatch.setitem(speed.PARTS, "curve", edit)
    with pytest.raises(RuntimeError, match="sources"):
        speeds.run("cuda:0", "--parts", "curve")
    assert not speeds.out.exists()


def test_a_file_that_cannot_be_written_is_found_out_first(speeds):
    speeds.out.mkdir(parents=True)
    with pytest.raises(ValueError, match="directory"):
        speeds.run("cuda:0")
    assert not speeds.calls


def test_rates_of_training_are_of_the_same_device(speeds):
    speeds.run("cuda:0", "--parts", "curve")
    origin = json.loads(speeds.out.read_text())
    row = {"gpus": 1, "num_envs": 4096, "train_env_steps_per_s": 7.0, "device": "cuda:0"}
    rows = [
        row,
        {**row, "num_envs": 8192, "device": "cuda:1"},
        {**row, "peer": "mjlab 1", "train_env_steps_per_s": 2.0},
    ]
    file = speeds.out.with_name("train_speed.json")
    file.write_text(json.dumps({**origin, "rows": rows}))
    report = speeds.run("cuda:0", "--parts", "curve")
    assert [report[f"train_env_steps_per_s{key}"] for key in ("", "_8192", "_mjlab")] == [7.0, None, 2.0]
    file.write_text(json.dumps({**origin, "rows": rows, "sources_sha256": "0" * 64}))
    assert speeds.run("cuda:0", "--parts", "curve")["train_env_steps_per_s"] is None


def test_rows_of_several_runs_say_which_they_are_of(tmp_path, monkeypatch):
    def time_training(script, device, num_envs, steps, iterations):
        return {"gpus": Ranks.from_environment().size, "num_envs": num_envs}

    monkeypatch.setattr(train_speed, "time_training", time_training)
    file = tmp_path / "train_speed.json"
    for commit, gpus in (("first", "1"), ("second", "2")):
        monkeypatch.setenv("FAULTLINE_COMMIT", commit)
        monkeypatch.setenv("WORLD_SIZE", gpus)
        train_speed.main(["--small", "--device", "cpu", "--out", str(file)])
    rows = json.loads(file.read_text())["rows"]
    assert [(row["gpus"], row["num_envs"], row["commit"]) for row in rows] == [
        (1, 8, "first"), (1, 16, "first"), (2, 16, "second"),
    ]  # fmt: skip
    assert rows[0]["command"].startswith("python -m ") and rows[0]["date"] <= rows[2]["date"]
    assert rows[2]["command"].startswith("torchrun --nproc-per-node 2 -m ")


def test_rows_that_are_there_keep_their_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(search_noise, "row_of", lambda script, name: {"search": name})
    words = ["--small", "--device", "cpu", "--out", str(tmp_path / "search_noise.json"), "--parts"]

    def run(commit, *parts):
        monkeypatch.setenv("FAULTLINE_COMMIT", commit)
        report = search_noise.main([*words, *parts])
        assert report == json.loads((tmp_path / "search_noise.json").read_text())
        return report["commit"], [(row["search"], row["commit"]) for row in report["rows"]]

    one, other = "once, seed 0", "once, seed 1"
    assert run("first", one) == run("second", one) == ("first", [(one, "first")])
    assert run("third", one, other) == ("third", [(one, "first"), (other, "third")])


def test_each_search_of_a_method_names_its_commit(tmp_path, monkeypatch):
    monkeypatch.setattr(Compute, "open", lambda self, cfg: open_made_up(cfg))
    monkeypatch.chdir(tmp_path)
    without_figures(monkeypatch)
    out = tmp_path / "anymal/search.json"
    for commit in ("first", "second"):
        monkeypatch.setenv("FAULTLINE_COMMIT", commit)
        report = search.main(["--small", "--device", "cpu", "--out", str(out)])
        (row,) = report["searches"]
        assert (report["commit"], row["commit"]) == (commit, "first")
        assert (row["method"], row["search_seed"]) == ("surrogate", 10)
        assert row["elites"] == report["methods"]["surrogate"]["elites"]


def test_what_a_search_asks_for_is_remembered(tmp_path, monkeypatch):
    without_figures(monkeypatch)
    with speed.remembering() as asked:
        run(tmp_path / "run", iterations=4)
    # Lots of 12 terrains: one is put in first, one behind each iteration, and the last is not crossed.
    assert [len(lot) for lot in asked] == [12] * 5
    assert sum(row["terrains"] for row in rows_of(tmp_path / "run")) == 4 * 12


def test_robots_that_have_ended_are_left_out_of_bare_physics(anymal, device):
    # Two robots for 60 control steps, of which the first 10 of every 20 are replayed. One ends behind the 15th: of
    # (2 + 1 + 1) * 10 control steps, 4 physics steps each, count.
    rollout = Rollout(
        replace(anymal, max_duration_s=1.2), anymal.policy_file, num_terrains=1, num_replicas=2, device=device
    )
    steps, step = [], rollout.control_step

    def end_one():
        step()
        steps.append(None)
        if len(steps) == 15:
            rollout.outcome.assign([rollout.outcome.numpy()[0], Outcome.TIME_OUT])

    rollout.control_step = end_one
    level, seeds = np.zeros((1, NUM_ROWS, NUM_COLS), np.float32), np.zeros(1, np.uint32)
    motion = bare.Motion(rollout.sim, bare.record_segments(rollout, level, seeds))
    assert motion.robot_steps == 160
    assert motion.replay() > 0.0 and rollout.sim.parked.numpy().tolist() == [0, 2]
    assert rollout.sim.joint_q.numpy()[1, 2] == PARKING_HEIGHT
    owner = Stub(None)  # of arrays, of which a graph has the addresses alone
    kept, beside = weakref.ref(owner), bare.Motion(rollout.sim, [], partial(bool, owner))
    del owner
    beside.stand(1)
    assert kept() is not None


def test_means_over_seeds():
    # Of 1, 2 and 6 the mean is 3 and the standard deviation sqrt(7); t at 97.5 % and 2 degrees of freedom is 4.303.
    half = 4.303 * np.sqrt(7) / np.sqrt(3)
    numbers = common.mean_over_seeds("elites", [1, 2, 6])
    assert numbers["elites"] == 3
    assert numbers["elites_interval"] == pytest.approx([3 - half, 3 + half], rel=1e-3)
    assert common.mean_over_seeds("faults", [1, None]) == {"faults": None, "faults_interval": None}


def test_rates_are_of_valid_episodes():
    np.testing.assert_array_equal(common.crossing_rates(OURS, "success"), [0.75, 0.0, np.nan, 1.0])
    np.testing.assert_array_equal(common.crossing_rates(OURS, "goal"), [0.5, 0.0, np.nan, 1.0])
    assert np.isnan(common.crossing_rates(THEIRS[3:], "goal"))  # they still run
    rates = common.crossing_rates(np.uint8([[INVALID, GOAL, GOAL, HIT], [INVALID, INVALID, GOAL, GOAL]]), "goal")
    np.testing.assert_array_equal(rates, [2 / 3, np.nan])  # more than a quarter of the second's are invalid


def test_bias_and_distance_are_of_terrains_that_both_have():
    # Success .75 and 0 against 1 and .25: both .25 lower. Goal .5 and 0 against .25 and .25: once more, once less.
    numbers = common.agreement(OURS, THEIRS, seed=0)
    assert numbers["terrains"] == 2
    assert numbers["success_bias"] == -0.25 and numbers["success_difference"] == 0.25
    low, high = numbers["success_bias_interval"]  # two terrains say little, though they agree
    assert -1.0 < low < -0.5 and 0.2 < high < 0.5
    assert numbers["goal_bias"] == 0.0 and numbers["goal_difference"] == 0.25
    low, high = numbers["goal_bias_interval"]
    assert -0.8 < low < -0.25 and high == pytest.approx(-low)
    assert common.agreement(OURS, THEIRS, seed=0, families=np.zeros(4, np.int64))["goal_bias_interval"] is None
    numbers = common.agreement(OURS[2:], THEIRS[2:], seed=0)
    assert numbers.pop("terrains") == 0 and set(numbers.values()) == {None}


def test_differences_are_of_the_later_kind_minus_the_earlier():
    rates = {"C-HR": np.full(24, 0.75), "C-G": np.full(24, 0.52), "C-G@1": np.full(24, 0.5)}
    [(pair, row)] = tables.differences_of(rates, np.arange(24), 0).items()
    assert pair == "C-G - C-HR" and row["goal"] == pytest.approx(0.51 - 0.75) and row["seeds"] == [2, 1]


def test_pages_say_what_the_files_say():
    assert docs.main(["--check"]) == 0


def test_a_table_is_written_between_its_marks(tmp_path, monkeypatch):
    (tmp_path / "docs").mkdir()
    (tmp_path / "README.md").write_text("Before.\n<!-- table: spaces -->\nold\n<!-- end -->\nBehind.\n")
    counts = {"space": "course", "elites": 1234, "faults": None}
    monkeypatch.setattr(docs, "ROOT", tmp_path)
    monkeypatch.setattr(docs, "of_robots", lambda file: {"Dog": {"spaces": {"course": counts}}})
    assert docs.main(["--check"]) == 1 and docs.main([]) == 0 and docs.main(["--check"]) == 0
    lines = ["Before.", "<!-- table: spaces -->", "|  | elites |", "|---|---|", "| Dog, course | 1,234 |"]
    assert (tmp_path / "README.md").read_text().splitlines() == [*lines, "<!-- end -->", "Behind."]
    with pytest.raises(ValueError, match="absent"):
        docs.with_tables("<!-- table: absent -->\n<!-- end -->")


def test_a_cell_is_a_number_with_its_interval():
    rows = {"a": {"share": 0.5, "share_interval": [0.2, 1.0]}, "b": {"share": 0.25}}
    made = docs.table(rows, {"cm": docs.shown("share", ".1f", 100), "rate": docs.shown("share", ".2f")}, upright=True)
    assert made.splitlines()[2:] == ["| cm | 50.0 (20.0 to 100.0) | 25.0 |", "| rate | 0.50 (0.20 to 1.00) | 0.25 |"]


def test_a_rate_of_training_names_the_packages_of_another_learner():
    rows = [{"train_env_steps_per_s": 2000.4}, {"train_env_steps_per_s": 7.0, "versions": {"a": "1.2"}}]
    row = {"ours": 2000.4, "theirs": 7.0, "lost": 3.0, "training": rows}
    cells = [docs.trained(key)(row) for key in ("ours", "theirs", "lost", "absent")]
    assert cells == ["2,000", "7 (a 1.2)", "-", "-"]


def test_results_name_no_path_of_the_machine_that_made_them():
    files = [file for kind in ("*.json", "*.jsonl") for file in MAKE.parent.rglob(kind)]
    place = re.compile(r"(?<![\w.])/(tmp|home|root|work|opt|mnt|usr)/")
    assert files and [str(file) for file in files if place.search(file.read_text())] == []
