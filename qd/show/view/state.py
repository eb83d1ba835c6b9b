"""What the viewer stands at: which elites are brushed, which is picked, which crossing of it, and at what time."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from qd.show.view.elites import Elites

PAGE = 8
"""Lines of the list at once."""


class Selection:
    """Which elites are in the brushed ranges, and which of them is picked."""

    def __init__(self, elites: Elites) -> None:
        """Nothing brushed, the worst elite picked.

        Args:
            elites: At least one.
        """
        self._elites = elites
        self._ranges: dict[str, tuple[float, float]] = {}
        self.kept: NDArray[np.int64] = elites.within({})
        """Numbers of the elites in all ranges, worst first."""
        self.picked = 0
        """Number of the elite that is shown; it stays when a range leaves it out."""
        self.page = 0
        """Page of the list, from 0."""

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """Brushed ranges by axis; an axis that is open at both ends has none."""
        return dict(self._ranges)

    @property
    def num_pages(self) -> int:
        """Pages of the list, at least 1."""
        return max(1, -(-len(self.kept) // PAGE))

    @property
    def listed(self) -> list[int]:
        """Numbers of the elites on the page."""
        return self.kept[self.page * PAGE : (self.page + 1) * PAGE].tolist()

    def brush(self, name: str, low: float, high: float) -> None:
        """Keep elites in a range of an axis alone, ends included; the axis's full range frees it.

        Raises:
            ValueError: If the upper end is below the lower one.
        """
        if high < low:
            raise ValueError(f"a range must go from low to high, got {low} to {high}")
        axis = self._elites.axis(name)
        half = 0.5 * axis.step
        if low <= axis.low + half and high >= axis.high - half:
            self._ranges.pop(name, None)
        else:
            self._ranges[name] = (low, high)
        self._keep()

    def clear(self) -> None:
        """Free all axes."""
        self._ranges.clear()
        self._keep()

    def _keep(self) -> None:
        self.kept = self._elites.within(self._ranges)
        self.page = 0

    def turn(self, pages: int) -> None:
        """Turn the list by some pages, no further than its ends."""
        self.page = int(np.clip(self.page + pages, 0, self.num_pages - 1))

    def pick(self, number: int) -> bool:
        """Show an elite, and the page of the list it is on if it is in the ranges.

        Returns:
            Whether it is another one than before.

        Raises:
            ValueError: If there is no such elite.
        """
        if not 0 <= number < len(self._elites):
            raise ValueError(f"there is no elite {number}: expected 0 to {len(self._elites) - 1}")
        place = np.searchsorted(self.kept, number)
        if place < len(self.kept) and self.kept[place] == number:
            self.page = int(place) // PAGE
        changed = number != self.picked
        self.picked = number
        return changed

    def step(self, by: int) -> int:
        """Number of the next (1) or previous (-1) elite in the ranges; the picked one if there is none."""
        if by > 0:
            later = self.kept[self.kept > self.picked]
            return int(later[0]) if len(later) else self.picked
        earlier = self.kept[self.kept < self.picked]
        return int(earlier[-1]) if len(earlier) else self.picked


@dataclass(kw_only=True)
class Clock:
    """Time within a crossing, run by real time."""

    duration_s: float = 0.0
    """Length of the crossing [s]."""
    time_s: float = 0.0
    """Shown time [s]."""
    speed: float = 1.0
    """Simulated seconds in a real one."""
    playing: bool = field(default=False)

    def load(self, duration_s: float) -> None:
        """Begin another crossing; playing goes on."""
        self.duration_s = duration_s
        self.time_s = 0.0

    def seek(self, time_s: float) -> None:
        """Show a time, no further than the ends."""
        self.time_s = float(np.clip(time_s, 0.0, self.duration_s))

    def toggle(self) -> None:
        """Play or pause; at its end a crossing begins anew."""
        self.playing = not self.playing
        if self.playing and self.time_s >= self.duration_s:
            self.time_s = 0.0

    def tick(self, real_s: float) -> bool:
        """Let real time go by [s]; at its end a crossing stops.

        Returns:
            Whether the shown time changed.
        """
        if not self.playing:
            return False
        before = self.time_s
        self.seek(before + self.speed * real_s)
        self.playing = self.time_s < self.duration_s
        return self.time_s != before

    def frame(self, dt: float, num_frames: int) -> int:
        """Frame of the shown time among ``num_frames`` that are ``dt`` [s] apart."""
        return int(np.clip(round(self.time_s / dt), 0, num_frames - 1))
