from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from qd.search.descriptors import Cells, terrain_ratios


def test_terrain_ratio_is_the_mean_of_the_valid_episodes_ratios():
    # episodes (1, 3) -> (1/4, 3/4) and (10, 0) -> (1, 0): mean (5/8, 3/8); the ratio of means would be (11/14, 3/14)
    # (3, 1) -> (3/4, 1/4), and without penalties one half each
    penalties = [[[1.0, 3.0], [np.nan, np.inf], [10.0, 0.0]], [[np.nan, 1.0]] * 3, [[3.0, 1.0], [0.0, 0.0], [3.0, 1.0]]]
    ratios = terrain_ratios(penalties, [[True, False, True], [False] * 3, [True, True, False]])
    assert ratios.tolist() == [[0.625, 0.375], [0.5, 0.5], [0.625, 0.375]]


@pytest.mark.parametrize(
    ("num_ratios", "intervals"), [(2, 1), (2, 7), (3, 1), (3, 2), (3, 4), (3, 10), (4, 3), (4, 6), (6, 3)]
)
def test_reachable_are_the_boxes_with_a_strictly_inner_point_on_the_plane(num_ratios, intervals):
    # Exact oracle: walk from the lower to the upper corner of a box; the sum grows linearly, so the plane sum = 1 is
    # crossed strictly inside exactly if the walk's parameter lies strictly between 0 and 1.
    expected = [
        box
        for box in product(range(intervals), repeat=num_ratios)
        if 0 < (1 - Fraction(sum(box), intervals)) / Fraction(num_ratios, intervals) < 1
    ]
    assert [tuple(row) for row in Cells(num_ratios, intervals).tuples.tolist()] == expected


@pytest.mark.parametrize(("num_ratios", "intervals", "count"), [(5, 10, 1750), (6, 10, 4795), (2, 49, 49)])
def test_every_reachable_cell_is_hit_by_a_point_in_its_middle(num_ratios, intervals, count):
    cells = Cells(num_ratios, intervals)
    assert cells.num_cells == count
    lower = cells.tuples / intervals
    inside = lower + (1.0 - lower.sum(axis=1, keepdims=True)) / num_ratios
    assert cells.find_cells(inside).tolist() == list(range(cells.num_cells))


@pytest.mark.parametrize(
    ("ratios", "expected"),
    [
        # all on a lower edge, indices sum to 10: down on the largest, the first of equal ones
        ([0.2, 0.2, 0.2, 0.2, 0.2], [1, 2, 2, 2, 2]),
        ([0.1, 0.5, 0.4, 0.0, 0.0], [1, 4, 4, 0, 0]),
        # 1.0 is in the last interval, so this one is reachable as it is
        ([0.0, 0.0, 1.0, 0.0, 0.0], [0, 0, 9, 0, 0]),
        # every ratio one rounding step below its upper edge, indices sum to 5: up on the ratio nearest its edge
        ([np.nextafter(0.2, 0), np.nextafter(0.2, 0) - 1e-12, 0.2 - 1e-12, 0.2 - 1e-12, 0.2 - 1e-12], [2, 1, 1, 1, 1]),
        # a knife edge inside the set stays where it is: .3 opens its interval
        ([0.3, 0.25, 0.15, 0.15, 0.15], [3, 2, 1, 1, 1]),
    ],
)
def test_knife_edges(ratios, expected):
    cells = Cells(5)
    assert cells.tuples[cells.find_cells([ratios])[0]].tolist() == expected


def test_edges_of_other_intervals_are_exact():
    cells = Cells(2, 49)  # floor(1/49 * 49) = 0 in float64; the edge belongs to interval 1
    assert cells.tuples[cells.find_cells([[1 / 49, 48 / 49]])[0]].tolist() == [1, 47]


def test_collision_bit_selects_the_upper_half():
    cells = Cells(5, collision_bit=True)
    ratios = [[0.25, 0.25, 0.25, 0.15, 0.1]] * 2
    without, with_collision = cells.find_cells(ratios, [False, True])
    assert with_collision == without + 1750 and cells.num_cells == 3500
    assert not cells.are_neighbours([without], [with_collision])[0]
    with pytest.raises(ValueError, match="collided"):
        cells.find_cells(ratios)


def test_a_described_cell_is_as_the_docstring_shows_it():
    cells = Cells(3, collision_bit=True)
    with_collision = cells.find_cells([[0.08, 0.35, 0.57]], [True])
    assert f"``{cells.describe(int(with_collision[0]))}``" in Cells.describe.__doc__
    assert Cells(2, 4).describe(0) == "0-0.25 0.75-1"


def test_neighbours():
    cells = Cells(3)

    def cell(*ratios: float) -> int:
        return int(cells.find_cells([ratios])[0])

    here = cell(0.35, 0.35, 0.30)
    assert cells.are_neighbours([here], [here])[0]
    assert cells.are_neighbours([here], [cell(0.45, 0.30, 0.25)])[0]
    assert not cells.are_neighbours([here], [cell(0.55, 0.25, 0.20)])[0]


@pytest.mark.parametrize("ratios", [[[0.5, 0.6]], [[-0.1, 1.1]], [[np.nan, 1.0]], [[0.5, 0.25, 0.25]], [0.5, 0.5]])
def test_ratios_that_are_none_are_refused(ratios):
    with pytest.raises(ValueError, match="ratios"):
        Cells(2).find_cells(ratios)
