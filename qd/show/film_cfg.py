"""How a film looks."""

from dataclasses import dataclass
from typing import Annotated

from msgspec import Meta

from sim.files.settings import NonNegativeInt


@dataclass(frozen=True, kw_only=True)
class FilmCfg:
    """How a film looks."""

    episode: NonNegativeInt | None = None
    """Which episode to film. If left out, of the episodes that end as most do, the one with the median penalties."""
    ghosts: NonNegativeInt = 2
    """How many others to show translucent."""
    fps: Annotated[int, Meta(ge=1, le=50)] = 25
    """Pictures a second."""
    shadows: bool = True
    """Whether the sun casts shadows; without a GPU they take half of the time."""
