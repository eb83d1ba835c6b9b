"""A search on ground with friction and softness of its own, and what uses its run."""

from dataclasses import replace

import numpy as np
import pytest

from qd.commands import ArchiveCommand
from qd.faults.causes import find_causes, find_effects
from qd.faults.minimise import minimise
from qd.search import settings
from qd.search.archive import read_archive, write_archive
from qd.show.commands import ExportCommand
from sim.files.command import run_command
from sim.terrains.bank import make_terrains
from sim.terrains.maps.heightmap import read_heightmap
from sim.terrains.spaces.registry import get_space
from tests.builders import fresh_values
from tests.qd import stand_in
from tests.qd.robots import Robots
from tests.qd.searches import crossing_by

SPACE = get_space("super_gaussian+friction+softness")


def search(*words: str) -> int:
    with crossing_by(stand_in.open_stand_in):
        return run_command(ArchiveCommand, [*words, "--device", "cpu"], name="archive")


@pytest.fixture
def run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(settings, "read_penalty_scales", lambda robot, policy=None: stand_in.SCALES)
    size = ["--scheduler.emitters", "2", "--scheduler.batch-size", "4", "--iterations", "1"]
    assert search("--space", SPACE.name, "--run-dir", "run", "--method", "hard_random", *size) == 0
    return tmp_path / "run"


def test_a_run_goes_on_with_its_ground_and_exports_it(run):
    archive = read_archive(run)
    assert (archive.space, archive.genes.shape[1]) == (SPACE.name, 128)
    more = ("--resume", "run", "--iterations", "2")
    assert search(*more) == 0 and read_archive(run).iterations == 2
    ExportCommand(run=run, elite="0", formats=("npz", "xml")).execute()
    exported = read_heightmap(run / "terrains/elite-0.npz")
    heights, ground = make_terrains(read_archive(run).genes[:1], SPACE)
    np.testing.assert_array_equal(exported.heights, heights[0])
    np.testing.assert_array_equal(exported.ground.friction, ground.friction)
    np.testing.assert_array_equal(exported.ground.time_constant_s, ground.time_constant_s)
    with pytest.raises(ValueError, match="npz"):
        ExportCommand(run=run, elite="0", formats=("stl",), overwrite=True).execute()


@pytest.mark.slow
def test_a_minimal_terrain_may_be_a_patch(run):
    archive = read_archive(run).rows(np.arange(1))
    archive.genes[0, 64:96], archive.genes[0, 96:] = -1.0, 1.0  # slippery and soft everywhere
    write_archive(run / "archive.npz", archive.corrected_by(replace(fresh_values(archive), goal_rate=np.zeros(1))))
    ice = Robots(lambda cfg, genes, seeds: genes[:, 64 + 11] < 0.0)  # robots fall on patch 11, in the middle of the way
    (entry,) = minimise(run, compute=stand_in.compute_by(ice), elite="0", how="greedy").numbers["elites"]
    assert entry["bumps"] == [8 + 11] and entry["of"] >= 64 and entry["cause"]["kind"] == "slippery ground"
    assert (entry["height_m"], entry["scale"], entry["margin_m"], entry["scales"]) == (0.0, None, None, [])
    ExportCommand(run=run, minimal="all", formats=("npz",)).execute()
    exported = read_heightmap(run / "minimal-terrains/minimal-0.npz")
    slippery = np.ones((1, 4, 8), np.float32)
    slippery[0, 1, 3] = 0.15  # the 8 x 4 patches are counted along the way first: 11 = 8 + 3
    np.testing.assert_allclose(exported.ground.friction, slippery, rtol=1e-6)
    assert not exported.heights.any() and not exported.ground.time_constant_s.any()


def test_effects_of_patches_are_parts_like_bumps():
    genes = np.zeros(128, np.float32)
    genes[:64] = 1e-9  # heights of 0: no bump
    genes[64:96], genes[96:] = 1.0, -1.0
    genes[64 + 8 + 3] = -1.0  # slippery, right of the way
    genes[96 + 24] = 1.0  # soft, at the left edge
    effects = find_effects(genes, range(72), SPACE)
    changing = np.flatnonzero(effects.changes(1e-4)).tolist()
    assert changing == [8 + 8 + 3, 8 + 32 + 24]
    assert [effects.way(part, 0.3) for part in changing] == [(0.0, True), (0.0, False)]
    assert [effects.shape(part, 0.3).kind for part in changing] == ["slippery ground", "soft ground"]
    # Robots end on each of the three patches, of which one is as ground always is.
    ends = np.array([[7.0, 3.0], [1.0, 7.0], [7.0, 5.0]])
    assert find_causes(genes[None].repeat(3, axis=0), ends, SPACE, 0.4) == ["slippery ground", "soft ground", "unclear"]
