"""Recorded crossings by what they are of, kept on disk; a file that is not what it should be counts as none."""

import hashlib
import json
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.show.replay import REPLAY_STREAM
from qd.workers.evaluator import episode_seeds
from sim.files.atomic import prepare_output
from sim.files.provenance import code_fingerprint
from sim.policy.spec import controller_hash
from sim.recording.file import read_recording, write_recording
from sim.recording.recorder import Recording
from sim.robots.own import robot_digest
from sim.robots.robot import RobotCfg

_ROOMS = ("kernels", "sim")
"""What a crossing is computed by."""
_KEY_LENGTH = 16


@dataclass(frozen=True, kw_only=True)
class Wanted:
    """The crossings of one elite's terrain with one controller: those that ``make replay`` runs, on the CPU."""

    elite: int
    """Number of the elite, which seeds its episodes."""
    controller: str
    """Its name for the user."""
    policy: str
    """What it is loaded from."""
    replicas: int
    """Episodes."""
    genes: NDArray[np.float32] = field(compare=False)
    """Shape (1, 64)."""

    @property
    def seeds(self) -> NDArray[np.uint32]:
        """Seed of the terrain's episodes, shape (1,)."""
        return episode_seeds(0, self.elite, 1, stream=REPLAY_STREAM)


class Crossings:
    """Recordings on disk: the published ones, and those made here."""

    def __init__(self, robot: RobotCfg, *, cache: Path, published: Path | None = None) -> None:
        """Look at nothing yet.

        Args:
            robot: The robot.
            cache: Folder of recordings made here, by this code with these packages alone.
            published: Folder of recordings that came with the project, whatever made them.

        Raises:
            ValueError: If nothing can be written to ``cache``.
        """
        self._robot = robot
        self._code = f"{code_fingerprint(_ROOMS)} {robot_digest(robot)}"
        self._cache, self._published = cache, published
        self._last: tuple[Wanted, Recording] | None = None
        prepare_output(cache / "recording.npz")

    def read(self, wanted: Wanted) -> Recording | None:
        """The recording of some crossings; None if there is none, or what is there is damaged or of something else.

        Of a controller whose code has no file nothing is known from one run to the next: only its last one is found.
        """
        if self._last is not None and self._last[0] == wanted:
            return self._last[1]
        for file in self._files(wanted):
            try:
                recording = read_recording(file)
            except (OSError, ValueError):
                continue
            if self._is(recording, wanted):
                return recording
        return None

    def write(self, wanted: Wanted, recording: Recording) -> None:
        """Keep a recording.

        Raises:
            OSError: If it cannot be written.
        """
        self._last = (wanted, recording)
        if controller_hash(wanted.policy) is not None:
            write_recording(self.cache_file(wanted), recording)

    def cache_file(self, wanted: Wanted) -> Path:
        """Where the recording of some crossings is kept; another file with other code or packages."""
        return self._cache / f"{self._key(wanted, self._code)}.npz"

    def published_file(self, wanted: Wanted) -> Path | None:
        """Where a published recording of some crossings would be."""
        return None if self._published is None else self._published / f"{self._key(wanted, '')}.npz"

    def _files(self, wanted: Wanted) -> list[Path]:
        if controller_hash(wanted.policy) is None:
            return []
        files = (self.cache_file(wanted), self.published_file(wanted))
        return [file for file in files if file is not None]

    def _key(self, wanted: Wanted, code: str) -> str:
        model = hashlib.sha256(self._robot.model_file.read_bytes()).hexdigest()
        identity: list[Any] = [self._robot.name, model, controller_hash(wanted.policy), wanted.seeds.tolist()]
        identity += [wanted.replicas, wanted.genes.tobytes().hex(), code]
        return hashlib.sha256(json.dumps(identity).encode()).hexdigest()[:_KEY_LENGTH]

    def _is(self, recording: Recording, wanted: Wanted) -> bool:
        """Whether a recording is of just these crossings; a file may have been renamed."""
        return (
            recording.robot == self._robot.name
            and recording.joint_names == self._robot.joint_names
            and recording.origin.get("policy_sha256") == controller_hash(wanted.policy)
            and recording.genes is not None
            and np.array_equal(recording.genes, wanted.genes)
            and np.array_equal(recording.seeds, wanted.seeds)
            and np.array_equal(recording.replicas, np.arange(wanted.replicas))
        )
