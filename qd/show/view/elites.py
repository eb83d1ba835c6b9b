"""The elites of an archive as the viewer lists them: numbers on axes, ranges brushed on these, and lines of text."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.show.figures import label_of
from sim.files.intervals import wilson_interval

_RATES = {"collision_rate": "base collision", "goal_rate": "goal reached", "fallen_rate": "fallen"}
_RATE_STEP, _FITNESS_STEP = 0.01, 0.1


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One quantity of every elite."""

    name: str
    """Key of the axis: a penalty, ``fitness`` or a rate."""
    label: str
    """In words, one line."""
    values: NDArray[np.float64]
    """Shape (num_elites,)."""
    low: float
    """Lower end, a multiple of ``step`` not above any value."""
    high: float
    """Upper end, above ``low`` and not below any value."""
    step: float
    """What ranges are set in."""


@dataclass(frozen=True, kw_only=True)
class Elites:
    """N elites, number 0 the worst for the robot, by fresh episodes where an elite has valid ones, else as found."""

    archive: Archive
    fresh: NDArray[np.bool_]
    """Whether an elite's numbers are of fresh episodes, shape (N,)."""
    counted: NDArray[np.int64]
    """Valid episodes that its rates are of, shape (N,)."""
    axes: tuple[Axis, ...]
    """Ratios in the archive's order, fitness, rates."""

    def __len__(self) -> int:
        """N."""
        return len(self.counted)

    def axis(self, name: str) -> Axis:
        """The axis of a name."""
        return next(axis for axis in self.axes if axis.name == name)

    @property
    def labels(self) -> list[str]:
        """The penalties in words, in the archive's order."""
        return [self.axis(name).label for name in self.archive.penalties]

    def within(self, ranges: dict[str, tuple[float, float]]) -> NDArray[np.int64]:
        """Numbers of the elites that lie in all ranges, limits included, worst first.

        Args:
            ranges: Lower and upper limit by the name of an axis; an axis without one is not looked at.
        """
        kept = np.ones(len(self), dtype=bool)
        for name, (low, high) in ranges.items():
            axis = self.axis(name)
            slack = 1e-6 * axis.step  # a slider's decimals are not those of float64
            kept &= (axis.values >= low - slack) & (axis.values <= high + slack)
        return np.flatnonzero(kept)

    def rate_text(self, name: str, number: int) -> str:
        """A rate of an elite with its 95 % interval (Wilson), such as ``45 % (31-60)``."""
        count = int(self.counted[number])
        hits = round(float(self.axis(name).values[number]) * count)
        low, high = wilson_interval(hits, count)
        return f"{hits / count:.0%} ({100 * low:.0f}-{100 * high:.0f})".replace("%", " %")

    def line(self, number: int) -> str:
        """An elite on one line of the list: number, fitness, rates."""
        fitness = self.axis("fitness").values[number]
        collided, goal = (self.rate_text(name, number) for name in ("collision_rate", "goal_rate"))
        return f"{number}: {fitness:.1f} · collision {collided} · goal {goal}"

    def details(self, number: int) -> str:
        """All that the archive says of an elite, as Markdown."""
        archive = self.archive
        of = f"{self.counted[number]} {'fresh' if self.fresh[number] else 'found'} episodes"
        lines = [
            f"**Elite {number}** of {len(self)} · fitness **{self.axis('fitness').values[number]:.2f}** "
            f"({archive.fitness[number]:.2f} as found in iteration {archive.iteration[number]})",
            "",
            f"| as searched | of {of}, 95 % interval |",
            "|---|---|",
            *(f"| {label} | {self.rate_text(name, number)} |" for name, label in _RATES.items()),
        ]
        return "\n".join(lines)


def elites_of(archive: Archive) -> Elites:
    """The elites of an archive that has some, in its order."""
    found = {name: np.asarray(getattr(archive, name)) for name in ("ratios", "fitness", *_RATES)}
    counted = archive.episodes - archive.invalid_episodes
    fresh = np.zeros(len(archive), dtype=bool)
    if archive.fresh is not None:
        again = archive.fresh
        fresh = again.valid
        counted = np.where(fresh, again.episodes - again.invalid_episodes, counted)
        found = {
            name: np.where(fresh if values.ndim == 1 else fresh[:, None], getattr(again, name), values)
            for name, values in found.items()
        }
    shares = [
        _axis(name, label_of(name), found["ratios"][:, column], _RATE_STEP)
        for column, name in enumerate(archive.penalties)
    ]
    rates = [_axis(name, label, found[name], _RATE_STEP) for name, label in _RATES.items()]
    fitness = _axis("fitness", "fitness", found["fitness"], _FITNESS_STEP)
    return Elites(archive=archive, fresh=fresh, counted=counted, axes=(*shares, fitness, *rates))


def _axis(name: str, label: str, values: NDArray[np.float64], step: float) -> Axis:
    """An axis as long as its values need: 0 to 1 at most for what is a share."""
    low = float(np.floor(values.min() / step + 1e-9)) * step
    high = float(np.ceil(values.max() / step - 1e-9)) * step
    if high <= low:
        high = low + step
    return Axis(name=name, label=label, values=values, low=round(low, 6), high=round(high, 6), step=step)
