"""How a valid episode may end, as figures and pages show it: in words, and in looks apart for the colour-blind."""

from dataclasses import dataclass

from kernels.episode import Outcome


@dataclass(frozen=True)
class Ending:
    """One way to end."""

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
"""By outcome, the good one first."""
