"""Hardening: its steps in order, what goes on after a stop anywhere, what is written, comparisons, errors."""

import json
import os
import signal
import time
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch

from kernels.episode import Outcome
from qd.archive import read_archive, write_archive
from qd.evaluate.marks import marks_of
from qd.evaluate.sets import make_sets, split_elites
from sim.files.atomic import read_json, to_json
from sim.files.command import Interrupted, run_command
from sim.policy.spec import controller_hash
from sim.robots.find import get_robot
from sim.rollout import RolloutResult
from tests.train.results import result_of
from tests.train.starts import write_actor
from train import choice, hardening
from train.harden import Harden
from train.hardening import harden, hardening_of

ROBOT = get_robot("anymal")
ITERATIONS = 3
WORSE = set[str]()  # runs of trainings after which nobody arrives


class Crossings:
    """Crossings at once: nobody arrives under the base, everybody under the certifier, half under what was trained.

    Args:
        die_after: Crossings after which Ctrl-C is pressed.
    """

    def __init__(self, die_after: int = 10_000) -> None:
        self.left, self.made = die_after, []

    @contextmanager
    def open(self, cfg):
        def evaluate(terrains, seeds, progress=None):
            if not self.left:
                raise KeyboardInterrupt
            self.left -= 1
            self.made.append((cfg.policy, cfg.resolved, len(seeds)))
            return crossed(cfg, seeds)

        yield evaluate


def crossed(cfg, seeds) -> RolloutResult:
    shape = (len(seeds), cfg.num_replicas)
    share = 1.0 if "certifier" in cfg.policy else 0.0 if "start" in cfg.policy else 0.5
    share *= cfg.policy.split("/")[-2] not in WORSE
    arrived = np.arange(shape[1]) < share * shape[1] * np.ones((shape[0], 1))
    outcomes = np.where(arrived, Outcome.GOAL, Outcome.BASE_COLLISION)
    rows = [np.random.default_rng(int(seed)).dirichlet(np.full(6, 0.3)) for seed in seeds]
    reward = np.ones(shape) if cfg.reward else None
    result = result_of(outcomes, names=ROBOT.penalties, reward=reward)
    penalties = 50.0 * np.array(rows)[:, None] * np.array(ROBOT.read_penalty_scales()) * np.ones((*shape, 1))
    return replace(result, penalties=penalties)


def stub_tune(job, tune):
    """A training that changes one weight; its record names what it trained on."""
    tune.run.mkdir()
    content = torch.load(tune.start, weights_only=True)
    state = content["actor_state_dict"]
    state["mlp.0.bias"] = state["mlp.0.bias"] + len(tune.run.name) + len(tune.archives)
    torch.save(content, tune.run / "policy.pt")
    torch.save(content, tune.run / "checkpoint.pt")
    record = {"iterations": job.tune_sizes["iterations"], "archives": [str(run) for run in tune.archives]}
    (tune.run / "policy.train.json").write_bytes(to_json(record))


@pytest.fixture
def places(tmp_path):
    write_actor(tmp_path / "start.pt")
    content = torch.load(tmp_path / "start.pt", weights_only=True)
    content["actor_state_dict"]["mlp.0.bias"] -= 1.0
    torch.save(content, tmp_path / "certifier.pt")
    return tmp_path


def config(places, **changes):
    values = {
        "policy": places / "start.pt", "run_dir": places / "run", "rounds": 2, "device": "cpu", "workers": "1",
        "emitters": 1, "batch_size": 12, "replicas": 2, "search_episodes": 20, "tune_iterations": ITERATIONS,
        "terrains": 3, "episodes": 2, "by": (f"C={places / 'certifier.pt'}",),
    }  # fmt: skip
    return Harden(**values | changes)


def rounds_of(places):
    return read_json(places / "run" / "rounds.json")


def numbers(content):
    """What a hardening found, without when and how."""
    return {name: content[name] for name in ("settings", "rounds", "comparisons", "tables", "robot")}


@pytest.fixture(autouse=True)
def _no_figures(monkeypatch):
    """Searches draw theirs otherwise, which takes longer than all the rest here."""
    monkeypatch.setattr("qd.show.figures.write_figures", lambda *_: [])


@pytest.fixture
def stubbed(monkeypatch):
    monkeypatch.setattr(hardening, "_tune", stub_tune)


def test_rounds_from_end_to_end(places, stubbed, capsys):
    crossings = Crossings()
    assert harden(config(places), open_evaluator=crossings.open) == 0
    content = rounds_of(places)
    assert [row["controller"] for row in content["rounds"]] == ["base", "round-1", "round-2"]
    assert [row["tuned"] for row in content["rounds"]] == [[], ["tune-1"], ["tune-2"]]
    for number, row in enumerate(content["rounds"]):
        archive = read_archive(places / "run" / f"search-{number}")
        assert row["search"] == f"search-{number}" and row["episodes"] == 24 and row["panel"] == ["C"]
        assert row["elites"] == len(archive) >= 5 and row["failing"] == int(archive.failing.sum())
        assert row["policy_sha256"] == archive.policy_sha256
    base, *later = content["rounds"]
    assert base["faults"] == base["failing"] == base["elites"]  # nobody arrives, and the certifier always does
    assert all(row["failing"] == row["confirmed"] == row["certified"] == row["faults"] == 0 for row in later)
    assert len({row["policy_sha256"] for row in content["rounds"]}) == 3
    records = [read_json(places / "run" / f"tune-{number}" / "policy.train.json") for number in (1, 2)]
    assert [len(record["archives"]) for record in records] == [1, 2]
    assert content["settings"]["search"]["episodes"] == 24  # 20 are rounded up
    assert content["settings"]["search"]["method"] == "surrogate"
    for key in ("command", "commit", "device", "versions", "seed", "date", "robot_sha256"):
        assert key in content, key
    said = capsys.readouterr().out
    assert f"report --robot anymal --run {places / 'run'}" in said and "round-2     " in said
    before = len(crossings.made)
    assert harden(config(places), open_evaluator=crossings.open) == 0  # nothing is left to be done
    assert len(crossings.made) == before and len(rounds_of(places)["sessions"]) == 2
    assert numbers(rounds_of(places)) == numbers(content)


def test_every_controller_is_evaluated_on_the_fixed_sets_and_every_archive(places, stubbed):
    harden(config(places, rounds=1), open_evaluator=Crossings().open)
    tables = rounds_of(places)["tables"]
    assert list(tables["goal"]) == ["hand_crafted", "hard_random", "search-0", "search-1"]
    assert all(row == {"base": 0.0, "round-1": 0.5} for row in tables["goal"].values())
    fates = tables["differences"]["search-0"]["base -> round-1"]
    assert fates["mended"]["count"] == fates["compared"] == tables["terrains"]["search-0"] >= 1
    archive = read_archive(places / "run" / "search-0")
    held_out = split_elites(archive).test
    assert set(fates["mended"]["terrains"]) <= set(held_out.tolist())


@pytest.mark.slow
def test_stopped_after_every_crossing_it_comes_to_the_same(places, stubbed):
    whole = config(places, rounds=1, run_dir=places / "whole")
    harden(whole, open_evaluator=Crossings().open)
    expected = numbers(read_json(places / "whole" / "rounds.json"))
    made = []
    for _session in range(60):
        crossings = Crossings(die_after=1)
        try:
            assert harden(config(places, rounds=1), open_evaluator=crossings.open) == 0
            break
        except Interrupted as stop:
            assert "Go on with:" in str(stop) and f"--run-dir {places / 'run'}" in str(stop)
            assert len(crossings.made) == 1  # each session gets further
        finally:
            made += crossings.made
    got = numbers(rounds_of(places))
    assert json.dumps(got).replace("/run/", "/whole/") == json.dumps(expected)
    assert len(set(made)) > 5


def test_stopped_in_a_training_it_goes_on_with_it(places, monkeypatch):
    begun = []

    def stopped(job, tune):
        begun.append(tune.run.name)
        if len(begun) == 1:
            raise KeyboardInterrupt
        stub_tune(job, tune)

    monkeypatch.setattr(hardening, "_tune", stopped)
    with pytest.raises(Interrupted, match=r"what is finished is kept\. Go on with:"):
        harden(config(places), open_evaluator=Crossings().open)
    assert [row["controller"] for row in rounds_of(places)["rounds"]] == ["base"]
    assert harden(config(places), open_evaluator=Crossings().open) == 0
    assert begun == ["tune-1", "tune-1", "tune-2"]


@pytest.fixture
def worse():
    """Names of trainings after which nobody arrives."""
    yield WORSE
    WORSE.clear()


def test_a_training_that_makes_it_worse_is_not_kept(places, stubbed, worse, capsys):
    worse.add("tune-2")
    crossings = Crossings()
    harden(config(places, rounds=3), open_evaluator=crossings.open)
    content, run = rounds_of(places), places / "run"
    assert {name: choice["kept"] for name, choice in content["choices"].items()} == {
        "tune-1": True, "tune-2": False, "tune-3": True,
    }  # fmt: skip
    assert "tune-2 was not kept: its goal rate on validation is 0.000, before 0.500" in capsys.readouterr().out
    first, second, third = content["rounds"][1:]
    assert second["policy_sha256"] == first["policy_sha256"] != third["policy_sha256"]
    assert (second["tuned"], second["kept"], second["search"]) == (["tune-2"], [False], "search-2")
    job = hardening_of(config(places, rounds=3))
    assert job.stages[3].tunes[0].start == run / "tune-1" / "checkpoint.pt"
    assert read_archive(run / "search-2").policy_sha256 == first["policy_sha256"]
    assert content["tables"]["goal"]["hand_crafted"]["round-2"] == 0.5
    before = len(crossings.made)
    harden(config(places, rounds=3), open_evaluator=crossings.open)
    assert len(crossings.made) == before and numbers(rounds_of(places)) == numbers(content)


def test_the_choice_is_by_terrains_that_are_not_reported(places, stubbed, monkeypatch):
    seen = {}
    real = choice.cross_all

    def cross(controllers, sets, *args, **kwargs):
        seen.update(sets)
        return real(controllers, sets, *args, **kwargs)

    monkeypatch.setattr(choice, "cross_all", cross)
    harden(config(places, rounds=1), open_evaluator=Crossings().open)
    assert list(seen) == ["hand_crafted", "hard_random", "search-0"]
    assert list(rounds_of(places)["choices"]["tune-1"]["goal"]["after"]) == ["hand_crafted", "hard_random", "elites"]
    archive = read_archive(places / "run" / "search-0")
    split = split_elites(archive)
    assert set(marks_of(seen["search-0"].terrains)) == set(marks_of(archive.genes[split.validation]))
    reported = make_sets(("hand_crafted", "hard_random"), 3, 0)
    assert not any(np.array_equal(seen[name].terrains, one.terrains) for name, one in reported.items())


def test_the_last_is_kept_where_that_is_asked_for(places, stubbed, worse):
    worse.add("tune-2")
    harden(config(places, keep="last"), open_evaluator=Crossings().open)
    content = rounds_of(places)
    assert content.get("choices", {}) == {} and content["rounds"][2]["kept"] == [True]
    assert content["tables"]["goal"]["hand_crafted"]["round-2"] == 0.0
    with pytest.raises(ValueError, match="holds a hardening of other settings: keep"):
        harden(config(places), open_evaluator=Crossings().open)


def test_a_run_begun_with_another_recipe_is_refused(places, stubbed):
    harden(config(places, rounds=1), open_evaluator=Crossings().open)
    content = rounds_of(places)
    for name in ("noise_of", "num_envs"):  # as of before they were named
        del content["settings"]["tune"][name]
    (places / "run" / "rounds.json").write_bytes(to_json(content))
    with pytest.raises(ValueError, match=r"other settings: tune\.noise_of .*, tune\.num_envs "):
        harden(config(places, rounds=1), open_evaluator=Crossings().open)


def test_killed_before_the_choice_it_is_made_before_anything_is_told(places, stubbed):
    job = hardening_of(config(places, rounds=1), open_evaluator=Crossings().open)
    harden(config(places, rounds=1), open_evaluator=Crossings().open)
    whole = rounds_of(places)
    content = {name: value for name, value in whole.items() if name != "choices"}
    (places / "run" / "rounds.json").write_bytes(to_json(content))
    assert not job.is_settled(job.stages[1])
    harden(config(places, rounds=1), open_evaluator=Crossings().open)
    assert numbers(rounds_of(places)) == numbers(whole) and rounds_of(places)["choices"] == whole["choices"]


def test_a_training_made_anew_is_judged_anew(places, stubbed):
    harden(config(places, rounds=1), open_evaluator=Crossings().open)
    job = hardening_of(config(places, rounds=1))
    assert job.stages[1].tunes[0].kept
    torch.save(torch.load(places / "certifier.pt", weights_only=True), places / "run" / "tune-1" / "policy.pt")
    assert job.stages[1].tunes[0].kept is None
    told = rounds_of(places)["rounds"]
    with pytest.raises(ValueError, match=r"must be the controller that .*search-1 was searched with, got another"):
        harden(config(places, rounds=1), open_evaluator=Crossings().open)
    assert rounds_of(places)["rounds"] == told  # nothing is lost, and no row mixes two controllers


def test_a_lost_choice_is_made_again_from_the_crossings(places, stubbed, worse):
    worse.add("tune-1")
    harden(config(places, rounds=1), open_evaluator=Crossings().open)
    whole = rounds_of(places)
    (places / "run" / "rounds.json").write_bytes(to_json({**whole, "choices": {}}))
    crossings = Crossings()
    harden(config(places, rounds=1), open_evaluator=crossings.open)
    assert crossings.made == [] and rounds_of(places)["choices"] == whole["choices"]
    assert numbers(rounds_of(places)) == numbers(whole)


def test_a_lost_choice_between_rounds_may_fall_on_any_controller(places, stubbed, worse):
    worse.update(("tune-2", "tune-3"))
    harden(config(places, rounds=3), open_evaluator=Crossings().open)
    whole = rounds_of(places)
    content = {**whole, "choices": {"tune-1": whole["choices"]["tune-1"]}}
    (places / "run" / "rounds.json").write_bytes(to_json(content))
    harden(config(places, rounds=3), open_evaluator=Crossings().open)  # the third search is of the first training
    assert numbers(rounds_of(places)) == numbers(whole) and rounds_of(places)["choices"] == whole["choices"]


def test_a_training_that_is_gone_is_refused_before_it_is_made_again(places, stubbed):
    harden(config(places, rounds=1), open_evaluator=Crossings().open)
    whole = rounds_of(places)
    (places / "run" / "tune-1").rename(places / "elsewhere")
    with pytest.raises(ValueError, match=r"tune-1 must be there, whole, as .*search-1 was searched after it: put a"):
        harden(config(places, rounds=1), open_evaluator=Crossings().open)
    assert rounds_of(places) == whole
    (places / "elsewhere").rename(places / "run" / "tune-1")
    assert harden(config(places, rounds=1), open_evaluator=Crossings().open) == 0


def test_trainings_of_a_comparison_are_chosen_too(places, stubbed, worse, capsys):
    worse.update(("tune-hard_random-2", "tune-2"))
    harden(config(places, against=("hard_random",)), open_evaluator=Crossings().open)
    content, run = rounds_of(places), places / "run"
    assert content["comparisons"]["hard_random"]["kept"] == [True, False]
    archive = read_archive(run / "search-hard_random-2")
    assert archive.policy_sha256 == controller_hash(str(run / "tune-hard_random-1" / "policy.pt"))
    assert list(content["choices"]["tune-hard_random-1"]["goal"]["after"]) == ["hand_crafted", "hard_random"]
    assert f"The hardened controller:  {run / 'tune-1' / 'policy.pt'}" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("after", "kept", "why"),
    [
        ((0.98, 0.96, 0.5), True, "its goal rate on validation is 0.813, before 0.793"),
        ((0.97, 0.95, 0.5), True, "its goal rate on validation is 0.807, before 0.793"),  # a point less than the base
        ((0.98, 0.96, 0.4), False, "its goal rate on validation is 0.780, before 0.793"),
        ((0.96, 0.97, 0.9), False, "; on hand_crafted it is 0.020 below the base's"),
        ((0.975, 0.93, 0.9), False, "; on hard_random it is 0.030 below the base's"),
    ],
)
def test_what_is_kept_is_no_worse_and_loses_nothing_on_ordinary_terrains(after, kept, why):
    names = ("hand_crafted", "hard_random", "elites")
    base, before = (dict(zip(names, row, strict=True)) for row in ((0.98, 0.96, 0.1), (0.98, 0.96, 0.44)))
    found = choice.verdict(base, before, dict(zip(names, after, strict=True)))
    assert found["kept"] is kept and why in found["why"]


def test_a_training_that_is_cut_short_is_not_taken_for_whole(places, stubbed):
    job = hardening_of(config(places), open_evaluator=Crossings().open)
    tune = replace(job.stages[1].tunes[0], start=places / "start.pt")
    assert not job.is_tuned(tune)
    (places / "run").mkdir()
    stub_tune(replace(job, tune_sizes={"iterations": ITERATIONS - 1}), tune)
    assert not job.is_tuned(tune)
    (tune.run / "policy.train.json").write_bytes(to_json({"iterations": ITERATIONS}))
    assert job.is_tuned(tune)


def test_its_searches_begin_with_other_terrains_than_those_that_controllers_are_tested_on(places):
    job = hardening_of(config(places), open_evaluator=Crossings().open)
    other = hardening_of(config(places, seed=1), open_evaluator=Crossings().open)
    seeds = [stage.seed for stage in (*job.stages, *other.stages)]
    assert seeds == [100, 101, 102, 200, 201, 202]  # plain searches have seeds 0, 1, ...


def test_more_rounds_continue_a_finished_run(places, stubbed):
    harden(config(places, rounds=1), open_evaluator=Crossings().open)
    first = rounds_of(places)["rounds"]
    crossings = Crossings()
    harden(config(places, rounds=2), open_evaluator=crossings.open)
    assert rounds_of(places)["rounds"][:2] == first and len(rounds_of(places)["rounds"]) == 3
    assert (str(places / "start.pt"), False, 12) not in crossings.made  # the first search is not made again


@pytest.mark.slow
def test_comparisons_spend_as_many_trainings_otherwise(places, stubbed):
    harden(config(places, rounds=2, against=("hard_random", "first_archive")), open_evaluator=Crossings().open)
    content = rounds_of(places)
    assert list(content["comparisons"]) == ["hard_random", "first_archive"]
    for kind, archives in (("hard_random", []), ("first_archive", [str(places / "run" / "search-0")])):
        row = content["comparisons"][kind]
        assert (row["controller"], row["rounds"], row["episodes"]) == (kind, 2, 24)
        assert row["tuned"] == ["tune-1" if archives else f"tune-{kind}-1", f"tune-{kind}-2"]
        records = [read_json(places / "run" / name / "policy.train.json") for name in row["tuned"]]
        assert [record["archives"] for record in records] == [archives, archives]
    assert list(content["tables"]["controllers"]) == ["base", "round-1", "round-2", "hard_random", "first_archive"]
    assert "search-hard_random-2" not in content["tables"]["goal"]
    harden(config(places, rounds=2), open_evaluator=Crossings().open)  # what was compared stays in the tables
    assert numbers(rounds_of(places)) == numbers(content)


def test_a_comparison_of_fewer_rounds_stays_in_the_tables(places, stubbed):
    harden(config(places, rounds=1, against=("hard_random",)), open_evaluator=Crossings().open)
    before, crossings = rounds_of(places), Crossings()
    harden(config(places, rounds=2), open_evaluator=crossings.open)
    content = rounds_of(places)
    assert content["comparisons"] == before["comparisons"] and content["comparisons"]["hard_random"]["rounds"] == 1
    assert [row["controller"] for row in content["rounds"]] == ["base", "round-1", "round-2"]
    goal = content["tables"]["goal"]
    assert goal["hand_crafted"]["hard_random"] == before["tables"]["goal"]["hand_crafted"]["hard_random"]
    assert "hard_random" in goal["search-1"]  # on what the rounds found since, too
    assert not (places / "run" / "search-hard_random-2").exists()
    (places / "run" / "search-hard_random-1").rename(places / "elsewhere")
    harden(config(places, rounds=2), open_evaluator=crossings.open)  # which is no reason to make it again
    assert rounds_of(places)["comparisons"] == before["comparisons"]
    assert "hard_random" not in rounds_of(places)["tables"]["controllers"]


def test_a_comparison_that_grows_is_one_controller_at_a_time(places, stubbed, monkeypatch):
    harden(config(places, rounds=1, against=("hard_random",)), open_evaluator=Crossings().open)
    before = rounds_of(places)["comparisons"]
    longer, search = config(places, rounds=2, against=("hard_random",)), hardening._search

    def stop(job, stage):
        if stage.compared:
            raise KeyboardInterrupt
        search(job, stage)

    with monkeypatch.context() as stopped, pytest.raises(Interrupted):
        stopped.setattr(hardening, "_search", stop)
        harden(longer, open_evaluator=Crossings().open)
    content = rounds_of(places)
    assert content["comparisons"] == before and "hard_random" not in content["tables"]["controllers"]
    harden(longer, open_evaluator=Crossings().open)
    content = rounds_of(places)
    row, about = content["comparisons"]["hard_random"], content["tables"]["controllers"]["hard_random"]
    assert (row["rounds"], row["policy_sha256"]) == (2, about["sha256"])


def test_a_comparison_that_began_with_a_training_of_its_own_goes_on_so(places):
    flags = config(places, rounds=2, against=("first_archive",))
    job = hardening_of(flags, open_evaluator=Crossings().open)
    assert [tune.run.name for tune in job.stages[-1].tunes] == ["tune-1", "tune-first_archive-2"]
    assert job.stages[-1].tunes[1].start == places / "run" / "tune-1" / "checkpoint.pt"
    (places / "run" / "tune-first_archive-1").mkdir(parents=True)
    tunes = job.stages[-1].tunes
    assert [tune.run.name for tune in tunes] == ["tune-first_archive-1", "tune-first_archive-2"]
    assert tunes[1].start == places / "run" / "tune-first_archive-1" / "checkpoint.pt"


def test_the_time_limit_stops_it_as_ctrl_c_does(places, monkeypatch, capsys):
    def endless(job, tune):
        time.sleep(60)

    monkeypatch.setattr(hardening, "_tune", endless)
    harden_once = config(places, rounds=1)
    before = signal.getsignal(signal.SIGALRM)
    assert harden(replace(harden_once, max_seconds=3.0), open_evaluator=Crossings().open) == 0
    assert "The time is up. Stopped; what is finished is kept. Go on with:" in capsys.readouterr().out
    assert signal.getsignal(signal.SIGALRM) == before


def test_the_time_limit_holds_in_the_background_where_ctrl_c_is_ignored(places, monkeypatch, capsys):
    monkeypatch.setattr(hardening, "_run", lambda job, number: time.sleep(60))
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        assert harden(config(places, max_seconds=0.5), open_evaluator=Crossings().open) == 0
    finally:
        signal.signal(signal.SIGINT, before)
    assert "The time is up. Stopped" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rounds": 0}, "rounds must be at least 1, got 0"),
        ({"policy": "nowhere.pt"}, "no such file"),
        ({"policy": "script.pt"}, "a fine-tuning starts from an rsl_rl checkpoint"),
        ({"by": ("C=start.pt",)}, "by must name a certifier other than start.pt, got C"),
        ({"by": ()}, "panel must hold certifiers of anymal"),
        ({"preset": "huge"}, "unknown preset 'huge'"),
        ({"rounds": 1, "against": ("first_archive",)}, "needs rounds of at least 2, got 1"),
        ({"tune_num_envs": 5}, "num_envs must be at least as many as terrains, 12, got 5"),
        ({"run_dir": "full"}, "is not empty and holds no rounds.json"),
        ({"run_dir": "other"}, "holds a hardening of other settings: "),
    ],
)
def test_errors_come_before_any_work_in_one_line(places, changes, message, monkeypatch, capsys):
    monkeypatch.chdir(places)
    torch.jit.script(torch.nn.Linear(235, 12)).save("script.pt")
    for name, content in (("full/file", b""), ("other/rounds.json", to_json({"settings": {"seed": 5}}))):
        (places / name).parent.mkdir()
        (places / name).write_bytes(content)
    flags = {"policy": "start.pt", "by": ("C=certifier.pt",), "run_dir": "run", "device": "cpu"} | changes
    given = [word for name, value in flags.items() for word in words_of(name, value)]
    before = sorted(os.listdir(places))
    assert run_command(Harden, given, name="harden") == 2
    (error,) = capsys.readouterr().err.splitlines()
    assert message in error and error.startswith("error: ")
    assert sorted(os.listdir(places)) == before


def words_of(name, value):
    values = [str(item) for item in value] if isinstance(value, tuple) else [str(value)]
    return [f"--{name.replace('_', '-')}", *values] if values else []


def test_too_few_elites_to_train_on_are_said(places, stubbed):
    with pytest.raises(ValueError, match=r"must have found at least 5 elites to train on, got [0-4]: give more"):
        harden(config(places, batch_size=2, search_episodes=4), open_evaluator=Crossings().open)


def test_fewer_rounds_than_are_done_are_refused(places, stubbed):
    harden(config(places), open_evaluator=Crossings().open)
    with pytest.raises(ValueError, match=r"rounds must be at least 2, as many as .*run has done, got 1"):
        harden(config(places, rounds=1), open_evaluator=Crossings().open)
    assert len(rounds_of(places)["rounds"]) == 3


def test_all_searches_have_the_same_certifiers(places, stubbed):
    harden(config(places, rounds=1), open_evaluator=Crossings().open)
    content = torch.load(places / "certifier.pt", weights_only=True)
    content["actor_state_dict"]["mlp.0.bias"] -= 1.0
    torch.save(content, places / "certifier_2.pt")
    both = tuple(f"{name}={places / file}.pt" for name, file in (("C", "certifier"), ("D", "certifier_2")))
    with pytest.raises(ValueError, match=r"must have the same certifiers, got certificates of C in search-0, who is"):
        harden(config(places, by=both[1:]), open_evaluator=Crossings().open)
    harden(config(places, by=both), open_evaluator=Crossings().open)
    assert [row["panel"] for row in rounds_of(places)["rounds"]] == [["C", "D"]] * 3


def test_what_was_changed_behind_its_back_is_refused(places, stubbed):
    harden(config(places, rounds=1), open_evaluator=Crossings().open)
    archive, tuned = places / "run" / "search-0" / "archive.npz", places / "run" / "tune-1" / "policy.pt"
    whole = archive.read_bytes()
    write_archive(archive, replace(read_archive(archive.parent), iterations=7))
    with pytest.raises(ValueError, match=r"search-0 must have 1 iterations, as all searches .* got 7: put a copy"):
        harden(config(places), open_evaluator=Crossings().open)
    archive.write_bytes(whole)
    tuned.write_bytes((places / "certifier.pt").read_bytes())
    with pytest.raises(ValueError, match=r"policy.pt must be the controller that .*search-1 was searched with, got an"):
        harden(config(places), open_evaluator=Crossings().open)


def test_killed_between_an_archive_and_its_numbers_it_makes_them_again(places, stubbed):
    harden(config(places, rounds=1), open_evaluator=Crossings().open)
    expected, summary = rounds_of(places), places / "run" / "search-1" / "archive.json"
    content = read_json(summary)
    stale = {"confirmed": None, "certified": None, "faults": None, "panel": []}  # as before the last lot
    early = {**content, **stale, "elites_reproduced": None, "corrected_elites": None, "reproduced_by": None}
    for damaged in (to_json({**content, **stale}), to_json(early), b"{"):
        summary.write_bytes(damaged)
        assert harden(config(places, rounds=1), open_evaluator=Crossings().open) == 0
        assert rounds_of(places)["rounds"] == expected["rounds"]


@pytest.mark.parametrize(
    ("key", "value"),
    [
        ("comparisons", {"hard_random": 3}), ("comparisons", {"hard_random": {"rounds": "2"}}), ("comparisons", []),
        ("comparisons", {"hard_random": {"rounds": True}}), ("comparisons", {"another": {"rounds": 1}}),
        ("rounds", 3), ("settings", 1), ("sessions", {}),
    ],
)  # fmt: skip
def test_a_damaged_file_of_rounds_is_said(places, key, value):
    (places / "run").mkdir()
    (places / "run" / "rounds.json").write_bytes(to_json({key: value}))
    with pytest.raises(ValueError, match=rf"rounds\.json is damaged at {key}: put a copy of it back"):
        hardening_of(config(places))
