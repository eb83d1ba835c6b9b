"""Evaluation by Ray workers, each an actor with one device of a cluster, or of this machine.

Ray places the workers and notices when one dies. What is done here is what Ray cannot know: that a result cannot be
true, and that other workers are free while one is gone.
"""

import logging
import os
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
from numpy.typing import NDArray
from ray.exceptions import RayError, RayTaskError

from qd.workers.evaluator import Build, EvaluatorCfg, Pipeline, WorkerStatus, available_cores, parse_workers
from qd.workers.process import EvaluatorError
from qd.workers.shards import copied, flaw_of, join_results
from sim.controllers.spec import ControllerSpec
from sim.files.command import debugging
from sim.files.provenance import code_fingerprint
from sim.robots.find import get_robot
from sim.robots.user import PackedRobot, pack_robot
from sim.rollout import RolloutResult
from sim.terrains.ground import joined_name, split_name
from sim.terrains.spaces.registry import is_own

_ROOMS = ("kernels", "sim", "qd")
_CONNECT_LIMIT_S = 10.0
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


_ray: Any = ray  # its annotations leave out what it documents


@_ray.remote
class RayWorker:
    """One device's simulation, which Ray gave to this process; controller, robot and space come with their files."""

    def __init__(
        self,
        cfg: EvaluatorCfg,
        controller: PackedCode,
        robot: PackedRobot | str,
        space: PackedCode | None,
        build: Build,
    ) -> None:
        self._cfg, self._controller, self._robot, self._space, self._build = cfg, controller, robot, space, build

    def prepare(self, num_terrains: int, code: str) -> None:
        """Builds the simulation; refuses to if this machine has other code."""
        if code_fingerprint(_ROOMS) != code:
            raise ValueError(f"{socket.gethostname()} has other code or packages: use the same commit everywhere")
        # The process may be killed at any time, so the folder must not live as long as it does.
        with tempfile.TemporaryDirectory(prefix="faultline-") as name:
            folder, cfg = Path(name), self._cfg
            robot = self._robot if isinstance(self._robot, str) else self._robot.unpacked(folder / "robot")
            if self._space is not None:
                code = self._space.unpacked(folder / "space")
                cfg = replace(cfg, space=joined_name(code, split_name(cfg.space)[1]))
            cfg = replace(cfg, policy=self._controller.unpacked(folder / "controller"), robot=robot)
            self._crosser = self._build(cfg, num_terrains)

    def cross(self, terrains: NDArray, seeds: NDArray) -> RolloutResult:
        """Crosses terrains, at most as many as it was prepared for."""
        self._crosser.put(terrains, seeds)
        return self._crosser.take()


@dataclass(eq=False)
class _Shard:
    terrains: NDArray
    seeds: NDArray
    tries: int = 0
    result: RolloutResult | None = None


class RayWorkers(Pipeline):
    """Evaluates terrains on Ray workers, one for each device that the cluster has or as many as asked for.

    A worker that fails in any way is replaced, and its terrains are crossed again by another.
    """

    def __init__(self, cfg: EvaluatorCfg, build: Build) -> None:
        super().__init__(cfg.num_terrains)
        gpus = int(cfg.device.startswith("cuda"))
        self._cfg, self._count = cfg, parse_workers(cfg.workers).count
        self._resources = {"num_gpus": gpus, "num_cpus": 1 - gpus}
        # Controller, robot and space travel once a machine, however many workers it has.
        space = PackedCode.of(split_name(cfg.space)[0]) if is_own(cfg.space) else None
        packed = [ray.put(value) for value in (PackedCode.of(cfg.policy), pack_robot(get_robot(cfg.robot)), space)]
        self._arguments = replace(cfg, device="cuda:0" if gpus else "cpu", robot=""), *packed, build
        self._code, self._size = code_fingerprint(_ROOMS), cfg.terrains_of_worker
        self._workers: set[Any] = set()
        self._idle: deque[Any] = deque()
        self._tasks: dict[Any, tuple[Any, _Shard | None]] = {}  # the worker of each, and what it crosses if prepared
        self._lots: deque[list[_Shard]] = deque()
        self._waiting: deque[_Shard] = deque()
        self._retries = self._failed_starts = 0
        self._grown_at, self._seen_at = -_GROW_EVERY_S, time.monotonic()  # when the cluster and a worker were looked at
        self._result_at = time.perf_counter()

    def open(self) -> None:
        """Starts the workers and waits for them; once one is ready, no longer than a minute for the others."""
        began = time.monotonic()
        while not self._idle or (self.status().workers < len(self._workers) and time.monotonic() - began < _GATHER_S):
            self._turn()

    def close(self) -> None:
        """Ends the workers, whatever they do."""
        for worker in self._workers:
            with suppress(RayError):  # the whole cluster may be gone
                ray.kill(worker)

    def status(self) -> WorkerStatus:
        """How the workers fare."""
        preparing = sum(shard is None for _, shard in self._tasks.values())
        return WorkerStatus(workers=len(self._workers) - preparing, retries=self._retries)

    def put(self, terrains: NDArray, seeds: NDArray) -> None:
        """Deals a lot out in shards of as many terrains as a worker has room for."""
        size = self._shard_size()
        lot = [_Shard(terrains[k : k + size], seeds[k : k + size]) for k in range(0, len(terrains), size)]
        if not self._lots:
            self._result_at = time.perf_counter()
        self._lots.append(lot)
        self._waiting.extend(lot)
        self._deal()

    def take(self, progress: Callable[[float], None] | None = None) -> RolloutResult:
        """Waits for the lot that was put in first."""
        lot, self._seen_at = self._lots[0], time.monotonic()
        while (done := sum(shard.result is not None for shard in lot)) < len(lot):
            self._turn()
            if progress is not None:
                progress(done / len(lot))
        if progress is not None:
            progress(1.0)
        self._lots.popleft()
        now = time.perf_counter()
        wall_s, self._result_at = now - self._result_at, now
        return replace(join_results([shard.result for shard in lot if shard.result is not None], join=0), wall_s=wall_s)

    def _shard_size(self) -> int:
        """Terrains of a shard: fewer once the cluster has grown; never more, for which workers have no room."""
        self._size = min(self._size, self._cfg.terrains_of_worker)
        return self._size

    def clear(self) -> None:
        """Forgets all lots; what workers still cross of them is of no later one."""
        self._lots.clear()
        self._waiting.clear()

    def _turn(self) -> None:
        """Waits for some task to end, but not for long, and gives idle workers the next."""
        self._start_missing()
        if not self._tasks:
            time.sleep(_POLL_S)
        for task in ray.wait([*self._tasks], timeout=_POLL_S)[0] if self._tasks else []:
            self._finish(task, *self._tasks.pop(task))
        if self.status().workers:
            self._seen_at = time.monotonic()
        elif time.monotonic() - self._seen_at > _PATIENCE_S:
            raise EvaluatorError(f"no worker came within {_PATIENCE_S:g} s; the cluster has {_resources()}")
        self._deal()

    def _start_missing(self) -> None:
        if time.monotonic() - self._grown_at < _GROW_EVERY_S:
            return
        self._grown_at = time.monotonic()
        actor: Any = RayWorker
        for _ in range((self._count or max(1, num_devices(self._cfg.device))) - len(self._workers)):
            worker = actor.options(**self._resources).remote(*self._arguments)
            self._workers.add(worker)
            self._tasks[worker.prepare.remote(self._shard_size(), self._code)] = worker, None

    def _deal(self) -> None:
        while self._waiting and self._idle:
            worker, shard = self._idle.popleft(), self._waiting.popleft()
            self._tasks[worker.cross.remote(shard.terrains, shard.seeds)] = worker, shard

    def _finish(self, task: Any, worker: Any, shard: _Shard | None) -> None:
        """Takes a task's result; replaces the worker if it failed."""
        result: Any = None
        error, flaw = None, None
        try:
            result = ray.get(task)
            if shard is not None:
                flaw = flaw_of(result, len(shard.terrains), self._cfg.num_replicas)
        except RayError as raised:
            error, flaw = raised, _reason_of(raised)
        if flaw is None:
            self._idle.append(worker)
            if shard is not None:
                shard.result = copied(result)
            return
        with suppress(RayError):
            ray.kill(worker)
        self._workers.remove(worker)
        self._grown_at = -_GROW_EVERY_S  # another is started at once
        if shard is None:
            self._failed_starts += 1
            if _is_refusal(error) or self._failed_starts >= _MOST_TRIES:
                kind = ValueError if _is_refusal(error) else EvaluatorError
                raise kind(f"a worker cannot build its simulation: {flaw}")
            return
        if not any(shard in lot for lot in self._lots):  # forgotten meanwhile
            return
        if _is_refusal(error):  # as any other worker would
            raise ValueError(flaw)
        shard.tries += 1
        self._retries += 1
        what = f"{len(shard.terrains)} terrains"
        if shard.tries >= _MOST_TRIES:
            raise EvaluatorError(f"{what} failed {_MOST_TRIES} times; the last time: {flaw}")
        print(f"a worker failed ({flaw}); its {what} are crossed again by another", file=sys.stderr)
        self._waiting.appendleft(shard)


def _is_refusal(error: BaseException | None) -> bool:
    """Whether a worker raised a ValueError, which the user can mend."""
    return isinstance(error, RayTaskError) and isinstance(error.cause, ValueError)


def _reason_of(error: BaseException) -> str:
    """Why a worker failed, in one line: the exception that it raised, or how it died; its traceback for debugging."""
    if isinstance(error, RayTaskError):
        text = f"{type(error.cause).__name__}: {' '.join(str(error.cause).split())}"
        return f"{text}\n{error}" if debugging() else text  # Ray keeps the worker's traceback in the error's text
    return next((line.strip() for line in str(error).splitlines() if line.strip()), type(error).__name__)


@contextmanager
def open_ray_workers(cfg: EvaluatorCfg, build: Build) -> Iterator[RayWorkers]:
    """Starts the workers and ends them; arguments and errors as of :func:`qd.workers.evaluator.open_evaluator`."""
    connect(parse_workers(cfg.workers).count)
    workers = RayWorkers(cfg, build)
    try:
        workers.open()
        yield workers
    except RayError as error:
        raise EvaluatorError(f"the Ray cluster failed: {_reason_of(error)}") from error
    finally:
        workers.close()


def connect(count: int | None) -> None:
    """Joins the cluster that RAY_ADDRESS names, or starts Ray on this machine for ``count`` workers or one a device."""
    if ray.is_initialized():
        return
    os.environ.setdefault("RAY_USAGE_STATS_ENABLED", "0")
    os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")  # Ray's behaviour to come; it warns otherwise
    quiet: dict[str, Any] = {"log_to_driver": False, "logging_level": logging.ERROR}
    address = os.environ.get("RAY_ADDRESS")
    if address is None:
        cores = max(available_cores(), count or 1)
        ray.init(address="local", num_cpus=cores, include_dashboard=False, object_store_memory=256 << 20, **quiet)
        return
    host, _, port = address.removeprefix("ray://").rpartition(":")
    try:
        if host and port.isdecimal():  # Ray itself would try for minutes where nothing listens
            socket.create_connection((host.strip("[]"), int(port)), timeout=_CONNECT_LIMIT_S).close()
        ray.init(address=address, **quiet)
    except Exception as error:  # of many types: no such host, another version of Ray, a token that is missing
        reason = " ".join(str(error.__cause__ or error).split())[:300]
        raise OSError(
            f"no Ray cluster at RAY_ADDRESS={address}: {reason}: start one with `ray start --head`, or unset "
            "RAY_ADDRESS to use this machine alone"
        ) from None


def cluster_device(name: str | None, count: int | None) -> str:
    """Device of the workers, ``cuda`` or ``cpu``; for None CUDA where the cluster has it."""
    if name not in (None, "cpu", "cuda"):
        raise ValueError(f"with workers on Ray the device must be cpu or cuda, got {name}")
    connect(count)
    gpus = num_devices("cuda")
    if name == "cuda" and not gpus:
        raise ValueError(f"device cuda: the cluster has no GPU: {_resources()}; give --device cpu, or add a node")
    device = name or ("cuda" if gpus else "cpu")
    most = num_devices(device)
    if count is not None and count > most and not os.environ.get("RAY_ADDRESS"):
        raise ValueError(f"workers must be at most ray:{most}, one for each GPU of this machine, got ray:{count}")
    return device


def num_devices(device: str) -> int:
    """GPUs or CPU cores that the cluster has now."""
    return int(ray.cluster_resources().get("GPU" if device.startswith("cuda") else "CPU", 0))


def _resources() -> str:
    return ", ".join(f"{value:g} {name}" for name, value in ray.cluster_resources().items() if name in ("CPU", "GPU"))
