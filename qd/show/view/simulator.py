"""What the viewer's processes work on: they record crossings and film them."""

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

import sim.simulation  # noqa: F401  Newton takes seconds to load: now, and not when somebody waits
from qd.show.film import FilmCfg, film
from qd.show.recordings import Simulation, Wanted
from sim.recording.recorder import Recording
from sim.robots.robot import RobotCfg


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


class _DroppedError(Exception):
    """Nobody waits for it any more."""


class Simulator:
    """Records and films what is put in, and drops what is under way where ``drop`` is set."""

    def __init__(self, drop: Event) -> None:
        self._drop = drop
        self._simulation: Simulation | None = None
        self._tasks = deque[tuple[Wanted | WantedFilm, RobotCfg, bool]]()

    def put(self, wanted: Wanted | WantedFilm, robot_and_only_ready: tuple[RobotCfg, bool]) -> None:
        """Queue a task; of one that is only to be ready, the simulation is built."""
        self._tasks.append((wanted, *robot_and_only_ready))

    def take(self, progress: Callable[[float], None]) -> Any:
        """The recording or the file of the oldest task; an error of it; None if it was dropped or is ready."""
        wanted, robot, only_ready = self._tasks.popleft()

        def report(share: float) -> None:
            progress(share)
            if self._drop.is_set():
                raise _DroppedError

        try:
            if isinstance(wanted, WantedFilm):
                film(
                    wanted.recording, robot, wanted.scales, wanted.file, wanted.cfg, by=wanted.by,
                    beside=wanted.beside, progress=report,
                )  # fmt: skip
                return wanted.file
            self._simulation = simulation = self._simulation or Simulation(robot, "cpu")
            if only_ready:
                simulation.prepare(wanted)
                return None
            return simulation([wanted], report)[0]
        except _DroppedError:
            return None
        except (ValueError, OSError) as error:
            return error
