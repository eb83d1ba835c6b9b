"""Records crossings on the CPU in a process of their own, while the page goes on answering."""

import threading
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qd.workers.process import EvaluatorError, WorkerProcess

if TYPE_CHECKING:  # they import torch, which a process takes with its simulation
    from qd.show.recordings import Wanted
    from sim.recording.recorder import Recording
    from sim.robots.robot import RobotCfg

MAX_PROCESSES = 3
"""Controllers whose simulation is kept ready, one process each."""
_PREPARING = "building the simulation (the very first one compiles its kernels: up to some minutes)"


@dataclass(frozen=True, kw_only=True)
class Report:
    """How the recording of some crossings goes on."""

    wanted: "Wanted"
    text: str
    """In words, without who and what."""
    share: float = 0.0
    """Done so far."""
    recording: "Recording | None" = None
    """The result, once there is one."""
    failed: bool = False
    """Whether there will be none."""


@dataclass(frozen=True, kw_only=True)
class RecorderCfg:
    """What a recording process builds."""

    robot: "RobotCfg"
    """Robot settings."""
    policy: str
    """The controller."""
    replicas: int
    """Episodes at once."""
    space: str = "super_gaussian"
    """Terrain space of genes."""


class _Recording:
    """A simulation of one terrain that records all its episodes."""

    def __init__(self, cfg: RecorderCfg) -> None:
        from sim.rollout import Rollout
        from sim.space import get_space

        self._policy, space = cfg.policy, get_space(cfg.space)
        self._rollout = Rollout(
            cfg.robot, cfg.policy, num_terrains=1, num_replicas=cfg.replicas, device="cpu", space=space
        )

    def evaluate(self, terrains: NDArray, seeds: NDArray, *, progress: Callable[[float], None] | None = None) -> Any:
        """The recording of the crossings of one terrain."""
        from sim.recording.recorder import record

        return record(self._rollout, terrains, seeds, policy=self._policy, progress=progress)[1]


def build_recording(cfg: RecorderCfg, num_terrains: int) -> Any:
    """The simulation of a recording process, called in it."""
    return _Recording(cfg)


Build = Callable[[RecorderCfg, int], Any]


class Recorder:
    """Records the crossings asked for last; what was asked for before and is not begun is dropped."""

    def __init__(self, robot: "RobotCfg", report: Callable[[Report], None], *, build: Build = build_recording) -> None:
        """Start to wait for work.

        Args:
            robot: Robot settings.
            report: Called in another thread, with every step forward.
            build: Makes the simulation; a module-level function, since processes import it by name.
        """
        self._robot, self._report, self._build = robot, report, build
        self._workers: dict[RecorderCfg, WorkerProcess] = {}
        self._wish: Wanted | None = None
        self._stopped = False
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._run, name="recorder", daemon=True)
        self._thread.start()

    def record(self, wanted: "Wanted | None") -> None:
        """Record these crossings next; with None, nothing more after those at hand."""
        with self._changed:
            self._wish = wanted
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
                self._changed.wait_for(lambda: self._stopped or self._wish is not None)
                if self._stopped or self._wish is None:
                    return
                wanted, self._wish = self._wish, None
            cfg = RecorderCfg(robot=self._robot, policy=wanted.policy, replicas=wanted.replicas, space=wanted.space)
            try:
                self._report(self._recorded(wanted, cfg))
            except (ValueError, EvaluatorError, OSError) as error:
                if self._stopped:
                    return
                self._dismiss(cfg)
                self._report(Report(wanted=wanted, text=str(error), failed=True))

    def _recorded(self, wanted: "Wanted", cfg: RecorderCfg) -> Report:
        worker = self._worker(wanted, cfg)
        worker.send(wanted.terrain[None], np.array([wanted.terrain_seed], np.uint32))
        while True:
            message, value = worker.receive()
            if message == "result":
                return Report(wanted=wanted, text="recorded", share=1.0, recording=value)
            self._report(Report(wanted=wanted, text="crossing", share=float(value)))

    def _worker(self, wanted: "Wanted", cfg: RecorderCfg) -> WorkerProcess:
        """The process of a controller, built if there is none; the one longest unused makes room."""
        worker = self._workers.pop(cfg, None)
        if worker is None:
            self._report(Report(wanted=wanted, text=_PREPARING))
            while len(self._workers) >= MAX_PROCESSES:
                self._dismiss(next(iter(self._workers)))
            with self._changed:
                if self._stopped:
                    raise EvaluatorError("the viewer is stopping")
                worker = self._workers[cfg] = WorkerProcess(1, self._build, cfg)
            worker.receive()  # that it is ready
        else:
            self._workers[cfg] = worker  # used last
        return worker

    def _dismiss(self, cfg: RecorderCfg) -> None:
        worker = self._workers.pop(cfg, None)
        if worker is not None:
            worker.stop()
