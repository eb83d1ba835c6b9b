import math

import numpy as np
import pytest

from sim.files.intervals import bootstrap_interval, paired_interval, t_interval


def test_t_interval_by_hand():
    # Mean 2, standard deviation 1; 4.303 is Student's quantile of 2 degrees of freedom.
    half = 4.303 / math.sqrt(3)
    assert t_interval(np.array([1.0, 2.0, 3.0])) == pytest.approx([2.0 - half, 2.0 + half])


def test_the_last_quantile_is_that_of_ten_values():
    values = np.array([-1.0, 1.0] * 5)
    # Squares sum to 10 over 9 degrees of freedom.
    half = 2.262 * math.sqrt(10 / 9) / math.sqrt(10)
    assert t_interval(values) == pytest.approx([-half, half])


def test_a_single_value_says_nothing_of_its_spread():
    assert t_interval(np.array([5.0])) is None


def test_more_values_than_quantiles_are_refused():
    with pytest.raises(ValueError, match="a t interval is of at most 10 values, got 11"):
        t_interval(np.zeros(11))


def test_the_interval_from_shared_resamples_is_the_bootstraps():
    values = np.random.default_rng(1).random(80)
    expected = bootstrap_interval(values, np.random.default_rng(3))
    assert paired_interval(values, 3) == pytest.approx(expected, abs=1e-12)
    assert paired_interval(values, 4) != pytest.approx(expected, abs=1e-6)
    assert paired_interval(np.ones(7), 0) == [1.0, 1.0]
    assert paired_interval(np.empty(0), 0) is None
