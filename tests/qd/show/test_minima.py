"""Minimal terrains as they are replayed, exported and shown: what ``faultline minimise`` left of elites."""

import dataclasses
import json

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.archive import read_archive
from qd.show.commands import Export
from qd.show.elites import find_archive
from qd.show.replay import describe, draw, replay
from qd.show.view.plots import MINIMAL, Choice
from qd.show.view.show import find_show
from tests.qd.recordings import recording_of
from tests.qd.show.report.pages import make_run, minimal_of


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    """A run of 20 elites, of which two have a minimal terrain: the elite with its last gene changed."""
    run = make_run(tmp_path_factory.mktemp("minima"))
    minimal_of(run, 2)
    return run


@pytest.fixture(scope="module")
def found(run):
    return find_archive("anymal", run)


def test_they_are_chosen_by_the_numbers_of_their_elites(found, run):
    minima = found.minima()
    first, second = minima.genes
    assert minima.chosen("all", run) == [first, second] and minima.chosen(f"{second}", run) == [second]
    with pytest.raises(ValueError, match="elite 19"):
        minima.chosen(f"{first} 19", run)
    told = "1 of 2 parts; goal reached 0% (0 to 9%) when they were found; the cause is a rise; margin 12.0 cm"
    assert minima.words(first) == told
    (run / "minimal.json").rename(run / "away.json")
    try:
        with pytest.raises(FileNotFoundError, match="minimal"):
            found.minima()
    finally:
        (run / "away.json").rename(run / "minimal.json")


def test_one_is_replayed(found, run, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    first = next(iter(found.minima().genes))
    asked = []

    def all_of(recordings, wanted):
        asked.extend(wanted)
        recording = recording_of([Outcome.GOAL, Outcome.TIME_OUT], [14.0, 6.0])
        return [dataclasses.replace(recording, genes=wanted[0].terrain[None])]

    monkeypatch.setattr("qd.show.recordings.Recordings.all_of", all_of)
    done = replay(found, found.terrain("0", str(first)), replicas=2, policy="shipped")
    assert asked[0].label == f"minimal terrain of elite {first} of 20 of anymal"
    assert (run / f"minimal-{first}.png").is_file()
    np.testing.assert_array_equal(asked[0].terrain, found.minima().genes[first])
    text = describe(done)
    assert f"minimal terrain of elite {first} of 20" in text and "minimal, now (2 episodes)" in text
    assert "Of the minimal terrain: 1 of 2 parts; goal reached 0% (0 to 9%)" in text
    assert f"minimal terrain of elite {first}" in draw(done).axes[0].get_title()


def test_they_are_exported_beside_whole_elites(found, run, tmp_path):
    numbers = list(found.minima().genes)
    Export(run=run, minimal="all", out=tmp_path, formats=("npz",)).execute()
    assert {file.name for file in tmp_path.glob("*.npz")} == {f"minimal-{number}.npz" for number in numbers}
    with np.load(tmp_path / f"minimal-{numbers[0]}.npz") as content:
        np.testing.assert_array_equal(content["genes"], found.minima().genes[numbers[0]])
    about = json.loads((tmp_path / f"minimal-{numbers[0]}.json").read_text())
    assert about["elite"] == numbers[0] and about["minimal"]["cause"]["kind"] == "rise"
    with pytest.raises(ValueError, match="holds an export already"):
        Export(run=run, minimal="all", out=tmp_path, formats=("npz",)).execute()


def test_the_viewer_lists_them(found, run):
    numbers = list(found.minima().genes)
    show = find_show(run, minimal=str(numbers[1]), policies=("base=shipped",))
    assert show.elite == numbers[1] and show.minima is not None
    assert f"{MINIMAL} (2)" in show.axes.kinds()
    assert set(show.axes.listed(Choice(ranges={}, kind=MINIMAL)).tolist()) == set(numbers)
    assert len(read_archive(run)) == len(show.axes.elites)
