"""95 % intervals of measured rates and means, and how they are written."""

import math
from collections.abc import Sequence
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import stdtrit

_Z = 1.959963984540054  # the normal distribution's 97.5 % quantile
_BOOTSTRAP_DRAWS = 10_000


def wilson_interval(hits: int, count: int) -> tuple[float, float]:
    """Wilson score interval of a rate (Wilson 1927): ``hits`` of ``count`` independent trials; 0 to 1 without any."""
    if not 0 <= hits <= count:
        raise ValueError(f"a rate needs 0 <= hits <= count, got {hits} of {count}")
    if count == 0:
        return 0.0, 1.0
    rate, spread = hits / count, _Z * _Z / count
    centre = (rate + spread / 2) / (1 + spread)
    half = _Z * math.sqrt(rate * (1 - rate) / count + spread / (4 * count)) / (1 + spread)
    # At 0 and 1 the interval begins and ends there exactly, whatever the rounding.
    return (0.0 if hits == 0 else centre - half), (1.0 if hits == count else centre + half)


def t_interval(values: NDArray[np.floating]) -> list[float] | None:
    """Interval of the mean of a few independent measurements (Student 1908), one a training or search; None of one."""
    count = len(values)
    if count < 2:
        return None
    half = float(stdtrit(count - 1, 0.975)) * float(values.std(ddof=1)) / math.sqrt(count)
    return [float(values.mean()) - half, float(values.mean()) + half]


@lru_cache(maxsize=3)  # of a few sizes of sets, 80 kB a terrain
def resamples(count: int, seed: int, draws: int = _BOOTSTRAP_DRAWS) -> NDArray[np.float64]:
    """How often each of ``count`` terrains is drawn in each resample, shape (draws, count)."""
    drawn = np.random.default_rng(seed).integers(count, size=(draws, count))
    drawn += count * np.arange(draws)[:, None]
    return np.bincount(drawn.ravel(), minlength=drawn.size).reshape(drawn.shape).astype(np.float64)


def bootstrap_interval(
    values: NDArray[np.floating], seed: int, *, families: NDArray[np.int64] | None = None
) -> list[float] | None:
    """Interval of the mean of ``values`` (num_terrains,), resampling terrains; None of fewer than two families.

    One seed draws the same resamples for all values of equally many terrains, so that they can be compared in pairs.
    Terrains of one family, by their numbers (num_terrains,), are not independent: they are drawn together.
    """
    family = np.arange(len(values)) if families is None else np.unique(families, return_inverse=True)[1]
    count = int(family.max(initial=-1)) + 1
    if count < 2:
        return None
    drawn = resamples(count, seed)
    means = (drawn @ np.bincount(family, weights=values)) / (drawn @ np.bincount(family).astype(np.float64))
    return [float(limit) for limit in np.quantile(means, [0.025, 0.975])]


def value_words(value: float | None, limits: Sequence[float] | None, form: str = ".3f") -> str:
    """A number with its interval: ``0.750 (0.301 to 0.954)``, by ``.0%`` ``75% (30 to 95%)``; "-" for None."""
    if value is None:
        return "-"
    if limits is None:
        return format(value, form)
    low, high = (format(limit, form) for limit in limits)
    return f"{value:{form}} ({low.removesuffix('%')} to {high})"


def rate_words(hits: int, count: int, *, short: bool = False) -> str:
    """A rate with its Wilson interval: ``3 of 4 (75%, 30 to 95%)``, in short ``75% (30 to 95%)``."""
    if not count:
        return "no valid episode"
    words = value_words(hits / count, wilson_interval(hits, count), ".0%")
    return words if short else f"{hits} of {count} ({words.replace(' (', ', ')}"
