"""Recorded crossings, kept on disk. Those that are missing are crossed.

The name of a file is the hash of all that its crossings depend on: terrain, seed, number of episodes, controller, robot
and code. So no file is ever out of date, and what one command recorded the others find.
"""

import hashlib
import json
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import reduce
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.run.directory import RUNS
from qd.run.progress import share_bar
from qd.workers.evaluator import episode_seeds
from sim.files.records import code_fingerprint, robot_identity
from sim.policy.spec import controller_hash

if TYPE_CHECKING:
    from sim.ground import GroundMaps
    from sim.recording.recorder import Recording
    from sim.robots.robot import RobotCfg

FOLDER = RUNS / "recordings"
"""Where recordings are kept."""
AT_ONCE = 32
"""Terrains crossed side by side on a GPU."""
_ROOMS = ("kernels", "sim")  # what a crossing is computed by
_STREAM, _OWN_STREAM = 2, 4  # of the seeds of episodes on elites, and on a user's own terrains
_KEY_LENGTH = 16


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """Crossings of one terrain by one controller."""

    label: str = field(compare=False)
    """What the terrain is, in words."""
    terrain: NDArray[np.float32] = field(compare=False)
    """Genes, shape (num_genes,), or heights [m], shape (nrow, ncol)."""
    policy: str
    """The controller."""
    replicas: int
    """Episodes."""
    seed: int = 0
    """What ``terrain_seed`` was drawn with, for the record."""
    terrain_seed: int
    """Seed of the terrain's episodes."""
    space: str = "super_gaussian"
    """Terrain space of genes, as :func:`sim.spaces.registry.load_space` takes it."""
    ground: "GroundMaps | None" = field(default=None, compare=False)
    """Friction and softness beside heights."""

    def __post_init__(self) -> None:
        if self.replicas < 1 or self.seed < 0:
            raise ValueError(f"episodes must be at least 1 and seed at least 0, got {self.replicas} and {self.seed}")


def on_elite(
    archive: Archive,
    number: int,
    *,
    policy: str,
    replicas: int,
    seed: int = 0,
    label: str | None = None,
    minimal: NDArray[np.float32] | None = None,
) -> Wanted:
    """The crossings of an elite, or of its minimal terrain, that ``faultline replay`` shows.

    Args:
        archive: That it is of.
        number: Its number.
        policy: The controller.
        replicas: Episodes.
        seed: Other episodes for another seed.
        label: What the terrain is, in words.
        minimal: Genes of its minimal terrain, which is crossed from the same starts.

    Raises:
        ValueError: If a number is out of range, or the terrain space is not at hand.
    """
    from sim.spaces.registry import get_space

    return Wanted(
        label=label or f"{'' if minimal is None else 'minimal terrain of '}elite {number} of {archive.robot}",
        terrain=archive.genes[number] if minimal is None else minimal,
        policy=policy,
        replicas=replicas,
        seed=seed,
        terrain_seed=int(episode_seeds(max(seed, 0), number, 1, stream=_STREAM)[0]),
        space=get_space(archive.space, archive.space_sha256).name,
    )


def on_heights(
    heights: NDArray[np.float32],
    *,
    label: str,
    policy: str,
    replicas: int,
    seed: int,
    ground: "GroundMaps | None" = None,
) -> Wanted:
    """Crossings of a user's own terrain, with its ground; arguments and errors as of :func:`on_elite`."""
    drawn = int(episode_seeds(max(seed, 0), 0, 1, stream=_OWN_STREAM)[0])
    return Wanted(
        label=label, terrain=heights, policy=policy, replicas=replicas, seed=seed, terrain_seed=drawn, ground=ground
    )


Cross = Callable[[Sequence[Wanted], Callable[[float], None]], "list[Recording]"]
"""Crosses terrains that differ in nothing but the terrain and its seed, telling the share that is done."""


class Simulation:
    """Crosses terrains by simulation; a controller is loaded once.

    Args:
        robot: The robot.
        device: Warp device name.
    """

    def __init__(self, robot: "RobotCfg", device: str) -> None:
        self._robot, self._device = robot, device
        self._rollouts: dict[tuple[str, int, int, str, bool], Any] = {}

    def prepare(self, first: Wanted, count: int = 1) -> Any:
        """The rollout that crosses such terrains, so many at once; built if there is none yet.

        Raises:
            ValueError: If the controller cannot be loaded or does not fit the robot.
        """
        from sim.rollout import Rollout
        from sim.spaces.registry import load_space

        with_ground = first.ground is not None
        kind = (first.policy, count, first.replicas, first.space, with_ground)
        if kind not in self._rollouts:
            self._rollouts[kind] = Rollout(
                self._robot, first.policy, num_terrains=count, num_replicas=first.replicas, device=self._device,
                space=load_space(first.space), with_ground=with_ground,
            )  # fmt: skip
        return self._rollouts[kind]

    def __call__(self, wanted: Sequence[Wanted], progress: Callable[[float], None]) -> "list[Recording]":
        """Recordings of all, in their order.

        Raises:
            ValueError: If the controller cannot be loaded or does not fit the robot.
        """
        from sim.ground import GroundMaps
        from sim.recording.recorder import record

        first = wanted[0]
        grounds = [one.ground for one in wanted if one.ground is not None]
        _, recording = record(
            self.prepare(first, len(wanted)),
            np.stack([one.terrain for one in wanted]),
            np.array([one.terrain_seed for one in wanted], np.uint32),
            policy=first.policy,
            ground=reduce(GroundMaps.joined, grounds) if grounds else None,
            labels=[one.label for one in wanted],
            seed=first.seed,
            progress=progress,
        )
        return [recording.of_terrain(k) for k in range(len(wanted))]


class Recordings:
    """The recordings of a robot that are kept, and the simulation that makes those that are not.

    Args:
        robot: The robot.
        device: Where missing ones are crossed.
        folder: Where they are kept.
        cross: Crosses what is missing; by default a :class:`Simulation`.
    """

    def __init__(
        self, robot: "RobotCfg", *, device: str = "cpu", folder: Path = FOLDER, cross: Cross | None = None
    ) -> None:
        on_gpu = device.startswith("cuda")  # its last bits differ from a CPU's
        self._robot, self._folder = robot, folder
        self._about = robot_identity(robot)
        self._code = f"{code_fingerprint(_ROOMS)}{' cuda' * on_gpu}"
        self._at_once = AT_ONCE if on_gpu else 1
        self._cross = cross or Simulation(robot, device)
        self._last: tuple[Wanted, Recording] | None = None

    def read(self, wanted: Wanted) -> "Recording | None":
        """What is kept of some crossings; None if there is nothing, or it is damaged or of something else.

        Nothing is known of a controller whose code has no file: only its last recording is found.
        """
        from sim.recording.file import read_recording

        if self._last is not None:
            last, recording = self._last
            if last == wanted and last.ground == wanted.ground and np.array_equal(last.terrain, wanted.terrain):
                return recording
        if controller_hash(wanted.policy) is None:
            return None
        try:
            recording = read_recording(self.file_of(wanted))
        except (OSError, ValueError):
            return None
        return replace(recording, labels=(wanted.label,)) if self._is(recording, wanted) else None

    def may_keep(self, wanted: Wanted) -> bool:
        """Whether a recording of these crossings would be found again, and there is no file of them yet."""
        return controller_hash(wanted.policy) is not None and not self.file_of(wanted).exists()

    def keep(self, wanted: Wanted, recording: "Recording") -> None:
        """Keeps a recording; prints a warning if it cannot be written."""
        from sim.recording.file import write_recording

        self._last = (wanted, recording)
        if controller_hash(wanted.policy) is None:
            return
        try:
            self._folder.mkdir(parents=True, exist_ok=True)
            write_recording(self.file_of(wanted), recording)
        except OSError as error:  # it can be shown all the same
            print(f"not kept: {error}", flush=True)

    def all_of(self, wanted: Sequence[Wanted]) -> "list[Recording]":
        """Recordings of all that is wanted, in its order; what is missing is crossed and kept, batch by batch.

        Raises:
            ValueError: If a controller cannot be loaded or does not fit the robot.
        """
        found = {k: recording for k, one in enumerate(wanted) if (recording := self.read(one)) is not None}
        missing = [k for k in range(len(wanted)) if k not in found]
        if not missing:
            return list(found.values())
        words = f"{len(missing)} terrain{'s' * (len(missing) > 1)}, {wanted[missing[0]].replicas} times each"
        with share_bar(f"crossing {words}") as progress:
            done = 0
            for batch in self._batches(wanted, missing):

                def tell(share: float, done: int = done, size: int = len(batch)) -> None:
                    progress((done + share * size) / len(missing))

                for k, recording in zip(batch, self._cross([wanted[k] for k in batch], tell), strict=True):
                    self.keep(wanted[k], recording)
                    found[k] = recording
                done += len(batch)
                progress(done / len(missing))
        return [found[k] for k in range(len(wanted))]

    def _batches(self, wanted: Sequence[Wanted], missing: Sequence[int]) -> Iterator[list[int]]:
        """Those that can be crossed side by side; on the CPU one a time, so that what is done is kept."""
        alike: dict[Any, list[int]] = {}
        for k in missing:
            one = wanted[k]
            with_ground = one.ground is not None
            kind = (one.policy, one.replicas, one.seed, one.space, one.terrain.shape, with_ground)
            alike.setdefault(kind, []).append(k)
        for numbers in alike.values():
            yield from (numbers[k : k + self._at_once] for k in range(0, len(numbers), self._at_once))

    def file_of(self, wanted: Wanted) -> Path:
        """Where the recording of some crossings is kept; another file with other code or packages."""
        from sim.spaces.registry import get_space, identity
        from sim.spaces.super_gaussian import SUPER_GAUSSIAN

        depends_on: list[Any] = [self._about, controller_hash(wanted.policy), [wanted.terrain_seed]]
        depends_on += [wanted.replicas, wanted.terrain.astype(np.float32).tobytes().hex(), self._code]
        if wanted.ground is not None:
            depends_on += [wanted.ground.friction.tobytes().hex(), wanted.ground.time_constant_s.tobytes().hex()]
        if wanted.space != SUPER_GAUSSIAN.name:  # the only one at first, which no name says
            depends_on.append(identity(wanted.space, get_space(wanted.space).sha256))
        key = hashlib.sha256(json.dumps(depends_on).encode()).hexdigest()[:_KEY_LENGTH]
        return self._folder / f"{key}.npz"

    def _is(self, recording: "Recording", wanted: Wanted) -> bool:
        """Whether a recording is of just these crossings; a file may have been renamed."""
        from sim.spaces.registry import get_space, identity

        origin = recording.origin
        terrain = recording.heights if recording.genes is None else recording.genes
        return (
            recording.robot == self._robot.name
            and self._about.items() <= recording.origin.items()
            and recording.joint_names == self._robot.joint_names
            and recording.origin.get("policy_sha256") == controller_hash(wanted.policy)
            and identity(origin.get("space", ""), origin.get("space_sha256"))
            == identity(wanted.space, get_space(wanted.space).sha256)
            and np.array_equal(terrain, wanted.terrain[None])
            and (wanted.ground is None or _same_ground(recording.ground, wanted.ground))
            and recording.seeds.tolist() == [wanted.terrain_seed]
            and np.array_equal(recording.replicas, np.arange(wanted.replicas))
        )


def _same_ground(there: "GroundMaps | None", wanted: "GroundMaps") -> bool:
    if there is None:
        return False
    alike = np.array_equal(there.friction, wanted.friction)
    return alike and np.array_equal(there.time_constant_s, wanted.time_constant_s)
