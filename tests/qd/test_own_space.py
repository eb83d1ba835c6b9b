"""A terrain space of a user's own with three genes, from a search to a page about it; nothing runs without a name."""

import json
import re
import signal
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive
from qd.commands import Archive
from qd.judge import judge
from qd.show.commands import Export
from qd.show.elites import find_archive
from qd.show.recordings import on_elite
from qd.show.report import report
from qd.workers.evaluator import Compute
from sim.bank import heights_of
from sim.files.command import run_command
from sim.maps.heightmap import read_heightmap
from sim.policy.spec import controller_hash
from sim.recording.file import read_recording, write_recording
from sim.robots.robot import RobotCfg
from sim.spaces import registry as spaces
from sim.spaces.registry import load_space
from tests.qd import stand_in
from tests.qd.recordings import stand_in_cross
from tests.qd.searches import crossing_by, without_figures
from tests.qd.stand_in import Stub
from tests.sim.spaces.spaces import move, write_ridges

TINY = ["--device", "cpu", "--scheduler.emitters", "2", "--scheduler.batch-size", "4", "--replicas", "2"]
TINY += ["--method", "cma_mae+hard_random"]
PICTURE = bytes.fromhex("89504e470d0a1a0a")


@contextmanager
def open_rasterising(cfg):
    """Crosses as a worker would: it loads the space by its name, and what a terrain costs follows from its heights."""
    space = load_space(cfg.space)

    def evaluate(genes, seeds, progress=None):
        assert genes.shape[1] == space.num_genes
        heights = heights_of(genes, space).astype(float)
        steep = np.abs(np.diff(heights, axis=2)).mean(axis=(1, 2))
        rough = np.stack(
            [heights.max(axis=(1, 2)), 9 * steep, *(np.abs(heights[:, 80, col]) for col in (90, 120, 160, 200))], 1
        )
        noise = np.stack([np.random.default_rng(int(seed)).uniform(0.9, 1.1, (cfg.num_replicas, 6)) for seed in seeds])
        return stand_in.make_result((0.1 + rough[:, None]) * noise)

    yield Stub(evaluate)


@dataclass(frozen=True, kw_only=True)
class RasterisingArchive(Archive):
    """The search's command, on what rasterises."""

    def execute(self) -> None:
        with crossing_by(open_rasterising):
            super().execute()


def forget(patch):
    """As in a program that has just begun."""
    patch.setattr(spaces, "_loaded", [])


def search(*words: str) -> int:
    return run_command(RasterisingArchive, words, name="archive")


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    without_figures(monkeypatch)
    monkeypatch.setattr(RobotCfg, "read_penalty_scales", lambda self, policy=None: stand_in.SCALES)
    forget(monkeypatch)
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.fixture
def ridges(tmp_path):
    write_ridges(tmp_path / "mine")
    return "mine/space.py:Ridges"


@pytest.fixture
def searched(ridges, tmp_path, monkeypatch):
    """A run of two iterations; the program that made it has ended."""
    assert search("--space", ridges, "--run-dir", "run", "--iterations", "2", *TINY) == 0
    forget(monkeypatch)
    return tmp_path / "run"


def test_the_run_names_the_space_and_what_to_do_next(ridges, searched, capsys):
    archive = read_archive(searched)  # which runs nothing
    assert (archive.space, archive.space_sha256) == (ridges, controller_hash(ridges))
    assert archive.genes.shape == (len(archive), 3) and len(archive) > 1
    settings = json.loads((searched / "config.json").read_text())["settings"]
    assert (settings["space"], settings["space_sha256"]) == (ridges, archive.space_sha256)
    numbers = json.loads((searched / "archive.json").read_text())
    assert (numbers["space"], numbers["space_sha256"]) == (ridges, archive.space_sha256)


def test_it_goes_on_as_if_it_had_never_stopped(ridges, searched, tmp_path, monkeypatch):
    more = ["--iterations", "4", "--device", "cpu"]
    there = move(ridges, tmp_path / "elsewhere")  # its hash says that it is the same
    assert search("--resume", "run", "--space", there, *more) == 0
    forget(monkeypatch)
    write_ridges(tmp_path / "mine")
    assert search("--space", ridges, "--run-dir", "whole", *TINY, *more) == 0
    assert (tmp_path / "whole/archive.npz").read_bytes() == (searched / "archive.npz").read_bytes()


def test_a_run_goes_on_with_no_other_space(ridges, searched, capsys, monkeypatch):
    def refused(*words):
        capsys.readouterr()
        forget(monkeypatch)
        assert search("--resume", "run", "--iterations", "3", "--device", "cpu", *words) == 2
        return capsys.readouterr().err

    assert "--space mine/space.py:Ridges" in refused()
    assert "mine/space.py:Ridges" in refused("--space", "course")
    file = searched.parent / "mine/space.py"
    file.write_text(file.read_text().replace("0.9", "0.8"))
    assert "has changed" in refused("--space", ridges)


@pytest.mark.parametrize(
    "look",
    [
        lambda: Export().execute(),
        lambda: find_archive(None, None),
        lambda: judge(Path("runs/anymal-1"), compute=Compute()),
    ],
)
def test_a_run_alone_runs_nothing(searched, monkeypatch, look):
    searched.rename(searched.parent / "moved")
    (searched.parent / "runs").mkdir()
    (searched.parent / "moved").rename(searched.parent / "runs/anymal-1")
    with pytest.raises(ValueError, match="--space mine"):
        look()
    assert not spaces._loaded


def test_fresh_episodes(ridges, searched):
    archive = judge(
        searched, space=ridges, compute=Compute(workers="1"), stages=("fresh",), open_evaluator=open_rasterising
    )
    assert archive.fresh is not None and (archive.fresh.episodes == 40).all()
    assert read_archive(searched).space_sha256 == controller_hash(ridges)


def test_elites_as_files(ridges, searched):
    Export(run=searched, elite="1", formats=("npz",), space=ridges).execute()
    found = find_archive(None, searched, space=ridges)
    genes = found.archive.genes[1]
    heightmap = read_heightmap(searched / "terrains/elite-1.npz")
    np.testing.assert_array_equal(heightmap.heights, heights_of(genes[None], found.space)[0])
    index = json.loads((searched / "terrains/index.json").read_text())
    assert index["space"] == ridges and index["elites"][0]["terrain"] == found.space.describe(genes)


def test_a_recording_is_read_without_the_code(ridges, searched, tmp_path, monkeypatch):
    found = find_archive(None, searched, space=ridges)
    wanted = on_elite(found.archive, 0, policy="shipped", replicas=2)
    assert wanted.space == ridges
    (made,) = stand_in_cross([])([wanted], lambda share: None)
    heights = heights_of(wanted.terrain[None], found.space)
    origin = {**made.origin, "space": ridges, "space_sha256": found.archive.space_sha256}
    write_recording(tmp_path / "a.npz", replace(made, heights=heights, origin=origin))
    forget(monkeypatch)
    read = read_recording(tmp_path / "a.npz")
    np.testing.assert_array_equal(read.heights, heights)
    np.testing.assert_array_equal(read.genes, wanted.terrain[None])


def test_a_page_about_it(ridges, searched, monkeypatch):
    monkeypatch.setattr("sim.files.figures._png_of", lambda figure: PICTURE)
    monkeypatch.setattr(report, "check_policy", lambda policy, robot, device: None)
    out = report.write_report(searched, space=ridges, device="cpu", episodes=2, num_elites=1, cross=stand_in_cross([]))
    page = out.read_text()
    assert re.search(r"ridges of 0\.\d\d m", page)
