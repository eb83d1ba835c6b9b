"""Minimal terrains as they are replayed, exported and shown: what ``faultline minimise`` left of elites."""

import dataclasses
import json

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.show.commands import Export
from qd.show.elites import open_run
from qd.show.replay import describe, replay
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


def test_one_is_replayed(run, monkeypatch):
    archive, asked = open_run("anymal", run), []
    first = next(iter(archive.minima().genes))

    def all_of(recordings, wanted):
        asked.extend(wanted)
        recording = recording_of([Outcome.GOAL, Outcome.TIME_OUT], [14.0, 6.0])
        return [dataclasses.replace(recording, genes=wanted[0].terrain[None])]

    monkeypatch.setattr("qd.show.recordings.Recordings.all_of", all_of)
    done = replay(archive, archive.terrain("0", str(first)), replicas=2, policy="shipped")
    np.testing.assert_array_equal(asked[0].terrain, archive.minima().genes[first])
    assert (run / f"minimal-{first}.png").is_file()
    assert archive.minima().words(first) in describe(done)


def test_they_are_exported_and_listed_in_the_viewer(run, tmp_path):
    genes = open_run("anymal", run).minima().genes
    Export(run=run, minimal="all", out=tmp_path, formats=("npz",)).execute()
    assert {file.name for file in tmp_path.glob("*.npz")} == {f"minimal-{number}.npz" for number in genes}
    number = next(iter(genes))
    with np.load(tmp_path / f"minimal-{number}.npz") as content:
        np.testing.assert_array_equal(content["genes"], genes[number])
    about = json.loads((tmp_path / f"minimal-{number}.json").read_text())
    assert about["elite"] == number and about["minimal"]["cause"]["kind"] == "rise"
    show = find_show(run, minimal=str(number), policies=("base=shipped",))
    assert show.elite == number and f"{MINIMAL} (2)" in show.axes.kinds()
    assert set(show.axes.listed(Choice(ranges={}, kind=MINIMAL)).tolist()) == set(genes)
