"""Evaluation by Ray workers, each an actor with one device of a cluster, or of this machine."""

import socket
import sys
import tempfile
import time
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import ray
from ray.exceptions import RayError, RayTaskError

from qd.workers.compute import connect, num_devices, parse_workers, resources
from qd.workers.invalid import find_flaw
from qd.workers.pipeline import Build, Pipeline, PipelineCfg, WorkerStatus
from qd.workers.process import EvaluatorError
from sim.controllers.spec import ControllerSpec
from sim.files.command import debugging
from sim.files.provenance import code_fingerprint
from sim.robots.find import get_robot
from sim.robots.user import PackedRobot, pack_robot
from sim.rollout import RolloutResult
from sim.terrains.spaces.registry import is_user_space, split_name
from sim.terrains.terrains import Terrains

_ROOMS = ("kernels", "sim", "qd")
_POLL_S = 0.25
_GROW_EVERY_S = 2.0
_GATHER_S = 60.0
_PATIENCE_S = 600.0  # how long the evaluation waits while no worker is ready; building and compiling take minutes
_MOST_TRIES = 5  # of which three may be bad luck


@dataclass(frozen=True, kw_only=True)
class PackedCode:
    """A controller or a terrain space with the content of its files, which other machines need not have."""

    spec: ControllerSpec
    files: tuple[tuple[str, bytes], ...]
    """Name and content of each file; none of ``module:callable``."""

    @classmethod
    def of(cls, name: str) -> "PackedCode":
        """Reads the files that a controller's name holds."""
        spec = ControllerSpec.parse(name)
        return cls(spec=spec, files=tuple((file.name, file.read_bytes()) for file in spec.files if file.is_file()))

    def unpacked(self, folder: Path) -> str:
        """Writes the files into a new folder; returns the name that stands for them there."""
        folder.mkdir()
        for name, content in self.files:
            (folder / name).write_bytes(content)
        return str(self.spec.in_folder(folder) if self.files else self.spec)


_Packed = tuple[PackedCode, PackedRobot | str, PackedCode | None]  # controller, robot and space
_ray: Any = ray  # its annotations leave out what it documents


@_ray.remote
class RayWorker:
    """One device's simulation, which Ray gave to this process; controller, robot and space come with their files."""

    def prepare(self, num_terrains: int, code: str, cfg: PipelineCfg, packed: _Packed, build: Build) -> None:
        """Builds the simulation; refuses to if this machine has other code."""
        controller, robot, space = packed
        if code_fingerprint(_ROOMS) != code:
            raise ValueError(f"{socket.gethostname()} has other code or packages: use the same commit everywhere")
        # The process may be killed at any time, so the folder must not live as long as it does.
        with tempfile.TemporaryDirectory(prefix="faultline-") as name:
            folder = Path(name)
            if space is not None:
                code = space.unpacked(folder / "space")
                cfg = replace(cfg, space="+".join((code, *split_name(cfg.space)[1])))
            unpacked = robot if isinstance(robot, str) else robot.unpacked(folder / "robot")
            cfg = replace(cfg, policy=controller.unpacked(folder / "controller"), robot=unpacked)
            self._simulator = build(cfg, num_terrains)

    def cross(self, terrains: Terrains) -> RolloutResult:
        """Crosses terrains, at most as many as it was prepared for."""
        self._simulator.put(terrains)
        return self._simulator.take()


@dataclass(eq=False)
class _Shard:
    terrains: Terrains
    tries: int = 0
    result: RolloutResult | None = None


class RayWorkers(Pipeline):
    """Ray workers, one a device of the cluster or as many as asked for; others cross again what a failed one had.

    Ray places workers and notices when one dies; it cannot know that a result is untrue, or others free meanwhile.
    """

    def __init__(self, cfg: PipelineCfg, build: Build) -> None:
        super().__init__(cfg.num_terrains)
        self._cfg, gpus = cfg, int(cfg.compute.on_gpu)
        _, self._count = parse_workers(cfg.compute.workers)
        self._resources = {"num_gpus": gpus, "num_cpus": 1 - gpus}
        # Controller, robot and space travel once a machine, however many workers it has.
        space = PackedCode.of(split_name(cfg.space)[0]) if is_user_space(cfg.space) else None
        packed = ray.put((PackedCode.of(cfg.policy), pack_robot(get_robot(cfg.robot)), space))
        compute = replace(cfg.compute, device="cuda:0" if gpus else "cpu")
        self._arguments = code_fingerprint(_ROOMS), replace(cfg, compute=compute, robot=""), packed, build
        self._size = cfg.terrains_of_worker
        self._workers: set[Any] = set()
        self._idle: deque[Any] = deque()
        self._tasks: dict[Any, tuple[Any, _Shard | None]] = {}  # the worker of each, and what it crosses if prepared
        self._lots: deque[list[_Shard]] = deque()
        self._waiting: deque[_Shard] = deque()
        self._retries = self._failed_starts = 0
        self._grown_at, self._seen_at = -_GROW_EVERY_S, time.monotonic()  # when the cluster and a worker were looked at
        self._result_at = time.perf_counter()

    @classmethod
    @contextmanager
    def opened(cls, cfg: PipelineCfg, build: Build) -> Iterator["RayWorkers"]:
        """Starts the workers and ends them; once one is ready, it waits no longer than a minute for the others."""
        connect(parse_workers(cfg.compute.workers)[1])
        workers = cls(cfg, build)
        began = time.monotonic()
        try:
            while not workers._idle or (
                workers.status().workers < len(workers._workers) and time.monotonic() - began < _GATHER_S
            ):
                workers._turn()
            yield workers
        except RayError as error:
            raise EvaluatorError(f"the Ray cluster failed: {_find_reason(error)}") from error
        finally:
            for worker in workers._workers:
                with suppress(RayError):  # the whole cluster may be gone
                    ray.kill(worker)

    def status(self) -> WorkerStatus:
        """How the workers fare."""
        preparing = sum(shard is None for _, shard in self._tasks.values())
        return WorkerStatus(workers=len(self._workers) - preparing, retries=self._retries)

    def put(self, terrains: Terrains) -> None:
        """Deals a lot out in shards of as many terrains as a worker has room for."""
        # Shards are smaller once the cluster has grown; never larger, for which workers have no room.
        self._size = min(self._size, self._cfg.terrains_of_worker)
        lot = [_Shard(terrains[k : k + self._size]) for k in range(0, len(terrains), self._size)]
        if not self._lots:
            self._result_at = time.perf_counter()
        self._lots.append(lot)
        self._waiting.extend(lot)
        self._deal()

    def take(self, progress: Callable[[float], None] | None = None) -> RolloutResult:
        """Waits for the lot that was put in first."""
        lot = self._lots[0]
        self._seen_at = time.monotonic()
        while (done := sum(shard.result is not None for shard in lot)) < len(lot):
            self._turn()
            if progress is not None:
                progress(done / len(lot))
        if progress is not None:
            progress(1.0)
        self._lots.popleft()
        result = RolloutResult.join([shard.result for shard in lot if shard.result is not None], at_once=True)
        began, self._result_at = self._result_at, time.perf_counter()
        return replace(result, wall_s=self._result_at - began)

    def clear(self) -> None:
        """Drops all pending lots; what workers still cross of them counts for no later one."""
        self._lots.clear()
        self._waiting.clear()

    def _turn(self) -> None:
        """Waits for some task to end, but not for long, and gives idle workers the next; starts workers that lack."""
        if time.monotonic() - self._grown_at >= _GROW_EVERY_S:
            self._grown_at = time.monotonic()
            for _ in range((self._count or max(1, num_devices(self._cfg.compute.device))) - len(self._workers)):
                worker = RayWorker.options(**self._resources).remote()
                self._workers.add(worker)
                self._tasks[worker.prepare.remote(self._size, *self._arguments)] = worker, None
        if not self._tasks:
            time.sleep(_POLL_S)
        for task in ray.wait([*self._tasks], timeout=_POLL_S)[0] if self._tasks else []:
            self._finish(task, *self._tasks.pop(task))
        if self.status().workers:
            self._seen_at = time.monotonic()
        elif time.monotonic() - self._seen_at > _PATIENCE_S:
            raise EvaluatorError(f"no worker came within {_PATIENCE_S:g} s; the cluster has {resources()}")
        self._deal()

    def _deal(self) -> None:
        while self._waiting and self._idle:
            worker = self._idle.popleft()
            shard = self._waiting.popleft()
            self._tasks[worker.cross.remote(shard.terrains)] = worker, shard

    def _finish(self, task: Any, worker: Any, shard: _Shard | None) -> None:
        """Takes a task's result; replaces the worker if it failed."""
        refused = False
        try:
            result: Any = ray.get(task)
            flaw = shard and find_flaw(result, len(shard.terrains), self._cfg.replicas)
        except RayError as error:
            result = None
            flaw = _find_reason(error)
            refused = isinstance(error, RayTaskError) and isinstance(error.cause, ValueError)  # the user can mend it
        if flaw is None:
            self._idle.append(worker)
            if shard is not None:
                # What Ray delivers cannot be written to, and holds its memory.
                shard.result = replace(result, **{name: values.copy() for name, values in result.arrays.items()})
            return
        with suppress(RayError):
            ray.kill(worker)
        self._workers.remove(worker)
        self._grown_at = -_GROW_EVERY_S  # another is started at once
        if shard is None:
            self._failed_starts += 1
            if refused or self._failed_starts >= _MOST_TRIES:
                kind = ValueError if refused else EvaluatorError
                raise kind(f"a worker cannot build its simulation: {flaw}")
            return
        if not any(shard in lot for lot in self._lots):  # forgotten meanwhile
            return
        if refused:  # as any other worker would
            raise ValueError(flaw)
        shard.tries += 1
        self._retries += 1
        what = f"{len(shard.terrains)} terrains"
        if shard.tries >= _MOST_TRIES:
            raise EvaluatorError(f"{what} failed {_MOST_TRIES} times; the last time: {flaw}")
        print(f"a worker failed ({flaw}); its {what} are crossed again by another", file=sys.stderr)
        self._waiting.appendleft(shard)


def _find_reason(error: BaseException) -> str:
    """Why a worker failed, in one line: the exception that it raised, or how it died; its traceback for debugging."""
    if isinstance(error, RayTaskError):
        text = f"{type(error.cause).__name__}: {' '.join(str(error.cause).split())}"
        return f"{text}\n{error}" if debugging() else text  # Ray keeps the worker's traceback in the error's text
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)
