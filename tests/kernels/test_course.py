"""Courses against a NumPy builder, and elements of any size by hand."""

import numpy as np
import pytest
import warp as wp

from kernels.course import Element, Kind, lay_out, place, rasterise, rasterise_elements
from tests.kernels import course_oracle as oracle


def heights_of(genes):
    out = wp.zeros((len(genes), 161, 321), dtype=float)
    rasterise(wp.array(np.float32(genes)), 0.05, out)
    return out.numpy()


def test_courses_equal_the_builders():
    genes = np.random.default_rng(0).uniform(-1.2, 1.2, (60, 36)).astype(np.float32)
    genes[:4] = np.sign(genes[:4])
    for row, grid in zip(genes, heights_of(genes), strict=True):
        np.testing.assert_allclose(grid, oracle.heights(row), atol=5e-6)
    kinds = lay_out(wp.array(genes)).numpy()["kind"]
    assert len(np.unique(kinds)) == len(Kind)  # every kind is among them


def test_elements_of_any_size_lie_where_they_say():
    # A step of 0.7 m behind column 100, which no gene has, and behind column 200 a ditch of 80 cells that is cut to 40.
    elements = np.zeros((2, 1), Element.numpy_dtype())
    elements[0, 0] = (Kind.STEP, 100, 0, 0.0, 0.0, 0.7, 0.0, 0.0, -1.0)
    elements[1, 0] = (Kind.DITCH, 200, 0, 0.0, 0.0, 0.3, 80.0, 0.0, 0.0)
    laid = wp.array(elements, dtype=Element)
    place(laid)
    out = wp.zeros((2, 161, 321), dtype=float)
    rasterise_elements(laid, out)
    step, ditch = out.numpy()[:, 80]
    assert not step[:101].any() and step[101:] == pytest.approx(-0.7)
    assert np.flatnonzero(ditch).tolist() == list(range(201, 240))
    assert laid.numpy()["rise"][:, 0] == pytest.approx([-0.7, 0.0])


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
        rasterise(genes, spacing, out)
