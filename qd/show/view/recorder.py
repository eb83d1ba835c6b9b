"""Records crossings on the CPU in a process of their own, while the page goes on answering."""

import threading
from collections import deque
from collections.abc import Callable, Hashable, Sequence
from dataclasses import dataclass, replace
from multiprocessing import get_context
from multiprocessing.synchronize import Event
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.show.recordings import Simulation, Wanted
from qd.workers.process import EvaluatorError, WorkerProcess
from sim.recording.recorder import Recording
from sim.robots.robot import RobotCfg

MAX_PROCESSES = 3
"""Controllers whose simulation stays ready, one process each."""
_PREPARING = "building the simulation (the very first one compiles its kernels: up to some minutes)"


@dataclass(frozen=True, kw_only=True)
class Report:
    """How the recording of some crossings goes on."""

    wanted: Wanted
    text: str
    """In words."""
    share: float = 0.0
    recording: Recording | None = None
    """The result, when it is done."""
    failed: bool = False


class _DroppedError(Exception):
    """Nobody waits for what is being recorded."""


class _Simulator:
    """The work of a recording process: the simulation of a controller, ready to cross."""

    def __init__(self, robot: RobotCfg, first: Wanted, drop: Event) -> None:
        self._simulation, self._first, self._drop = Simulation(robot, "cpu"), first, drop
        self._simulation.prepare(first)
        self._wanted: deque[Wanted] = deque()

    def put(self, terrains: NDArray, seeds: NDArray) -> None:
        """Queues one terrain, to be crossed as the first one was."""
        self._wanted.append(replace(self._first, terrain=terrains[0], terrain_seed=int(seeds[0])))

    def take(self, progress: Callable[[float], None]) -> Recording | None:
        """Crosses the oldest terrain of the queue; None if it is dropped meanwhile."""

        def report(share: float) -> None:
            progress(share)
            if self._drop.is_set():
                raise _DroppedError

        try:
            return self._simulation([self._wanted.popleft()], report)[0]
        except _DroppedError:
            return None


Cfg = tuple[RobotCfg, Wanted, Event]
"""Of a recording process: the robot, what it crosses at first, and the event that drops its work."""


def build_simulator(cfg: Cfg, num_terrains: int) -> Any:
    """What a recording process works with, called in it."""
    return _Simulator(*cfg)


class Recorder:
    """Records the crossings that each tab asked for last; earlier wishes that are not begun are dropped.

    While nobody waits it records ahead what a tab may ask for next, and drops that when somebody asks for another one.

    Args:
        robot: Robot settings.
        report: Called in another thread, with every step forward.
        build: Makes the simulation; a module-level function, since processes import it by name.
    """

    def __init__(
        self,
        robot: RobotCfg,
        report: Callable[[Report], None],
        *,
        build: Callable[[Cfg, int], Any] = build_simulator,
    ) -> None:
        self._robot, self._report, self._build = robot, report, build
        self._workers: dict[str, WorkerProcess] = {}  # by controller, the one used last at the end
        self._wishes: dict[Hashable, Wanted] = {}  # by tab, the oldest first
        self._ahead: dict[Hashable, list[Wanted]] = {}  # by tab, the likeliest first
        self._warm: Wanted | None = None
        self._ahead_now: Wanted | None = None  # what is being recorded while nobody waits for it
        self._drop = get_context("spawn").Event()
        self._stopped = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def record(self, wanted: Wanted | None, *, tab: Hashable = 0) -> None:
        """Record these crossings for a tab when its turn comes; with None, nothing more for it."""
        with self._changed:
            self._wishes.pop(tab, None)
            if wanted is not None:
                self._wishes[tab] = wanted
                if wanted == self._ahead_now:
                    self._ahead_now = None  # now somebody waits for it
                elif self._ahead_now is not None:
                    self._drop.set()
            self._changed.notify()

    def record_ahead(self, wanted: Sequence[Wanted], *, tab: Hashable = 0) -> None:
        """Record these for a tab, in their order, while nobody waits for others; they replace the tab's former ones."""
        with self._changed:
            self._ahead.pop(tab, None)
            if wanted:
                self._ahead[tab] = list(wanted)
            self._changed.notify()

    def warm(self, wanted: Wanted) -> None:
        """Have the process of these crossings' controller ready before anybody asks."""
        with self._changed:
            self._warm = wanted
            self._changed.notify()

    def stop(self) -> None:
        """End all processes and the thread at once."""
        with self._changed:
            self._stopped = True
            for worker in self._workers.values():
                worker.stop()
            self._changed.notify()
        self._thread.join(timeout=10)

    def _run(self) -> None:
        while True:
            with self._changed:
                self._changed.wait_for(lambda: self._stopped or bool(self._wishes or self._ahead or self._warm))
                if self._stopped:
                    return
                wanted, only_warm = self._next()
            try:
                if only_warm:
                    self._worker(wanted)
                    continue
                report = self._record_now(wanted)
                with self._changed:
                    self._ahead_now = None
                    self._drop.clear()
                    if report is not None:  # others may have asked for the same meanwhile
                        self._wishes = {tab: wish for tab, wish in self._wishes.items() if wish != wanted}
            except (ValueError, EvaluatorError, OSError) as error:
                if self._stopped:
                    return
                with self._changed:
                    awaited = not only_warm and self._ahead_now is None
                    self._ahead_now = None
                self._dismiss(wanted.policy)
                report = Report(wanted=wanted, text=str(error), failed=True) if awaited else None
            if report is not None:
                self._report(report)

    def _next(self) -> tuple[Wanted, bool]:
        """What to do next, and whether only to have its process ready."""
        if self._wishes:
            return self._wishes.pop(next(iter(self._wishes))), False
        if self._warm is not None:
            warm, self._warm = self._warm, None
            return warm, True
        tab = next(iter(self._ahead))
        self._ahead_now = self._ahead[tab].pop(0)
        if not self._ahead[tab]:
            del self._ahead[tab]
        return self._ahead_now, False

    def _record_now(self, wanted: Wanted) -> Report | None:
        """The last report on it; None if it was recorded ahead and is dropped."""
        worker = self._worker(wanted)
        worker.send(wanted.terrain[None], np.array([wanted.terrain_seed], np.uint32))
        while True:
            message, value = worker.receive()
            if message == "result":
                return None if value is None else Report(wanted=wanted, text="recorded", share=1.0, recording=value)
            if self._ahead_now is None:
                self._report(Report(wanted=wanted, text="crossing", share=float(value)))

    def _worker(self, wanted: Wanted) -> WorkerProcess:
        """The process of a controller, built if there is none; the one longest unused makes room."""
        worker = self._workers.pop(wanted.policy, None)
        if worker is not None:
            self._workers[wanted.policy] = worker
            return worker
        if self._ahead_now is None:
            self._report(Report(wanted=wanted, text=_PREPARING))
        while len(self._workers) >= MAX_PROCESSES:
            self._dismiss(next(iter(self._workers)))
        with self._changed:
            if self._stopped:
                raise EvaluatorError("the viewer is stopping")
            worker = self._workers[wanted.policy] = WorkerProcess(1, self._build, (self._robot, wanted, self._drop))
        worker.receive()  # that it is ready
        return worker

    def _dismiss(self, policy: str) -> None:
        worker = self._workers.pop(policy, None)
        if worker is not None:
            worker.stop()
