"""What lives in a Ray actor: one simulation on one device, which crosses shards of terrains."""

import os
import socket
import tempfile
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import ray
from numpy.typing import NDArray

from qd.workers.process import Crosser
from sim.files.provenance import code_fingerprint
from sim.policy.spec import ControllerSpec

if TYPE_CHECKING:
    from sim.rollout import RolloutResult

_ROOMS = ("kernels", "sim", "qd")
_WATCH = "watch"


@dataclass(frozen=True, kw_only=True)
class Controller:
    """A controller on its way to other machines, which need not have its file."""

    spec: ControllerSpec
    files: tuple[tuple[str, bytes], ...]
    """Name and content of each of its files; none of ``module:callable``."""

    @classmethod
    def of(cls, policy: str) -> "Controller":
        """What ``policy`` names."""
        spec = ControllerSpec.parse(policy)
        return cls(spec=spec, files=tuple((file.name, file.read_bytes()) for file in spec.files if file.is_file()))

    def unpacked(self, folder: str) -> str:
        """A policy as :func:`sim.policy.loaders.load_policy` takes it; its files are put into ``folder``."""
        for name, content in self.files:
            (Path(folder) / name).write_bytes(content)
        return str(self.spec.in_folder(Path(folder)) if self.files else self.spec)


@dataclass(frozen=True, kw_only=True)
class Luggage:
    """What a worker is sent beside its settings: controller and robot, with their files."""

    controller: Controller
    robot: Any
    """As :func:`sim.robots.own.pack_robot` packs it."""

    @classmethod
    def of(cls, cfg: Any) -> "Luggage":
        """That of an evaluator's settings."""
        return cls(controller=Controller.of(cfg.policy), robot=_packed(cfg.robot))

    def unpacked(self, cfg: Any, folder: str) -> Any:
        """The settings with controller and robot from files in ``folder``."""
        robot = self.robot
        if not isinstance(robot, str):
            robot = robot.unpacked(Path(folder) / "robot")
        return replace(cfg, policy=self.controller.unpacked(folder), robot=robot)


def _packed(robot: Any) -> Any:
    if isinstance(robot, str):
        return robot
    from sim.robots.own import pack_robot  # with the physics, which only workers need otherwise

    return pack_robot(robot)


def build_of_code() -> str:
    """A fingerprint of what a worker runs."""
    return code_fingerprint(_ROOMS)


_ray: Any = ray  # its annotations leave out what it documents


@_ray.remote(concurrency_groups={_WATCH: 1}, max_restarts=0)
class RayWorker:
    """One device's simulation, built when it is first needed and again when shards change their size.

    Args:
        cfg: An evaluator's settings; its device is the one Ray gave to this process.
        luggage: Its controller and robot.
        build: Makes the simulation of ``cfg`` for a number of terrains.
    """

    def __init__(self, cfg: Any, luggage: Luggage, build: Callable[[Any, int], Crosser]) -> None:
        self._cfg, self._luggage, self._build = cfg, luggage, build
        self._crosser: Crosser | None = None
        self._num_terrains = 0
        self._share = 0.0
        self._building_since: float | None = None

    def introduce(self) -> tuple[str, int, str]:
        """Host, process id and fingerprint of the code."""
        return socket.gethostname(), os.getpid(), build_of_code()

    def prepare(self, num_terrains: int) -> None:
        """Builds the simulation for shards of this size.

        Raises:
            ValueError: If it cannot be built as asked for.
        """
        if num_terrains == self._num_terrains:
            return
        self._crosser, self._num_terrains = None, 0  # its memory, before the next one's is asked for
        self._building_since = time.monotonic()
        # A worker is killed when it is no longer wanted: a folder that lived as long would be left behind.
        with tempfile.TemporaryDirectory(prefix="faultline-") as folder:
            self._crosser = self._build(self._luggage.unpacked(self._cfg, folder), num_terrains)
        self._building_since, self._num_terrains = None, num_terrains

    def cross(self, terrains: NDArray, seeds: NDArray, num_terrains: int) -> tuple["RolloutResult", float]:
        """Crosses up to ``num_terrains`` terrains; what fills up the simulation is crossed in vain.

        Returns:
            Their result, and the seconds it took, building excluded.
        """
        self._share = 0.0
        self.prepare(num_terrains)
        assert self._crosser is not None
        filled = np.arange(num_terrains) % len(terrains)
        began = time.perf_counter()
        result = self._crosser.evaluate(terrains[filled], seeds[filled], progress=self._note)
        return result, time.perf_counter() - began

    @_ray.method(concurrency_group=_WATCH)
    def share(self) -> float:
        """Share of the present shard that is done; minus the seconds it has taken so far while it builds."""
        since = self._building_since
        return self._share if since is None else since - time.monotonic()

    def _note(self, share: float) -> None:
        self._share = share
