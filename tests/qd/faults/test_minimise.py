"""Minimal terrains of a run of the stand-in: what is written, what goes on, and what is refused."""

import json
from dataclasses import replace

import numpy as np
import pytest

from qd.faults.minimise import minimise
from qd.faults.numbers import read_minimal
from qd.search.archive import read_archive
from sim.controllers.spec import controller_hash
from sim.robots.find import get_robot
from tests.qd.robots import OTHER, Robots, bump_stops
from tests.qd.stand_in import compute_by

SPACE = "sim.terrains.spaces.super_gaussian.SuperGaussian"


@pytest.fixture(autouse=True)
def minimal_undrawn(request, monkeypatch):
    """The figure takes longer to draw than the rest; one test draws it."""
    if "end_to_end" not in request.node.name:
        monkeypatch.setattr("qd.faults.minimise.draw_minimal", lambda *_: None)
        monkeypatch.setattr("qd.faults.minimise.save_figure", lambda *_: None)


def minimised(path, elites, robots=None, **changes):
    elite = " ".join(map(str, elites)) if elites else None
    return minimise(path, compute=compute_by(robots or Robots(bump_stops)), elite=elite, **changes)


def test_minimal_terrains_from_end_to_end(path, elites, capsys):
    minima = minimised(path, elites)
    assert f"Elite {elites[0]}: 1 of 8 parts" in capsys.readouterr().out
    numbers = json.loads((path / "minimal.json").read_text())
    assert numbers == minima.numbers
    assert numbers["seed"] == 3 and numbers["robot"] == "anymal" and numbers["space"] == "super_gaussian"
    assert (numbers["minimal"], numbers["bumps_histogram"], numbers["bumps_median"]) == (2, {"1": 2}, 1.0)
    first = numbers["elites"][0]
    assert first["elite"] == elites[0] and first["bumps"] == [4]
    assert (first["goal_rate"], first["valid_episodes"], first["without"]) == (0.0, 40, {"4": 1.0})
    assert first["of"] == 8 and first["how"] == "greedy" and "0.24 m at (8.0, 4.0) m" in first["words"][0]
    # .96 * .4375 = .42 fails, .96 * .40625 = .39 does not; the highest point moves by .24 m * (1 - .4375).
    assert (first["scale"], first["passing_scale"], first["margin_m"]) == (0.4375, 0.40625, 0.135)
    assert first["height_m"] == 0.24 and numbers["margin_m_median"] == 0.135
    # Half widths of .5 m + .25 * 2.5 m = 1.125 m along the way: the bump's half is longer than 1 m.
    assert first["cause"]["bump"] == 4 and first["cause"]["kind"] == "rise" and first["cause"]["height_m"] == 0.24
    assert numbers["causes"] == {"rise": 2} and first["verdict"] == "failing" and first["resolved"] is None
    assert numbers["confirmed"] is numbers["faults"] is None
    genes = minima.genes[elites[0]]
    assert not np.delete(genes[7::8], 4).any() and genes[39] == pytest.approx(0.96)
    assert (path / "minimal.png").read_bytes().startswith(b"\x89PNG")
    stored = read_minimal(path, read_archive(path))
    assert list(stored.genes) == elites and np.array_equal(stored.genes[elites[0]], genes)
    assert stored.choose("all", path) == elites and stored.choose(f"{elites[1]}", path) == elites[1:]
    with pytest.raises(ValueError, match="999"):
        stored.choose(f"{elites[0]} 999", path)
    assert all(part in stored.describe(elites[0]) for part in ("1 of 8 parts", "0% (0 to 9%)", "rise", "13.5 cm"))


def test_stopped_it_goes_on_and_results_of_several_calls_add_up(path, elites):
    stopped, rest = Robots(bump_stops, stop_after=9), Robots(bump_stops)
    with pytest.raises(KeyboardInterrupt):
        minimised(path, elites[1:], stopped, how="exhaustive")
    minimised(path, elites[1:], rest, how="exhaustive")
    # 1 + 8 subsets of four rows, eight rows of fresh episodes, five scales of four rows
    assert len(stopped.seeds) + len(rest.seeds) == 9 * 4 + 8 + 5 * 4 and rest.seeds
    minimised(path, elites[1:], Robots(bump_stops, stop_after=0), how="exhaustive")  # nothing is left to be crossed
    minima = minimised(path, elites[:1])
    hows = [(entry["elite"], entry["how"]) for entry in minima.numbers["elites"]]
    assert hows == [(elites[0], "greedy"), (elites[1], "exhaustive")] and sorted(minima.genes) == elites
    again = minimised(path, elites[:1], how="exhaustive")
    assert [entry["how"] for entry in again.numbers["elites"]] == ["exhaustive"] * 2


def test_minimal_terrains_are_judged_like_elites(path, elites, capsys):
    numbers = minimised(path, elites, judged=True, certifiers=OTHER).numbers
    assert "; fault." in capsys.readouterr().out
    assert (numbers["confirmed"], numbers["certified"], numbers["faults"]) == (2, 2, 2)
    assert numbers["certifiers"] == ["C-G"]
    first = numbers["elites"][0]
    assert first["verdict"] == "fault" and first["resolved"]["goal_rate"] == 0.0
    (certificate,) = first["certificates"]
    assert certificate["controller"] == "C-G" and certificate["searched"]["goal_rate"] == 1.0
    assert certificate["policy_sha256"] == controller_hash(OTHER["C-G"])
    assert not read_archive(path).is_judged  # the elites' own counts are another thing


def test_elites_that_are_not_named_are_some_that_fail_and_without_scales_there_is_no_margin(path, monkeypatch):
    monkeypatch.setattr(f"{SPACE}.scaled", lambda self, genes, scale: None)
    minima = minimised(path, [])
    assert list(minima.genes) == np.flatnonzero(read_archive(path).failing)[:3].tolist()
    first = minima.numbers["elites"][0]
    assert (first["scale"], first["margin_m"], first["scales"]) == (None, None, [])


def test_what_cannot_be_minimised_is_refused_before_anything_is_crossed(path, made, elites, monkeypatch):
    nobody, fine = Robots(bump_stops, stop_after=0), np.flatnonzero(~read_archive(path).failing)[:1].tolist()
    with pytest.raises(ValueError, match=f"judge --run {made / 'found'} --robot anymal"):
        minimised(made / "found", elites, nobody)
    for number in (*fine, 999):
        with pytest.raises(ValueError, match=f"elite .*{number}"):
            minimised(path, [number], nobody)
    with pytest.raises(ValueError, match="certifier same"):
        minimised(path, elites, nobody, judged=True, certifiers={"same": str(get_robot("anymal").policy_file)})
    with monkeypatch.context() as patch, pytest.raises(ValueError, match="how"):
        patch.setattr("qd.faults.subsets.MAX_PARTS", 7)
        minimised(path, elites, nobody, how="exhaustive")
    monkeypatch.setattr(f"{SPACE}.parts", lambda self, genes: ())
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
