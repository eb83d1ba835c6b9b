"""Evaluation of many terrains: in this process on a GPU, over several processes on a CPU, or by Ray workers.

Whole terrains are handed out, and an episode depends on its terrain, seed and replica alone, so that how terrains are
spread changes nothing in the result.
"""

import importlib
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from typing import TYPE_CHECKING, Any, Literal, Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from qd.workers.process import Crosser, EvaluatorError, WorkerProcess
from qd.workers.shards import MIN_ROWS, checked_count, merged, taken
from sim.files.provenance import provenance

if TYPE_CHECKING:
    from qd.workers.crew import CrewStatus
    from sim.robots.robot import RobotCfg
    from sim.rollout import RolloutResult

__all__ = [
    "Evaluate",
    "EvaluatorCfg",
    "EvaluatorError",
    "available_cores",
    "build_rollout",
    "check_policy",
    "crew_status",
    "episode_seeds",
    "open_evaluator",
    "origin_of",
    "resolve_device",
]


@dataclass(frozen=True, kw_only=True)
class EvaluatorCfg:
    """What an evaluator crosses, with what, and where."""

    robot: "RobotCfg | str"
    """The robot, or the name of a shipped one."""
    policy: str
    """Controller, as :func:`sim.policy.loaders.load_policy` takes it."""
    num_terrains: int
    """Terrains at once; more are taken in turns."""
    num_replicas: int
    """Episodes a terrain."""
    device: str = "cpu"
    """Warp device name."""
    num_processes: int | None = None
    """Processes on the CPU without Ray; None: one a core."""
    workers: int | Literal["auto"] | None = None
    """Ray actors, a GPU or a CPU core each; `auto`: as many as the cluster has; None: no Ray."""
    worker_limit_s: float = 300.0
    """A Ray actor that gets no further for so long [s] is given up."""
    penalties_from_s: float = 0.0
    """Penalties are summed from this time of an episode on [s]."""
    reward: bool = False
    """Whether the training task's reward is summed too, for which robots go on after the goal."""
    space: str = "super_gaussian"
    """Terrain space of the genes."""

    def __post_init__(self) -> None:
        if not 0.0 < self.worker_limit_s < 1e6:
            raise ValueError(f"worker_limit_s must be a positive number of seconds, got {self.worker_limit_s}")

    @property
    def processes(self) -> int:
        """Processes that evaluate: this one on a GPU; on the CPU no more than there is work for; or Ray's."""
        if self.workers is not None:
            return _cluster("cluster").num_devices(self.device) if self.workers == "auto" else self.workers
        if self.device.startswith("cuda"):
            return 1
        by_rows = self.num_terrains * self.num_replicas // MIN_ROWS
        return max(1, min(self.num_processes or available_cores(), self.num_terrains, by_rows))


class Evaluate(Protocol):
    """Evaluates any number of terrains."""

    def __call__(
        self, terrains: NDArray, seeds: NDArray, progress: Callable[[float], None] | None = None
    ) -> "RolloutResult":
        """Cross each terrain once a replica.

        Args:
            terrains: Genes, shape (num_terrains, 64), or heights [m], shape (num_terrains, nrow, ncol).
            seeds: One a terrain, uint32.
            progress: Called now and then with the share that is done.
        """
        ...


@runtime_checkable
class _Staffed(Protocol):
    """An :class:`Evaluate` that has workers to report on."""

    def status(self) -> "CrewStatus":
        """How they fare."""
        ...


def crew_status(evaluate: Evaluate) -> "CrewStatus | None":
    """How the Ray workers of an evaluator fare; None if it has none."""
    return evaluate.status() if isinstance(evaluate, _Staffed) else None


def episode_seeds(seed: int, iteration: int, count: int, *, stream: int = 0) -> NDArray[np.uint32]:
    """Seeds of the terrains of one evaluation; the same for the same numbers, so that a resumed search repeats nothing.

    Args:
        seed: The run's seed.
        iteration: Number of the evaluation.
        count: Number of terrains.
        stream: Set apart what must not share its episodes with the search.

    Returns:
        One seed a terrain, shape (count,).
    """
    sequence = np.random.SeedSequence([seed, iteration], spawn_key=(stream,) if stream else ())
    return sequence.generate_state(count, np.uint32).astype(np.uint32)


def available_cores() -> int:
    """Processor cores this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def resolve_device(name: str | None, workers: int | Literal["auto"] | None = None) -> str:
    """Warp device name; None means CUDA where it is there, else the CPU.

    Args:
        name: What the user asked for.
        workers: Ray workers, whose devices are meant then; None without Ray.

    Raises:
        ValueError: If the device is unknown or absent, or there are not so many.
        OSError: If there is no Ray cluster at RAY_ADDRESS.
    """
    if workers is not None:
        return _cluster("cluster").cluster_device(name, workers)
    from sim.simulation import resolve_device as resolve

    return resolve(name)


def origin_of(device: str, seed: int, workers: int | Literal["auto"] | None) -> dict[str, Any]:
    """Provenance of what Ray workers, or this machine without them, evaluate on a device."""
    origin = provenance(device, seed)
    return origin if workers is None else {**origin, "device": _cluster("cluster").name_of_device(device)}


def check_policy(policy: str, robot: "RobotCfg | str", device: str) -> None:
    """Loads a controller and tries it on the robot that is named, so that a bad one is found before any long work.

    Raises:
        ValueError: If it cannot be loaded or does not fit the robot.
    """
    from sim.policy.loaders import load_policy
    from sim.robots.robot import get_robot

    # A cluster's GPUs need not be this machine's; for the CPU no simulation need be loaded.
    here = device if device == "cpu" else resolve_device(None)
    load_policy(policy, get_robot(robot), device if here.startswith("cuda") else "cpu")


def build_rollout(cfg: EvaluatorCfg, num_terrains: int) -> Crosser:
    """The simulation of an evaluator, for a share of its terrains."""
    from sim.robots.robot import get_robot
    from sim.rollout import CrossingCfg, Rollout
    from sim.space import get_space

    return Rollout(
        get_robot(cfg.robot),
        cfg.policy,
        num_terrains=num_terrains,
        num_replicas=cfg.num_replicas,
        device=cfg.device,
        cfg=CrossingCfg(penalties_from_s=cfg.penalties_from_s, reward=cfg.reward),
        space=get_space(cfg.space),
    )


def _cluster(module: str) -> Any:
    """A module of this room that needs Ray, which nothing else imports.

    Raises:
        ValueError: If Ray is not installed.
    """
    try:
        return importlib.import_module(f"qd.{module}")
    except ModuleNotFoundError as error:
        if error.name != "ray":
            raise
        raise ValueError("workers need Ray, which is not installed: pip install -e '.[cluster]'") from None


Build = Callable[[EvaluatorCfg, int], Crosser]


@contextmanager
def open_evaluator(cfg: EvaluatorCfg, *, build: Build = build_rollout) -> Iterator[Evaluate]:
    """Builds the simulation, in as many processes as pay or on a Ray cluster, and keeps it until the end.

    Args:
        cfg: What, with what, where.
        build: Makes the simulation; a module-level function, since processes import it by name.

    Yields:
        A function of terrains and seeds.

    Raises:
        ValueError: If the simulation cannot be built as asked for.
        EvaluatorError: If a process dies; of a Ray cluster, if no worker is left and none comes.
        OSError: If there is no Ray cluster at RAY_ADDRESS.
    """
    if cfg.workers is not None:
        with _cluster("crew").open_crew(cfg, build) as crew:
            yield crew
        return
    if cfg.device.startswith("cuda"):
        crosser = build(cfg, cfg.num_terrains)
        yield _in_turns(_in_process(crosser), cfg.num_terrains)
        return
    workers: list[WorkerProcess] = []
    try:
        per_worker = -(-cfg.num_terrains // cfg.processes)
        for first in range(0, cfg.num_terrains, per_worker):
            num_terrains = min(per_worker, cfg.num_terrains - first)
            workers.append(WorkerProcess(num_terrains, build, cfg))
            if first == 0:
                workers[0].receive()  # it compiles the kernels; the others then find them compiled
        for worker in workers[1:]:
            worker.receive()
        yield _in_turns(_over_workers(workers), cfg.num_terrains)
    finally:
        for worker in workers:
            worker.stop()


def _in_process(crosser: Crosser) -> Evaluate:
    def evaluate(terrains: NDArray, seeds: NDArray, progress: Callable[[float], None] | None = None) -> "RolloutResult":
        return crosser.evaluate(terrains, seeds, progress=progress)

    return evaluate


def _over_workers(workers: list["WorkerProcess"]) -> Evaluate:
    """Shards of whole terrains, one a worker, put together again in order."""

    def evaluate(terrains: NDArray, seeds: NDArray, progress: Callable[[float], None] | None = None) -> "RolloutResult":
        first = 0
        for worker in workers:
            own = slice(first, first + worker.num_terrains)
            worker.send(terrains[own], seeds[own])
            first = own.stop
        results: dict[int, Any] = {}
        shares = np.zeros(len(workers))
        while len(results) < len(workers):
            for index in _ready(workers, results):
                message, value = workers[index].receive()
                if message == "result":
                    results[index] = value
                shares[index] = value if message == "progress" else 1.0
            if progress is not None:
                progress(float(shares.mean()))
        return merged([results[index] for index in range(len(workers))], join=0)

    return evaluate


def _ready(workers: list["WorkerProcess"], results: dict[int, Any]) -> list[int]:
    """Workers still at it that have something to say, or died."""
    waiting = {workers[k].connection: k for k in range(len(workers)) if k not in results}
    return [waiting[connection] for connection in wait(list(waiting)) if isinstance(connection, Connection)]


def _in_turns(evaluate: Evaluate, at_once: int) -> Evaluate:
    """Any number of terrains, ``at_once`` at a time; the last turn is filled up and what fills it is dropped."""

    def in_turns(terrains: NDArray, seeds: NDArray, progress: Callable[[float], None] | None = None) -> "RolloutResult":
        count = checked_count(terrains, seeds)
        parts = []
        for first in range(0, count, at_once):
            turn = np.arange(first, first + at_once) % count
            report = None if progress is None else _share_of(progress, first / count, at_once / count)
            result = evaluate(terrains[turn], seeds[turn], report)
            parts.append(taken(result, min(at_once, count - first)))
        return merged(parts, join=1)

    return in_turns


def _share_of(progress: Callable[[float], None], start: float, share: float) -> Callable[[float], None]:
    return lambda done: progress(min(1.0, start + share * done))
