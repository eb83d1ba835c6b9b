import math

import numpy as np
import pytest

from sim.files.intervals import (
    bootstrap_interval,
    rate_words,
    t_interval,
    value_words,
    wilson_interval,
)


@pytest.mark.parametrize(
    ("values", "mean", "deviation", "quantile"),  # Student's of 2 and of 9 degrees of freedom
    [([1.0, 2.0, 3.0], 2.0, 1.0, 4.302653), ([-1.0, 1.0] * 5, 0.0, math.sqrt(10 / 9), 2.262157)],
)
def test_t_interval_by_hand(values, mean, deviation, quantile):
    half = quantile * deviation / math.sqrt(len(values))
    assert t_interval(np.array(values)) == pytest.approx([mean - half, mean + half], abs=1e-6)
    assert t_interval(np.array(values[:1])) is None


def test_wilson_interval_by_hand():
    # 10 of 20: centre 0.5, half width 1.96 sqrt(0.0125 + 0.0480) / (1 + 0.192) = 0.2007 (Wilson 1927).
    np.testing.assert_allclose(wilson_interval(10, 20), [0.2993, 0.7007], atol=1e-4)
    # 0 of 20: from 0 to z^2 / (n + z^2) = 3.841 / 23.841.
    np.testing.assert_allclose(wilson_interval(0, 20), [0.0, 0.1611], atol=1e-4)
    assert wilson_interval(20, 20)[1] == 1.0
    for hits, count in ((1, 0), (3, 2), (-1, 2)):
        with pytest.raises(ValueError, match="hits"):
            wilson_interval(hits, count)
    assert wilson_interval(0, 0) == (0.0, 1.0)


def test_rates_and_values_in_words():
    assert rate_words(3, 4) == "3 of 4 (75%, 30 to 95%)"
    assert rate_words(3, 4, short=True) == "75% (30 to 95%)"
    assert rate_words(0, 0) == "no valid episode"
    assert value_words(0.75, (0.5, 1.0)) == "0.750 (0.500 to 1.000)"
    assert value_words(0.012, (-0.1, 0.1), "+.2f") == "+0.01 (-0.10 to +0.10)"
    assert value_words(2.0, None, ".1f") == "2.0"
    assert value_words(None, None) == "-"


def test_bootstrap_interval():
    low, high = bootstrap_interval(np.array([0.0, 1.0] * 50), 0)
    # The mean of 100 draws of 0 or 1: 0.5 +- 1.96 * 0.05.
    np.testing.assert_allclose([low, high], [0.40, 0.60], atol=0.02)
    assert bootstrap_interval(np.array([]), 0) is None
    assert bootstrap_interval(np.array([0.4]), 0) is None
    assert bootstrap_interval(np.array([0.2, 0.9]), 0, families=np.array([5, 5])) is None


def test_the_bootstrap_resamples_terrains():
    values, rng = np.random.default_rng(1).random(80), np.random.default_rng(3)
    means = [values[rng.integers(80, size=80)].mean() for _ in range(10_000)]
    assert bootstrap_interval(values, 3) == pytest.approx(np.quantile(means, [0.025, 0.975]).tolist(), abs=1e-12)
    assert bootstrap_interval(values, 4) != pytest.approx(bootstrap_interval(values, 3), abs=1e-6)
    assert bootstrap_interval(np.ones(7), 0) == [1.0, 1.0]
