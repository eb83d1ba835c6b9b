"""Crossings kept on disk, so that a killed evaluation goes on without crossing again what it has crossed.

Every file carries in its name the hash of all that its numbers depend on: controller, terrains, seeds, episodes, kind
of device, code and packages. Nothing in it can be out of date, whichever command asks for it.
"""

import dataclasses
import hashlib
import io
import json
import os
from pathlib import Path
from typing import Any

import numpy as np

from kernels.episode import Outcome
from sim.files.atomic import check_zip, write_atomically
from sim.files.provenance import code_fingerprint
from sim.policy.spec import controller_hash
from sim.rollout import RolloutResult
from train.evaluate.sets import TerrainSet

_ROOMS = ("kernels", "sim")
_ARRAYS = ("penalties", "outcome", "fallen", "duration_s", "final_position", "reward")
_SETTINGS = ("penalty_names", "physics_steps", "wall_s")


def take_terrains(result: RolloutResult, places: np.ndarray) -> RolloutResult:
    """Crossings of some of the terrains, shape (num_places,) of integers, in the order given."""
    arrays = {name: getattr(result, name) for name in _ARRAYS}
    return dataclasses.replace(result, **{name: array[places] for name, array in arrays.items() if array is not None})


class KeptCrossings:
    """A folder of crossings.

    Args:
        folder: Where they are kept; made when the first is written.
        robot: Name of the robot.
        robot_sha256: Hash of a robot that is not shipped (:func:`sim.robots.own.robot_digest`).
        episodes: Episodes a terrain.
        device: Warp device name; crossings of a CPU and of a GPU differ in their last bits.
    """

    def __init__(
        self, folder: Path, *, robot: str, robot_sha256: str | None = None, episodes: int, device: str
    ) -> None:
        self.folder, self._episodes = folder, episodes
        kind = "cuda" if device.startswith("cuda") else "cpu"
        self._common = [robot if robot_sha256 is None else robot_sha256, episodes, kind, code_fingerprint(_ROOMS)]

    def file(self, policy: str, terrains: TerrainSet) -> Path:
        """Where the crossings of one controller on one set are kept."""
        parts = [hashlib.sha256(part.tobytes()).hexdigest() for part in (terrains.terrains, terrains.seeds)]
        callable_name = None if os.path.isfile(policy) else policy
        identity = [*self._common, callable_name, controller_hash(policy), *parts]
        digest = hashlib.sha256(json.dumps(identity).encode()).hexdigest()
        return self.folder / f"{terrains.name}-{digest[:24]}.npz"

    def read(self, policy: str, terrains: TerrainSet) -> RolloutResult | None:
        """Crossings that are kept; None if there are none, or their file is damaged, which is said."""
        file = self.file(policy, terrains)
        if not file.is_file():
            return None
        try:
            check_zip(file)
            with np.load(file, allow_pickle=False) as content:
                arrays = {name: content[name] for name in _ARRAYS}
                names, steps, wall_s = (content[name] for name in _SETTINGS)
            self._check(arrays, len(terrains), len(names))
        except Exception as error:  # zip, zlib and npy headers answer damage with a dozen types
            print(f"{file} is damaged ({' '.join(str(error).split())}): its terrains are crossed again", flush=True)
            return None
        return RolloutResult(
            **arrays, penalty_names=tuple(names.tolist()), physics_steps=int(steps), wall_s=float(wall_s)
        )

    def write(self, policy: str, terrains: TerrainSet, result: RolloutResult) -> None:
        """Keep crossings.

        Raises:
            OSError: If they cannot be written.
        """
        self.folder.mkdir(parents=True, exist_ok=True)
        buffer = io.BytesIO()
        content: dict[str, Any] = {name: np.asarray(getattr(result, name)) for name in (*_ARRAYS, *_SETTINGS)}
        np.savez_compressed(buffer, **content)
        write_atomically(self.file(policy, terrains), buffer.getvalue())

    def _check(self, arrays: dict[str, np.ndarray], num_terrains: int, num_penalties: int) -> None:
        """That arrays are such as a rollout gives; bits that flipped before they were written have no checksum."""
        shape = (num_terrains, self._episodes)
        widths = {"penalties": (num_penalties,), "final_position": (3,)}
        for name, array in arrays.items():
            if array.shape != (*shape, *widths.get(name, ())):
                raise ValueError(f"{name} of shape {array.shape} for {shape[0]} terrains of {shape[1]} episodes")
        valid = arrays["outcome"] != Outcome.INVALID
        if not all(np.isfinite(arrays[name][valid]).all() for name in ("penalties", "reward")):
            raise ValueError("valid episodes with numbers that are not finite")
