"""Minimal terrains of a run of the stand-in: what is written, what goes on, and what is refused."""

import json
import shutil
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive, write_archive
from qd.minimise import minimise, read_minimal
from qd.workers.evaluator import Compute
from sim.policy.spec import controller_hash
from sim.robots.find import get_robot
from tests.qd.stand_in import Stub, make_result

RESULTS = Path(__file__).parents[2] / "results"
OTHER = {"C-G": f"{RESULTS}/anymal/C-G.pt"}
NOT_OF_THE_WORK = ("date", "command")


class Robots:
    """Nobody crosses bump 4 where it is higher than .1 m; C-G crosses everything; Ctrl-C after so many terrains."""

    def __init__(self, stop_after=None):
        self.seeds, self.stop_after = [], stop_after

    @contextmanager
    def __call__(self, cfg):
        def evaluate(genes, seeds, progress=None):
            if self.stop_after is not None and len(self.seeds) >= self.stop_after:
                raise KeyboardInterrupt
            self.seeds += seeds.tolist()
            fails = (np.abs(genes[:, 4 * 8 + 7]) > 0.4) & ("C-G" not in cfg.policy)
            fails = np.repeat(fails[:, None], cfg.num_replicas, axis=1)
            return make_result(np.ones((*fails.shape, 6)), base_collision=fails)

        yield Stub(evaluate)


@pytest.fixture
def elites(path):
    """Numbers of two elites that fail for bump 4, which is .24 m high."""
    archive = read_archive(path)
    numbers = np.flatnonzero(archive.failing)[:2]
    genes = archive.genes.copy()
    genes[numbers, 4 * 8 : 5 * 8] = (0.0, 0.0, -0.5, 1.0, 1.0, 1.0, 0.0, 0.96)  # in the middle of the way, across it
    write_archive(path / "archive.npz", replace(archive, genes=genes))
    return numbers.tolist()


def minimised(path, elites, robots=None, **changes):
    elite = " ".join(map(str, elites)) if elites else None
    return minimise(path, compute=Compute(workers="1"), elite=elite, open_evaluator=robots or Robots(), **changes)


def written(path):
    content = json.loads((path / "minimal.json").read_text())
    return {name: value for name, value in content.items() if name not in NOT_OF_THE_WORK}


@pytest.mark.parametrize("how", ["greedy", "exhaustive"])
def test_minimal_terrains_from_end_to_end(path, elites, how):
    minima = minimised(path, elites, how=how)
    numbers = written(path)
    assert numbers == {name: value for name, value in minima.numbers.items() if name not in NOT_OF_THE_WORK}
    assert numbers["seed"] == 3 and numbers["robot"] == "anymal" and numbers["space"] == "super_gaussian"
    assert (numbers["minimal"], numbers["bumps_histogram"], numbers["bumps_median"]) == (2, {"1": 2}, 1.0)
    first = numbers["elites"][0]
    assert first["elite"] == elites[0] and first["bumps"] == [4]
    assert (first["goal_rate"], first["valid_episodes"], first["without"]) == (0.0, 40, {"4": 1.0})
    assert first["of"] == 8 and first["how"] == how and first["words"][0].startswith("bump of 0.24 m at (8.0, 4.0) m")
    # .96 * .4375 = .42 fails, .96 * .40625 = .39 does not; the highest point moves by .24 m * (1 - .4375).
    assert (first["scale"], first["passing_scale"], first["margin_m"]) == (0.4375, 0.40625, 0.135)
    assert first["height_m"] == 0.24 and numbers["margin_m_median"] == 0.135
    # Half widths of .5 m + .25 * 2.5 m = 1.125 m along the way: the bump's half is longer than 1 m.
    assert first["cause"]["bump"] == 4 and first["cause"]["kind"] == "rise" and first["cause"]["height_m"] == 0.24
    assert numbers["causes"] == {"rise": 2} and first["verdict"] == "failing" and first["resolved"] is None
    assert numbers["confirmed"] is numbers["faults"] is None
    genes = minima.genes[elites[0]]
    assert not np.delete(genes[7::8], 4).any() and genes[39] == pytest.approx(0.96)
    with np.load(path / "minimal.npz") as content:
        assert str(content["space"]) == "super_gaussian" and content["genes"].shape == (2, 64)
        assert content["elite"].tolist() == elites
    assert (path / "minimal.png").read_bytes().startswith(b"\x89PNG")
    stored = read_minimal(path, read_archive(path))
    assert np.array_equal(stored.genes[elites[1]], minima.genes[elites[1]])
    assert "1 of 8 parts" in stored.words(elites[0]) and stored.chosen("all", path) == elites


def test_stopped_it_goes_on_and_gives_the_same_files(path, elites, tmp_path):
    whole, every = Path(shutil.copytree(path, tmp_path / "whole")), Robots()
    minimised(whole, elites, every)
    begun = [Robots(stop_after) for stop_after in (9, 40)]
    for robots in begun:
        with pytest.raises(KeyboardInterrupt):
            minimised(path, elites, robots)
    rest = Robots()
    minimised(path, elites, rest)
    seeds = [seed for robots in (*begun, rest) for seed in robots.seeds]
    assert sorted(seeds) == sorted(every.seeds) and rest.seeds
    assert (path / "minimal.npz").read_bytes() == (whole / "minimal.npz").read_bytes()
    assert written(path) == written(whole)
    minimised(path, elites, Robots(stop_after=0))  # nothing is left to be crossed


def test_results_of_several_calls_add_up(path, elites):
    minimised(path, elites[1:], how="exhaustive")
    minima = minimised(path, elites[:1])
    hows = [(entry["elite"], entry["how"]) for entry in minima.numbers["elites"]]
    assert hows == [(elites[0], "greedy"), (elites[1], "exhaustive")] and list(minima.genes) != []
    again = minimised(path, elites[:1], how="exhaustive")
    assert [entry["how"] for entry in again.numbers["elites"]] == ["exhaustive"] * 2


def test_minimal_terrains_are_judged_like_elites(path, elites):
    numbers = minimised(path, elites, judged=True, certifiers=OTHER).numbers
    assert (numbers["confirmed"], numbers["certified"], numbers["faults"]) == (2, 2, 2)
    assert numbers["certifiers"] == ["C-G"]
    first = numbers["elites"][0]
    assert first["verdict"] == "fault" and first["resolved"]["goal_rate"] == 0.0
    (certificate,) = first["certificates"]
    assert certificate["controller"] == "C-G" and certificate["searched"]["goal_rate"] == 1.0
    assert certificate["policy_sha256"] == controller_hash(OTHER["C-G"])
    minimised(path, elites, Robots(stop_after=0), judged=True, certifiers=OTHER)
    assert read_archive(path).faults is None  # the elites' own counts are another thing


def test_elites_that_are_not_named_are_faults_first(path):
    failing = np.flatnonzero(read_archive(path).failing)[:3].tolist()
    assert list(minimised(path, []).genes) == failing


def test_a_space_without_scales_has_no_margin(path, elites, monkeypatch):
    monkeypatch.setattr("sim.spaces.super_gaussian.SuperGaussian.scaled", lambda self, genes, scale: None)
    (first, _) = minimised(path, elites).numbers["elites"]
    assert (first["bumps"], first["scale"], first["margin_m"], first["scales"]) == ([4], None, None, [])


def test_what_cannot_be_minimised_is_refused_before_anything_is_crossed(path, made, elites, monkeypatch):
    archive, nobody = read_archive(path), Robots(stop_after=0)
    with pytest.raises(ValueError, match="fresh episodes"):
        minimised(made / "found", elites, nobody)
    fine = np.flatnonzero(~archive.failing)[:1].tolist()
    with pytest.raises(ValueError, match=f"elite .* got {fine[0]}"):
        minimised(path, fine, nobody)
    with pytest.raises(ValueError, match="no elite 999"):
        minimised(path, [999], nobody)
    with pytest.raises(ValueError, match="policy"):
        minimised(path, elites, nobody, policy=OTHER["C-G"])
    with pytest.raises(ValueError, match="certifier same"):
        minimised(path, elites, nobody, judged=True, certifiers={"same": str(get_robot("anymal").policy_file)})
    with monkeypatch.context() as patch, pytest.raises(ValueError, match="how must be greedy"):
        patch.setattr("qd.minimal.MOST_PARTS", 7)
        minimised(path, elites, nobody, how="exhaustive")
    monkeypatch.setattr("sim.spaces.super_gaussian.SuperGaussian.parts", lambda self, genes: ())
    with pytest.raises(ValueError, match="parts"):
        minimised(path, elites, nobody)
    assert not (path / "minimal.json").exists()


def test_terrains_of_elites_that_are_gone_and_damaged_files(path, elites):
    minimised(path, elites)
    archive = read_archive(path)
    gone = replace(archive, iteration=archive.iteration + (np.arange(len(archive)) == elites[0]))
    assert list(read_minimal(path, gone).genes) == elites[1:]
    (path / "minimal.npz").write_bytes(b"not an archive")
    with pytest.raises(ValueError, match=str(path)):
        read_minimal(path, archive)
    (path / "minimal.json").unlink()
    assert read_minimal(path, archive) is None


@pytest.mark.parametrize("run", ["anymal/archive", "cassie/archive"])
def test_published_minimal_terrains_are_read(run):
    archive = read_archive(RESULTS / run)
    minima = read_minimal(RESULTS / run, archive)
    assert len(minima.genes) == minima.numbers["minimal"] == 200
    assert all(genes.shape == (64,) for genes in minima.genes.values())
