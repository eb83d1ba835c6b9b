"""Groups of terrains that several searches see, and how many there are at least."""

import numpy as np
import pytest

from results.make.left import count_left, estimate_groups, find_groups
from tests.builders import make_archive


def test_chao2_by_hand():
    # Of 8 groups one search alone sees 4, two see 2. Chao2 = 8 + 4/5 * 4 * 3 / (2 * 3) = 9.6, with the variance
    # 1.6 + 16/25 * 4 * 49 / (4 * 9) + 16/25 * 16 * 2 * 9 / (4 * 81) = 5.653333. The unseen 1.6 over and times
    # exp(1.959964 * sqrt(ln(1 + 5.653333 / 2.56))) = 8.299 are added to 8.
    numbers = estimate_groups(np.array([1, 1, 1, 1, 2, 2, 3, 5]), 5)
    assert (numbers["groups"], numbers["by_searches"]) == (8, [4, 2, 1, 0, 1])
    assert numbers["chao2"] == pytest.approx(9.6)
    assert numbers["chao2_interval"] == pytest.approx([8.1928, 21.279], abs=2e-3)
    # A group that c of 5 searches see is missed by k with C(5 - c, k) / C(5, k): one search sees 16/5 groups, two miss
    # (4 * 6 + 2 * 3 + 1) / 10.
    assert numbers["growth"] == pytest.approx([3.2, 4.9, 8 - 1.8, 8 - 0.8, 8.0])


@pytest.mark.parametrize("counts", [[], [1, 2, 2], [2, 3]])
def test_nothing_is_added_where_at_most_one_search_sees_one_group_alone(counts):
    numbers = estimate_groups(np.array(counts, np.int64), 3)
    assert numbers["chao2"] == numbers["groups"] == len(counts) and numbers["chao2_interval"] is None


def test_groups_are_led_by_distinct_terrains_and_joined_by_the_nearest():
    # On a line, in order of fitness: 0 and 2 lead by 1. What is at 1.1 is kin of the latter alone, 1.4 too.
    places = np.array([0.0, 2.0, 0.9, 1.1, 1.4, 0.6])
    distances = np.abs(np.subtract.outer(places, places))
    assert find_groups(distances, 1.0).tolist() == [0, 1, 0, 1, 1, 0]
    assert find_groups(distances, 2.5).tolist() == [0] * 6
    assert find_groups(distances[:0, :0], 1.0).tolist() == []


def test_a_terrain_that_two_searches_find_is_one_group():
    archives = [make_archive(3), make_archive(3, seed=1)]  # hard-random terrains, no two of them kin
    archives[1].genes[2] = archives[0].genes[0]
    numbers = count_left(archives, [np.ones(3, bool)] * 2)
    assert numbers["elites"] == 6 and numbers["distances"]["1"]["by_searches"] == [4, 1]
    assert numbers["distances"]["1"]["chao2"] == 5 + 1 / 2 * 4 * 3 / (2 * 2)
    numbers = count_left(archives, [np.array([True, False, False]), np.zeros(3, bool)])
    assert numbers["elites"] == 1 and numbers["distances"]["1"]["by_searches"] == [1, 0]
    none = count_left(archives, [np.zeros(3, bool)] * 2)["distances"]["1"]
    assert none["groups"] == none["chao2"] == 0 and none["growth"] == [0.0, 0.0]
