"""Evaluation by Ray workers, each an actor with one device.

Workers are handed whole terrains. An episode depends on its terrain, seed and replica alone, so any worker may cross
any terrains, and again after another worker failed at them. Ray restarts a worker that died, where the cluster has
place; what is done here is what Ray cannot know: that a result cannot be true, and that another worker is free.
"""

import os
import socket
import sys
import tempfile
import time
import uuid
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import ray
from numpy.typing import NDArray
from ray.exceptions import RayActorError, RayError, RayTaskError
from tqdm import tqdm

from qd.workers.evaluator import WorkerStatus, parse_workers
from qd.workers.process import Crosser, EvaluatorError
from qd.workers.ray_cluster import connect, num_devices, resources
from qd.workers.shards import MIN_ROWS, checked_count, flaw_of, merged, taken
from sim.files.command import debugging
from sim.files.records import code_fingerprint
from sim.policy.spec import ControllerSpec

if TYPE_CHECKING:
    from qd.workers.evaluator import EvaluatorCfg
    from sim.rollout import RolloutResult

_ROOMS = ("kernels", "sim", "qd")
_WATCH = "watch"
_POLL_S = 0.25
_GROW_EVERY_S = 2.0
_GATHER_S = 60.0  # how long the others are waited for where one worker is there
_PATIENCE_S = 300.0  # how long the evaluation waits when no worker is there
_HANG_S = 1800.0  # a busy worker without progress for so long is restarted; building and compiling take minutes
_MOST_TRIES = 5  # of which three may be bad luck


@dataclass(frozen=True, kw_only=True)
class Controller:
    """A controller, or other code, with the content of its files, which other machines need not have."""

    spec: ControllerSpec
    files: tuple[tuple[str, bytes], ...]
    """Name and content of each file; none of ``module:callable``."""

    @classmethod
    def of(cls, policy: str) -> "Controller":
        """Reads the files that ``policy`` names."""
        spec = ControllerSpec.parse(policy)
        return cls(spec=spec, files=tuple((file.name, file.read_bytes()) for file in spec.files if file.is_file()))

    def unpacked(self, folder: str) -> str:
        """Writes the files into ``folder``; returns a policy as :func:`sim.policy.loaders.load_policy` takes it."""
        for name, content in self.files:
            (Path(folder) / name).write_bytes(content)
        return str(self.spec.in_folder(Path(folder)) if self.files else self.spec)


def _packed_robot(robot: Any) -> Any:
    if isinstance(robot, str):
        return robot
    from sim.robots.own import pack_robot  # with the physics, which only workers need otherwise

    return pack_robot(robot)


def _packed_space(space: str) -> Controller | str:
    from sim.ground import split_name
    from sim.spaces.registry import is_own

    return Controller.of(split_name(space)[0]) if is_own(space) else space


_ray: Any = ray  # its annotations leave out what it documents


@_ray.remote(concurrency_groups={_WATCH: 1}, max_restarts=-1)
class RayWorker:
    """One device's simulation, built when first needed, and again when the number of terrains changes.

    Args:
        cfg: Settings of the evaluator; the device is the one that Ray gave to this process.
        controller: Its controller.
        robot: Its robot, as :func:`sim.robots.own.pack_robot` packs it.
        space: Its terrain space: a name, or code with its file.
        build: Makes the simulation of ``cfg`` for a number of terrains.
    """

    def __init__(
        self,
        cfg: Any,
        controller: Controller,
        robot: Any,
        space: Controller | str,
        build: Callable[[Any, int], Crosser],
    ) -> None:
        self._cfg, self._controller, self._robot, self._space, self._build = cfg, controller, robot, space, build
        self._crosser: Crosser | None = None
        self._num_terrains = 0
        self._share = 0.0
        self._life = uuid.uuid4().hex

    def introduce(self) -> tuple[str, str, str]:
        """Where this process is, a name of this life between restarts, and the fingerprint of the code."""
        return f"process {os.getpid()} on {socket.gethostname()}", self._life, code_fingerprint(_ROOMS)

    def prepare(self, num_terrains: int) -> None:
        """Builds the simulation.

        Raises:
            ValueError: If it cannot be built as asked for.
        """
        if num_terrains == self._num_terrains:
            return
        self._crosser, self._num_terrains = None, 0  # frees its memory before the next one is built
        # The process may be killed at any time, so the folder must not live as long as it does.
        with tempfile.TemporaryDirectory(prefix="faultline-") as folder:
            robot = self._robot if isinstance(self._robot, str) else self._robot.unpacked(Path(folder) / "robot")
            space = self._space if isinstance(self._space, str) else self._unpacked(self._space, folder)
            cfg = replace(self._cfg, policy=self._controller.unpacked(folder), robot=robot, space=space)
            self._crosser = self._build(cfg, num_terrains)
        self._num_terrains = num_terrains

    def _unpacked(self, space: Controller, folder: str) -> str:
        from sim.ground import joined_name, split_name

        return joined_name(space.unpacked(tempfile.mkdtemp(dir=folder)), split_name(self._cfg.space)[1])

    def cross(self, terrains: NDArray, seeds: NDArray, num_terrains: int) -> tuple["RolloutResult", float]:
        """Crosses up to ``num_terrains`` terrains.

        Returns:
            The result, and the seconds it took without building.
        """
        self.prepare(num_terrains)
        assert self._crosser is not None
        began = time.perf_counter()
        try:
            result = self._crosser.evaluate(terrains, seeds, progress=self._note)
            return result, time.perf_counter() - began
        finally:
            self._share = 0.0

    @_ray.method(concurrency_group=_WATCH)
    def share(self) -> float:
        """Share of the present terrains that is done."""
        return self._share

    def _note(self, share: float) -> None:
        self._share = share


@dataclass
class _Shard:
    """Terrains that one worker crosses."""

    part: slice
    tries: int = 0
    result: Any = None

    def __str__(self) -> str:
        return f"terrains {self.part.start} to {self.part.stop - 1}"


@dataclass
class _Worker:
    """A worker as seen from here: coming, idle, or busy with a task."""

    number: int
    actor: Any
    coming: Any = None
    """The introduction to come of a worker that starts; None once it is there."""
    where: str = "starting"
    life: str = ""
    task: Any = None
    """The result to come of the shard that it crosses; None without one."""
    shard: _Shard | None = None
    share: float = 0.0
    """Share of the shard that is done."""
    moved_at: float = 0.0
    """When the share last changed, by the monotonic clock [s]."""
    question: Any = None
    """The share to come that it was asked for."""
    episodes_per_s: float = 0.0
    """In its last shard; 0 before."""

    def __str__(self) -> str:
        return f"worker {self.number} ({self.where})"

    def wait_for(self) -> None:
        """Takes its task away; the worker is there again when it introduces itself, in whichever process."""
        self.task = self.shard = self.question = None
        self.share = 0.0
        self.coming = self.actor.introduce.options(max_task_retries=-1).remote()

    def restart(self) -> None:
        """Ends its process, whatever that does; Ray starts another."""
        with suppress(RayError):
            ray.kill(self.actor, no_restart=False)
        self.wait_for()


class RayWorkers:
    """Evaluates any number of terrains (:class:`qd.workers.evaluator.Evaluate`) on Ray workers.

    Args:
        cfg: What is crossed, with what; ``num_terrains`` at once over all workers.
        build: Makes a worker's simulation.
    """

    def __init__(self, cfg: "EvaluatorCfg", build: Callable[[Any, int], Crosser]) -> None:
        gpus = int(cfg.device.startswith("cuda"))
        self._cfg, self._count = cfg, parse_workers(cfg.workers).count
        self._options = {"num_gpus": gpus, "num_cpus": 1 - gpus}
        # Controller, robot and space travel once a machine, however many workers it has.
        packed = Controller.of(cfg.policy), _packed_robot(cfg.robot), _packed_space(cfg.space)
        files = tuple(map(ray.put, packed))
        self._arguments = replace(cfg, device="cuda:0" if gpus else "cpu", robot=""), *files, build
        self._code = code_fingerprint(_ROOMS)
        self._workers: list[_Worker] = []
        self._started = self._retries = 0
        self._grown_at = -np.inf

    def open(self) -> None:
        """Starts the workers, and lets the first one compile the kernels, which the others then find compiled.

        Raises:
            ValueError: If the simulation cannot be built as asked for.
            EvaluatorError: If no worker comes, or none that can be used.
        """
        began = time.monotonic()
        while len(self._ready) < max(1, len(self._workers)):
            self._start_missing()
            self._wait()
            if time.monotonic() - began > (_GATHER_S if self._ready else _PATIENCE_S):
                break
        if not self._ready:
            raise self._nobody_came()
        first = self._ready[0]
        try:
            ray.get(first.actor.prepare.options(max_task_retries=_MOST_TRIES - 1).remote(self._shard_size()))
        except RayError as error:
            raise _as_raised(error, f"{first} cannot build its simulation: {reason_of(error)}") from None

    def close(self) -> None:
        """Ends the workers, whatever they do."""
        for worker in self._workers:
            with suppress(RayError):  # the whole cluster may be gone
                ray.kill(worker.actor)

    def status(self) -> WorkerStatus:
        """How the workers fare."""
        rates = tuple(worker.episodes_per_s for worker in self._ready if worker.episodes_per_s)
        return WorkerStatus(workers=len(self._ready), episodes_per_s=rates, retries=self._retries)

    def __call__(
        self, terrains: NDArray, seeds: NDArray, progress: Callable[[float], None] | None = None
    ) -> "RolloutResult":
        """Crosses each terrain once a replica.

        Raises:
            ValueError: If the arguments do not fit, or a shard is refused five times.
            EvaluatorError: If a shard fails five times, or no worker is left and none comes.
        """
        count, size, began = checked_count(terrains, seeds), self._shard_size(), time.monotonic()
        shards = [_Shard(slice(first, min(first + size, count))) for first in range(0, count, size)]
        try:
            self._cross_all(shards, size, terrains, seeds, progress or (lambda share: None))
        except BaseException:  # Ctrl-C too: what is under way belongs to no later call
            for worker in self._busy:
                worker.restart()
            raise
        whole = merged([shard.result for shard in shards], join=0)
        return replace(whole, wall_s=time.monotonic() - began)

    def _cross_all(
        self, shards: list[_Shard], size: int, terrains: NDArray, seeds: NDArray, progress: Callable[[float], None]
    ) -> None:
        waiting, shown, busy_at = deque(shards), 0.0, time.monotonic()
        while any(shard.result is None for shard in shards):
            self._start_missing()
            for worker in self._ready:
                if waiting and worker.task is None:
                    shard = worker.shard = waiting.popleft()
                    worker.share, worker.moved_at, worker.question = 0.0, time.monotonic(), None
                    worker.task = worker.actor.cross.remote(terrains[shard.part], seeds[shard.part], size)
            if self._busy:
                busy_at = time.monotonic()
            elif time.monotonic() - busy_at > _PATIENCE_S:
                raise self._nobody_came()
            self._wait()
            waiting.extendleft(shard for worker in self._busy if (shard := self._failed_shard(worker)))
            done = sum(shard.result is not None for shard in shards) + sum(map(_share_of, self._ready))
            shown = max(shown, min(1.0, done / len(shards)))
            progress(shown)

    @property
    def _wanted(self) -> int:
        """Workers wanted: as many as asked for, or as the cluster has devices now."""
        return self._count or max(1, num_devices(self._cfg.device))

    @property
    def _ready(self) -> list[_Worker]:
        return [worker for worker in self._workers if worker.coming is None]

    @property
    def _busy(self) -> list[_Worker]:
        return [worker for worker in self._ready if worker.task is not None]

    def _shard_size(self) -> int:
        """Terrains of a shard: an equal part of those that are crossed at once."""
        return max(-(-self._cfg.num_terrains // self._wanted), -(-MIN_ROWS // self._cfg.num_replicas))

    def _start_missing(self) -> None:
        """Starts workers for the devices that have none; one whose worker could not be used gets no other."""
        if time.monotonic() - self._grown_at < _GROW_EVERY_S:
            return
        self._grown_at = time.monotonic()
        for _ in range(self._wanted - self._started):
            self._started += 1
            actor: Any = RayWorker
            worker = _Worker(number=self._started, actor=actor.options(**self._options).remote(*self._arguments))
            worker.wait_for()
            self._workers.append(worker)

    def _wait(self) -> None:
        """Waits until a task is done or a worker is there, but not for long."""
        references = {worker.task if worker.coming is None else worker.coming: worker for worker in self._workers}
        references.pop(None, None)
        if not references:
            time.sleep(_POLL_S)
            return
        for reference in ray.wait([*references], timeout=_POLL_S)[0]:
            if references[reference].coming is not None:
                self._welcome(references[reference])

    def _welcome(self, worker: _Worker) -> None:
        try:
            where, life, code = ray.get(worker.coming)
        except RayError as error:
            self._dismiss(worker, f"did not start: {reason_of(error)}")
            return
        if life == worker.life:  # still the process that is being ended
            worker.wait_for()
            return
        worker.coming, worker.where, worker.life = None, where, life
        if code != self._code:
            self._dismiss(
                worker, "has other code or packages than this machine: use the same commit and `make setup` everywhere"
            )

    def _dismiss(self, worker: _Worker, reason: str) -> None:
        """Goes on without a worker that cannot be used.

        Raises:
            EvaluatorError: If it was the last.
        """
        self._workers.remove(worker)
        with suppress(RayError):
            ray.kill(worker.actor)
        if not self._workers:
            raise EvaluatorError(f"no worker can be used: {worker} {reason}")
        _tell(f"{worker} {reason}; the others go on without it")

    def _failed_shard(self, worker: _Worker) -> _Shard | None:
        """Takes a worker's result if it is there; returns the shard if it failed or hangs and must be crossed again.

        Raises:
            ValueError: If the shard was refused five times.
            EvaluatorError: If it failed five times.
        """
        shard, replicas, error = worker.shard, self._cfg.num_replicas, None
        assert shard is not None
        there = bool(ray.wait([worker.task], timeout=0)[0])
        if not there and time.monotonic() - worker.moved_at < _HANG_S:
            return None
        trouble = f"made no progress for {_HANG_S:g} s"
        try:
            if there:
                result, seconds = ray.get(worker.task)
                count = shard.part.stop - shard.part.start
                flaw = flaw_of(result, count, replicas)
                if flaw is None:
                    shard.result = taken(result, count)
                    worker.task, worker.share = None, 0.0
                    worker.episodes_per_s = count * replicas / seconds
                    return None
                trouble = f"answered with nonsense: {flaw}"
        except RayError as raised:
            error, trouble = raised, f"failed: {reason_of(raised)}"
        who = str(worker)
        if isinstance(error, RayActorError):
            worker.wait_for()  # Ray is restarting it
        else:
            worker.restart()
        self._retries += 1
        shard.tries += 1
        if shard.tries >= _MOST_TRIES:
            raise _as_raised(error, f"{shard} failed {_MOST_TRIES} times; the last time {who} {trouble}")
        _tell(f"{who} {trouble}; {shard} are crossed again by another")
        return shard

    def _nobody_came(self) -> EvaluatorError:
        return EvaluatorError(f"no worker came within {_PATIENCE_S:g} s; the cluster has {resources()}")


def _share_of(worker: _Worker) -> float:
    """Share of its shard that a worker has done when it last said so; asks it again without waiting.

    The question also shows that an idle worker died; the task of a busy one fails, and says why.
    """
    if worker.question is None:
        worker.question = worker.actor.share.remote()
    elif ray.wait([worker.question], timeout=0)[0]:
        question, worker.question = worker.question, None
        try:
            share: Any = ray.get(question)
            if share != worker.share:
                worker.share, worker.moved_at = share, time.monotonic()
        except RayError:
            if worker.task is None:
                worker.wait_for()
    return worker.share


def _as_raised(error: BaseException | None, message: str) -> Exception:
    """A ValueError if a worker raised one, since the user can mend it; else the evaluation's own error."""
    refused = isinstance(error, RayTaskError) and isinstance(error.cause, ValueError)
    return ValueError(message) if refused else EvaluatorError(message)


def reason_of(error: BaseException) -> str:
    """Why a worker failed, in one line: the exception that it raised, or how it died; its traceback for debugging."""
    if isinstance(error, RayTaskError):
        text = f"{type(error.cause).__name__}: {' '.join(str(error.cause).split())}"
        return f"{text}\n{error}" if debugging() else text  # Ray keeps the worker's traceback in the error's text
    lines = [line.strip() for line in str(error).splitlines() if line.strip()]
    return lines[0] if lines else type(error).__name__


def _tell(message: str) -> None:
    """Prints a line that leaves progress bars whole."""
    tqdm.write(message, file=sys.stderr)


@contextmanager
def open_ray_workers(cfg: "EvaluatorCfg", build: Callable[[Any, int], Crosser]) -> Iterator[RayWorkers]:
    """Starts the workers and ends them; arguments and errors as of :func:`qd.workers.evaluator.open_evaluator`."""
    connect(parse_workers(cfg.workers).count)
    workers = RayWorkers(cfg, build)
    try:
        workers.open()
        yield workers
    except RayError as error:
        raise EvaluatorError(f"the Ray cluster failed: {reason_of(error)}") from error
    finally:
        workers.close()
