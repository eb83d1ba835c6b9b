"""Hardening: its rounds in order, which trainings are kept, what is written, going on after a stop, and errors."""

import os
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from kernels.episode import Outcome
from qd.evaluate.sets import generated_set, hash_elites, make_sets, read_trained_on, split_elites
from qd.search.archive import read_archive, write_archive
from qd.search.directory import RunDirectory
from qd.workers.compute import Compute
from sim.files.atomic import read_json, to_json
from sim.files.command import Interrupted, run_command
from sim.robots.find import get_robot
from tests.builders import fresh_values, make_archive
from tests.qd.stand_in import Stub, compute_by, result_of
from tests.train.conftest import PPO, write_actor
from train import harden as module
from train.cfg import FinetuneCfg, HardenCfg, RoundEvaluationCfg, RoundSearchCfg
from train.commands import HardenCommand
from train.harden import harden, verdict

ROBOT = get_robot("anymal")
CPU = Compute(device="cpu", workers="1")


class World:
    """Stands for searches, trainings and simulations: nobody arrives under the base, half under what was trained.

    After the trainings in ``worse`` nobody arrives. ``searched`` has controller, seed and iterations of each search.
    """

    def __init__(self, *worse: str) -> None:
        self.worse, self.stop_in = worse, ""
        self.searched, self.trained, self.asked = {}, {}, {}

    def _work(self, run) -> bool:
        """Whether there is work to do in a run; Ctrl-C comes in the middle of ``stop_in``."""
        if (run / "done").exists():
            return False
        run.mkdir(exist_ok=True)
        if run.name == self.stop_in:
            self.stop_in = ""
            raise KeyboardInterrupt
        (run / "done").touch()
        return True

    def search(self, cfg, run, compute, **_) -> None:
        self.asked[run.name] = cfg
        if self._work(run):
            self.searched[run.name] = (cfg.policy, cfg.seed, cfg.iterations)
            archive = replace(make_archive(20, seed=cfg.seed), policy_sha256=cfg.policy_sha256)
            write_archive(run / "archive.npz", archive)

    def judge(self, run, **_):
        archive = read_archive(run)
        archive = replace(archive, fresh=fresh_values(archive))
        counts = {"elites": len(archive), "failing": int(archive.failing.sum()), "faults": None, "faults_panel": 3}
        (run / "archive.json").write_bytes(to_json(counts))
        return archive

    def finetune(self, robot, cfg, run, options) -> Path:
        if self._work(run):
            self.trained[run.name] = cfg
            content = torch.load(cfg.policy, weights_only=True)
            content["actor_state_dict"]["mlp.0.bias"] += len(self.trained)
            for name in ("policy.pt", "checkpoint.pt"):
                torch.save(content, run / name)
        return run / "policy.pt"

    @contextmanager
    def open(self, cfg):
        def evaluate(terrains, seeds, progress=None):
            arrive = "tune-" in cfg.policy and not any(f"/{name}/" in cfg.policy for name in self.worse)
            ends = np.full((len(seeds), cfg.replicas), Outcome.BASE_COLLISION, np.uint8)
            ends[:, 1::2] = Outcome.GOAL if arrive else Outcome.BASE_COLLISION
            return result_of(ends, names=ROBOT.penalties, reward=np.ones(ends.shape))

        yield Stub(evaluate)


@pytest.fixture
def place(tmp_path):
    write_actor(tmp_path / "start.pt")
    return tmp_path


@pytest.fixture
def hardened(place, monkeypatch):
    """Hardens in a world; returns what rounds.json has."""

    def run(world, **changes):
        for name in ("search", "judge", "finetune"):
            monkeypatch.setattr(module, name, getattr(world, name))
        harden(ROBOT, cfg_of(place, **changes), place / "run", compute_by(world.open, CPU))
        return read_json(place / "run" / "rounds.json")

    return run


def cfg_of(place, **changes):
    tune = replace(FinetuneCfg.of(ROBOT), num_envs=6, terrains=4, iterations=1, ppo=PPO)
    base = HardenCfg(
        policy=str(place / "start.pt"), rounds=2, search=RoundSearchCfg(episodes=200), tune=tune,
        evaluation=RoundEvaluationCfg(terrains=3, episodes=2),
    )  # fmt: skip
    return replace(base, **changes)


def test_rounds_from_end_to_end(place, hardened):
    world, run = World(), place / "run"
    content = hardened(world)
    columns = ("controller", "search", "tuned", "kept", "elites", "faults_panel")
    assert [tuple(row[name] for name in columns) for row in content["rounds"]] == [
        ("base", "search-0", None, None, 20, 3),
        ("round-1", "search-1", "tune-1", True, 20, 3),
        ("round-2", "search-2", "tune-2", True, 20, 3),
    ]
    # 200 episodes are two iterations of 4 x 8 terrains x 4 episodes; seeds are apart from those of other searches.
    assert list(world.searched.values()) == [
        (str(place / "start.pt"), 100, 2), (str(run / "tune-1" / "policy.pt"), 101, 2),
        (str(run / "tune-2" / "policy.pt"), 102, 2),
    ]  # fmt: skip
    first, second = world.trained["tune-1"], world.trained["tune-2"]
    assert (first.policy, first.seed, first.archive) == (str(place / "start.pt"), 101, (str(run / "search-0"),))
    assert (second.policy, second.seed) == (str(run / "tune-1" / "checkpoint.pt"), 102)  # its critic comes along
    assert second.archive == (str(run / "search-0"), str(run / "search-1"))
    assert (first.recipe.noise_of, second.recipe.noise_of) == (None, str(place / "start.pt"))
    goal = content["tables"]["goal"]
    assert list(goal) == ["hand_crafted", "hard_random", "search-0", "search-1", "search-2"]
    assert all(row == {"base": 0.0, "round-1": 0.5, "round-2": 0.5} for row in goal.values())


@pytest.mark.slow
def test_stopped_it_comes_to_the_same_and_goes_on_for_more_rounds(hardened, place):
    expected = hardened(World(), rounds=1)
    (place / "run").rename(place / "whole")
    world = World()
    world.stop_in = "tune-1"
    with pytest.raises(Interrupted):
        hardened(world, rounds=1)
    again = hardened(world, rounds=1)
    assert sorted([*world.searched, *world.trained]) == ["search-0", "search-1", "tune-1"]  # nothing is done twice
    for key in ("rounds", "choices", "tables", "settings"):
        assert again[key] == expected[key], key
    world = World()
    assert hardened(world)["rounds"][:2] == again["rounds"]
    assert (list(world.searched), list(world.trained)) == (["search-2"], ["tune-2"])
    with pytest.raises(ValueError, match="rounds"):
        hardened(World(), rounds=1)


def test_what_nobody_crosses_earns_less_as_in_a_search_and_a_search_goes_on_as_it_was_begun(hardened, place):
    world, wide = World(), {"rounds": 1, "search": RoundSearchCfg(preset="wide", episodes=64_000)}
    world.stop_in = "search-0"
    with pytest.raises(Interrupted):
        hardened(world, **wide)
    cfg = world.asked["search-0"]
    assert (cfg.fitness.crossed, cfg.iterations) == (0.95, 2)
    before = replace(cfg, fitness=replace(cfg.fitness, crossed=0.0))
    RunDirectory(place / "run" / "search-0").begin_session(before, CPU.origin(0), 0)
    hardened(world, **wide)
    assert [world.asked[f"search-{number}"].fitness.crossed for number in range(2)] == [0.0, 0.95]


@pytest.mark.slow
def test_a_training_that_makes_it_worse_is_not_kept(hardened, place):
    world, run = World("tune-2"), place / "run"
    content = hardened(world, rounds=3)
    assert [choice["kept"] for choice in content["choices"].values()] == [True, False, True]
    first, second, third = content["rounds"][1:]
    assert second["policy_sha256"] == first["policy_sha256"] != third["policy_sha256"]
    assert (second["tuned"], second["kept"]) == ("tune-2", False)
    assert world.searched["search-2"][0] == str(run / "tune-1" / "policy.pt")  # with a seed of its own
    assert world.trained["tune-3"].policy == str(run / "tune-1" / "checkpoint.pt")
    assert content["tables"]["goal"]["hand_crafted"]["round-2"] == 0.5


def test_the_choice_is_by_terrains_that_are_neither_reported_nor_trained_on(hardened, place, monkeypatch):
    seen, cross = {}, module.cross_sets

    def watched(controllers, sets, **settings):
        seen.update(sets)
        return cross(controllers, sets, **settings)

    monkeypatch.setattr(module, "cross_sets", watched)
    world = World()
    world.finetune = module.finetune
    content = hardened(world, rounds=1)
    assert list(content["choices"]["tune-1"]["goal"]["after"]) == ["hand_crafted", "hard_random", "elites"]
    archive = read_archive(place / "run" / "search-0")
    validation = split_elites(archive).validation
    assert set(hash_elites(seen["search-0"].terrains.genes)) == set(hash_elites(archive.genes[validation]))
    reported = make_sets(("hand_crafted", "hard_random"), 3, 0)
    assert not any(np.array_equal(seen[name].terrains.values, reported[name].terrains.values) for name in reported)
    tested = hash_elites(generated_set(archive, 3, 0).terrains.genes)
    trained = read_trained_on(f"{place}/run/tune-1/policy.pt")
    assert trained and not {*tested, *trained} & set(hash_elites(seen["search-0"].terrains.genes))
    assert not set(tested) & trained


@pytest.mark.parametrize(
    ("after", "kept"),
    [
        ((0.97, 0.95, 0.9), True),  # a point is at the limit
        ((0.98, 0.96, 0.40), False),  # worse on the whole
        ((0.96, 0.97, 0.90), False),  # two points less than the base on hand-crafted terrains
        ((0.98, 0.93, 0.90), False),  # three on hard-random ones
    ],
)
def test_what_is_kept_is_no_worse_and_loses_nothing_on_ordinary_terrains(after, kept):
    def rates(values):
        return dict(zip(("hand_crafted", "hard_random", "elites"), values, strict=True))

    choice = verdict(rates((0.98, 0.96, 0.1)), rates((0.98, 0.96, 0.44)), rates(after))
    assert choice["kept"] is kept
    assert choice["score"]["before"] == pytest.approx((0.98 + 0.96 + 0.44) / 3)


def test_specialists_are_trained_before_the_judging(hardened, monkeypatch):
    calls, world = [], World()
    judge = world.judge

    def watched(run, **settings):
        calls.append((run.name, settings.get("stages")))
        return judge(run, **settings)

    world.judge = watched
    monkeypatch.setattr(
        module, "train_specialist", lambda robot, run, cfg, options: calls.append((run.name, cfg.recipe.only))
    )
    hardened(world, rounds=1, specialists=True)
    assert calls[:3] == [("search-0", ("fresh",)), ("search-0", "failing"), ("search-0", None)]
    assert [name for name, _ in calls[3:]] == ["search-1"] * 3


@pytest.mark.parametrize(
    ("flags", "field"),
    [
        (["--search.preset", "huge"], "huge"),
        (["--tune.num-envs", "5"], "num_envs"),
        (["--run-dir", "full"], "full"),
        (["--run-dir", "other"], "seed"),
    ],
)
def test_bad_settings_are_refused_before_any_work(place, flags, field, monkeypatch, capsys):
    monkeypatch.chdir(place)
    for name, content in (("full/file", b""), ("other/rounds.json", to_json({"settings": {"seed": 5}}))):
        (place / name).parent.mkdir()
        (place / name).write_bytes(content)
    before = sorted(os.listdir(place))
    given = ["--policy", "start.pt", "--device", "cpu", "--run-dir", "run", *flags]
    assert run_command(HardenCommand, given, name="harden") == 2
    assert field in capsys.readouterr().err.splitlines()[-1]
    assert sorted(os.listdir(place)) == before
