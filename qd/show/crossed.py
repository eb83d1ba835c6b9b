"""Recorded crossings in numbers: how they ended, what they cost, and where."""

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Outcome
from sim.files.intervals import rate_words, wilson_interval
from sim.recording.recorder import Recording


class Ending(NamedTuple):
    """A way to end, in words and in looks that the colour-blind tell apart."""

    words: str
    color: str
    """As ``#rrggbb`` (Okabe and Ito's)."""
    marker: str
    """Matplotlib's, where the episode ended."""
    line: str
    """Matplotlib's, of the path to it."""


ENDINGS = {
    Outcome.GOAL: Ending("reached the goal", "#009e73", "o", "-"),
    Outcome.BASE_COLLISION: Ending("base collision", "#d55e00", "X", "--"),
    Outcome.TIME_OUT: Ending("out of time", "#0072b2", "s", "-."),
    Outcome.OUT: Ending("left the terrain", "#cc79a7", "^", ":"),
}
"""How a valid episode may end, the good way first."""
_INVALID = Ending("invalid: the simulation broke", "#5a5a5a", "", "")
ARRIVED, *FAILED = (ending.words for ending in ENDINGS.values())
"""The good way in words, and the others."""


def ending_of(outcome: int) -> Ending:
    """How an episode of an outcome ended, a valid one or not."""
    return ENDINGS.get(Outcome(outcome), _INVALID)


class Rate(NamedTuple):
    """Hits among episodes."""

    hits: int
    count: int

    def __str__(self) -> str:
        return rate_words(self.hits, self.count)

    @property
    def limits(self) -> str:
        """The 95 % Wilson interval in words: ``0 to 16 %``; anything possible without an episode."""
        return "{:.0f} to {:.0f} %".format(*(100.0 * limit for limit in wilson_interval(self.hits, self.count)))


@dataclass(frozen=True, kw_only=True)
class Crossed:
    """One terrain's recording; E valid episodes."""

    recording: Recording
    """Of one terrain."""
    chosen: NDArray[np.int64]
    """Valid episodes, shape (E,)."""
    penalties: NDArray[np.float64]
    """Raw penalty sums of each, in the archive's order, shape (E, P)."""
    scales: NDArray[np.float64]
    """Shape (P,)."""
    rates: dict[str, Rate]
    """By the words of :data:`ENDINGS`, and ``fallen``."""

    @property
    def ends(self) -> NDArray[np.float64]:
        """Where each episode ended, shape (E, 3) [m]."""
        last = self.recording.num_frames[0, self.chosen] - 1
        return self.recording.base_position[0, self.chosen, last].astype(np.float64)

    @property
    def outcome(self) -> NDArray[np.uint8]:
        """How each ended, shape (E,)."""
        return self.recording.outcome[0, self.chosen]

    @property
    def scaled(self) -> NDArray[np.float64]:
        """Scaled penalties, shape (E, P)."""
        return self.penalties / self.scales

    @property
    def failed_at(self) -> float | None:
        """Median of x where the episodes that did not reach the goal ended [m]; None if all did."""
        x = self.ends[self.outcome != Outcome.GOAL, 0]
        return float(np.median(x)) if len(x) else None

    def path(self, k: int) -> NDArray[np.float64]:
        """Base positions of the k-th valid episode [m], shape (frames, 3)."""
        episode = self.chosen[k]
        frames = slice(self.recording.num_frames[0, episode])
        return self.recording.base_position[0, episode, frames].astype(np.float64)


def crossed_of(recording: Recording, penalties: tuple[str, ...], scales: tuple[float, ...]) -> Crossed:
    """A recording of one terrain in numbers."""
    outcome = recording.outcome[0]
    chosen = np.flatnonzero(outcome != Outcome.INVALID)
    columns = [recording.penalty_names.index(name) for name in penalties]
    last = recording.num_frames[0, chosen] - 1
    hits = {ending.words: outcome[chosen] == end for end, ending in ENDINGS.items()}
    hits["fallen"] = recording.fallen[0, chosen]
    return Crossed(
        recording=recording,
        chosen=chosen,
        penalties=recording.penalties[0, chosen, last][:, columns].astype(np.float64),
        scales=np.asarray(scales, dtype=np.float64),
        rates={label: Rate(int(hit.sum()), len(chosen)) for label, hit in hits.items()},
    )


def penalties_by_place(crossed: Crossed, penalties: tuple[str, ...], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scaled penalties per episode by where along x they were incurred.

    Args:
        crossed: The crossings.
        penalties: Those of the archive.
        edges: Of the places [m], shape (places + 1,); what lies outside counts in the first or last.

    Returns:
        Mean over the episodes, shape (places, P); the sum over places is the mean penalty.
    """
    recording = crossed.recording
    columns = [recording.penalty_names.index(name) for name in penalties]
    amounts = np.zeros((len(edges) - 1, len(columns)))
    for k, episode in enumerate(crossed.chosen):
        sums = recording.penalties[0, episode, : recording.num_frames[0, episode]][:, columns].astype(np.float64)
        places = np.clip(np.digitize(crossed.path(k)[1:, 0], edges) - 1, 0, len(amounts) - 1)
        np.add.at(amounts, places, np.diff(sums, axis=0))
    return amounts / (crossed.scales * max(1, len(crossed.chosen)))
