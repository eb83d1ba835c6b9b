"""Searches against different controllers side by side."""

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from qd.archive import read_archive, write_archive
from qd.run.directory import RunDirectory
from qd.search import run_search
from qd.studies.beside import Beside, draw_beside, sides_of
from tests.qd.searches import CFG, make_job
from tests.qd.stand_in import open_stand_in


@pytest.fixture(scope="module")
def runs(tmp_path_factory):
    """Two searches of 2 iterations; the elites of the second are crossed by all robots, those of the first by few."""
    folder = tmp_path_factory.mktemp("beside")
    job = make_job(folder / "base")
    run_search(job, open_evaluator=open_stand_in)
    shutil.copytree(folder / "base", folder / "tuned")
    tuned = RunDirectory(folder / "tuned")
    tuned.write_config(replace(CFG, policy="tuned.pt", seed=9, iterations=2), job.origin)
    archive = read_archive(folder / "base")
    rates = np.linspace(0.0, 1.0, len(archive))
    write_archive(folder / "base" / "archive.npz", replace(archive, goal_rate=0.6 * rates, collision_rate=0.4 * rates))
    write_archive(folder / "tuned" / "archive.npz", replace(archive, goal_rate=0.0 * rates + 1.0))
    return folder


def test_numbers_of_both(runs, tmp_path, capsys):
    report = Beside(runs=(f"base={runs / 'base'}", f"C-G={runs / 'tuned'}"), out=tmp_path / "both.json").execute()
    assert report == json.loads((tmp_path / "both.json").read_text())
    assert (tmp_path / "both.png").stat().st_size > 10_000
    base, tuned = report["runs"]["base"], report["runs"]["C-G"]
    assert base["goal_rate"] == pytest.approx(0.3) and base["collision_rate"] == pytest.approx(0.2)
    # Goal rates are .6 x, uniform in x: under .5 for x < 5/6.
    assert base["under_half_cross"] == pytest.approx(5 / 6, abs=0.06) and base["half_collide"] == 0.0
    low, high = base["intervals"]["under_half_cross"]
    assert 0.5 < low < base["under_half_cross"] < high <= 1.0
    assert (tuned["goal_rate"], tuned["under_half_cross"]) == (1.0, 0.0)
    assert tuned["controller"]["policy"] == "tuned.pt" and (base["seed"], tuned["seed"]) == (3, 9)
    assert sum(base["mean_ratios"].values()) == pytest.approx(1.0)
    assert len(base["curves"]["elites"]) == report["iterations"] == 2
    assert f"base: {base['elites']} elites" in capsys.readouterr().out


def test_figure_has_a_line_a_run_in_every_panel(runs):
    sides = sides_of([f"base={runs / 'base'}", f"C-G={runs / 'tuned'}"])
    figure = draw_beside(sides)
    assert [len(axes.lines) for axes in figure.axes] == [2] * 4
    crossed = figure.axes[2].lines[1].get_xydata()
    assert set(crossed[:, 0]) == {100.0} and crossed[-1, 1] == 100.0
    assert [text.get_text().split(":")[0] for text in figure.legends[0].get_texts()] == ["base", "C-G"]


def test_the_figure_does_not_take_the_place_of_the_numbers(runs, tmp_path):
    with pytest.raises(ValueError, match=r"out must be a file named \*.json, .* got .*both.png"):
        Beside(runs=(f"a={runs / 'base'}", f"b={runs / 'tuned'}"), out=tmp_path / "both.png").execute()
    assert not any(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("runs_asked", "message"),
    [
        (("{base}",), "runs must be NAME=DIR each"),
        (("base={base}",), "runs must be 2 to 4, got 1"),
        (("a={base}", "a={tuned}"), "with different names"),
        (("a={base}", "b={base}/nowhere"), "no run at"),
        (("a={base}", "b={longer}"), "equally many iterations, got 2 against a and 3 against b"),
        (("a={base}", "b={other}"), "must have the same settings, but: fitness.alpha (1.0 there, 0.0 wanted)"),
        (("a={base}", "b={torn}"), "metrics.jsonl is damaged"),
    ],
)
def test_what_cannot_be_compared_is_refused_before_anything_is_written(runs, tmp_path, runs_asked, message):
    shutil.copytree(runs / "base", tmp_path / "longer")
    with (tmp_path / "longer" / "metrics.jsonl").open("a") as file:
        file.write('{"iteration": 3}\n')
    archive = read_archive(runs / "base")
    write_archive(tmp_path / "longer" / "archive.npz", replace(archive, iterations=3))
    shutil.copytree(runs / "base", tmp_path / "other")
    cfg = replace(CFG, fitness=replace(CFG.fitness, alpha=0.0), iterations=2)
    RunDirectory(tmp_path / "other").write_config(cfg, make_job(tmp_path).origin)
    shutil.copytree(runs / "base", tmp_path / "torn")
    (tmp_path / "torn" / "metrics.jsonl").write_text('{"iteration":')
    places = {name: tmp_path / name for name in ("longer", "other", "torn")}
    named = tuple(item.format(base=runs / "base", tuned=runs / "tuned", **places) for item in runs_asked)
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        Beside(runs=named, out=tmp_path / "both.json").execute()
    assert message in str(error.value)
    assert not (tmp_path / "both.json").exists()
