"""Recorded crossings of elites, kept on disk: what is there is read, what is missing is crossed, one terrain a time.

A file carries in its name the hash of all that it depends on, so that none can be out of date.
"""

import hashlib
import json
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qd.run.progress import share_bar
from qd.show.replay import REPLAY_STREAM
from qd.workers.evaluator import episode_seeds
from sim.files.provenance import code_fingerprint
from sim.policy.spec import controller_hash
from sim.recording.file import read_recording, write_recording
from sim.recording.recorder import Recording, record
from sim.robots.own import robot_digest
from sim.robots.robot import RobotCfg

_SEED = 0
_ROOMS = ("kernels", "sim")


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """A terrain to be crossed by a controller."""

    label: str
    """What it is, in words."""
    genes: NDArray[np.float32]
    """Shape (64,)."""
    number: int
    """Of the elite; its episodes follow from it."""
    policy: str
    """The controller."""

    @property
    def seeds(self) -> NDArray[np.uint32]:
        """Seed of its episodes, shape (1,): those of `make replay ELITE=N`, whoever crosses it."""
        return episode_seeds(_SEED, self.number, 1, stream=REPLAY_STREAM)


Record = Callable[[Wanted, Callable[[float], None]], Recording]
"""Crosses a terrain, telling the share that is done."""


@dataclass(frozen=True, kw_only=True)
class Place:
    """Where and how often terrains are crossed."""

    robot: RobotCfg
    device: str
    """Warp device name."""
    episodes: int
    """Crossings of each."""
    folder: Path
    """Where recordings are kept; made with the first."""


def recorder(place: Place) -> Record:
    """What crosses terrains by simulation; a controller is loaded once, when it is first needed.

    Args:
        place: Where and how often.
    """
    from sim.rollout import Rollout

    rollouts: dict[str, Rollout] = {}

    def cross(wanted: Wanted, progress: Callable[[float], None]) -> Recording:
        if wanted.policy not in rollouts:
            rollouts[wanted.policy] = Rollout(
                place.robot, wanted.policy, num_terrains=1, num_replicas=place.episodes, device=place.device
            )
        _, recording = record(
            rollouts[wanted.policy], wanted.genes[None], wanted.seeds, policy=wanted.policy, labels=[wanted.label],
            seed=_SEED, progress=progress,
        )  # fmt: skip
        return recording

    return cross


def cross_all(wanted: Sequence[Wanted], place: Place, cross: Record) -> list[Recording]:
    """Recordings of all that is wanted, in its order.

    Args:
        wanted: Terrains and who is to cross them.
        place: Where and how often.
        cross: Crosses what is not kept yet.

    Raises:
        OSError: If a recording cannot be written; those before it are kept.
    """
    files = _files_of(wanted, place)
    found = [_kept(file) for file in files]
    missing = [k for k, recording in enumerate(found) if recording is None]
    if not missing:
        return [recording for recording in found if recording is not None]
    place.folder.mkdir(parents=True, exist_ok=True)
    with share_bar(f"crossing {len(missing)} terrains, {place.episodes} times each") as progress:
        for done, k in enumerate(missing):
            recording = cross(wanted[k], lambda share, done=done: progress((done + share) / len(missing)))
            write_recording(files[k], recording)
            found[k] = recording
            progress((done + 1) / len(missing))
    return [recording for recording in found if recording is not None]


def _files_of(wanted: Sequence[Wanted], place: Place) -> list[Path]:
    kind = "cuda" if place.device.startswith("cuda") else "cpu"  # which differ in their last bits
    common = [place.robot.name, robot_digest(place.robot), place.episodes, kind, code_fingerprint(_ROOMS)]
    files = []
    for one in wanted:
        genes = hashlib.sha256(one.genes.astype(np.float32).tobytes()).hexdigest()
        named = None if Path(one.policy).is_file() else one.policy
        identity = [*common, named, controller_hash(one.policy), genes, int(one.seeds[0]), one.label]
        digest = hashlib.sha256(json.dumps(identity).encode()).hexdigest()
        files.append(place.folder / f"elite-{one.number}-{digest[:24]}.npz")
    return files


def _kept(file: Path) -> Recording | None:
    """A recording that is there and whole; of a damaged one it is said that it is made again."""
    try:
        return read_recording(file) if file.is_file() else None
    except ValueError as error:
        print(f"{error}; its terrain is crossed again", flush=True)
        return None
