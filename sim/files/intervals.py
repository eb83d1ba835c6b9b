"""95 % intervals of measured rates and means, and how they are written."""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr, stdtrit

_Values = NDArray[np.floating]
_Bounds = tuple[float, float]
RATES = (0.0, 1.0)  # bounds of rates
DIFFERENCES = (-1.0, 1.0)  # bounds of differences of rates
_Z = 1.959963984540054  # the normal distribution's 97.5 % quantile
_BOOTSTRAP_DRAWS = 10_000
_MIN_DIFFERING = 10  # with so many families that differ from the others, resampling shows how far the mean may lie


def wilson_interval(hits: float, count: int) -> tuple[float, float]:
    """Wilson score interval of a rate (Wilson 1927): ``hits``, maybe a fraction, of ``count``; 0 to 1 of none."""
    if not 0 <= hits <= count:
        raise ValueError(f"a rate needs 0 <= hits <= count, got {hits} of {count}")
    if count == 0:
        return 0.0, 1.0
    rate = hits / count
    spread = _Z * _Z / count
    centre = (rate + spread / 2) / (1 + spread)
    half = _Z * math.sqrt(rate * (1 - rate) / count + spread / (4 * count)) / (1 + spread)
    # At 0 and 1 the interval begins and ends there exactly, whatever the rounding.
    return (0.0 if hits == 0 else centre - half), (1.0 if hits == count else centre + half)


@lru_cache(maxsize=3)  # of a few sizes of sets, 80 kB a terrain
def resamples(count: int, seed: int, draws: int = _BOOTSTRAP_DRAWS) -> NDArray[np.float64]:
    """How often each of ``count`` terrains is drawn in each resample, shape (draws, count)."""
    drawn = np.random.default_rng(seed).integers(count, size=(draws, count))
    drawn += count * np.arange(draws)[:, None]
    return np.bincount(drawn.ravel(), minlength=drawn.size).reshape(drawn.shape).astype(np.float64)


def bootstrap_interval(
    values: _Values, seed: int, *, families: NDArray[np.int64] | None = None, bounds: _Bounds | None = None
) -> list[float] | None:
    """Interval of the mean of ``values`` (num_terrains,), resampling terrains; None of fewer than two families.

    One seed draws the same resamples for equally many terrains; those of one family are drawn together. Quantiles are
    those of Hesterberg's expanded percentile interval (2015). Resamples lack rare values: with ``bounds``,
    :data:`RATES` or :data:`DIFFERENCES`, the interval is at least as wide as Wilson's, or Newcombe's (1998, method 10).
    """
    family = np.arange(len(values)) if families is None else np.unique(families, return_inverse=True)[1]
    count = int(family.max(initial=-1)) + 1
    if count < 2:
        return None
    drawn = resamples(count, seed)
    means = (drawn @ np.bincount(family, weights=values)) / (drawn @ np.bincount(family).astype(np.float64))
    tail = ndtr(-stdtrit(count - 1, 0.975) * math.sqrt(count / (count - 1)))
    low, high = np.quantile(means, [tail, 1.0 - tail])
    if bounds is not None:
        lowest, highest = _bound_rare(values, family, count, bounds)
        low, high = min(low, lowest), max(high, highest)
    return [float(low), float(high)]


def _bound_rare(values: _Values, family: NDArray[np.int64], count: int, bounds: _Bounds) -> _Bounds:
    """How far the mean may lie if few of ``count`` families differ from 0, or 1; the mean itself if many do."""
    mean = float(values.mean())
    apart = values - (1.0 if bounds == RATES and mean > 0.5 else 0.0)
    if len(np.unique(family[apart != 0.0])) >= _MIN_DIFFERING:
        return mean, mean
    if bounds == RATES:
        return wilson_interval(mean * count, count)
    more, less = (float(np.maximum(side, 0.0).mean()) for side in (values, -values))
    (more_low, more_high), (less_low, less_high) = (wilson_interval(share * count, count) for share in (more, less))
    low = mean - math.hypot(more - more_low, less_high - less)
    high = mean + math.hypot(more_high - more, less - less_low)
    return max(low, bounds[0]), min(high, bounds[1])


def format_value(value: float | None, limits: Sequence[float] | None, form: str = ".3f") -> str:
    """A number with its interval: ``0.750 (0.301 to 0.954)``, by ``.0%`` ``75% (30 to 95%)``; "-" for None."""
    if value is None:
        return "-"
    if limits is None:
        return format(value, form)
    low, high = (format(limit, form) for limit in limits)
    return f"{value:{form}} ({low.removesuffix('%')} to {high})"


def format_rate(hits: int, count: int, *, short: bool = False) -> str:
    """A rate with its Wilson interval: ``3 of 4 (75%, 30 to 95%)``, in short ``75% (30 to 95%)``."""
    if not count:
        return "no valid episode"
    rate = format_value(hits / count, wilson_interval(hits, count), ".0%")
    return rate if short else f"{hits} of {count} ({rate.replace(' (', ', ')}"
