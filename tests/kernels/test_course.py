"""Courses against a NumPy builder, and every element by numbers worked out by hand."""

import numpy as np
import pytest
import warp as wp

from kernels.course import Element, Kind, lay_out, place, rasterise, rasterise_elements
from tests.kernels import course_oracle as oracle
from tests.kernels.course_oracle import course, element


def heights_of(genes):
    out = wp.zeros((len(genes), 161, 321), dtype=float)
    rasterise(wp.array(np.float32(genes)), 0.05, out)
    return out.numpy()


@pytest.fixture
def way():
    """Heights along y = 4 m of a course of some elements, by the node from x = 4 m on."""
    return lambda *elements: heights_of(course(*elements))[0, 80, 80:]


def test_courses_equal_the_builders():
    genes = np.random.default_rng(0).uniform(-1.2, 1.2, (60, 36)).astype(np.float32)
    genes[:4] = np.sign(genes[:4])
    for row, grid in zip(genes, heights_of(genes), strict=True):
        np.testing.assert_allclose(grid, oracle.heights(row), atol=5e-6)
    kinds = lay_out(wp.array(genes)).numpy()["kind"]
    assert len(np.unique(kinds)) == len(Kind)  # every kind is among them


def test_stairs_have_their_risers_at_the_nearest_nodes(way):
    # Treads of 0.28 m are 5.6 cells: risers 0, 6 (5.6), 11 (11.2) cells behind the first, which stands at 0.2 m.
    ground = way(element("stairs", size=0.18, length=0.28, detail=3, turn=1))
    assert ground[:5] == pytest.approx(0.0)
    assert ground[5:11] == pytest.approx(0.18) and ground[11:16] == pytest.approx(0.36)
    assert ground[16:] == pytest.approx(0.54)
    down = way(element("stairs", size=0.18, length=0.28, detail=3, turn=-1))
    assert down == pytest.approx(-ground)


def test_stepping_stones():
    # Stones of 0.2 m, 0.1 m apart: after a gap of 2 cells one of 4, and so on; the first lies on rows 78 to 82.
    grid = heights_of(course(element("stones", size=0.3, length=20, detail=4, turn=2)))[0]
    along = grid[80, 84 : 84 + 21]
    assert along[:8] == pytest.approx([0, -0.3, 0, 0, 0, 0, 0, -0.3])
    assert np.flatnonzero(grid[76:85, 84 + 3] == 0.0).tolist() == [0, 2, 3, 4, 5, 6, 8]
    assert grid[80, 84 + 10] == pytest.approx(-0.3)  # the next ones are moved by half of 0.3 m: rows 81 to 85
    assert grid[83, 84 + 10] == 0.0


def test_what_does_not_fit_is_cut_or_left_out(way):
    # 60 cells of flat ground twice and the least ground before each take 128 of 160 cells; 16 more: 16 are left.
    before = [element("flat", length=60)] * 2
    ramp = way(*before, element("ramp", lead=16, size=0.25, length=48, turn=1))
    assert ramp[160] == pytest.approx(0.25 * 16 * 0.05)  # cut to 16 cells
    nothing = way(*before, element("cross_slope", lead=16, size=0.25, length=48, turn=1))
    assert not nothing.any()
    # Stairs lose steps: of 8 with treads of 0.3 m, 6 cells, three have risers 0, 6 and 12 cells behind the first.
    stairs = course(*before, element("stairs", lead=16, size=0.2, length=0.3, detail=8, turn=1))
    assert lay_out(wp.array(stairs)).numpy()["detail"][0, 2] == 3


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
