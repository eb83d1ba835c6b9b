"""What crosses terrains: one simulation in this process, or one in each of several processes.

An episode depends on its terrain, seed and replica alone, so the result is the same however terrains are spread.
"""

import multiprocessing
from collections import deque
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import Any, Literal, NamedTuple

from qd.workers.compute import Compute, available_cores, num_devices, parse_workers
from qd.workers.process import WorkerProcess
from sim.crossing import CrossingCfg, SolverCfg, resolved
from sim.mujoco_c.crossing import MujocoC
from sim.recording.recorder import RolloutRecorder
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from sim.rollout import Rollout, RolloutResult
from sim.terrains.spaces.registry import load_space
from sim.terrains.terrains import Terrains

Engine = Literal["search", "resolved", "mujoco_c", "mujoco_c_search"]
"""The search's physics, or with contact resolved (:func:`sim.crossing.resolved`); MuJoCo C resolved, or as searched."""
Progress = Callable[[float], None]
"""Gets the share that is done, now and then."""

_MIN_ROWS = 4  # fewest robots of a simulation: one more process costs more than fewer of them gain
_MAX_ENVS = {"cuda": 32_768, "cpu": 32}  # of a worker, when there is work for more
_RUNNING_SHARE = 0.7  # of the episodes under way in several lots: the others wait for the last of their lot


@dataclass(frozen=True, kw_only=True)
class PipelineCfg:
    """What a pipeline crosses, with what, and where."""

    compute: Compute
    robot: RobotCfg | str
    policy: str
    """Controller, as :func:`sim.controllers.loaders.load_policy` takes it."""
    num_terrains: int
    """Terrains under way at once; of more, half as many follow each time that the first half is done."""
    replicas: int
    lots: int = 1
    """Lots of terrains under way at once in a search, equally large."""
    engine: Engine = "search"
    space: str = "super_gaussian"
    """Terrain space of the genes, as :func:`sim.terrains.spaces.registry.load_space` takes it."""
    with_ground: bool = False
    """Whether heights come with maps of friction and softness."""
    with_conditions: bool = False
    with_steering: bool = False
    """Whether terrains come with ways of their episodes."""
    penalties_from_s: float = 0.0
    """Penalties are summed from this time of an episode on [s]."""
    reward: bool = False
    """Whether the training task's reward is summed too, for which robots go on after the goal."""
    record: bool = False
    """Whether results have the frames of all episodes."""
    helps_to_compile: bool = False
    """Whether another process compiles kernels at the same time, so that this one begins with those needed last."""

    def __post_init__(self) -> None:
        if self.on_mujoco_c and (self.reward or self.penalties_from_s or self.record):
            raise ValueError("engine mujoco_c sums no reward, sums penalties from the start only, and records nothing")

    @property
    def is_resolved(self) -> bool:
        """Whether contact is resolved (:func:`sim.crossing.resolved`)."""
        return self.engine in ("resolved", "mujoco_c")

    @property
    def on_mujoco_c(self) -> bool:
        """Whether MuJoCo C crosses, which has no GPU and no part in Ray."""
        return self.engine.startswith("mujoco_c")

    @property
    def on_ray(self) -> bool:
        """Whether Ray workers cross."""
        return self.compute.on_ray and not self.on_mujoco_c

    @property
    def in_process(self) -> bool:
        """Whether this process simulates: on a GPU without Ray, and where it may have no children of its own."""
        alone = self.compute.on_gpu or multiprocessing.current_process().daemon
        return alone and not self.on_ray and not self.on_mujoco_c

    @property
    def num_workers(self) -> int:
        """How many work at once: one in this process; on the CPU no more than there is work for."""
        on_ray, count = parse_workers(self.compute.workers)
        if self.on_ray:
            return count or num_devices(self.compute.device)
        if self.in_process:
            return 1
        cores = (None if on_ray else count) or available_cores()
        if self.on_mujoco_c:
            return min(cores, self.num_terrains)
        by_rows = (self.compute.num_envs or self.num_terrains * self.replicas) // _MIN_ROWS
        return max(1, min(cores, self.num_terrains, by_rows))

    @property
    def envs_of_worker(self) -> int:
        """Robots of a worker, at least 4: by default so many that they seldom wait (results/anymal/speed.json)."""
        num_envs = self.compute.num_envs
        if num_envs is None:
            episodes = self.num_terrains * self.replicas
            num_envs = episodes if self.lots == 1 else int(_RUNNING_SHARE * episodes)
            num_envs = min(num_envs, _MAX_ENVS["cuda" if self.compute.on_gpu else "cpu"] * self.num_workers)
        return max(_MIN_ROWS, -(-num_envs // self.num_workers))

    @property
    def terrains_of_worker(self) -> int:
        """Terrains that a process has under way at most, or as many as give 4 robots an episode."""
        return max(-(-self.num_terrains // self.num_workers), -(-_MIN_ROWS // self.replicas))


class WorkerStatus(NamedTuple):
    """How Ray workers fare."""

    workers: int
    """Workers that are ready."""
    retries: int
    """How often terrains had to be crossed again by another worker."""

    def __str__(self) -> str:
        again = f", {self.retries} crossed again" if self.retries else ""
        return f"{self.workers} worker{'s' * (self.workers != 1)}{again}"


Simulator = Rollout | RolloutRecorder | MujocoC
"""Crosses lots of terrains in one process: ``put`` takes them in, ``take`` gives their results in that order."""
Build = Callable[[PipelineCfg, int], Simulator]
"""Makes a simulator with room for so many terrains; a module-level function, since processes import it by name."""


def build_simulator(cfg: PipelineCfg, num_terrains: int) -> Simulator:
    """The simulator of a pipeline, for a share of its terrains."""
    robot = get_robot(cfg.robot)
    solver = SolverCfg()
    if cfg.is_resolved:
        robot, solver = resolved(robot)
    if cfg.on_mujoco_c:
        return MujocoC(robot, cfg.policy, replicas=cfg.replicas, solver=solver)
    import sim.simulation  # Newton keeps the frames that first import it, and a simulation in them

    if cfg.helps_to_compile:
        sim.simulation.load_kernels(cfg.compute.device)
    rollout = Rollout(
        robot, cfg.policy, num_terrains=num_terrains, replicas=cfg.replicas, num_envs=cfg.envs_of_worker,
        device=cfg.compute.device, cfg=CrossingCfg(penalties_from_s=cfg.penalties_from_s, reward=cfg.reward),
        solver=solver, space=load_space(cfg.space), with_ground=cfg.with_ground, with_conditions=cfg.with_conditions,
        with_steering=cfg.with_steering,
    )  # fmt: skip
    return RolloutRecorder(rollout) if cfg.record else rollout


class Pipeline:
    """Crosses lots of terrains, which come out in the order in which they were put in.

    Robots go on with the lots behind while the last robots of the first one still walk. At most ``num_terrains`` are
    under way at once. ``simulator`` works in this process; subclasses have others.
    """

    def __init__(self, num_terrains: int, simulator: Simulator | None = None) -> None:
        self.num_terrains = num_terrains
        self._simulator: Any = simulator

    def put(self, terrains: Terrains) -> None:
        """Queues a lot of terrains; waits for nothing."""
        self._simulator.put(terrains)

    def take(self, progress: Progress | None = None) -> RolloutResult:
        """Waits for the lot that was put in first; ``progress`` gets the share of it that is done."""
        return self._simulator.take(progress)

    def clear(self) -> None:
        """Drops all pending lots."""
        self._simulator.clear()

    def status(self) -> WorkerStatus | None:
        """How Ray workers fare; None without them."""
        return None

    def __call__(self, terrains: Terrains, progress: Progress | None = None) -> RolloutResult:
        """Crosses each terrain once a replica, as :meth:`in_lots` does; all in one result."""
        count = len(terrains)
        size = count if count <= self.num_terrains else max(1, self.num_terrains // 2)
        return RolloutResult.join([result for _, result in self.in_lots(terrains, size, progress)])

    def in_lots(
        self, terrains: Terrains, size: int, progress: Progress | None = None
    ) -> Iterator[tuple[slice, RolloutResult]]:
        """Crosses each terrain once a replica, in lots of ``size``; drops all pending lots first.

        Yields which terrains a lot has, and its result; those behind are under way meanwhile as far as there is room.
        """
        count, num_crossed = len(terrains), 0
        lots = [slice(first, min(first + size, count)) for first in range(0, count, size)]
        behind = deque(lots)

        def put_what_fits() -> None:
            while behind and (behind[0].stop - num_crossed <= self.num_terrains or behind[0].start == num_crossed):
                self.put(terrains[behind.popleft()])

        def report(share: float) -> None:
            if progress is not None:
                progress(min(1.0, (lot.start + share * (lot.stop - lot.start)) / count))

        self.clear()
        for lot in lots:
            put_what_fits()
            result = self.take(report)
            num_crossed = lot.stop
            put_what_fits()  # before the result is looked at
            yield lot, result


class ProcessPipeline(Pipeline):
    """Processes that each cross a part of every lot, whole terrains in order."""

    def __init__(self, processes: list[WorkerProcess], num_terrains: int) -> None:
        super().__init__(num_terrains)
        self._processes = processes
        self._first = 0  # process that is the first to get one of the terrains that do not divide evenly
        self._lots: deque[dict[int, Any]] = deque()  # of each lot under way, the results by process, None to come

    def put(self, terrains: Terrains) -> None:
        """Spreads a lot so that over all lots no process gets more than one terrain more than another."""
        each, rest = divmod(len(terrains), len(self._processes))
        results, begin = dict[int, Any](), 0
        for index, process in enumerate(self._processes):
            end = begin + each + ((index - self._first) % len(self._processes) < rest)
            if end > begin:
                process.send(terrains[begin:end])
                results[index] = None
                begin = end
        self._first = (self._first + rest) % len(self._processes)
        self._lots.append(results)

    def take(self, progress: Progress | None = None) -> RolloutResult:
        """Waits for the parts of the lot that was put in first."""
        results = self._lots[0]
        shares = dict.fromkeys(results, 0.0)
        while waiting := {self._processes[k].connection: k for k, result in results.items() if result is None}:
            for connection in wait(list(waiting)):
                assert isinstance(connection, Connection)
                index = waiting[connection]
                message, value = self._processes[index].receive()
                if message == "result":
                    results[index] = value
                shares[index] = value if message == "progress" else 1.0
            if progress is not None:
                progress(sum(shares.values()) / len(shares))
        self._lots.popleft()
        return RolloutResult.join(list(results.values()), at_once=True)

    def clear(self) -> None:
        """Waits for all pending lots and drops them."""
        while self._lots:
            self.take()
