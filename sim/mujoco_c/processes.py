"""Crossings in plain MuJoCo C shared out over processes."""

import multiprocessing
import os
import signal
import threading
import time
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from sim.mujoco_c.crossing import PlainCrossings, Starts, cross, join
from sim.policy.loaders import load_policy, prepare_torch
from sim.robots.robot import RobotCfg

_CHUNK = 25  # episodes at a time: enough for the policy's batch, few enough to share out

_worker: dict[str, Any] = {}


def _end_with(parent: int) -> None:
    """Ends this process once its parent is gone, which a pool's workers would otherwise outlive."""
    while os.getppid() == parent:
        time.sleep(1.0)
    os._exit(1)


def _start_worker(robot: RobotCfg, policy: str, parent: int) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends its workers
    threading.Thread(target=_end_with, args=(parent,), daemon=True).start()
    prepare_torch("cpu")
    _worker.update(robot=robot, policy=load_policy(policy, robot, "cpu"))


def _cross_chunk(heights: NDArray[np.float32], starts: Starts, time_constant_s: float | None) -> PlainCrossings:
    return cross(_worker["robot"], _worker["policy"], heights, starts, time_constant_s=time_constant_s)


def run_plain(
    robot: RobotCfg,
    policy: str,
    heights: NDArray[np.float32],
    starts: list[Starts],
    *,
    processes: int,
    time_constant_s: float | None = None,
) -> list[PlainCrossings]:
    """Cross every terrain from its starts in plain MuJoCo, shared out over processes.

    Args:
        robot: Robot settings.
        policy: The controller, as :func:`sim.policy.loaders.load_policy` takes it.
        heights: Height grids [m], shape (num_terrains, nrow, ncol).
        starts: Of each terrain.
        processes: How many at once.
        time_constant_s: Contact time constant [s]; that of the robot's file if None.
    """
    context = multiprocessing.get_context("spawn")
    parts: list[list[PlainCrossings | None]] = []
    pool = ProcessPoolExecutor(
        processes, mp_context=context, initializer=_start_worker, initargs=(robot, policy, os.getpid())
    )
    try:
        place: dict[Future[PlainCrossings], tuple[int, int]] = {}
        for terrain, start in enumerate(starts):
            chunks = [slice(k, k + _CHUNK) for k in range(0, len(start.qpos), _CHUNK)]
            parts.append([None] * len(chunks))
            for k, rows in enumerate(chunks):
                chunk = replace(start, qpos=start.qpos[rows], qvel=start.qvel[rows])
                place[pool.submit(_cross_chunk, heights[terrain], chunk, time_constant_s)] = terrain, k
        waiting = set(place)
        with tqdm(desc="plain MuJoCo", total=sum(len(s.qpos) for s in starts), unit="episode", disable=None) as bar:
            while waiting:
                done, waiting = wait(waiting, return_when=FIRST_COMPLETED)
                for future in done:
                    terrain, k = place[future]
                    parts[terrain][k] = future.result()
                    bar.update(len(future.result().outcome))
    except BrokenProcessPool as error:
        raise OSError(f"a process of plain MuJoCo died: {error}") from None
    finally:
        pool.shutdown(cancel_futures=True)
    return [join([part for part in terrain if part is not None]) for terrain in parts]
