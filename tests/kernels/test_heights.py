"""Genes to heights and ground: equation 1 and Table I of the paper, courses against a NumPy builder, maps by hand."""

import numpy as np
import pytest
import warp as wp

from kernels.ground import FIRM, decode_friction, decode_softness
from kernels.super_gaussian import LOWER, PARAMETERS, UPPER, rasterise
from sim.terrains.elements.kinds import all_elements
from sim.terrains.spaces.course import COURSE
from tests.kernels import oracle


def make_heights(genes, shape=(161, 321), spacing=0.05, by=rasterise):
    out = wp.zeros((len(genes), *shape), dtype=float)
    by(wp.array(np.float32(genes)), spacing, out)
    return out.numpy()


def test_table_one_is_the_papers():
    assert tuple(oracle.TABLE_I) == PARAMETERS
    np.testing.assert_array_equal(np.stack([LOWER, UPPER], axis=1), np.float64(list(oracle.TABLE_I.values())))


@pytest.mark.parametrize(
    ("num_terrains", "num_bumps", "shape"), [(5, 8, (161, 321)), (2, 1, (7, 13)), (3, 11, (50, 9))]
)
def test_heights_equal_equation_one(num_terrains, num_bumps, shape):
    spacing = 8.0 / (shape[0] - 1)
    genes = np.random.default_rng(num_bumps).uniform(-1.3, 1.3, (num_terrains, 8 * num_bumps)).astype(np.float32)
    y, x = (spacing * index for index in np.ogrid[: shape[0], : shape[1]])
    expected = [oracle.mixture_height(row, x, y) for row in genes]
    # A terrain is at most 2 m of bumps; float32 resolves 1e-7 of that, steep flanks (exponent 8) cost two digits.
    np.testing.assert_allclose(make_heights(genes, shape, spacing), expected, atol=1e-5)


def test_courses_equal_the_builders():
    genes = np.random.default_rng(0).uniform(-1.2, 1.2, (60, 36)).astype(np.float32)
    genes[:4] = np.sign(genes[:4])
    for row, grid in zip(genes, make_heights(genes, by=COURSE.rasterise), strict=True):
        np.testing.assert_allclose(grid, oracle.course_heights(row), atol=5e-6)
    kinds = COURSE.elements(genes)["kind"]
    assert [all_elements()[kind].name for kind in np.unique(kinds)] == list(COURSE.kinds)  # every kind is among them


@pytest.mark.parametrize(
    ("by", "genes", "heights", "spacing", "field"),
    [
        (rasterise, (2, 63), (2, 5, 5), 0.05, "genes"),
        (rasterise, (2, 8, 8), (2, 5, 5), 0.05, "genes"),
        (rasterise, (2, 64), (3, 5, 5), 0.05, "heights_out"),
        (COURSE.rasterise, (2, 64), (2, 161, 321), 0.05, "genes"),
        (COURSE.rasterise, (2, 36), (3, 5, 5), 0.05, "heights"),
        (COURSE.rasterise, (2, 36), (2, 9, 9), 0.1, "spacing"),
    ],
)
def test_wrong_shapes_are_named(by, genes, heights, spacing, field):
    genes, out = (wp.zeros(shape, dtype=float) for shape in (genes, heights))
    with pytest.raises(ValueError, match=field):
        by(genes, spacing, out)


def test_ground_by_hand():
    # Friction: -1 is 0.15, 0 is 0.575, 1 exactly 1. Softness: -1 is firm, 0 the geometric mean of 0.01 s and 0.06 s.
    genes = wp.array(np.float32(np.tile(np.repeat([-1.0, 0.0, 1.0, 5.0], 8), (2, 1))))
    friction, softness = (wp.full((2, 4, 8), -1.0, dtype=float) for _ in range(2))
    decode_friction(genes, friction)
    decode_softness(genes, softness)
    np.testing.assert_allclose(friction.numpy()[1, :, 3], [0.15, 0.575, 1, 1], rtol=1e-6)
    assert (friction.numpy()[:, 2:] == 1.0).all()
    np.testing.assert_allclose(softness.numpy()[0, :, 7], [FIRM, 0.0006**0.5, 0.06, 0.06], rtol=1e-5)
