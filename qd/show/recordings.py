"""Recorded crossings, stored on disk by all that they depend on; missing ones are crossed."""

import hashlib
import json
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.search.archive import Archive
from qd.search.directory import RUNS
from qd.search.progress import Bar
from qd.workers.cache import Cache
from qd.workers.compute import Compute
from qd.workers.crosser import Crosser
from qd.workers.seeds import Stream, episode_seeds
from sim.controllers.spec import controller_hash
from sim.files.provenance import code_fingerprint
from sim.recording.recorder import Recording, make_recording, read_recording, write_recording
from sim.robots.robot import RobotCfg, robot_identity
from sim.terrains.spaces.registry import space_key
from sim.terrains.terrains import Terrains

_LOT = 32  # terrains crossed side by side on a GPU


@dataclass(frozen=True, kw_only=True)
class CrossingRequest:
    """A controller's crossings of one terrain. Requests are equal if their crossings are."""

    label: str = field(compare=False)  # of the terrain
    terrain: Terrains = field(compare=False)  # one row
    policy: str
    replicas: int = 20
    seed: int = field(default=0, compare=False)  # what the terrain's seed was drawn with, for the record
    terrain_key: str = field(init=False)  # hash of the terrain and its seed

    def __post_init__(self) -> None:
        (digest,) = self.terrain.digests()
        space = self.terrain.space
        object.__setattr__(self, "terrain_key", f"{space_key(space.name, space.sha256)} {digest.hex()}")

    @property
    def lot_key(self) -> tuple[Any, ...]:
        """Equal for requests that one simulation crosses side by side."""
        space = self.terrain.space.name
        maps = (self.terrain.has_ground, self.terrain.has_conditions, self.terrain.steering is not None)
        return self.policy, self.replicas, self.seed, space, self.terrain.values.shape, maps


def request_elite(
    archive: Archive,
    number: int,
    *,
    label: str | None = None,
    minimal: NDArray[np.float32] | None = None,
    seed: int = 0,
    **crossing: Any,
) -> CrossingRequest:
    """The crossings of an elite that ``faultline replay`` shows, or of ``minimal`` genes from the same starts."""
    genes = archive.genes[number] if minimal is None else minimal
    seeds = episode_seeds(seed, number, 1, stream=Stream.RECORDED_ELITE)
    terrain = Terrains(genes=genes[None], seeds=seeds, space=archive.terrain_space)
    label = label or f"{'' if minimal is None else 'minimal terrain of '}elite {number} of {archive.robot}"
    return CrossingRequest(label=label, terrain=terrain, seed=seed, **crossing)


class RecordingCrosser:
    """Crosses terrains and records the crossings; the simulation of each controller stays open."""

    def __init__(self, robot: RobotCfg, device: str) -> None:
        self._robot = robot
        self._device = device
        self._crossers = defaultdict[str, Crosser](lambda: Crosser(robot, Compute(device, workers="1")))

    def __call__(self, requests: Sequence[CrossingRequest], progress: Callable[[float], None]) -> list[Recording]:
        """Recordings of terrains of one :attr:`CrossingRequest.lot_key`; ``progress`` gets the share that is done."""
        policy = requests[0].policy
        terrains = Terrains.join([request.terrain for request in requests])
        how: Any = {"replicas": requests[0].replicas, "record": True, "progress": progress, "invalid_ok": True}
        result = self._crossers[policy].cross(policy, terrains, **how)
        origin: Any = {"device": self._device, "seed": requests[0].seed, "labels": [r.label for r in requests]}
        recording = make_recording(self._robot, policy, terrains, result, **origin)
        return [recording.select_terrain(k) for k in range(len(requests))]


class Recordings:
    """The stored recordings of a robot."""

    def __init__(self, robot: RobotCfg, *, device: str = "cpu", folder: Path = RUNS / "recordings") -> None:
        on_gpu = device.startswith("cuda")  # its last bits differ from a CPU's
        self._settings = [robot_identity(robot), robot.penalties, on_gpu, code_fingerprint(("kernels", "sim"))]
        self._cache = Cache(folder)
        self._lot = _LOT if on_gpu else 1  # on the CPU each is stored as soon as it is done
        self._cross = RecordingCrosser(robot, device)

    def read(self, request: CrossingRequest) -> Recording | None:
        """The stored recording; None if there is none, or it is damaged."""
        key = self._key(request)
        try:
            recording = read_recording(self._cache.file(key))
        except (OSError, ValueError):
            return None
        self._cache.touch(key)
        return replace(recording, labels=(request.label,))

    def store(self, request: CrossingRequest, recording: Recording) -> None:
        """Stores a recording; prints a warning if it cannot be written."""
        key = self._key(request)
        try:
            self._cache.folder.mkdir(parents=True, exist_ok=True)
            write_recording(self._cache.file(key), recording)
            self._cache.remove_least_used(but=key)
        except OSError as error:  # it can be shown all the same
            print(f"not stored: {error}", flush=True)

    def record(self, requests: Sequence[CrossingRequest]) -> list[Recording]:
        """Recordings of all requests in their order; missing ones are crossed and stored, lot by lot."""
        recordings = {k: recording for k, request in enumerate(requests) if (recording := self.read(request))}
        missing = [k for k in range(len(requests)) if k not in recordings]
        if not missing:
            return [*recordings.values()]
        lots = defaultdict[Any, list[int]](list)
        for k in missing:
            lots[requests[k].lot_key].append(k)
        text = f"{len(missing)} terrain{'s' * (len(missing) > 1)}, {requests[missing[0]].replicas} times each"
        done = 0
        with Bar(f"recording {text}", len(missing)) as bar:
            for lot in (rows[k : k + self._lot] for rows in lots.values() for k in range(0, len(rows), self._lot)):
                crossed = self._cross([requests[k] for k in lot], bar.within(done, len(lot)))
                for k, recording in zip(lot, crossed, strict=True):
                    self.store(requests[k], recording)
                    recordings[k] = recording
                done += len(lot)
                bar.move_to(done)
        return [recordings[k] for k in range(len(requests))]

    def _key(self, request: CrossingRequest) -> str:
        """Hash of all that a recording depends on."""
        policy = controller_hash(request.policy) or request.policy
        content = [*self._settings, policy, request.terrain_key, request.replicas]
        return hashlib.sha256(json.dumps(content).encode()).hexdigest()[:32]
