"""The ablation of the standard deviations in the fitness, over the stand-in evaluator."""

import json
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import pytest

from qd.run import settings
from qd.run.directory import RunDirectory
from qd.studies.ablation import Ablation, numbers_of
from sim.files.command import Interrupted
from tests.qd.stand_in import open_stand_in


@pytest.fixture(autouse=True, scope="module")
def plain_searches():
    """The preset as it is, but for the networks of its method, which would learn longer than the stand-in takes."""
    small = settings._PRESETS["small"]
    plain = {**small, "scheduler": replace(small["scheduler"], method="cma_mae+map_elites")}
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(settings._PRESETS, "small", plain)
        yield


def config(folder, **changes) -> Ablation:
    return Ablation(**{"preset": "small", "iterations": 4, "device": "cpu", "run_dir": folder / "both", **changes})


@pytest.fixture(scope="module")
def finished(tmp_path_factory):
    folder = tmp_path_factory.mktemp("ablation")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qd.show.figures.write_figures", lambda folder, archive, metrics: [])
        return folder, config(folder).execute(open_evaluator=open_stand_in)


def test_both_searches_and_their_looks(finished):
    folder, report = finished
    assert report == json.loads((folder / "both" / "ablation.json").read_text())
    assert (folder / "both" / "ablation.png").stat().st_size > 10_000
    assert report["iterations"] == [2, 4]
    there = {name: RunDirectory(folder / "both" / name).read_cfg() for name in ("alpha_1", "alpha_0")}
    assert there["alpha_1"].fitness.alpha == 1.0 and there["alpha_0"].fitness.alpha == 0.0
    for name in there:
        rows = RunDirectory(folder / "both" / name).read_metrics()
        assert [rows[k]["mean_std"] for k in (1, 3)] == report["mean_std"][name]
        assert [rows[k]["elites"] for k in (1, 3)] == report["elites"][name]
        assert all(low <= mean <= high for (low, high), mean in zip(
            report["intervals"][name], report["mean_std"][name], strict=True))  # fmt: skip


@pytest.fixture(autouse=True)
def without_figures_of_runs(monkeypatch):
    monkeypatch.setattr("qd.show.figures.write_figures", lambda folder, archive, metrics: [])


@contextmanager
def never(cfg):
    raise AssertionError("nothing is left to evaluate")
    yield


def test_done_it_is_drawn_again_without_evaluating(finished):
    folder, report = finished
    again = config(folder, out=folder / "again.json").execute(open_evaluator=never)
    assert again["mean_std"] == report["mean_std"]


def test_a_run_that_is_there_is_the_one_with_alpha_1(finished, tmp_path):
    folder, report = finished
    found = config(tmp_path, preset=None, run=folder / "both" / "alpha_1").execute(open_evaluator=open_stand_in)
    assert not (tmp_path / "both" / "alpha_1").exists()
    assert found["mean_std"] == report["mean_std"]  # the stand-in is the same for the same seed
    longer = config(tmp_path, iterations=2, run=folder / "both" / "alpha_1").execute(open_evaluator=open_stand_in)
    assert longer["iterations"] == [2]


def test_stopped_the_same_command_goes_on(finished, tmp_path):
    _, report = finished
    calls = []

    @contextmanager
    def open_stopping(cfg):
        with open_stand_in(cfg) as evaluate:

            def stopping(*args):
                calls.append(1)
                if len(calls) == 8:
                    raise KeyboardInterrupt
                return evaluate(*args)

            yield stopping

    with pytest.raises(Interrupted, match="The same command goes on"):
        config(tmp_path).execute(open_evaluator=open_stopping)
    assert 0 < RunDirectory(tmp_path / "both" / "alpha_0").iterations_done() < 4
    assert config(tmp_path).execute(open_evaluator=open_stand_in)["mean_std"] == report["mean_std"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"run": "{folder}/nowhere"}, "no run at"),
        ({"run": "{folder}/both/alpha_0"}, "fitness.alpha (0.0 there, 1.0 wanted)"),
        ({"run": "{folder}/both/alpha_1", "robot": "cassie"}, "is of anymal, got --robot cassie"),
        ({"run": "{folder}/both/alpha_1", "preset": "paper"}, 'preset ("small" there, "paper" wanted)'),
        ({"preset": "huge"}, "unknown preset 'huge'"),
        ({"out": Path("numbers.png")}, "out must be a file named *.json"),
        ({"iterations": 1}, "no iteration up to 1 at which elites"),
    ],
)
def test_what_cannot_be_compared_is_named(finished, tmp_path, changes, message):
    folder, _ = finished
    given = {
        key: folder.parent / value.format(folder=folder) if key == "run" else value for key, value in changes.items()
    }
    with pytest.raises((ValueError, FileNotFoundError)) as error:
        config(tmp_path, **given).execute(open_evaluator=open_stand_in)
    assert message in str(error.value)


@pytest.mark.parametrize(("preset", "every"), [("small", 2), ("paper", 50), ("wide", 6)])
def test_too_few_iterations_are_refused_before_any_search(tmp_path, preset, every):
    with pytest.raises(ValueError, match=rf"no iteration up to 1 .* give at least {every} --iterations"):
        config(tmp_path, preset=preset, iterations=1).execute(open_evaluator=never)
    assert not (tmp_path / "both").exists()


def test_intervals_that_do_not_overlap():
    def rows(mean, interval):
        return [
            {"iteration": 1},
            {"iteration": 2, "mean_std": mean, "mean_std_interval": interval, "elites": 5, "mean_fitness": 1.0},
        ]

    apart = numbers_of({"alpha_1": rows(1.0, [0.9, 1.1]), "alpha_0": rows(1.5, [1.2, 1.8])}, 2)
    assert apart["below_by_more_than_intervals"] == [True] and apart["iterations"] == [2]
    near = numbers_of({"alpha_1": rows(1.0, [0.9, 1.3]), "alpha_0": rows(1.5, [1.2, 1.8])}, 2)
    assert near["below_by_more_than_intervals"] == [False]
