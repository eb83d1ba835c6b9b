import numpy as np
import pytest

from kernels import super_gaussian
from qd import space


def test_one_row_is_what_the_rasteriser_expects():
    assert space.GENES_PER_BUMP == super_gaussian.GENES_PER_BUMP
    assert space.NUM_GENES == 64


def test_clip_keeps_the_inside_and_cuts_the_outside():
    genes = np.zeros((2, 64))
    genes[0, :3] = [-1.5, 0.25, 7.0]
    assert space.clip(genes)[0, :4].tolist() == [-1.0, 0.25, 1.0, 0.0]
    assert space.clip(genes).dtype == np.float32
    assert genes[0, 0] == -1.5


@pytest.mark.parametrize("shape", [(10, 32), (64,), (2, 8, 8), (0, 65)])
def test_wrong_shape_says_what_was_expected(shape):
    with pytest.raises(ValueError, match=r"genes must have shape \(batch, 64\), got .*: one row is 8 bumps x 8"):
        space.validate(np.zeros(shape))


@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_genes_that_are_not_finite_are_refused_by_row(value):
    genes = np.zeros((3, 64))
    genes[1, 5] = value
    with pytest.raises(ValueError, match="row 1"):
        space.clip(genes)


def test_random_fills_the_space_and_repeats_with_its_seed():
    genes = space.random(500, 3)
    assert genes.shape == (500, 64)
    assert genes.min() >= -1.0
    assert genes.max() <= 1.0
    assert abs(genes.mean()) < 0.02  # 4 standard errors: .577 / sqrt(32000) = .0032
    assert np.array_equal(genes, space.random(500, np.random.default_rng(3)))
    assert not np.array_equal(genes, space.random(500, 4))
