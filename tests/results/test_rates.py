"""How far rates lie apart, by hand."""

import numpy as np
import pytest

from kernels.episode import Outcome
from results.make.common import agreement, crossing_rates
from sim.rates import counted_episodes

GOAL, HIT, LATE = Outcome.GOAL, Outcome.BASE_COLLISION, Outcome.TIME_OUT
INVALID, RUNNING = Outcome.INVALID, Outcome.RUNNING

OURS = np.uint8([[GOAL, GOAL, HIT, LATE], [HIT, HIT, HIT, INVALID], [INVALID] * 4, [GOAL] * 4])
THEIRS = np.uint8([[GOAL, LATE, LATE, LATE], [GOAL, HIT, HIT, HIT], [GOAL] * 4, [RUNNING] * 4])


def test_rates_are_of_valid_episodes():
    np.testing.assert_array_equal(crossing_rates(OURS, "success"), [0.75, 0.0, np.nan, 1.0])
    np.testing.assert_array_equal(crossing_rates(OURS, "goal"), [0.5, 0.0, np.nan, 1.0])
    assert np.isnan(crossing_rates(THEIRS[3:], "goal"))  # they still run


def test_no_episode_counts_where_more_than_a_quarter_are_invalid():
    invalid = np.array([[True, False, False, False], [True, True, False, False]])
    assert counted_episodes(invalid).tolist() == [[False, True, True, True], [False] * 4]
    rates = crossing_rates(np.uint8([[INVALID, GOAL, GOAL, HIT], [INVALID, INVALID, GOAL, GOAL]]), "goal")
    np.testing.assert_array_equal(rates, [2 / 3, np.nan])


def test_bias_and_distance_are_of_terrains_that_both_have():
    # Success .75 and 0 against 1 and .25: both .25 lower. Goal .5 and 0 against .25 and .25: once more, once less.
    numbers = agreement(OURS, THEIRS, seed=0)
    assert numbers["terrains"] == 2
    assert numbers["success_bias"] == -0.25 and numbers["success_difference"] == 0.25
    assert numbers["success_bias_interval"] == pytest.approx([-0.25, -0.25])
    assert numbers["goal_bias"] == 0.0 and numbers["goal_difference"] == 0.25
    assert numbers["goal_bias_interval"] == pytest.approx([-0.25, 0.25])


def test_without_terrains_nothing_is_said():
    numbers = agreement(OURS[2:], THEIRS[2:], seed=0)
    assert numbers.pop("terrains") == 0 and set(numbers.values()) == {None}
