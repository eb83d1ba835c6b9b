"""Records and films crossings on the CPU in a process of its own, while the page goes on answering.

The process takes seconds to load the simulation. So it is begun before the page, and only the process loads that.
"""

import threading
from collections.abc import Callable, Hashable
from dataclasses import dataclass
from functools import partial
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from typing import Any

from qd.workers.process import EvaluatorError, WorkerProcess

_PREPARING = "the simulation is built; the very first one compiles its kernels, up to some minutes"


@dataclass(frozen=True, kw_only=True)
class Report:
    """How a task goes on."""

    wanted: Any
    """The task: :class:`qd.show.recordings.Wanted`, or a film."""
    text: str = ""
    """In words, where its share does not say it."""
    share: float = 0.0
    result: Any = None
    """The recording or the film's file, when it is done."""
    failed: bool = False


class _DroppedError(Exception):
    """Nobody waits for it any more."""


class Simulator:
    """What works in the process: it does the task that is put in, and drops it where ``drop`` is set."""

    def __init__(self, drop: Event, num_terrains: int) -> None:
        import sim.simulation  # noqa: F401  Newton takes seconds to load: now, and not when somebody waits
        from qd.show.recordings import Simulation

        self._drop, self._simulation_of = drop, Simulation
        self._simulation: Simulation | None = None

    def put(self, wanted: Any, robot: Any) -> None:
        """Take on a :class:`qd.show.recordings.Wanted`, or a film as :func:`qd.show.film.film` makes it."""
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
            self._simulation = self._simulation or self._simulation_of(robot, "cpu")
            return self._simulation([wanted], report)[0]
        except _DroppedError:
            return None
        except (ValueError, OSError) as error:
            return error


class Recorder:
    """Does the tasks that each tab asked for last, the oldest first; earlier ones that are not begun are dropped."""

    def __init__(self, *, build: Callable[[Event, int], Any] = Simulator) -> None:
        """The process imports by its name what ``build`` is, and has it make what works there."""
        self.robot: Any = None
        """Whose crossings they are; set before the first task."""
        self.report: Callable[[Report], None] = lambda report: None
        """Called in another thread, with every step forward."""
        self._build = build
        self._drop = get_context("spawn").Event()
        self._wishes: dict[Hashable, Any] = {}  # by tab, the oldest first
        self._now: Any = None  # the task that is worked on
        self._stopped = False
        self._changed = threading.Condition()
        self._worker, self._is_ready = self._begin(), False
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def record(self, wanted: Any, *, tab: Hashable = 0) -> None:
        """Do a task for a tab when its turn comes; with None, nothing more for it."""
        with self._changed:
            self._wishes.pop(tab, None)
            if wanted is not None and wanted != self._now:
                self._wishes[tab] = wanted
            self._changed.notify()

    def cancel(self, wanted: Any) -> None:
        """Drop a task, also while it is worked on."""
        with self._changed:
            self._wishes = {tab: wish for tab, wish in self._wishes.items() if wish != wanted}
            if self._now is not None and self._now == wanted:
                self._drop.set()

    def stop(self) -> None:
        """End process and thread at once."""
        with self._changed:
            self._stopped = True
            self._worker.stop()
            self._changed.notify()
        self._thread.join(timeout=10)

    def _begin(self) -> WorkerProcess:
        return WorkerProcess(1, self._build, self._drop)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or bool(self._wishes))
                if self._stopped:
                    return
                wanted = self._now = self._wishes.pop(next(iter(self._wishes)))
            try:
                result = self._result_of(wanted)
            except (EvaluatorError, OSError) as error:
                with self._changed:
                    if self._stopped:
                        return
                    self._worker.stop()
                    self._worker, self._is_ready, result = self._begin(), False, error
            with self._changed:
                self._now = None
                self._drop.clear()
                if result is not None:  # others may have asked for the same meanwhile
                    self._wishes = {tab: wish for tab, wish in self._wishes.items() if wish != wanted}
            if isinstance(result, Exception):
                self.report(Report(wanted=wanted, text=str(result), failed=True))
            elif result is not None:
                self.report(Report(wanted=wanted, share=1.0, result=result))

    def _result_of(self, wanted: Any) -> Any:
        """What came of a task: its result, an error, or None of one that is dropped."""
        if not self._is_ready:
            self.report(Report(wanted=wanted, text=_PREPARING))
            self._worker.receive()  # that it is ready
            self._is_ready = True
        self._worker.send(wanted, self.robot)
        while True:
            message, value = self._worker.receive()
            if message == "result":
                return value
            self.report(Report(wanted=wanted, share=float(value)))
