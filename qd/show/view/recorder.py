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
"""Controllers whose simulation is kept ready, one process each."""
_PREPARING = "building the simulation (the very first one compiles its kernels: up to some minutes)"


@dataclass(frozen=True, kw_only=True)
class Report:
    """How the recording of some crossings goes on."""

    wanted: Wanted
    text: str
    """In words, without who and what."""
    share: float = 0.0
    """Done so far."""
    recording: Recording | None = None
    """The result, once there is one."""
    failed: bool = False
    """Whether there will be none."""


class _DroppedError(Exception):
    """What is under way is wanted no more."""


class _Recording:
    """What a recording process has: the simulation of a controller, ready to cross."""

    def __init__(self, robot: RobotCfg, first: Wanted, drop: Event) -> None:
        self._simulation, self._first, self._drop = Simulation(robot, "cpu"), first, drop
        self._simulation.prepare(first)
        self._wanted: deque[Wanted] = deque()

    def put(self, terrains: NDArray, seeds: NDArray) -> None:
        """Keeps one terrain, to be crossed as the first one was."""
        self._wanted.append(replace(self._first, terrain=terrains[0], terrain_seed=int(seeds[0])))

    def take(self, progress: Callable[[float], None]) -> Recording | None:
        """The recording of the terrain that was put in first, crossed now; None if it is dropped meanwhile."""

        def tell(share: float) -> None:
            progress(share)
            if self._drop.is_set():
                raise _DroppedError

        try:
            return self._simulation([self._wanted.popleft()], tell)[0]
        except _DroppedError:
            return None


Cfg = tuple[RobotCfg, Wanted, Event]
"""Of a recording process: the robot, what it crosses at first, and what is set when its work is wanted no more."""


def build_recording(cfg: Cfg, num_terrains: int) -> Any:
    """What a recording process works with, called in it."""
    return _Recording(*cfg)


Build = Callable[[Cfg, int], Any]


class Recorder:
    """Records the crossings that each tab asked for last; what it asked for before and is not begun is dropped.

    While nobody waits it records ahead what a tab may ask for next, and drops that when somebody asks for another one.
    """

    def __init__(self, robot: RobotCfg, report: Callable[[Report], None], *, build: Build = build_recording) -> None:
        """Start to wait for work.

        Args:
            robot: Robot settings.
            report: Called in another thread, with every step forward.
            build: Makes the simulation; a module-level function, since processes import it by name.
        """
        self._robot, self._report, self._build = robot, report, build
        self._workers: dict[str, WorkerProcess] = {}  # by controller, the one used last at the end
        self._wishes: dict[Hashable, Wanted] = {}  # by tab, the oldest first
        self._ahead: dict[Hashable, list[Wanted]] = {}  # by tab, the likeliest first
        self._warm: Wanted | None = None
        self._at: Wanted | None = None  # what is recorded now
        self._ahead_now = False  # whether nobody waits for it
        self._drop = get_context("spawn").Event()
        self._stopped = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def record(self, wanted: Wanted | None, *, tab: Hashable = 0) -> None:
        """Record these crossings for a tab when its turn comes; with None, nothing more for it after those at hand."""
        with self._changed:
            self._wishes.pop(tab, None)
            if wanted is not None:
                self._wishes[tab] = wanted
                if self._ahead_now and wanted == self._at:
                    self._ahead_now = False  # now somebody waits for it
                elif self._ahead_now:
                    self._drop.set()
            self._changed.notify()

    def record_ahead(self, wanted: Sequence[Wanted], *, tab: Hashable = 0) -> None:
        """Record these while nobody waits for others, the first ones first; of a tab the last ones asked for count."""
        with self._changed:
            self._ahead.pop(tab, None)
            if wanted:
                self._ahead[tab] = list(wanted)
            self._changed.notify()

    def warm(self, wanted: Wanted) -> None:
        """Have the process ready that records such crossings, before anybody asks."""
        with self._changed:
            self._warm = wanted
            self._changed.notify()

    def stop(self) -> None:
        """End all processes and the thread, whatever they do."""
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
                report = self._recorded(wanted)
                with self._changed:  # others may have asked for the same meanwhile
                    self._at, self._ahead_now = None, False
                    self._drop.clear()
                    if report is not None:
                        self._wishes = {tab: wish for tab, wish in self._wishes.items() if wish != wanted}
                if report is not None:
                    self._report(report)
            except (ValueError, EvaluatorError, OSError) as error:
                if self._stopped:
                    return
                with self._changed:
                    told = not (only_warm or self._ahead_now)
                    self._at, self._ahead_now = None, False
                self._dismiss(wanted.policy)
                if told:
                    self._report(Report(wanted=wanted, text=str(error), failed=True))

    def _next(self) -> tuple[Wanted, bool]:
        """What to do next, and whether it is only to have its process ready."""
        self._ahead_now = False
        if self._wishes:
            self._at = self._wishes.pop(next(iter(self._wishes)))
        elif self._warm is not None:
            warm, self._warm = self._warm, None
            return warm, True
        else:
            tab = next(iter(self._ahead))
            self._at, self._ahead_now = self._ahead[tab].pop(0), True
            if not self._ahead[tab]:
                del self._ahead[tab]
        return self._at, False

    def _recorded(self, wanted: Wanted) -> Report | None:
        """What became of it; None if it was recorded ahead and is dropped."""
        worker = self._worker(wanted)
        worker.send(wanted.terrain[None], np.array([wanted.terrain_seed], np.uint32))
        while True:
            message, value = worker.receive()
            if message == "result":
                return None if value is None else Report(wanted=wanted, text="recorded", share=1.0, recording=value)
            if not self._ahead_now:
                self._report(Report(wanted=wanted, text="crossing", share=float(value)))

    def _worker(self, wanted: Wanted) -> WorkerProcess:
        """The process of a controller, built if there is none; the one longest unused makes room."""
        worker = self._workers.pop(wanted.policy, None)
        if worker is None:
            if not self._ahead_now:
                self._report(Report(wanted=wanted, text=_PREPARING))
            while len(self._workers) >= MAX_PROCESSES:
                self._dismiss(next(iter(self._workers)))
            with self._changed:
                if self._stopped:
                    raise EvaluatorError("the viewer is stopping")
                worker = self._workers[wanted.policy] = WorkerProcess(1, self._build, (self._robot, wanted, self._drop))
            worker.receive()  # that it is ready
        else:
            self._workers[wanted.policy] = worker
        return worker

    def _dismiss(self, policy: str) -> None:
        worker = self._workers.pop(policy, None)
        if worker is not None:
            worker.stop()
