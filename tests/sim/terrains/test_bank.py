"""The terrain bank: heights and ceilings replaced together, in place."""

import numpy as np
import pytest

from sim.terrains.bank import TerrainBank, make_heights
from sim.terrains.spaces.course import COURSE
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.terrains import Terrains
from tests.kernels import oracle
from tests.sim.scenes import NODE_X, NODE_Y


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
