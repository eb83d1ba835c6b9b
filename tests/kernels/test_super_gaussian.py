"""Super-Gaussian rasterisation against equation 1 and Table I of the paper."""

import numpy as np
import pytest
import warp as wp

from kernels.super_gaussian import GENES_PER_BUMP, LOWER, PARAMETERS, UPPER, rasterise
from tests.kernels import oracle

SPACING = 0.05


def heights_of(genes, nrow=161, ncol=321, spacing=SPACING):
    out = wp.zeros((len(genes), nrow, ncol), dtype=float)
    rasterise(wp.array(np.float32(genes)), spacing, out)
    return out.numpy()


def nodes(nrow=161, ncol=321, spacing=SPACING):
    return np.arange(ncol)[None, :] * spacing, np.arange(nrow)[:, None] * spacing


def bump(**parameters):
    """Genes of one bump with the given parameters; the others in the middle of their range."""
    genes = np.zeros(GENES_PER_BUMP)
    for name, value in parameters.items():
        low, high = oracle.TABLE_I[name]
        genes[PARAMETERS.index(name)] = 2 * (value - low) / (high - low) - 1
    return genes[None]


def test_table_one_is_the_papers():
    assert tuple(oracle.TABLE_I) == PARAMETERS
    np.testing.assert_array_equal(np.stack([LOWER, UPPER], axis=1), np.float64(list(oracle.TABLE_I.values())))


@pytest.mark.parametrize(
    ("num_terrains", "num_bumps", "nrow", "ncol"), [(5, 8, 161, 321), (2, 1, 7, 13), (3, 11, 50, 9)]
)
def test_heights_equal_equation_one(num_terrains, num_bumps, nrow, ncol):
    spacing = 8.0 / (nrow - 1)
    genes = np.random.default_rng(num_bumps).uniform(-1.3, 1.3, (num_terrains, 8 * num_bumps)).astype(np.float32)
    expected = [oracle.mixture_height(row, *nodes(nrow, ncol, spacing)) for row in genes]
    # A terrain is at most 2 m of bumps; float32 resolves 1e-7 of that, steep flanks (exponent 8) cost two digits.
    np.testing.assert_allclose(heights_of(genes, nrow, ncol, spacing), expected, atol=1e-5)


def test_one_bump_by_hand():
    # All genes 0: centre (8, 4), half widths 1.75 m, exponents 2 * 2.5 = 5, theta 0, w 0: flat.
    assert not heights_of(np.zeros((1, 8))).any()
    # w = 0.25, p = 1: h = 0.25 exp(-(dx / 1.75)^2 - (dy / 1.75)^2); at the centre (row 80, col 160) 0.25, and one half
    # width east (x = 9.75, col 195) 0.25 / e = 0.0919699.
    grid = heights_of(bump(w=0.25, p_x=1, p_y=1))[0]
    assert grid[80, 160] == pytest.approx(0.25)
    assert grid[80, 195] == pytest.approx(0.0919699, abs=1e-6)
    # North (y = 5.75, row 115) the same, and 0.25 / e^2 = 0.0338338 on the diagonal: rows are y, columns x.
    assert grid[115, 160] == pytest.approx(0.0919699, abs=1e-6)
    assert grid[115, 195] == pytest.approx(0.0338338, abs=1e-6)
    # sigma_x = 3, sigma_y = 0.5, theta = pi / 2: the long axis lies along y. At (8, 7): 1 / e; at (8.5, 4): 1 / e.
    grid = heights_of(bump(w=0.25, p_x=1, p_y=1, sigma_x=3, sigma_y=0.5, theta=np.pi / 2))[0]
    assert grid[140, 160] == pytest.approx(0.0919699, abs=1e-6)
    assert grid[80, 170] == pytest.approx(0.0919699, abs=1e-6)


@pytest.mark.parametrize(
    ("genes", "heights", "field"),
    [((2, 63), (2, 5, 5), "genes"), ((2, 8, 8), (2, 5, 5), "genes"), ((2, 64), (3, 5, 5), "heights_out")],
)
def test_wrong_shapes_are_named(genes, heights, field):
    genes, out = (wp.zeros(shape, dtype=float) for shape in (genes, heights))
    with pytest.raises(ValueError, match=field):
        rasterise(genes, SPACING, out)
