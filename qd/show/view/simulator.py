"""What the viewer's processes work on: they record crossings and film them."""

from collections.abc import Callable
from functools import partial
from multiprocessing.synchronize import Event
from typing import Any

import sim.simulation  # noqa: F401  Newton takes seconds to load: now, and not when somebody waits
from qd.show.recordings import Simulation, Wanted
from sim.robots.robot import RobotCfg


class _DroppedError(Exception):
    """Nobody waits for it any more."""


class Simulator:
    """Records and films what is put in, and drops what is under way where ``drop`` is set."""

    def __init__(self, drop: Event) -> None:
        self._drop = drop
        self._simulation: Simulation | None = None

    def put(self, wanted: Wanted | partial[None], robot: RobotCfg) -> None:
        """Take on a crossing, or a film as :func:`qd.show.film.film` makes it."""
        self._task = wanted, robot

    def take(self, progress: Callable[[float], None]) -> Any:
        """The recording or the file of the task; an error of it; None if it was dropped."""
        wanted, robot = self._task

        def report(share: float) -> None:
            progress(share)
            if self._drop.is_set():
                raise _DroppedError

        try:
            if isinstance(wanted, partial):
                wanted(progress=report)
                return wanted.keywords["out"]
            self._simulation = self._simulation or Simulation(robot, "cpu")
            return self._simulation([wanted], report)[0]
        except _DroppedError:
            return None
        except (ValueError, OSError) as error:
            return error
