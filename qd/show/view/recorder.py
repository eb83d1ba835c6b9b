"""Records and films crossings on the CPU in a process of its own, while the page goes on answering.

The process takes seconds to load the simulation, so it starts before the page, and the page never loads it.
"""

import threading
from collections.abc import Callable, Hashable
from concurrent.futures import CancelledError
from functools import partial
from multiprocessing.synchronize import Event
from typing import Any, NamedTuple

from qd.workers.process import CONTEXT, EvaluatorError, WorkerProcess

_PREPARING = "the simulation is built; the very first one compiles its kernels, up to some minutes"


class TaskProgress(NamedTuple):
    """How far a task is."""

    task: Any  # a qd.show.recordings.CrossingRequest, or a film: a partial call of qd.show.film.film
    text: str = ""  # an error, or what the process does where its share does not say it
    share: float = 0.0
    result: Any = None  # the recording, or the film's file, when it is done
    failed: bool = False


class RecordingWorker:
    """Works in the process: it does the task that is put in, and drops it when ``cancelled`` is set."""

    def __init__(self, cancelled: Event, num_terrains: int) -> None:
        import sim.simulation  # noqa: F401  Newton takes seconds to load: now, and not when somebody waits
        from qd.show.recordings import RecordingCrosser

        self._cancelled = cancelled
        self._make_crosser = RecordingCrosser
        self._crosser: Any = None  # of the first task's robot

    def put(self, task: Any, robot: Any) -> None:
        """Accept a task of a robot."""
        self._task = task
        self._crosser = self._crosser or self._make_crosser(robot, "cpu")

    def take(self, progress: Callable[[float], None]) -> Any:
        """The recording or the film's file; an error of the task; None if it was cancelled."""

        def report(share: float) -> None:
            progress(share)
            if self._cancelled.is_set():
                raise CancelledError

        try:
            if isinstance(self._task, partial):
                self._task(progress=report)
                return self._task.keywords["out"]
            return self._crosser([self._task], report)[0]
        except CancelledError:
            return None
        except (ValueError, OSError) as error:
            return error


class Recorder:
    """Does the last request of each key, the oldest first; requests that are not begun are replaced.

    ``robot`` is that of all tasks, set before the first one; ``report`` is called in another thread at every step
    forward. The process imports ``build`` by its name, and calls it for what works there.
    """

    def __init__(self, *, build: Callable[[Event, int], Any] = RecordingWorker) -> None:
        self.robot: Any = None
        self.report: Callable[[TaskProgress], None] = lambda progress: None
        self._build = build
        self._cancelled = CONTEXT.Event()
        self._requests: dict[Hashable, Any] = {}  # by key, the oldest first
        self._current: Any = None
        self._stopped = False
        self._changed = threading.Condition()
        self._start_process()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def request(self, task: Any, *, key: Hashable = 0) -> None:
        """Do a task when its turn comes; None withdraws the request of the key."""
        with self._changed:
            self._requests.pop(key, None)
            if task is not None and task != self._current:
                self._requests[key] = task
            self._changed.notify()

    def cancel(self, task: Any) -> None:
        """Drop a task, even while it runs."""
        with self._changed:
            self._requests = {key: request for key, request in self._requests.items() if request != task}
            if self._current is not None and self._current == task:
                self._cancelled.set()

    def stop(self) -> None:
        """End process and thread at once."""
        with self._changed:
            self._stopped = True
            self._worker.stop()
            self._changed.notify()
        self._thread.join(timeout=10)

    def _start_process(self) -> None:
        self._is_ready = False
        self._worker = WorkerProcess(1, self._build, self._cancelled)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or bool(self._requests))
                if self._stopped:
                    return
                task = self._current = self._requests.pop(next(iter(self._requests)))
            try:
                if not self._is_ready:
                    self.report(TaskProgress(task=task, text=_PREPARING))
                self._worker.send(task, self.robot)
                while (message := self._worker.receive())[0] != "result":
                    self._is_ready = True
                    if message[0] == "progress":
                        self.report(TaskProgress(task=task, share=message[1]))
                result = message[1]  # of the task, its error, or None if it was cancelled
            except (EvaluatorError, OSError) as error:
                with self._changed:
                    if self._stopped:
                        return
                    self._worker.stop()
                    self._start_process()
                result = error
            with self._changed:
                self._current = None
                self._cancelled.clear()
            if result is not None:
                self.cancel(task)  # other keys may have requested the same meanwhile
            if isinstance(result, Exception):
                self.report(TaskProgress(task=task, text=str(result), failed=True))
            elif result is not None:
                self.report(TaskProgress(task=task, share=1.0, result=result))
