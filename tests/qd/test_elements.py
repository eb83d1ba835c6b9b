"""A search on courses whose elements are slippery or soft, and what uses its run."""

import json
from contextlib import contextmanager
from dataclasses import replace

import numpy as np
import pytest
import torch

from qd.archive import read_archive, write_archive
from qd.causes import effects_of
from qd.run.minimise import Minimise, minimise_run
from qd.run.settings import SchedulerCfg
from qd.show.elites import find_archive
from qd.show.export import Export, export
from qd.show.recordings import Recordings, on_heights
from qd.show.view.meshes import terrain_mesh
from qd.variation import varied
from sim.bank import terrains_of
from sim.ground import GroundMaps
from sim.maps.heightmap import read_heightmap
from sim.recording.file import read_recording, write_recording
from sim.recording.recorder import record
from sim.recording.scene import ground_paint
from sim.rollout import CrossingCfg, Rollout
from sim.space import get_space
from tests.builders import fresh_values
from tests.kernels.course_oracle import course, element
from tests.qd import stand_in
from tests.qd.test_ground import FLAT, in_a_folder_of_its_own  # noqa: F401 - pytest finds the fixture here
from tests.qd.test_own_space import TINY, search
from tests.sim.policies import stand

SPACE = "course+element-friction+element-softness"
STRIPS = (1, 320)


@pytest.fixture
def searched(tmp_path):
    words = ("--space", "course", "--ground", "element-friction", "element-softness", "--run-dir", "run")
    assert search(*words, "--iterations", "1", *TINY) == 0
    return tmp_path / "run"


def kerb_plate_and_ditch():
    """Genes of a slippery kerb, a slippery plate of 1 m on the flat, and a soft ditch."""
    heights = course(
        element("kerb", size=0.15, turn=1), element("flat", length=20), element("ditch", size=0.4, length=6)
    )
    own = np.repeat([[[1.0, -1.0]]], 6, axis=1)
    own[0, :3] = [-1.0, -1.0], [-1.0, -1.0], [1.0, 1.0]
    return np.float32(np.concatenate([heights.reshape(1, 6, 6), own], axis=2)).reshape(48)


@contextmanager
def nobody_crosses_a_wet_plate(cfg):
    """Who meets a slippery second element falls; all others arrive."""

    def evaluate(genes, seeds, progress=None):
        fails = np.repeat(genes[:, 8 + 6, None] < 0.0, cfg.num_replicas, axis=1)
        return stand_in.make_result(np.ones((*fails.shape, 6)), base_collision=fails)

    yield evaluate


def test_a_search_goes_on_and_exports_what_was_crossed(searched, capsys):
    assert search("--resume", "run", "--iterations", "2", "--device", "cpu") == 0
    archive = read_archive(searched)
    assert (archive.space, archive.genes.shape[1], archive.iterations) == (SPACE, 48, 2)
    assert json.loads((searched / "config.json").read_text())["settings"]["space"] == SPACE
    assert find_archive(None, searched).space == get_space(SPACE)
    export(Export(run=searched, elite="0", formats=("npz",)))
    found = read_heightmap(searched / "terrains/elite-0.npz")
    heights, ground = terrains_of(archive.genes[:1], get_space(SPACE))
    np.testing.assert_array_equal(found.heights, heights[0])
    np.testing.assert_array_equal(found.ground.friction, ground.friction)
    np.testing.assert_array_equal(found.ground.time_constant_s, ground.time_constant_s)
    assert search("--run-dir", "other", "--iterations", "1", "--ground", "element-friction", *TINY) == 2
    assert "the space super_gaussian has no elements" in capsys.readouterr().err


def test_a_minimal_terrain_may_be_a_slippery_plate(searched):
    archive = read_archive(searched)
    archive.genes[0] = kerb_plate_and_ditch()
    fresh = replace(fresh_values(archive), goal_rate=np.zeros(len(archive)))
    write_archive(searched / "archive.npz", archive.corrected_by(fresh))
    number = int(np.flatnonzero((read_archive(searched).genes == archive.genes[0]).all(axis=1))[0])
    args = Minimise(run=searched, elite=str(number), device="cpu", workers="1", how="greedy")
    (entry,) = minimise_run(args, open_evaluator=nobody_crosses_a_wet_plate)["elites"]
    assert (entry["bumps"], entry["of"], entry["words"]) == ([1], 3, ["flat ground of 1.00 m (friction 0.15)"])
    assert entry["cause"]["kind"] == "slippery ground" and (entry["height_m"], entry["scale"]) == (0.0, None)
    export(Export(run=searched, minimal="all", formats=("npz",)))
    found = read_heightmap(searched / f"minimal-terrains/minimal-{number}.npz")
    # The kerb, 4 cells in, is one cell long, and 4 cells lie before the plate of 20 cells.
    slippery = np.flatnonzero(found.ground.friction[0, 0] < 1.0)
    assert (slippery[0], slippery[-1], len(slippery)) == (89 - 2, 89 + 20 + 2 - 1, 24)
    assert not found.heights.any() and not found.ground.time_constant_s.any()


def test_effects_of_elements_are_their_heights_and_their_ground():
    effects = effects_of(kerb_plate_and_ditch(), range(6), get_space(SPACE))
    assert np.flatnonzero(effects.changes(1e-4)).tolist() == [0, 1, 2]
    assert [effects.shape(part, 0.3).kind for part in range(3)] == ["rise", "slippery ground", "ditch"]
    assert [effects.way(part, 0.3)[1] for part in range(6)] == [True, True, True, False, False, False]
    assert effects.slippery[1].sum() == 24 and effects.soft[2].sum() == 6 + 4 and not effects.soft[:2].any()


def test_a_child_takes_an_element_with_its_ground():
    space = get_space(SPACE)
    pool = space.uniform_random(2, 0)
    cfg = SchedulerCfg(crossover_share=1.0, iso_sigma=0.0, line_sigma=0.0)
    draw = torch.Generator().manual_seed(0)
    found = varied(torch.from_numpy(pool), 100, cfg, space.genes_per_part, draw).numpy().reshape(100, 6, 8)
    first, second = ((found == genes.reshape(6, 8)).all(axis=2) for genes in pool)
    assert (first ^ second).all()  # every element is one of the two, whole, with its ground
    assert 0.4 < (first.any(axis=1) & second.any(axis=1)).mean() < 0.6  # an elite meets another half of the time


def test_recordings_keep_strips_beside_patches(anymal, tmp_path):
    strips, patches = GroundMaps.plain(1, STRIPS), GroundMaps.plain(1)
    strips.friction[0, 0, 100:110], patches.friction[0, 1, 2] = 0.3, 0.3
    sizes = {"num_terrains": 1, "num_replicas": 1, "device": "cpu", "cfg": CrossingCfg(max_duration_s=0.1)}
    asked = []

    def cross(wanted, progress):
        asked.append(len(wanted))
        found = []
        for one in wanted:
            rollout = Rollout(anymal, stand, **sizes, ground_shape=one.ground.shape)
            seeds = np.array([one.terrain_seed], np.uint32)
            found.append(record(rollout, one.terrain[None], seeds, policy=one.policy, ground=one.ground)[1])
        return found

    policy = str(anymal.policy_file)
    wanted = [
        on_heights(FLAT, label="map", policy=policy, replicas=1, seed=0, ground=ground) for ground in (strips, patches)
    ]
    at_once = Recordings(anymal, device="cuda", folder=tmp_path / "recordings", cross=cross)
    found = at_once.all_of(wanted)
    assert asked == [1, 1]  # maps of two shapes are not crossed side by side
    for recording, ground in zip(found, (strips, patches), strict=True):
        write_recording(tmp_path / "one.npz", recording)
        np.testing.assert_array_equal(read_recording(tmp_path / "one.npz").ground.friction, ground.friction)


def test_strips_are_tinted_where_they_lie():
    ground = GroundMaps.plain(1, STRIPS)
    ground.friction[0, 0, 100:110] = 0.15
    bare, tinted = (
        terrain_mesh(FLAT, maps).visual.vertex_colors[:, :3].reshape(161, 321, 3).astype(int) for maps in (None, ground)
    )
    changed = (bare != tinted).any(axis=2)
    assert (changed == changed[0]).all() and np.flatnonzero(changed[0]).tolist() == list(range(100, 110))
    painted = ground_paint(np.pad(FLAT, 40), ground).astype(int) - ground_paint(np.pad(FLAT, 40))
    columns = np.flatnonzero(painted[:, :, 0].any(axis=0))  # pixels, four a cell, behind a margin of 40 cells
    assert (columns[0], columns[-1]) == (4 * 140, 4 * 150 - 1)
