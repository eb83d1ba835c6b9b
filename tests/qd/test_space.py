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
