"""Super-Gaussian rasterisation against equation 1 and Table I of the paper."""

import numpy as np
import pytest
import warp as wp

from kernels.super_gaussian import LOWER, PARAMETERS, UPPER, rasterise
from tests.kernels import oracle

SPACING = 0.05


def make_heights(genes, nrow=161, ncol=321, spacing=SPACING):
    out = wp.zeros((len(genes), nrow, ncol), dtype=float)
    rasterise(wp.array(np.float32(genes)), spacing, out)
    return out.numpy()


def nodes(nrow=161, ncol=321, spacing=SPACING):
    return np.arange(ncol)[None, :] * spacing, np.arange(nrow)[:, None] * spacing


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
    np.testing.assert_allclose(make_heights(genes, nrow, ncol, spacing), expected, atol=1e-5)


@pytest.mark.parametrize(
    ("genes", "heights", "field"),
    [((2, 63), (2, 5, 5), "genes"), ((2, 8, 8), (2, 5, 5), "genes"), ((2, 64), (3, 5, 5), "heights_out")],
)
def test_wrong_shapes_are_named(genes, heights, field):
    genes, out = (wp.zeros(shape, dtype=float) for shape in (genes, heights))
    with pytest.raises(ValueError, match=field):
        rasterise(genes, SPACING, out)
