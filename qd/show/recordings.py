"""Recorded crossings, stored on disk by all that they depend on. Those that are missing are crossed.

So no file is ever out of date, and what one command recorded the others find.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
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
from sim.recording.file import read_recording, write_recording
from sim.recording.recorder import Recording, make_recording
from sim.robots.identity import robot_identity
from sim.robots.robot import RobotCfg
from sim.terrains.ground import GroundMaps
from sim.terrains.spaces.registry import get_space, identity, load_space
from sim.terrains.terrains import Terrains

FOLDER = RUNS / "recordings"
AT_ONCE = 32
"""Terrains crossed side by side on a GPU."""


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """Crossings of one terrain by one controller."""

    label: str = field(compare=False)
    """What the terrain is, in words."""
    terrain: NDArray[np.float32] = field(compare=False)
    """Genes, shape (num_genes,), or heights [m], shape (nrow, ncol)."""
    policy: str
    replicas: int = 20
    seed: int = 0
    """What ``terrain_seed`` was drawn with, for the record."""
    terrain_seed: int
    """Seed of the terrain's episodes."""
    space: str = "super_gaussian"
    """Terrain space of genes, as :func:`sim.terrains.spaces.registry.load_space` takes it."""
    ground: GroundMaps | None = field(default=None, compare=False)
    """Friction and softness beside heights."""

    @property
    def terrains(self) -> Terrains:
        """The terrain as what crosses it takes it."""
        kind: dict[str, Any] = {"heights" if self.terrain.ndim == 2 else "genes": self.terrain[None]}
        seeds = np.array([self.terrain_seed], np.uint32)
        return Terrains(seeds=seeds, space=load_space(self.space), ground=self.ground, **kind)

    @property
    def kind(self) -> tuple[Any, ...]:
        """What crossings have in common that one simulation makes side by side."""
        conditions = self.ground is not None and self.ground.conditions is not None
        about = self.policy, self.replicas, self.seed, self.space, self.terrain.shape
        return *about, self.ground is None, conditions


def on_elite(
    archive: Archive,
    number: int,
    *,
    label: str | None = None,
    minimal: NDArray[np.float32] | None = None,
    seed: int = 0,
    **crossing: Any,
) -> Wanted:
    """The crossings of an elite that ``faultline replay`` shows, by a ``policy`` in ``replicas`` episodes.

    With ``minimal``, the genes of its minimal terrain, they are of that, from the same starts.
    """
    return Wanted(
        label=label or f"{'' if minimal is None else 'minimal terrain of '}elite {number} of {archive.robot}",
        terrain=archive.genes[number] if minimal is None else minimal,
        seed=seed,
        terrain_seed=int(episode_seeds(seed, number, 1, stream=Stream.RECORDED_ELITE)[0]),
        space=get_space(archive.space, archive.space_sha256).name,
        **crossing,
    )


def on_heights(heights: NDArray[np.float32], *, seed: int = 0, **crossing: Any) -> Wanted:
    """Crossings of a user's own terrain; further arguments as of :class:`Wanted`."""
    terrain_seed = int(episode_seeds(seed, 0, 1, stream=Stream.RECORDED_USER_TERRAIN)[0])
    return Wanted(terrain=heights, seed=seed, terrain_seed=terrain_seed, **crossing)


Cross = Callable[[Sequence[Wanted], Callable[[float], None]], list[Recording]]
"""Crosses terrains of one :attr:`Wanted.kind`, and calls back with the share that is done."""


class RecordingCrosser:
    """Crosses terrains and records the crossings; the simulation of each kind stays open."""

    def __init__(self, robot: RobotCfg, device: str) -> None:
        self._robot = robot
        self._device = device
        self._crossers: dict[Any, Crosser] = {}

    def __call__(self, wanted: Sequence[Wanted], progress: Callable[[float], None]) -> list[Recording]:
        """Recordings of all, in their order."""
        first = wanted[0]
        if first.kind not in self._crossers:
            self._crossers[first.kind] = Crosser(self._robot, Compute(self._device, workers="1"))
        terrains = Terrains.join([crossing.terrains for crossing in wanted])
        result = self._crossers[first.kind].cross(
            first.policy, terrains, replicas=first.replicas, record=True, progress=progress, invalid_ok=True
        )
        recording = make_recording(
            self._robot, first.policy, terrains, result, device=self._device,
            labels=[crossing.label for crossing in wanted], seed=first.seed,
        )  # fmt: skip
        return [recording.select_terrain(k) for k in range(len(wanted))]


class Recordings:
    """The stored recordings of a robot; ``cross`` makes what is missing, by default a :class:`RecordingCrosser`."""

    def __init__(
        self, robot: RobotCfg, *, device: str = "cpu", folder: Path = FOLDER, cross: Cross | None = None
    ) -> None:
        on_gpu = device.startswith("cuda")  # its last bits differ from a CPU's
        self._about = [robot_identity(robot), robot.penalties, on_gpu, code_fingerprint(("kernels", "sim"))]
        self._cache = Cache(folder)
        self._at_once = AT_ONCE if on_gpu else 1
        self._cross = cross or RecordingCrosser(robot, device)

    def read(self, wanted: Wanted) -> Recording | None:
        """The recording of some crossings; None if there is none, or it is damaged."""
        key = self._key(wanted)
        try:
            recording = read_recording(self._cache.file(key))
        except (OSError, ValueError):
            return None
        self._cache.touch(key)
        return replace(recording, labels=(wanted.label,))

    def keep(self, wanted: Wanted, recording: Recording) -> None:
        """Stores a recording; prints a warning if it cannot be written."""
        key = self._key(wanted)
        try:
            self._cache.folder.mkdir(parents=True, exist_ok=True)
            write_recording(self._cache.file(key), recording)
            self._cache.remove_least_used(but=key)
        except OSError as error:  # it can be shown all the same
            print(f"not stored: {error}", flush=True)

    def all_of(self, wanted: Sequence[Wanted]) -> list[Recording]:
        """Recordings of all that is wanted, in its order; what is missing is crossed and stored, batch by batch."""
        recordings = {k: recording for k, crossing in enumerate(wanted) if (recording := self.read(crossing))}
        missing = [k for k in range(len(wanted)) if k not in recordings]
        if not missing:
            return [*recordings.values()]
        words = f"{len(missing)} terrain{'s' * (len(missing) > 1)}, {wanted[missing[0]].replicas} times each"
        done = 0
        with Bar(f"crossing {words}", len(missing)) as bar:
            for batch in self._batches(wanted, missing):
                crossed = self._cross([wanted[k] for k in batch], bar.within(done, len(batch)))
                for k, recording in zip(batch, crossed, strict=True):
                    self.keep(wanted[k], recording)
                    recordings[k] = recording
                done += len(batch)
                bar.move_to(done)
        return [recordings[k] for k in range(len(wanted))]

    def _batches(self, wanted: Sequence[Wanted], missing: Sequence[int]) -> Iterator[list[int]]:
        """Those that can be crossed side by side; on the CPU one a time, so that what is done is stored."""
        for kind in dict.fromkeys(wanted[k].kind for k in missing):
            numbers = [k for k in missing if wanted[k].kind == kind]
            yield from (numbers[k : k + self._at_once] for k in range(0, len(numbers), self._at_once))

    def _key(self, wanted: Wanted) -> str:
        """Hash of all that a recording depends on."""
        ground = wanted.ground
        maps = [] if ground is None else [ground.friction, ground.time_constant_s, ground.rows]
        arrays = [array.astype(np.float32).tobytes().hex() for array in (wanted.terrain, *maps)]
        parts = [
            *self._about,
            controller_hash(wanted.policy) or wanted.policy,
            identity(wanted.space, get_space(wanted.space).sha256),
            wanted.terrain_seed,
            wanted.replicas,
            arrays,
        ]
        return hashlib.sha256(json.dumps(parts).encode()).hexdigest()[:32]
