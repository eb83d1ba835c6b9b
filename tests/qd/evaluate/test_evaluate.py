"""Evaluations over made-up crossings: tables, rates, packs, and what is refused before any work."""

import hashlib
import json
import shutil
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from qd.commands import EvaluateCommand
from qd.evaluate import evaluate as evaluation
from qd.evaluate import pack as packs
from qd.evaluate.evaluate import evaluate_rates, evaluate_tables
from qd.evaluate.labels import SETS, SetsCfg
from qd.evaluate.sets import split_elites
from qd.evaluate.tables import is_regression
from qd.faults.judge import judge
from qd.faults.minimise import minimise
from qd.faults.searches import find_search
from qd.search.archive import no_witnesses, read_archive, write_archive
from sim.controllers.spec import controller_identity
from sim.files.command import run_command
from sim.robots.robot import ROBOTS
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import judged_archive, make_archive, steered_archive
from tests.qd.robots import OTHER, Robots, bump_stops
from tests.qd.searches import crossing_by
from tests.qd.stand_in import BAD, GOAL, HIT, LATE, PENALTIES, compute_by, result_of
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
        given, trained_on = {"archive": archive}, make_archive(30).genes[split_elites(make_archive(30)).test[:1]]
    with pytest.raises(ValueError, match="C-G"):
        tables_of(anymal, Robots(arrives), {"C-G": str(write_trained(tmp_path, trained_on))}, **given)
    assert not Path("runs").exists()


def test_rates_of_one_controller(anymal, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robots = Robots(arrives)
    cfg, compute = SetsCfg(terrains=3, episodes=1), compute_by(robots)
    report = evaluate_rates(anymal, STAND, cfg, compute=compute)
    # Under runs/, never under results/, where the published ones stand; another controller has a file of its own.
    written = json.loads(Path("runs/anymal-tests.sim.policies-stand-rates.json").read_text())
    assert written == json.loads(json.dumps(report))
    assert report["hand_crafted"]["goal_rate"] == 1.0 and report["hard_random"]["episodes"] == 3
    assert set(report["hand_crafted"]["by_type"]) == {"slope", "rough_slope", "stairs_up_down"}
    # Velocity errors count from 2 s on: 1 (m/s)^2 s in 13 of 15 s.
    assert {cfg.penalties_from_s for cfg in robots.opened} == {2.0}
    assert report["flat"]["vx_error_mean"] == pytest.approx((1 / 13) ** 0.5)
    evaluate_rates(anymal, str(anymal.policy_file), cfg, compute=compute)
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


def fails(cfg, heights, seeds):
    """C-G crosses everything, others nothing but terrains whose highest point is below .2 m."""
    return (np.abs(heights).max(axis=(1, 2)) >= 0.2) & ("C-G" not in cfg.policy)


def candidate(elite, *, fault=True, family=0, cause="ridge", kind="elite", rate=0.0):
    return {
        "name": f"elite-{elite}", "elite": elite, "kind": kind, "verdict": "fault" if fault else "near-fault",
        "family": family, "cause": cause, "searched": {"goal_rate": rate},
    }  # fmt: skip


@pytest.mark.parametrize(
    ("candidates", "expected"),
    [
        ([candidate(0, fault=False, rate=0.0), candidate(1, rate=0.4)], [1, 0]),  # faults first
        ([candidate(0), candidate(1), candidate(2, family=1, rate=0.4)], [0, 2, 1]),  # one family before two
        ([candidate(0), candidate(1, family=1), candidate(2, family=2, cause="drop", rate=0.4)], [0, 2, 1]),  # causes
        ([candidate(0), candidate(1, family=1), candidate(2, family=2, kind="minimal", rate=0.4)], [0, 2, 1]),  # kinds
        ([candidate(0, rate=0.4), candidate(1, family=1, rate=0.1)], [1, 0]),  # the lowest goal rate
    ],
)
def test_what_comes_next(candidates, expected):
    for size in (9, 1):  # each beginning of a pack is one
        assert packs.choose_terrains(candidates, size) == expected[:size]


@pytest.mark.slow
def test_a_pack_is_made_of_a_judged_run(anymal, path, elites, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robots, base = Robots(fails), {"base": str(anymal.policy_file)}

    def make(controllers, *others, **changes):
        searches = [*map(find_search, (path, *others))]
        how = {"compute": compute_by(robots), "out": Path("pack"), "overwrite": True}
        return packs.make_pack(searches, controllers, **how, **changes)

    compute = compute_by(Robots(bump_stops))
    judge(path, stages=("resolved",), compute=compute)
    with pytest.raises(ValueError, match="judge"):  # nobody else crossed them
        make(base)
    archive = read_archive(path)
    write_archive(path, replace(archive, witnesses=no_witnesses(len(archive), 0.5)))
    assert len(packs._read_judged([find_search(path)])) == 1  # but ways were sought
    write_archive(path, archive)
    judge(path, stages=("others",), certifiers=OTHER, compute=compute)
    minimise(path, elite=" ".join(map(str, elites)), judged=True, certifiers=OTHER, compute=compute)
    assert not Path("pack").exists() and not robots.opened

    content, archive = make(base | OTHER), read_archive(path)
    assert json.loads(Path("pack/pack.json").read_text()) == json.loads(json.dumps(content))
    assert {"command", "commit", "sources_sha256", "device", "versions", "seed", "date"} <= content.keys()
    verdicts = [entry["verdict"] for entry in content["terrains"]]
    minimal = [entry for entry in content["terrains"] if entry["kind"] == "minimal"]
    faults = int((archive.confirmed & archive.certified).sum())
    assert verdicts == sorted(verdicts) and verdicts.count("fault") == faults + 2
    assert len(minimal) == 2 and all(entry["parts"] == [4] and entry["cause"] == "rise" for entry in minimal)
    for entry in content["terrains"]:
        assert entry["searched"]["goal_rate"] < 0.75 and entry["certificates"][0]["controller"] == "C-G"
        assert entry["rates"]["C-G"]["goal_rate"] == 1.0 and entry["rates"]["base"]["valid_episodes"] == 20
    assert (content["searched"], content["certifiers"]) == ("base", ["C-G"])
    rates = [entry["rates"]["base"]["goal_rate"] for entry in content["terrains"]]
    assert content["rates"]["base"]["failing"] == sum(rate < 0.5 for rate in rates)
    few = make(OTHER, size=3)  # the first of the same; the searched controller is always among those that cross
    assert list(few["controllers"]) == ["searched", "C-G"] and few["searched"] == "searched"
    assert [entry["name"] for entry in few["terrains"]] == [entry["name"] for entry in content["terrains"][:3]]
    assert list(make({}, size=1)["controllers"]) == ["base", "C-G", "S"]  # those that certify
    # A pack in place of another has the next version. Runs are joined: what both have counts once.
    other = shutil.copytree(path, tmp_path / "other")
    turned = replace(archive, genes=np.where(np.arange(len(archive)) % 2, 1.0, -1.0)[:, None] * archive.genes)
    write_archive(other, replace(turned, genes=turned.genes.astype(np.float32)))
    (other / "minimal.json").unlink()
    joined = make(base | OTHER, other, licence="CC-BY-4.0")
    assert (content["version"], joined["version"], joined["licence"]) == (1, 4, "CC-BY-4.0")
    new = [entry for entry in joined["terrains"] if entry["run"] == 1]
    assert len(content["terrains"]) + len(new) == len(joined["terrains"]) and 0 < len(new) < len(archive)
    assert not {entry["mark"] for entry in new} & {entry["mark"] for entry in content["terrains"]}
    for clash, named in (([path], "twice"), ([], "version 4")):
        with pytest.raises(ValueError, match=named):
            packs.make_pack(
                [*map(find_search, (path, *clash))],
                base,
                compute=compute_by(robots),
                out=Path("pack" if not clash else "more"),
            )
    with pytest.raises(ValueError, match="that are kin"):
        make(base | OTHER, apart_from=[archive])
    first = content["terrains"][0]["elite"]
    one = replace(archive, genes=np.repeat(archive.genes[[first]], len(archive), axis=0))
    apart = make(base | OTHER, apart_from=[one])["terrains"]  # neither it nor its minimal terrain
    assert first not in {entry["elite"] for entry in apart} and 0 < len(apart) < len(content["terrains"])
    for entry in minimal:  # is of the family of its elite
        (elite,) = (
            whole for whole in content["terrains"] if (whole["elite"], whole["kind"]) == (entry["elite"], "elite")
        )
        assert (entry["family"], entry["mark"]) == (elite["family"], elite["mark"])


def test_what_a_steered_robot_crosses_on_the_line_is_a_candidate(anymal, tmp_path):
    search = SimpleNamespace(space=SUPER_GAUSSIAN, run=tmp_path, robot=anymal)
    for archive, passable in ((judged_archive(), [0, 2, 4]), (steered_archive(), [0, 1, 2, 4])):
        candidates, not_passable = packs.find_candidates([search], [archive])
        assert [candidate.entry["elite"] for candidate in candidates] == passable
        assert not_passable == 5 - len(passable)
        steered = {candidate.entry["elite"] for candidate in candidates if "witness" in candidate.entry}
        assert steered == ({1} if 1 in passable else set())


@pytest.fixture
def pack(tmp_path, anymal, monkeypatch):
    """Three terrains: random heights of both signs, flat ground, and a step of 0.5 m."""
    monkeypatch.chdir(tmp_path)
    heights = np.zeros((3, NUM_ROWS, NUM_COLS))
    heights[0] = np.random.default_rng(0).uniform(-4.0, 4.0, heights[0].shape)
    heights[2, :, 150:] = 0.5
    Path("pack").mkdir()
    chosen = [candidate(3), candidate(7, fault=False), candidate(9, family=1, cause="drop")]
    entries = packs.add_rates(chosen, {"base": result_of([[HIT] * 4, [GOAL] * 4, [GOAL, GOAL, GOAL, HIT]])})
    genes = np.array([np.full(64, entry["elite"] / 100) for entry in chosen], np.float32)
    content = controller_identity(anymal, anymal.policy_file) | {"seed": 0, "episodes": 4, "searched": "base"}
    content |= {"terrains": entries, "rates": {"base": packs.summarise_rates(entries, "base", 0)}}
    content["terrains_sha256"] = packs.write_terrains(Path("pack"), packs.round_heights(heights), genes)
    Path("pack/pack.json").write_text(json.dumps(content))
    return heights


def test_a_pack_is_read_as_it_was_written(pack):
    stored = packs.read_pack(packs.find_pack("pack"))
    assert len(stored.terrains) == 3 and stored.terrains[1]["verdict"] == "near-fault"
    np.testing.assert_array_equal(stored.heights, packs.round_heights(pack))
    assert np.abs(stored.heights - pack).max() <= packs.HEIGHT_UNIT_M / 2 + 1e-6
    assert stored.genes[:, 0].tolist() == pytest.approx([0.03, 0.07, 0.09])
    assert packs.find_pack("anymal") == max(ROBOTS["anymal"].packs.glob("*"), key=lambda one: int(one.name))
    assert packs.find_pack("cassie@1") == ROBOTS["cassie"].packs / "1"
    assert len(packs.read_pack(packs.find_pack("cassie@1")).terrains) == 100
    for unknown, known in (("dog", "dog"), ("cassie@0", "cassie@1"), ("cassie@", "cassie@1"), ("cassie@x", "cassie@1")):
        with pytest.raises(FileNotFoundError, match=known):
            packs.find_pack(unknown)


@pytest.mark.parametrize("damage", ["npz", "other", "key"])
def test_a_damaged_pack_is_refused(pack, damage):
    file, content = Path("pack/pack.npz"), json.loads(Path("pack/pack.json").read_text())
    if damage == "other":  # of another making
        packs.write_terrains(Path("pack"), packs.round_heights(pack[::-1]), np.zeros((3, 64), np.float32))
    elif damage == "key":
        del content["rates"]
        Path("pack/pack.json").write_text(json.dumps(content))
    else:
        file.write_bytes(file.read_bytes()[:-9])
    with pytest.raises(ValueError, match="pack"):
        packs.read_pack(Path("pack"))


def test_rates_over_a_pack_are_means_with_families_drawn_together():
    chosen = [candidate(elite, family=family) for elite, family in enumerate((0, 0, 1))]
    entries = packs.add_rates(chosen, {"this": result_of([[GOAL] * 4, [GOAL] * 4, [HIT, HIT, LATE, LATE]])})
    rates = packs.summarise_rates(entries, "this", 0)
    assert rates["goal_rate"] == pytest.approx(2 / 3) and rates["success_rate"] == pytest.approx((1 + 1 + 0.5) / 3)
    assert (rates["failing"], rates["terrains"], rates["failing_families"], rates["families"]) == (1, 3, 1, 2)
    assert rates["goal_interval"] == [0.0, 1.0]  # two families: a quarter of the resamples each has one alone
    assert packs.count_failing(entries, "this", "cause") == {"ridge": {"terrains": 3, "failing": 1}}
    # An invalid terrain is in no rate.
    entries = packs.add_rates(chosen, {"this": result_of([[GOAL] * 4, [BAD] * 4, [HIT] * 4])})
    rates = packs.summarise_rates(entries, "this", 0)
    assert entries[1]["rates"]["this"]["goal_rate"] is None
    assert (rates["goal_rate"], rates["terrains"], rates["failing"]) == (0.5, 2, 1)


def test_any_controller_is_tested_on_a_pack(pack, anymal, capsys):
    robots = Robots(fails)
    given = packs.read_pack(Path("pack")), anymal, "tests.sim.policies:stand"
    report = packs.evaluate_pack(*given, SetsCfg(terrains=2, episodes=2), compute=compute_by(robots))
    (file,) = Path("runs").glob("anymal-*-pack.json")
    assert json.loads(file.read_text()) == json.loads(json.dumps(report))
    # It fails the first terrain, which is 4 m high, and crosses the flat one.
    assert [entry["rates"]["this"]["goal_rate"] for entry in report["terrains"]] == [0.0, 1.0]
    assert (report["rates"]["failing"], report["rates"]["terrains"]) == (1, 2)
    assert report["beside"]["base"]["goal_rate"] == 0.5 and report["pack"]["terrains"] == 3
    assert [report["by"]["verdict"][value]["failing"] for value in ("fault", "near-fault")] == [1, 0]
    shown = capsys.readouterr().out
    assert "1 of 2" in shown and "ridge" in shown
    assert not robots.opened[0].reward and robots.opened[0].engine == "search"
    whole = packs.evaluate_pack(*given, SetsCfg(terrains=9, episodes=2), compute=compute_by(robots))
    assert whole["rates"]["terrains"] == 3


@pytest.mark.parametrize(("least", "status"), [(0.34, 0), (0.35, 1)])
def test_ci_fails_where_the_goal_rate_may_be_lower(pack, capsys, least, status):
    flags = ["--pack", "pack", "--policy", OTHER["C-G"], "--device", "cpu", "--fail-under", str(least)]
    with crossing_by(Robots(fails)):
        assert run_command(EvaluateCommand, flags, name="evaluate") == status
    # All of two families: Wilson's interval begins at 2 / (2 + 1.96^2) = .342.
    assert "0.342" in (out := capsys.readouterr().out) and f"{least:.3f}" in out
    assert not packs.passes({"rates": {"goal_interval": None}}, 0.1)  # one family says nothing of its spread
