"""What the film process is asked for."""

from dataclasses import dataclass
from pathlib import Path

from qd.show.film import FilmCfg
from sim.recording.recorder import Recording


@dataclass(frozen=True, kw_only=True, eq=False)
class WantedFilm:
    """A film of an episode."""

    recording: Recording
    scales: dict[str, float]
    cfg: FilmCfg
    by: str
    """Name of the controller, where it is not the search's."""
    beside: tuple[str, Recording] | None
    """Name and recording of the ghost."""
    file: Path
    """Where it goes."""
