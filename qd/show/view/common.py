"""What all tabs of the viewer share."""

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from qd.show.recordings import Recordings, Wanted, on_elite
from qd.show.view.recorder import Recorder
from qd.show.view.scene import Shapes
from qd.show.view.show import Show
from sim.robots.skeleton import Skeleton


@dataclass(frozen=True, kw_only=True)
class Common:
    """What all tabs share."""

    show: Show
    skeleton: Skeleton
    shapes: Shapes
    recordings: Recordings
    recorder: Recorder
    films: Callable[[], Recorder]
    """What makes films, in a process of its own from the first call on."""
    post: Callable[..., None]
    """:meth:`qd.show.view.app.App.post`."""

    def genes(self, elite: int, minimal: bool) -> NDArray[np.float32] | None:
        """Of the minimal terrain of an elite; None where the whole one is to be shown."""
        minima = self.show.minima
        return minima.genes.get(elite) if minimal and minima is not None else None

    def wanted(self, elite: int, controller: str | None, *, minimal: bool = False) -> Wanted | None:
        """A controller's crossings of an elite, or of its minimal terrain if it has one; None without a controller."""
        show = self.show
        if controller is None:
            return None
        return on_elite(
            show.opened_run.archive, elite, policy=show.controllers[controller], replicas=show.replicas,
            minimal=self.genes(elite, minimal),
        )  # fmt: skip
