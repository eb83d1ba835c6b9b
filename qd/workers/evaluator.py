"""Evaluation of many terrains: in this process on a GPU, by several processes on a CPU, or by Ray workers.

Workers are handed whole terrains. An episode depends on its terrain, seed and replica alone, so the result is the same
however terrains are spread.
"""

import importlib
import os
import re
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import AbstractContextManager, contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, NamedTuple, Self

import numpy as np
from numpy.typing import NDArray

from qd.workers.process import WorkerProcess
from qd.workers.shards import join_results
from sim.controllers.loaders import load_policy
from sim.crossing import SolverCfg, resolved
from sim.device import resolve_device as resolve_warp_device
from sim.files.provenance import provenance
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from sim.rollout import CrossingCfg, Rollout, RolloutResult
from sim.terrains.spaces.registry import load_space

_MIN_ROWS = 4  # fewest robots of a simulation: one more process costs more than fewer of them gain
_MOST_ENVS = {"cuda": 32_768, "cpu": 32}  # of a worker, when there is work for more
_RUNNING_SHARE = 0.7  # of the episodes under way in several lots: the others wait for the last of their lot
_WORKERS = re.compile(r"(?P<ray>ray)(:(?P<actors>[1-9]\d{0,5}))?|(?P<processes>[1-9]\d{0,5})")


class Workers(NamedTuple):
    """Who crosses terrains."""

    on_ray: bool
    """Ray actors, a GPU or a CPU core each, or processes of this machine."""
    count: int | None
    """How many; None: one a device of the cluster, or a core of this machine."""


def parse_workers(text: str | None) -> Workers:
    """Reads ``--workers``: ``4`` processes, ``ray``, or ``ray:4``; None for one process a core."""
    if text is None:
        return Workers(on_ray=False, count=None)
    match = _WORKERS.fullmatch(text)
    if match is None:
        raise ValueError(f"workers must be a number of processes from 1 on, ray, or ray:N, got '{text}'")
    number = match["actors"] or match["processes"]
    return Workers(on_ray=match["ray"] is not None, count=None if number is None else int(number))


@dataclass(frozen=True)
class Compute:
    """Where terrains are crossed."""

    device: str = "cpu"
    """Warp device name."""
    workers: str | None = None
    """Who crosses them, as :func:`parse_workers` takes it; a GPU without Ray needs one process."""
    num_envs: int | None = None
    """Robots at once over all workers, which take the episodes one after the other; as many as the device is good for
    if None. It changes no result."""

    @classmethod
    def resolve(cls, device: str | None = None, workers: str | None = None, num_envs: int | None = None) -> Self:
        """What a command line asks for, on the device that is there: CUDA if there is one, else the CPU."""
        return cls(resolve_device(device, workers), workers, num_envs)

    def origin(self, seed: int) -> dict[str, Any]:
        """Provenance of what is crossed; on a cluster the device is ``cuda`` or ``cpu`` alone."""
        return provenance(self.device, seed) | ({"device": self.device} if parse_workers(self.workers).on_ray else {})

    def open(self, cfg: "EvaluatorCfg") -> AbstractContextManager["Pipeline"]:
        """Opens what crosses terrains."""
        return open_evaluator(cfg)


@dataclass(frozen=True, kw_only=True)
class EvaluatorCfg(Compute):
    """What an evaluator crosses, with what, and where."""

    robot: RobotCfg | str
    """The robot, or the name of a shipped one."""
    policy: str
    """Controller, as :func:`sim.controllers.loaders.load_policy` takes it."""
    num_terrains: int
    """Terrains under way at once; of more, half as many follow each time that the first half is done."""
    num_replicas: int
    """Episodes a terrain."""
    lots: int = 1
    """Lots of terrains under way at once in a search, equally large."""
    penalties_from_s: float = 0.0
    """Penalties are summed from this time of an episode on [s]."""
    reward: bool = False
    """Whether the training task's reward is summed too, for which robots go on after the goal."""
    space: str = "super_gaussian"
    """Terrain space of the genes, as :func:`sim.terrains.spaces.registry.load_space` takes it."""
    resolved: bool = False
    """Whether contact is resolved (:func:`sim.crossing.resolved`), which takes five times as long."""

    @property
    def num_workers(self) -> int:
        """How many work at once: one on a GPU without Ray; on the CPU no more than there is work for."""
        on_ray, count = parse_workers(self.workers)
        if on_ray:
            return count or _ray_workers().num_devices(self.device)
        if self.device.startswith("cuda"):
            return 1
        by_rows = (self.num_envs or self.num_terrains * self.num_replicas) // _MIN_ROWS
        return max(1, min(count or available_cores(), self.num_terrains, by_rows))

    @property
    def envs_of_worker(self) -> int:
        """Robots of a worker, at least 4: by default so many that they seldom wait (results/anymal/speed.json)."""
        num_envs = self.num_envs
        if num_envs is None:
            episodes = self.num_terrains * self.num_replicas
            num_envs = episodes if self.lots == 1 else int(_RUNNING_SHARE * episodes)
            num_envs = min(num_envs, _MOST_ENVS[self.device.partition(":")[0]] * self.num_workers)
        return max(_MIN_ROWS, -(-num_envs // self.num_workers))

    @property
    def terrains_of_worker(self) -> int:
        """Terrains that a process has under way at most, or as many as give 4 robots an episode."""
        return max(-(-self.num_terrains // self.num_workers), -(-_MIN_ROWS // self.num_replicas))


class WorkerStatus(NamedTuple):
    """How Ray workers fare."""

    workers: int
    """Workers that are ready."""
    retries: int
    """How often terrains had to be crossed again by another worker."""

    def __str__(self) -> str:
        again = f", {self.retries} crossed again" if self.retries else ""
        return f"{self.workers} worker{'s' * (self.workers != 1)}{again}"


def episode_seeds(seed: int, iteration: int, count: int, *, stream: int = 0) -> NDArray[np.uint32]:
    """Seeds of the terrains of one evaluation, shape (count,); the same for the same numbers.

    So a resumed search repeats nothing. Another ``stream`` shares no episodes with the search.
    """
    sequence = np.random.SeedSequence([seed, iteration], spawn_key=(stream,) if stream else ())
    return sequence.generate_state(count, np.uint32).astype(np.uint32)


def available_cores() -> int:
    """Processor cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def resolve_device(name: str | None, workers: str | None = None) -> str:
    """Warp device name, on Ray of the cluster; None means CUDA where there is one, else the CPU."""
    on_ray, count = parse_workers(workers)
    if on_ray:
        return _ray_workers().cluster_device(name, count)
    warp_device = resolve_warp_device(name)
    if warp_device.startswith("cuda") and (count or 1) > 1:
        raise ValueError(
            f"{count} workers need the CPU, got device {warp_device}: give --device cpu, or --workers ray:N"
        )
    return warp_device


def check_policy(policy: str, robot: RobotCfg, device: str) -> None:
    """Loads a controller and tries it on the robot, so that a bad one is found before any long work."""
    # A cluster's GPUs need not be this machine's.
    local_device = device if device == "cpu" else resolve_device(None)
    load_policy(policy, robot, device if local_device.startswith("cuda") else "cpu")


def build_rollout(cfg: EvaluatorCfg, num_terrains: int) -> Rollout:
    """The simulation of an evaluator, for a share of its terrains."""
    import sim.simulation  # noqa: F401  Newton keeps the frames that first import it, and a simulation in them

    robot = get_robot(cfg.robot)
    robot, solver = resolved(robot) if cfg.resolved else (robot, SolverCfg())
    return Rollout(
        robot,
        cfg.policy,
        num_terrains=num_terrains,
        num_replicas=cfg.num_replicas,
        num_envs=cfg.envs_of_worker,
        device=cfg.device,
        cfg=CrossingCfg(penalties_from_s=cfg.penalties_from_s, reward=cfg.reward),
        solver=solver,
        space=load_space(cfg.space),
    )


def _ray_workers() -> Any:
    """The module of Ray workers: Ray takes seconds to import and need not be installed."""
    try:
        return importlib.import_module("qd.workers.ray_workers")
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise ValueError("--workers ray needs Ray, which is not installed: pip install -e '.[cluster]'") from None


Build = Callable[[EvaluatorCfg, int], Rollout]


@contextmanager
def open_evaluator(cfg: EvaluatorCfg, *, build: Build = build_rollout) -> Iterator["Pipeline"]:
    """Builds the simulation, in as many processes as there is work for or on a Ray cluster, and keeps it until the end.

    ``build`` makes it; a module-level function, since processes import it by name.
    """
    if parse_workers(cfg.workers).on_ray:
        with _ray_workers().open_ray_workers(cfg, build) as workers:
            yield workers
        return
    if cfg.device.startswith("cuda"):
        yield Pipeline(cfg.num_terrains, build(cfg, cfg.num_terrains))
        return
    processes: list[WorkerProcess] = []
    try:
        for number in range(cfg.num_workers):
            processes.append(WorkerProcess(cfg.terrains_of_worker, build, cfg))
            if number == 0:
                processes[0].receive()  # it compiles the kernels; the others then find them compiled
        for process in processes[1:]:
            process.receive()
        yield _Processes(processes, cfg.num_terrains)
    finally:
        for process in processes:
            process.stop()


class Pipeline:
    """Evaluates any number of terrains: lots of them are put in, and come out in the same order.

    Robots go on with the lots behind while the last robots of the first one still walk. At most ``num_terrains`` are
    under way at once. ``crosser`` is the simulation in this process; subclasses have others.
    """

    def __init__(self, num_terrains: int, crosser: Any = None) -> None:
        self.num_terrains = num_terrains
        self._crosser = crosser

    def put(self, terrains: NDArray, seeds: NDArray) -> None:
        """Lets a lot of terrains be crossed; waits for nothing."""
        self._crosser.put(terrains, seeds)

    def take(self, progress: Callable[[float], None] | None = None) -> RolloutResult:
        """Waits for the lot that was put in first; ``progress`` gets the share of it that is done."""
        return self._crosser.take(progress)

    def clear(self) -> None:
        """Has nothing under way afterwards: what an evaluation that was stopped has left is of no later one."""
        self._crosser.clear()

    def status(self) -> WorkerStatus | None:
        """How Ray workers fare; None without them."""
        return None

    def __call__(
        self, terrains: NDArray, seeds: NDArray, progress: Callable[[float], None] | None = None
    ) -> RolloutResult:
        """Crosses each terrain once a replica, as :meth:`in_lots` does; all in one result."""
        count = len(terrains)
        size = count if count <= self.num_terrains else max(1, self.num_terrains // 2)
        return join_results([result for _, result in self.in_lots(terrains, seeds, size, progress)], join=1)

    def in_lots(
        self, terrains: NDArray, seeds: NDArray, size: int, progress: Callable[[float], None] | None = None
    ) -> Iterator[tuple[slice, RolloutResult]]:
        """Crosses each terrain once a replica, in lots of ``size``; nothing else may be under way.

        Terrains are genes, shape (num_terrains, num_genes), or heights [m], shape (num_terrains, nrow, ncol), with an
        uint32 seed each. ``progress`` is called now and then with the share that is done. Yields which terrains a lot
        has, and its result; those behind are under way meanwhile as far as there is room.
        """
        count = len(terrains)
        lots = [slice(first, min(first + size, count)) for first in range(0, count, size)]
        behind, num_crossed = deque(lots), 0

        def put_what_fits() -> None:
            while behind and (behind[0].stop - num_crossed <= self.num_terrains or behind[0].start == num_crossed):
                lot = behind.popleft()
                self.put(terrains[lot], seeds[lot])

        self.clear()
        for lot in lots:
            put_what_fits()
            share = (lot.stop - lot.start) / count
            result = self.take(None if progress is None else _share_of(progress, lot.start / count, share))
            num_crossed = lot.stop
            put_what_fits()  # before the result is looked at
            yield lot, result


class _Processes(Pipeline):
    """Processes that each cross a part of every lot, whole terrains in order."""

    def __init__(self, processes: list[WorkerProcess], num_terrains: int) -> None:
        super().__init__(num_terrains)
        self._processes = processes
        self._first = 0  # process that is the first to get one of the terrains that do not divide evenly
        self._lots: deque[dict[int, Any]] = deque()  # of each lot under way, the results by process, None to come

    def put(self, terrains: NDArray, seeds: NDArray) -> None:
        # Over all lots no process gets more than one terrain more than another.
        each, rest = divmod(len(terrains), len(self._processes))
        parts, begin = dict[int, Any](), 0
        for index, process in enumerate(self._processes):
            end = begin + each + ((index - self._first) % len(self._processes) < rest)
            if end > begin:
                process.send(terrains[begin:end], seeds[begin:end])
                parts[index], begin = None, end
        self._first = (self._first + rest) % len(self._processes)
        self._lots.append(parts)

    def take(self, progress: Callable[[float], None] | None = None) -> RolloutResult:
        parts = self._lots[0]
        shares = dict.fromkeys(parts, 0.0)
        while waiting := {self._processes[k].connection: k for k, result in parts.items() if result is None}:
            for connection in wait(list(waiting)):
                assert isinstance(connection, Connection)
                index = waiting[connection]
                message, value = self._processes[index].receive()
                if message == "result":
                    parts[index] = value
                shares[index] = value if message == "progress" else 1.0
            if progress is not None:
                progress(sum(shares.values()) / len(shares))
        self._lots.popleft()
        return join_results(list(parts.values()), join=0)

    def clear(self) -> None:
        while self._lots:
            self.take()


def _share_of(progress: Callable[[float], None], start: float, share: float) -> Callable[[float], None]:
    return lambda done: progress(min(1.0, start + share * done))
