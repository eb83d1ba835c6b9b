"""A search on ground with friction and softness of its own, and what uses its run."""

import json
import signal
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest

from qd.archive import read_archive, write_archive
from qd.causes import effects_of
from qd.minimise import minimise
from qd.show.commands import Export
from qd.show.crossed import crossed_of
from qd.show.crossing_figures import draw_paths
from qd.show.elites import find_archive
from qd.show.recordings import Recordings, on_elite, on_heights
from qd.show.report.relief import reliefs_of
from qd.show.view.meshes import terrain_mesh
from qd.workers.evaluator import Compute
from sim.bank import terrains_of
from sim.ground import GroundMaps
from sim.maps.heightmap import read_heightmap
from sim.recording.recorder import record
from sim.recording.scene import ground_paint
from sim.robots.robot import RobotCfg
from sim.rollout import CrossingCfg, Rollout
from sim.spaces.registry import get_space
from sim.terrain import NUM_COLS, NUM_ROWS
from tests.builders import fresh_values
from tests.qd import stand_in
from tests.qd.recordings import NAMES
from tests.qd.searches import without_figures
from tests.qd.stand_in import Stub
from tests.qd.test_own_space import TINY, search
from tests.sim.policies import stand

SPACE = "super_gaussian+friction+softness"
FLAT = np.zeros((NUM_ROWS, NUM_COLS), np.float32)


@pytest.fixture(autouse=True)
def in_a_folder_of_its_own(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    without_figures(monkeypatch)
    monkeypatch.setattr(RobotCfg, "read_penalty_scales", lambda self, policy=None: stand_in.SCALES)
    before = signal.getsignal(signal.SIGTERM)
    yield
    signal.signal(signal.SIGTERM, before)


@pytest.fixture
def searched(tmp_path):
    words = ("--ground", "softness", "friction", "--run-dir", "run", "--iterations", "1")
    assert search(*words, *TINY) == 0
    return tmp_path / "run"


def slippery_and_soft(value=0.3, tau=0.03):
    maps = GroundMaps.plain(1)
    maps.friction[0, 1, 2], maps.time_constant_s[0, 2, 5] = value, tau
    return maps


def test_the_run_names_its_ground_and_goes_on_with_it(searched, capsys):
    archive = read_archive(searched)
    assert (archive.space, archive.genes.shape[1]) == (SPACE, 128)
    assert json.loads((searched / "config.json").read_text())["settings"]["space"] == SPACE
    assert find_archive(None, searched).space.ground == ("friction", "softness")
    more = ("--resume", "run", "--iterations", "2", "--device", "cpu")
    assert search(*more) == 0
    assert len(read_archive(searched)) > 0 and read_archive(searched).iterations == 2
    capsys.readouterr()
    assert search(*more, "--ground", "friction") == 2
    assert "--ground" in capsys.readouterr().err


def test_exported_ground_is_read_back(searched):
    Export(run=searched, elite="0", formats=("npz", "xml")).execute()
    found = read_heightmap(searched / "terrains/elite-0.npz")
    heights, ground = terrains_of(read_archive(searched).genes[:1], get_space(SPACE))
    np.testing.assert_array_equal(found.heights, heights[0])
    np.testing.assert_array_equal(found.ground.friction, ground.friction)
    np.testing.assert_array_equal(found.ground.time_constant_s, ground.time_constant_s)
    with pytest.raises(ValueError, match="npz"):
        Export(run=searched, elite="0", formats=("stl",), overwrite=True).execute()


@contextmanager
def nobody_crosses_ice(cfg):
    """Who steps on a slippery patch 11, in the middle of the way, falls; all others arrive."""

    def evaluate(genes, seeds, progress=None):
        fails = np.repeat(genes[:, 64 + 11, None] < 0.0, cfg.num_replicas, axis=1)
        return stand_in.make_result(np.ones((*fails.shape, 6)), base_collision=fails)

    yield Stub(evaluate)


@pytest.fixture
def minimised(searched):
    """The run with an elite 0 that fails for one slippery patch, and the minimal terrain of it."""
    archive = read_archive(searched)
    archive.genes[0, 64:96], archive.genes[0, 96:] = -1.0, 1.0  # slippery and soft everywhere
    fresh = replace(fresh_values(archive), goal_rate=np.zeros(len(archive)))
    write_archive(searched / "archive.npz", archive.corrected_by(fresh))
    number = int(np.flatnonzero((read_archive(searched).genes == archive.genes[0]).all(axis=1))[0])
    found = minimise(
        searched, compute=Compute(workers="1"), elite=str(number), how="greedy", open_evaluator=nobody_crosses_ice
    )
    return searched, number, found.numbers


def test_a_minimal_terrain_may_be_a_patch(minimised, tmp_path):
    run, number, numbers = minimised
    (entry,) = numbers["elites"]
    assert entry["bumps"] == [8 + 11] and entry["of"] >= 64 and entry["cause"]["kind"] == "slippery ground"
    assert entry["words"] == ["friction 0.15 at x = 6 to 8 m, y = 2 to 4 m"]
    assert (entry["height_m"], entry["scale"], entry["margin_m"], entry["scales"]) == (0.0, None, None, [])
    Export(run=run, minimal="all", formats=("npz",)).execute()
    found = read_heightmap(run / f"minimal-terrains/minimal-{number}.npz")
    slippery = np.ones((1, 4, 8), np.float32)
    slippery[0, 1, 3] = 0.15
    assert not found.heights.any()
    np.testing.assert_allclose(found.ground.friction, slippery, rtol=1e-6)
    assert not found.ground.time_constant_s.any()


def test_recordings_keep_the_ground(searched, anymal):
    archive, cfg = read_archive(searched), CrossingCfg(max_duration_s=0.1)
    space, ground = get_space(SPACE), slippery_and_soft()
    own = {"num_terrains": 1, "num_replicas": 1, "device": "cpu", "cfg": cfg}
    asked = []

    def cross(wanted, progress):
        (one,) = wanted
        asked.append(one)
        rollout = Rollout(anymal, stand, space=get_space(one.space), with_ground=one.ground is not None, **own)
        seeds = np.array([one.terrain_seed], np.uint32)
        return [record(rollout, one.terrain[None], seeds, policy=one.policy, ground=one.ground)[1]]

    policy = str(anymal.policy_file)
    recordings = Recordings(anymal, folder=searched / "recordings", cross=cross)
    elite = on_elite(archive, 0, policy=policy, replicas=1)
    maps = {"label": "map", "policy": policy, "replicas": 1, "seed": 0}
    wanted = [elite, on_heights(FLAT, **maps, ground=ground), on_heights(FLAT, **maps)]
    recordings.all_of(wanted)
    again = Recordings(anymal, folder=searched / "recordings", cross=cross)
    of_elite, of_map, plain = again.all_of(wanted)  # each is found again by what it is of
    assert len(asked) == 3
    np.testing.assert_array_equal(of_elite.ground.friction, terrains_of(archive.genes[:1], space)[1].friction)
    np.testing.assert_array_equal(of_map.ground.time_constant_s, ground.time_constant_s)
    assert plain.ground is None
    labels = [text.get_text() for text in draw_paths(crossed_of(of_map, NAMES, (1.0,) * 6), "").legends[0].get_texts()]
    assert {"slippery", "soft"} <= set(labels)


def test_slippery_and_soft_patches_are_tinted():
    ground, plain = slippery_and_soft(), GroundMaps.plain(1)
    bare, same, other = (
        terrain_mesh(FLAT, maps).visual.vertex_colors[:, :3].reshape(161, 321, 3).astype(int)
        for maps in (None, plain, ground)
    )
    np.testing.assert_array_equal(bare, same)
    changed = np.argwhere((bare != other).any(axis=2))
    assert changed.min(axis=0).tolist() == [40, 80] and changed.max(axis=0).tolist() == [119, 239]
    painted = ground_paint(np.pad(FLAT, 40), ground).astype(int) - ground_paint(np.pad(FLAT, 40))
    genes = np.zeros((2, 128), np.float32)
    genes[:, :64], genes[:, 64:96], genes[:, 96:] = 1e-9, 1.0, -1.0
    genes[1, 64] = -1.0
    plain_relief, tinted_relief = reliefs_of(genes, get_space(SPACE))
    assert plain_relief != tinted_relief
    row, col = 4 * (40 + 60), 4 * (40 + 100)  # at y = 3 m and x = 5 m
    assert painted[row + 2, col + 2, 0] < -10 and not painted[: 4 * 79].any()


def test_effects_of_patches_are_parts_like_bumps():
    space = get_space(SPACE)
    genes = np.zeros(128, np.float32)
    genes[:64] = 1e-9  # heights of 0: no bump
    genes[64:96], genes[96:] = 1.0, -1.0
    genes[64 + 8 + 3] = -1.0  # slippery, right of the way
    genes[96 + 24] = 1.0  # soft, at the left edge
    effects = effects_of(genes, range(72), space)
    changing = np.flatnonzero(effects.changes(1e-4)).tolist()
    assert changing == [8 + 8 + 3, 8 + 32 + 24]
    assert [effects.way(part, 0.3) for part in changing] == [(0.0, True), (0.0, False)]
    assert [effects.shape(part, 0.3).kind for part in changing] == ["slippery ground", "soft ground"]
