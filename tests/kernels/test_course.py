"""Courses against a NumPy builder."""

import numpy as np
import pytest
import warp as wp

from sim.terrains.elements.kinds import all_elements
from sim.terrains.spaces.course import COURSE
from tests.kernels import course_oracle as oracle


def make_heights(genes):
    out = wp.zeros((len(genes), 161, 321), dtype=float)
    COURSE.rasterise(wp.array(np.float32(genes)), 0.05, out)
    return out.numpy()


def test_courses_equal_the_builders():
    genes = np.random.default_rng(0).uniform(-1.2, 1.2, (60, 36)).astype(np.float32)
    genes[:4] = np.sign(genes[:4])
    for row, grid in zip(genes, make_heights(genes), strict=True):
        np.testing.assert_allclose(grid, oracle.heights(row), atol=5e-6)
    kinds = COURSE.elements(genes)["kind"]
    assert [all_elements()[kind].name for kind in np.unique(kinds)] == list(COURSE.kinds)  # every kind is among them


@pytest.mark.parametrize(
    ("genes", "spacing", "heights", "field"),
    [
        ((2, 64), 0.05, (2, 161, 321), "genes"),
        ((2, 36), 0.05, (3, 5, 5), "heights"),
        ((2, 36), 0.1, (2, 9, 9), "spacing"),
    ],
)
def test_wrong_shapes_are_named(genes, spacing, heights, field):
    genes, out = (wp.zeros(shape, dtype=float) for shape in (genes, heights))
    with pytest.raises(ValueError, match=field):
        COURSE.rasterise(genes, spacing, out)
