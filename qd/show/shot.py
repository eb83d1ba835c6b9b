"""What a film shows."""

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from sim.recording.recorder import Recording


@dataclass(frozen=True, kw_only=True)
class Shot:
    """What a film shows: one episode of a recording, and others of the same terrain as ghosts."""

    recording: "Recording"
    terrain: int
    """Index of the terrain."""
    episode: int
    """Index of the episode."""
    ghosts: tuple[int, ...] = ()
    """Indices of the others."""
    scales: dict[str, float]
    """What each penalty is divided by, so that they compare; those not named are not drawn. All 1 where scales were
    never measured."""

    @property
    def num_frames(self) -> int:
        """Frames of the episode."""
        return int(self.recording.num_frames[self.terrain, self.episode])

    @property
    def penalties(self) -> dict[str, NDArray[np.float64]]:
        """Scaled penalty sums so far by name, shape (frames,) each."""
        sums = self.recording.penalties[self.terrain, self.episode, : self.num_frames].astype(np.float64)
        names = self.recording.penalty_names
        return {name: sums[:, names.index(name)] / scale for name, scale in self.scales.items() if name in names}
