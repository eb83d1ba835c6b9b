"""The terrain bank: heights and ceilings replaced together, in place."""

import numpy as np
import pytest

from sim.bank import TerrainBank, heights_of
from sim.spaces.course import COURSE
from sim.spaces.super_gaussian import SUPER_GAUSSIAN, SuperGaussian
from sim.terrain import NUM_COLS, NUM_ROWS
from tests.kernels import oracle
from tests.sim.scenes import NODE_X, NODE_Y


def block_maxima(heights):
    """Highest node of each 8 x 8 cells, from its 9 x 9 nodes."""
    nrow, ncol = heights.shape[1:]
    rows, cols = range(0, nrow - 1, 8), range(0, ncol - 1, 8)
    return np.array([[[grid[r : r + 9, c : c + 9].max() for c in cols] for r in rows] for grid in heights])


def test_genes_become_heights_and_ceilings(device):
    bank = TerrainBank(3, device=device)
    genes = SUPER_GAUSSIAN.uniform_random(3, 0)
    bank.set_genes(genes)
    expected = [oracle.mixture_height(row, NODE_X[None, :], NODE_Y[:, None]) for row in genes]
    np.testing.assert_allclose(bank.heights.numpy(), expected, atol=1e-5)
    np.testing.assert_array_equal(bank.terrain.ceilings.numpy(), block_maxima(bank.heights.numpy()))


@pytest.mark.parametrize("space", [SUPER_GAUSSIAN, COURSE], ids=lambda space: space.name)
def test_every_second_node_is_that_of_the_whole_grid(space):
    genes = space.hard_random(3, 0)
    whole, some = heights_of(genes, space), heights_of(genes, space, every=2)
    assert some.shape == (3, (NUM_ROWS + 1) // 2, (NUM_COLS + 1) // 2)
    np.testing.assert_allclose(some, whole[:, ::2, ::2], atol=1e-5)


@pytest.mark.parametrize("num_bumps", [1, 3])
def test_any_number_of_bumps(device, num_bumps):
    bank = TerrainBank(1, device=device)
    space = SuperGaussian(num_bumps=num_bumps)
    genes = space.uniform_random(1, 0)
    bank.set_genes(genes, space)
    expected = oracle.mixture_height(genes[0], NODE_X[None, :], NODE_Y[:, None])
    np.testing.assert_allclose(bank.heights.numpy()[0], expected, atol=1e-5)


@pytest.mark.parametrize(("nrow", "ncol"), [(NUM_ROWS, NUM_COLS), (2, 2), (10, 26)])
def test_heights_are_taken_as_they_are(device, nrow, ncol):
    bank = TerrainBank(2, device=device, nrow=nrow, ncol=ncol)
    heights = np.random.default_rng(0).normal(size=(2, nrow, ncol)).astype(np.float32)
    bank.set_heights(heights)
    np.testing.assert_array_equal(bank.heights.numpy(), heights)
    np.testing.assert_array_equal(bank.terrain.ceilings.numpy(), block_maxima(heights))
    bank.set_heights(heights - 5)  # lower ground lowers the ceilings too
    np.testing.assert_array_equal(bank.terrain.ceilings.numpy(), block_maxima(heights - 5))


def test_terrains_are_replaced_in_place(device):
    # Captured graphs keep the addresses.
    bank = TerrainBank(2, device=device)
    addresses = bank.heights.ptr, bank.terrain.ceilings.ptr
    bank.set_genes(np.zeros((2, 64)))
    bank.set_heights(np.ones((2, NUM_ROWS, NUM_COLS)))
    assert (bank.heights.ptr, bank.terrain.ceilings.ptr) == addresses


@pytest.mark.parametrize(
    ("genes", "message"),
    [
        (np.zeros((2, 63)), r"64\), got \(2, 63\)"),
        (np.zeros(64), r"got \(64,\)"),
        (np.zeros((10, 64)), "2 terrains, one row each, got 10"),
        (np.full((2, 64), np.inf), "finite, got .* row 0"),
    ],
)
def test_wrong_genes_are_named(device, genes, message):
    bank = TerrainBank(2, device=device)
    with pytest.raises(ValueError, match=message):
        bank.set_genes(genes)
    assert not bank.heights.numpy().any()


@pytest.mark.parametrize(
    ("heights", "message"),
    [
        (np.zeros((2, NUM_COLS, NUM_ROWS)), r"\(2, 161, 321\) \[terrain, row, col\], got \(2, 321, 161\)"),
        (np.full((2, NUM_ROWS, NUM_COLS), np.nan), "finite, got 103362"),
    ],
)
def test_wrong_heights_are_named(device, heights, message):
    with pytest.raises(ValueError, match=message):
        TerrainBank(2, device=device).set_heights(heights)


@pytest.mark.parametrize("shape", [(0, 2, 2), (1, 1, 2), (1, 2, 1)])
def test_an_empty_bank_is_refused(device, shape):
    with pytest.raises(ValueError, match="at least 1 terrain of 2 x 2 nodes, got"):
        TerrainBank(shape[0], device=device, nrow=shape[1], ncol=shape[2])
