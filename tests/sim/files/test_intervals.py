"""Intervals by hand, how they are written and drawn."""

import io

import numpy as np
import pytest
from PIL import Image
from scipy.special import ndtr, stdtrit

from sim.files.figures import as_png, new_figure
from sim.files.intervals import (
    DIFFERENCES,
    RATES,
    bootstrap_interval,
    format_rate,
    format_value,
    t_interval,
    wilson_interval,
)


def test_t_interval_by_hand():
    # Mean 2, standard deviation 1; Student's quantile of 2 degrees of freedom is 4.302653: 2 -+ 4.302653 / sqrt(3).
    assert t_interval(np.array([1.0, 2.0, 3.0])) == pytest.approx([-0.484138, 4.484138], abs=1e-6)
    assert t_interval(np.array([1.0])) is None


def test_wilson_interval_by_hand():
    # 10 of 20: centre 0.5, half width 1.96 sqrt(0.0125 + 0.0480) / (1 + 0.192) = 0.2007 (Wilson 1927).
    np.testing.assert_allclose(wilson_interval(10, 20), [0.2993, 0.7007], atol=1e-4)
    # 0 of 20: from 0 to z^2 / (n + z^2) = 3.841 / 23.841.
    np.testing.assert_allclose(wilson_interval(0, 20), [0.0, 0.1611], atol=1e-4)
    assert wilson_interval(20, 20)[1] == 1.0 and wilson_interval(0, 0) == (0.0, 1.0)
    for hits, count in ((3, 2), (-1, 2)):
        with pytest.raises(ValueError, match="hits"):
            wilson_interval(hits, count)


def test_rates_and_values_as_text():
    assert format_rate(3, 4) == "3 of 4 (75%, 30 to 95%)"
    assert format_rate(3, 4, short=True) == "75% (30 to 95%)"
    assert format_rate(0, 0) == "no valid episode"
    assert format_value(0.012, (-0.1, 0.1), "+.2f") == "+0.01 (-0.10 to +0.10)"
    assert format_value(2.0, None, ".1f") == "2.0"
    assert format_value(None, None) == "-"


def test_the_bootstrap_resamples_terrains_or_families():
    values, rng = np.random.default_rng(1).random(80), np.random.default_rng(3)
    means = [values[rng.integers(80, size=80)].mean() for _ in range(10_000)]
    tail = ndtr(-stdtrit(79, 0.975) * np.sqrt(80 / 79))  # .0222: 80 families are a sample, too
    assert bootstrap_interval(values, 3) == pytest.approx(np.quantile(means, [tail, 1 - tail]).tolist(), abs=1e-12)
    assert bootstrap_interval(values, 4) != pytest.approx(bootstrap_interval(values, 3), abs=1e-6)
    # Two families of three and one terrain, drawn together: a mean of all is 0, 3/4 or 1.
    assert bootstrap_interval(np.array([1.0, 1.0, 1.0, 0.0]), 0, families=np.array([5, 5, 5, 7])) == [0.0, 1.0]
    assert bootstrap_interval(np.array([0.4]), 0) is None
    assert bootstrap_interval(np.array([0.2, 0.9]), 0, families=np.array([5, 5])) is None


@pytest.mark.parametrize("colours", [None, "viridis"])
def test_lines_have_few_colours_and_maps_all(colours):
    figure = new_figure(3.0, 2.0)
    heights = np.random.default_rng(0).random((20, 20))
    axes = figure.subplots()
    axes.imshow(heights, cmap=colours) if colours else axes.plot(heights, alpha=0.5)
    image = Image.open(io.BytesIO(as_png(figure))).convert("RGB")
    assert image.size == (450, 300) and image.getpixel((1, 1)) == (255, 255, 255)
    assert (len(image.getcolors(10**6)) <= 256) == (colours is None)


@pytest.mark.parametrize(("share", "families"), [(0.003, 300), (0.1, 300), (0.5, 6)])
def test_intervals_of_rates_cover_what_is_rare_and_what_few_families_say(share, families):
    # A share of the terrains stops half of the episodes, the others stop none.
    rng, covered, repetitions = np.random.default_rng(5), 0, 200
    for _ in range(repetitions):
        rates = rng.binomial(20, np.where(rng.random(families) < share, 0.5, 1.0)) / 20
        low, high = bootstrap_interval(rates, 0, bounds=RATES)
        covered += low <= 1.0 - share / 2 <= high
    assert covered >= 0.92 * repetitions


def test_where_all_rates_are_alike_the_interval_is_wilsons():
    assert bootstrap_interval(np.ones(300), 0, bounds=RATES) == pytest.approx(wilson_interval(300, 300))
    assert bootstrap_interval(np.zeros(300), 0, bounds=RATES) == pytest.approx(wilson_interval(0, 300))
    low, high = bootstrap_interval(np.zeros(300), 0, bounds=DIFFERENCES)
    assert -low == high == pytest.approx(wilson_interval(0, 300)[1])
    few = np.zeros(300)
    few[:9] = 0.5  # of nine families, each a gain
    least, most = bootstrap_interval(few, 0, bounds=DIFFERENCES)
    assert least < bootstrap_interval(few, 0)[0] and most > few.mean() + 0.01
    few[9] = 0.5
    assert bootstrap_interval(few, 0, bounds=DIFFERENCES) == bootstrap_interval(few, 0)
