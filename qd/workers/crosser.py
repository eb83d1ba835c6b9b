"""The crossing service: controllers cross terrains, in lots that fill the device, and what is done is kept on disk."""

import hashlib
import importlib
import json
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import replace
from pathlib import Path
from typing import get_args

import numpy as np

from kernels.episode import Kind
from qd.search.progress import Bar
from qd.workers.cache import Cache, StoredCrossings
from qd.workers.compute import Compute
from qd.workers.invalid import report_invalid
from qd.workers.pipeline import Build, Engine, Pipeline, PipelineCfg, ProcessPipeline, Progress, build_simulator
from qd.workers.process import WorkerProcess
from sim.controllers.spec import controller_hash, resolve_policy
from sim.files.command import Interrupted
from sim.files.provenance import code_fingerprint
from sim.robots.find import get_robot, read_stray
from sim.robots.robot import RobotCfg, robot_identity
from sim.rollout import RolloutResult
from sim.terrains.spaces.registry import space_key
from sim.terrains.terrains import Terrains

_LOT_EPISODES = {"cuda": 16_384, "cpu": 20}  # of a worker; two lots are under way
_LOT_TERRAINS = 3_200  # of a worker at most: their height maps take 600 MB
_MUJOCO_C_LOT = 4  # terrains of a process
_COMPILERS = 2  # processes that compile kernels


@contextmanager
def open_pipeline(cfg: PipelineCfg, *, build: Build = build_simulator) -> Iterator[Pipeline]:
    """Opens what crosses terrains, in processes or on a Ray cluster, until the end; ``build`` makes simulators."""
    if cfg.on_ray:
        with importlib.import_module("qd.workers.ray_workers").RayWorkers.opened(cfg, build) as workers:
            yield workers
    elif cfg.in_process:
        yield Pipeline(cfg.num_terrains, build(cfg, cfg.num_terrains))
    else:
        processes: list[WorkerProcess] = []
        with ExitStack() as stack:
            for number in range(cfg.num_workers):
                if number == _COMPILERS:
                    for process in processes:
                        process.receive()  # the others then find the kernels compiled
                own = replace(cfg, helps_to_compile=0 < number < _COMPILERS)
                processes.append(WorkerProcess(cfg.terrains_of_worker, build, own))
                stack.callback(processes[-1].stop)
            for process in processes[_COMPILERS if cfg.num_workers > _COMPILERS else 0 :]:
                process.receive()
            yield ProcessPipeline(processes, cfg.num_terrains)


class Crosser(ExitStack):
    """Lets controllers of a robot cross terrains, and stores what is done in the folder ``cache``, if there is one.

    A simulation stays open for calls that agree in all but the terrains.
    """

    def __init__(self, robot: RobotCfg | str, compute: Compute, *, cache: Path | None = None) -> None:
        super().__init__()
        self.robot = get_robot(robot)
        self.compute = compute
        self._cache = None if cache is None else Cache(cache)
        self._stored: dict[str, StoredCrossings] = {}
        self._opened: tuple[PipelineCfg, Pipeline] | None = None
        self._keeps = False  # whether anything that was asked for is in the cache

    def cross(
        self,
        policy: str,
        terrains: Terrains,
        *,
        replicas: int,
        engine: Engine = "search",
        reward: bool = False,
        penalties_from_s: float = 0.0,
        record: bool = False,
        label: str = "",
        room: int = 0,
        invalid_ok: bool = False,
        progress: Progress | None = None,
    ) -> RolloutResult:
        """Lets a controller (:func:`sim.controllers.loaders.load_policy`) cross each terrain in ``replicas`` episodes.

        Penalties are summed from ``penalties_from_s`` of an episode on [s], with ``reward`` the training task's reward
        too; with ``record`` the result has frames. It is not stored then, nor where episodes are steered. The progress
        bar shows ``label``, or ``progress`` gets the share that is done. ``room`` are the terrains of the largest call
        to come that agrees with this one. A result without a valid episode is returned if ``invalid_ok``. Steps and
        time are those of terrains that were not in the cache.
        """
        if replicas < 1 or engine not in get_args(Engine):
            rule = f"replicas must be 1 or more, engine one of {get_args(Engine)}"
            raise ValueError(f"{rule}, got {replicas} and '{engine}'")
        cfg = PipelineCfg(
            compute=self.compute, robot=self.robot, policy=policy, num_terrains=max(1, len(terrains)),
            replicas=replicas, engine=engine, space=terrains.space.name, reward=reward, record=record,
            penalties_from_s=penalties_from_s, with_ground=terrains.has_ground,
            with_conditions=terrains.has_conditions, with_steering=terrains.steering is not None,
        )  # fmt: skip
        if not len(terrains):
            shape = (0, replicas)
            return RolloutResult(
                penalties=np.zeros((*shape, len(self.robot.penalties))), penalty_names=self.robot.penalties,
                outcome=np.zeros(shape, np.uint8), invalidity=np.zeros(shape, np.uint8), fallen=np.zeros(shape, bool),
                duration_s=np.zeros(shape, np.float32), final_position=np.zeros((*shape, 3), np.float32),
                deviation=np.zeros(shape, np.float32),
                reward=np.zeros(shape) if reward else None,
            )  # fmt: skip
        stored = None if record or terrains.steering is not None else self._stored_crossings(cfg, terrains)
        results = list(stored.read(terrains)) if stored else []
        self._keeps |= bool(results)
        done = np.concatenate([np.zeros(0, np.intp), *(numbers for numbers, _ in results)])
        missing = np.setdiff1d(np.arange(len(terrains)), done)
        try:
            for lot, result in self._cross_lots(cfg, terrains[missing], label, room, progress):
                numbers = missing[lot]
                if stored:
                    stored.write(terrains[numbers], result)
                    self._keeps = True
                results.append((numbers, result))
        except KeyboardInterrupt:
            before = "" if stored else " before this step"
            kept = f"; what was crossed{before} is kept, and the same command goes on" if self._keeps else ""
            raise Interrupted(f"Stopped{kept}.") from None
        order = np.argsort(np.concatenate([numbers for numbers, _ in results]))
        result = RolloutResult.join([result for _, result in results])[order]
        report_invalid(result, label or policy, all_ok=invalid_ok)
        return result

    def _stored_crossings(self, cfg: PipelineCfg, terrains: Terrains) -> StoredCrossings | None:
        """The cache of crossings with these settings; None without a cache, or if the controller's code has no file."""
        controller = controller_hash(cfg.policy)
        if self._cache is None or controller is None:
            return None
        space, terms = terrains.space, repr(self.robot.training) if cfg.reward else None  # that the reward has
        settings = [robot_identity(self.robot), self.robot.penalties, controller, space_key(space.name, space.sha256)]
        settings += [cfg.replicas, self.compute.on_gpu, cfg.engine, cfg.penalties_from_s, terms]
        settings += [code_fingerprint(("kernels", "sim"))]
        settings += [read_stray(self.robot, resolved=cfg.is_resolved)] if space.asks == Kind.ROUTE else []
        key = hashlib.sha256(json.dumps(settings).encode()).hexdigest()[:32]
        if key not in self._stored:
            self._stored[key] = StoredCrossings(self._cache, key, self.robot.penalties)
        return self._stored[key]

    def _cross_lots(
        self, cfg: PipelineCfg, terrains: Terrains, label: str, room: int, progress: Progress | None
    ) -> Iterator[tuple[slice, RolloutResult]]:
        """Which of the terrains a lot has, and its result."""
        if not len(terrains):
            return
        count = max(len(terrains), room)
        each = min(_LOT_EPISODES["cuda" if cfg.compute.on_gpu else "cpu"] // cfg.replicas, _LOT_TERRAINS)
        each = _MUJOCO_C_LOT if cfg.on_mujoco_c else max(1, each)
        lot = each * replace(cfg, num_terrains=count).num_workers
        try:
            pipeline = self._open(replace(cfg, num_terrains=min(count, 2 * lot)))
            with nullcontext() if progress else Bar(label) as bar:
                yield from pipeline.in_lots(terrains, lot, bar.move_to if bar else progress)
        except BaseException:
            self._opened = None  # what failed is not used again
            self.close()
            raise

    def _open(self, cfg: PipelineCfg) -> Pipeline:
        """A simulation with room for so many terrains; the one that is open if it serves."""
        if self._opened is not None:
            opened, pipeline = self._opened
            if replace(opened, num_terrains=cfg.num_terrains) == cfg and opened.num_terrains >= cfg.num_terrains:
                return pipeline
        self.close()
        self._opened = cfg, self.enter_context(open_pipeline(cfg))
        return self._opened[1]


def cross(
    controllers: Mapping[str, str],
    terrains: Terrains,
    *,
    robot: RobotCfg | str = "anymal",
    compute: Compute | None = None,
    replicas: int,
    engine: Engine = "search",
    reward: bool = False,
    penalties_from_s: float = 0.0,
    cache: Path | None = None,
) -> dict[str, RolloutResult]:
    """Lets each controller cross each terrain, as :meth:`Crosser.cross` does: one result a controller, by its name."""
    with Crosser(robot, compute or Compute(), cache=cache) as crosser:
        return {
            name: crosser.cross(
                resolve_policy(policy, crosser.robot), terrains, replicas=replicas, engine=engine, reward=reward,
                penalties_from_s=penalties_from_s, label=name,
            )
            for name, policy in controllers.items()
        }  # fmt: skip
