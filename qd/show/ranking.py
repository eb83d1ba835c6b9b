"""The orders that elites are shown in: what is a fault before what merely costs much, and no kind of failure twice.

Families are those of :mod:`qd.families`.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.elites import Elites, elites_of
from qd.families import families_of
from qd.modes import Mode, Modes, failure_modes
from qd.show.figures import label_of

if TYPE_CHECKING:
    from sim.space import TerrainSpace

ORDERS = {
    "modes": "each way of failing once first",
    "fault": "faults first",
    "goal_rate": "goal rate, the lowest first",
    "collision_rate": "base collision, the most first",
    "fallen_rate": "fallen, the most first",
    "fitness": "fitness, the highest first",
    "family": "families of like terrains",
}
"""Orders of elites, in words."""


def mode_words(mode: Mode) -> str:
    """A mode in a few words: how its crossings end, and the penalty that stands out."""
    return f"{mode.ending} · {label_of(mode.marked_by)}"


@dataclass(frozen=True, kw_only=True)
class Ranking:
    """N elites, their failure modes and their families, in orders to show them in."""

    elites: Elites
    modes: Modes
    """Groups of those that fail, by how the robot struggles."""
    families: NDArray[np.int64]
    """Family of each, shape (N,), numbered from 1 by its worst member."""

    @cached_property
    def _severity(self) -> NDArray[np.int64]:
        return self.elites.by_severity()

    def order(self, by: str = "modes") -> NDArray[np.int64]:
        """Rows of all elites, shape (N,), in one of the :data:`ORDERS`; ties are by severity.

        ``modes`` begins with the worst terrain of each mode that has one on which the controller fails, no two of one
        family where that can be had. The worst failing terrain of each other family follows, then the rest.
        """
        severity = self._severity
        if by == "fault":
            return severity
        if by == "modes":
            return self._leading(severity)
        values = self.families if by == "family" else np.asarray(getattr(self.elites, by))
        sign = 1 if by in ("family", "goal_rate") else -1
        return severity[np.argsort(sign * values[severity], kind="stable")]

    def _leading(self, severity: NDArray[np.int64]) -> NDArray[np.int64]:
        failing = severity[self.elites.failing[severity]]
        labels, families = self.modes.labels, set[int]()
        first: list[int] = []
        for mode in dict.fromkeys(labels[failing].tolist()):
            own = failing[labels[failing] == mode].tolist()
            chosen = next((row for row in own if int(self.families[row]) not in families), own[0])
            first.append(chosen)
            families.add(int(self.families[chosen]))
        for row in failing.tolist():
            if int(self.families[row]) not in families:
                first.append(row)
                families.add(int(self.families[row]))
        return np.array([*first, *np.setdiff1d(severity, first, assume_unique=True)], dtype=np.int64)

    def mode_of(self, place: int) -> Mode | None:
        """The mode of the elite in a row; None of one that does not fail."""
        number = int(self.modes.labels[place])
        return self.modes.modes[number - 1] if number else None

    def leaders(self) -> list[int]:
        """Numbers of the terrains that stand for a way of failing, one for each mode in which terrains fail."""
        count = len(np.unique(self.modes.labels[self.elites.failing]))
        return self.elites.numbers[self.order()[:count]].tolist()

    def worst(self, count: int) -> list[int]:
        """Numbers of the first terrains of the order ``modes``."""
        return self.elites.numbers[self.order()[:count]].tolist()


def rank(archive: Archive, space: "TerrainSpace", *, judged: bool = False) -> Ranking:
    """The ranking of an archive that has elites.

    Args:
        archive: The archive.
        space: Of its genes.
        judged: Leaves out elites whose fresh episodes are invalid.
    """
    elites = elites_of(archive, judged=judged)
    families = families_of(archive.genes[elites.numbers], space)
    places = {int(family): place for place, family in enumerate(dict.fromkeys(families[elites.by_severity()]), start=1)}
    numbered = np.array([places[int(family)] for family in families], dtype=np.int64)
    return Ranking(elites=elites, modes=failure_modes(elites), families=numbered)
