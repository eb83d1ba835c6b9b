"""What a page is written from: the material, and what was worked out and crossed for it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from qd.run.progress import clock
from qd.show.figures import as_png
from qd.show.report.changes import Change, Changes
from qd.show.report.elites import Elites
from qd.show.report.material import Material
from qd.show.report.modes import Modes
from qd.show.report.outcomes import Crossed
from qd.show.report.page import Picture

if TYPE_CHECKING:
    from matplotlib.figure import Figure


@dataclass(frozen=True, kw_only=True)
class Shown:
    """All that the sections take their numbers from."""

    material: Material
    elites: Elites
    modes: Modes
    worst: list[int]
    """Numbers of the failed terrains with the highest fitness; if there are fewer, of others after them."""
    steady: list[int]
    """Numbers of the most reproducible ones."""
    crossed: Mapping[int, Crossed] = field(default_factory=dict)
    """Crossings by the elite's number."""
    not_crossed: str = ""
    """Why there are none, if so."""
    changes: Changes | None = None
    """Terrains to show before and after fine-tuning; None without tables."""
    pairs: Mapping[Change, tuple[Crossed, Crossed]] = field(default_factory=dict)
    """What both controllers make of each."""

    @property
    def numbers(self) -> list[int]:
        """Elites to be shown in detail, each once: the worst, the steadiest, and the typical one of each mode."""
        typical = [mode.typical for mode in self.modes.modes]
        return list(dict.fromkeys([*self.worst, *self.steady, *typical]))


def picture(name: str, figure: "Figure", shows: str) -> Picture:
    """A figure as a part of the page.

    Args:
        name: Of its file, without .png.
        figure: What to draw.
        shows: What it shows, for who cannot see it.
    """
    return Picture(f"{name}.png", as_png(figure), shows)


def percent(share: float) -> str:
    """A share as people read it: 0 and 100 % only of none and all."""
    text = f"{100.0 * share:.1f}" if 0.0 < share < 1.0 and not 0.095 <= share < 0.995 else f"{100.0 * share:.0f}"
    if (text == "0.0" and share > 0.0) or (text == "100.0" and share < 1.0):
        text = "less than 0.1" if share < 0.5 else "over 99.9"
    return f"{text} %"


def hours(seconds: float) -> str:
    """A long duration."""
    return f"{seconds / 3600:,.0f} hours" if seconds > 36_000 else clock(seconds)


def counted(number: int, one: str, many: str = "") -> str:
    """A number with its noun: ``1 elite``, ``459 elites``."""
    return f"{number:,} {one if number == 1 else many or f'{one}s'}"
