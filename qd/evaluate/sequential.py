"""Sequential tests of goal rates, over rounds of episodes that have one of every terrain.

They hold whatever the terrains' own rates are, and however often one looks:

- *Rate*: wealth that bets on mean goal rates above ``limit - margin``, half of it on ``limit + margin`` and half on all
  by Beta(1/2, 1/2), is a likelihood ratio: at most 1 in expectation over a round whose mean rate is that or less, since
  a geometric mean is at most an arithmetic one. It exceeds 1 / error with a chance of at most ``error`` (Ville 1939).
  Then, if the rate is above the limit, the controller passes. By bets on rates below ``limit + margin`` it fails.
- *Old against new*: pairs of equal terrain, seed and replica differ by d = -1, 0 or 1. Wealth that bets a share x on d,
  times 1 + x d, grows beyond 1 / error with a chance of at most ``error`` where the mean of d is not positive (Waudby-
  Smith and Ramdas 2024); bets are means over :data:`BETS`. At the end McNemar's exact test decides, and new must not
  have lost half of the margin or more.
"""

import numpy as np
from scipy.special import betainc, betaincc, betaln
from scipy.stats import binomtest

BETS = np.linspace(0.02, 0.98, 49)  # shares of the wealth


def _log_mixture(goals: int, misses: int, low: float = 0.0, high: float = 1.0) -> float:
    """Logarithm of the mean likelihood of so many goals and misses over rates of Beta(1/2, 1/2) between two rates."""
    shapes = (goals + 0.5, misses + 0.5), (0.5, 0.5)
    with np.errstate(divide="ignore"):  # nothing is left inside
        parts = [betainc(*shape, high) if low == 0.0 else betaincc(*shape, low) for shape in shapes]  # one is a limit
        inside, share = np.log(parts)
    return float(betaln(goals + 0.5, misses + 0.5) - betaln(0.5, 0.5) + inside - share)


class RateTest:
    """Whether a mean goal rate over terrains is above ``limit``, if it is the margin or more away from it."""

    def __init__(self, limit: float, margin: float, error: float) -> None:
        self._limit, self._low, self._high = limit, limit - margin, limit + margin
        self._threshold = -np.log(error)
        self.goals = self.episodes = 0

    def add(self, goals: int, episodes: int) -> None:
        """Counts valid episodes of a round, and those that reached the goal."""
        self.goals, self.episodes = self.goals + goals, self.episodes + episodes

    @property
    def rate(self) -> float:
        """Goal rate over the valid episodes."""
        return self.goals / max(1, self.episodes)

    @property
    def passes(self) -> bool | None:
        """Whether it passes; None as long as that is not clear."""
        misses, above = self.episodes - self.goals, self.rate > self._limit
        null, bet = (self._low, self._high) if above else (self._high, self._low)
        mixture = _log_mixture(self.goals, misses, **({"low": null} if above else {"high": null}))
        bets, nulls = (self.goals * np.log(rate) + misses * np.log1p(-rate) for rate in (bet, null))
        wealth = np.logaddexp(mixture, bets) - np.log(2.0) - nulls
        return above if wealth >= self._threshold else None

    def decide(self) -> tuple[bool, str]:
        """Whether the rate is the limit or more, at the end of all rounds, and what was done."""
        return self.rate >= self._limit, "not clear, so by the rate alone"


def rate_interval(goals: int, episodes: int, level: float = 0.95) -> list[float]:
    """Interval of a mean rate that holds whenever one stops: rates that a mixture of all does not outweigh."""
    misses, rate = episodes - goals, goals / max(1, episodes)
    rates = np.sort(np.append(np.linspace(0.0005, 0.9995, 1000), np.clip(rate, 1e-6, 1.0 - 1e-6)))
    wealth = _log_mixture(goals, misses) - goals * np.log(rates) - misses * np.log1p(-rates)
    kept = np.flatnonzero(wealth < -np.log(1.0 - level))
    return np.concatenate([[0.0], rates, [1.0]])[[kept[0], kept[-1] + 2]].tolist()  # a step outward


class PairedTest:
    """Whether new reaches the goal less often than old on the same episodes, or not by ``margin`` or more."""

    def __init__(self, margin: float, error: float) -> None:
        self._margin, self._error = margin, error
        self.lost = self.won = self.pairs = 0

    def add(self, lost: int, won: int, pairs: int) -> None:
        """Counts valid pairs of a round, those that old alone crosses, and those that new alone does."""
        self.lost, self.won, self.pairs = self.lost + lost, self.won + won, self.pairs + pairs

    def _wealth(self, *outcomes: tuple[int, float]) -> float:
        """Logarithm of the mean wealth over bets, where so many pairs paid each outcome of at least -1."""
        logs = np.sum([count * np.log1p(BETS * paid) for count, paid in outcomes], axis=0)
        return float(np.logaddexp.reduce(logs) - np.log(len(BETS)))

    @property
    def passes(self) -> bool | None:
        """False once new is worse, True once it is not by the margin; None as long as neither is clear."""
        threshold, even, m = -np.log(self._error), self.pairs - self.lost - self.won, self._margin
        if self._wealth((self.lost, 1.0), (self.won, -1.0)) >= threshold:
            return False
        worse_by_less = self._wealth((self.lost, m - 1.0), (self.won, m + 1.0), (even, m)) >= threshold
        return True if worse_by_less else None

    def decide(self) -> tuple[bool, str]:
        """McNemar's exact test and the loss itself, at the end of all rounds, and what was done."""
        count = self.lost + self.won
        p = float(binomtest(self.lost, count, alternative="greater").pvalue) if count else 1.0
        loss = (self.lost - self.won) / max(1, self.pairs)
        passes = p > self._error and loss < self._margin / 2 and self.pairs > 0
        return passes, f"not clear, so by McNemar's exact test, p = {p:.3g}, and the loss, {loss:.3f}"
