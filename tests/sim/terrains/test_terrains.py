"""Terrains as a value, in the bank of a simulation, and along the way as networks see them."""

import dataclasses
import pickle

import numpy as np
import pytest
import torch

from sim.rollout import Rollout
from sim.terrains.bank import TerrainBank, make_heights, make_terrains
from sim.terrains.corridor import SHAPE, corridor_heights, corridor_maps, num_maps
from sim.terrains.ground import GroundMaps
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.spaces.course import COURSE
from sim.terrains.spaces.registry import get_space, load_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains
from tests.kernels import oracle
from tests.sim.scenes import NODE_X, NODE_Y
from tests.sim.terrains.spaces.spaces import write_ridges

GRIDS = np.arange(3, dtype=np.float32)[:, None, None] + np.zeros((3, NUM_ROWS, NUM_COLS), np.float32)


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"heights": None}, "genes or heights"),
        ({"genes": np.zeros((3, 64), np.float32)}, "genes or heights"),
        ({"seeds": np.arange(2)}, "seeds"),
        ({"ground": GroundMaps.plain(2)}, "ground"),
    ],
)
def test_what_does_not_fit_together_is_refused(changes, field):
    with pytest.raises(ValueError, match=field):
        Terrains(**{"heights": GRIDS, "seeds": np.arange(3)} | changes)


@pytest.mark.parametrize("ground", [None, GroundMaps.plain(3)])
def test_slices_joined_are_the_whole_and_each_terrain_has_a_digest_of_its_own(ground):
    whole = Terrains(heights=GRIDS, seeds=np.arange(3), ground=ground)
    again = Terrains.join([whole[:1], whole[np.array([1, 2])]])
    assert again.digests() == whole.digests() and len(set(whole.digests())) == 3
    assert (again.ground is None) == (ground is None) and again.has_ground == whole.has_ground
    assert whole.digests() != dataclasses.replace(whole, seeds=np.arange(1, 4)).digests()
    assert whole[np.array([2, 0])].heights[:, 0, 0].tolist() == [2.0, 0.0]


@pytest.mark.parametrize("name", ["super_gaussian@0.06", "course+friction+payload"])
def test_they_travel_with_their_space(name):
    space = get_space(name)
    back = pickle.loads(pickle.dumps(Terrains(genes=space.hard_random(2, 0), seeds=np.arange(2), space=space)))
    assert back.space.name == name and back.has_ground == bool(space.ground)


def test_a_simulation_takes_genes_of_its_own_space_alone_wherever_its_code_lies(anymal, tmp_path):
    first, moved = (load_space(f"{write_ridges(tmp_path / name)}+friction") for name in ("first", "moved"))
    short = dataclasses.replace(anymal, max_duration_s=0.1)
    sizes = {"num_terrains": 1, "replicas": 1, "device": "cpu"}
    rollout = Rollout(short, anymal.policy_file, **sizes, space=first)
    genes = first.hard_random(1, 0)
    outcomes = [rollout.evaluate(Terrains(genes=genes, seeds=np.arange(1), space=space)) for space in (first, moved)]
    np.testing.assert_array_equal(outcomes[0].penalties, outcomes[1].penalties)
    with pytest.raises(ValueError, match="space"):
        rollout.evaluate(Terrains(genes=np.zeros((1, 64), np.float32), seeds=np.arange(1)))


def block_maxima(heights):
    """Highest node of each 8 x 8 cells, from its 9 x 9 nodes."""
    nrow, ncol = heights.shape[1:]
    rows, cols = range(0, nrow - 1, 8), range(0, ncol - 1, 8)
    return np.array([[[grid[r : r + 9, c : c + 9].max() for c in cols] for r in rows] for grid in heights])


def test_terrains_are_replaced_in_place(device):
    bank = TerrainBank(3, device=device)
    addresses = bank.heights.ptr, bank.terrain.ceilings.ptr  # captured graphs keep them
    genes = SUPER_GAUSSIAN.uniform_random(3, 0)
    bank.set(Terrains(genes=genes, seeds=np.arange(3)))
    expected = np.stack([oracle.mixture_height(row, NODE_X[None, :], NODE_Y[:, None]) for row in genes])
    np.testing.assert_allclose(bank.heights.numpy(), expected, atol=1e-5)
    heights = np.array(bank.heights.numpy())
    np.testing.assert_array_equal(bank.terrain.ceilings.numpy(), block_maxima(heights))
    heights[1:] -= 5.0  # lower ground lowers the ceilings too
    bank.set_heights(heights[1:], slice(1, 3))
    np.testing.assert_array_equal(bank.heights.numpy(), heights)
    np.testing.assert_array_equal(bank.terrain.ceilings.numpy(), block_maxima(heights))
    assert (bank.heights.ptr, bank.terrain.ceilings.ptr) == addresses


@pytest.mark.parametrize("space", [SUPER_GAUSSIAN, COURSE], ids=lambda space: space.name)
def test_every_second_node_is_that_of_the_whole_grid(space):
    genes = space.hard_random(3, 0)
    np.testing.assert_allclose(make_heights(genes, space, every=2), make_heights(genes, space)[:, ::2, ::2], atol=1e-5)


def test_wrong_genes_and_heights_are_named(device):
    bank = TerrainBank(2, device=device)
    with pytest.raises(ValueError, match="genes"):
        bank.set(Terrains(genes=np.zeros((2, 63)), seeds=np.arange(2)))
    for heights in (np.zeros((2, 321, 161)), np.full((2, 161, 321), np.nan)):
        with pytest.raises(ValueError, match="heights"):
            bank.set_heights(heights)
    assert not bank.heights.numpy().any()


PLACES = ((0, 0), (20, 57), (40, 120), (7, 70), (19, 71))


@pytest.mark.parametrize(
    ("name", "around"),
    # A space of one spacing gives means of 3 x 3 nodes, 0.05 m apart.
    [("super_gaussian", 0), ("course", 1), ("super_gaussian+friction+softness", 0), ("course+softness", 1)],
)
def test_heights_and_ground_around_the_way(name, around):
    space = get_space(name)
    genes = space.uniform_random(3, 2)
    nodes, ground = make_heights(genes, space), make_terrains(genes, space)[1]
    heights = corridor_heights(torch.from_numpy(genes), space).numpy()
    maps = corridor_maps(torch.from_numpy(genes), space).numpy()
    assert heights.shape == (3, *SHAPE) == (3, 41, 121) and maps.shape == (3, len(space.ground), *SHAPE)
    for row, col in PLACES:  # from x = y = 2 m on, 0.1 m apart
        y, x = 40 + 2 * row, 40 + 2 * col
        expected = nodes[:, y - around : y + around + 1, x - around : x + around + 1].mean(axis=(1, 2))
        np.testing.assert_allclose(heights[:, row, col], expected, atol=1e-6)
        for place, kind in enumerate(space.ground):
            values = 1.0 - ground.friction if kind == "friction" else ground.time_constant_s / 0.06
            np.testing.assert_allclose(maps[:, place, row, col], values[:, y // 40, x // 40], atol=1e-6)


def test_conditions_are_maps_whose_mirror_images_are_those_of_mirrored_conditions():
    space = get_space("super_gaussian+friction+payload+delay+push")
    genes = torch.from_numpy(space.uniform_random(2, 0))
    mirrored = genes.clone()
    mirrored[:, [64 + 32 + 2, 64 + 32 + 5]] *= -1.0  # payload and push to the side
    maps, others = corridor_maps(genes, space), corridor_maps(mirrored, space)
    assert maps.shape == (2, 1 + 7, *SHAPE) and num_maps(space) == 8
    torch.testing.assert_close(maps[:, 1:].flip(2), others[:, 1:])
    assert not torch.equal(maps[:, 1:], others[:, 1:])
    assert torch.equal(maps[:, 1], genes[:, 96, None, None].expand(-1, *SHAPE))
    assert torch.equal(maps[:, 3, -1], genes[:, 98, None].expand(-1, SHAPE[1]))  # in full on the left
    assert torch.equal(maps[:, :1], corridor_maps(genes[:, :96], get_space("super_gaussian+friction")))
