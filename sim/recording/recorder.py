"""Recorded crossings: what every robot did at every control step, for films, figures and the browser.

A recording is made while a rollout runs its ordinary episodes; nothing is simulated for it. Frame k of an episode is
the state at ``k * dt``: frame 0 the start, the last one the end of the control step in which the episode ended, up to
``dt`` after its end. The frames of an invalid episode end before the step that broke it.

On disk a recording is one npz, read as data, with the fields of :class:`Recording` as arrays of those names, of
``ground`` its maps, ``origin`` as JSON, and ``format`` as its name and version. Heights of terrains given by genes of a
shipped space are made again by the reader; of a space of a user's own it holds both, so that reading runs no code.
"""

import json
import os
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Outcome
from kernels.penalties import COLLISION_FORCE, penalty_columns
from sim.controllers.spec import controller_identity
from sim.files.atomic import write_atomically
from sim.files.npz import npz_bytes, read_arrays
from sim.files.provenance import provenance
from sim.recording.frames import FRAME_ARRAYS, Frames
from sim.robots.robot import RobotCfg
from sim.rollout import Rollout, RolloutResult
from sim.terrains.bank import make_heights
from sim.terrains.spaces.registry import get_space, is_user_space
from sim.terrains.terrains import GroundMaps, Terrains

FORMAT = "faultline recording 4"
"""Name and version in every file."""
_MAPS = tuple(field.name for field in fields(GroundMaps))
_EPISODE_ARRAYS = ("outcome", "invalidity", "fallen", "duration_s", "deviation")
_MAX_FORCE = 60_000.0  # [N]; what a float16 can hold


@dataclass(frozen=True, kw_only=True, eq=False)
class Recording(Frames):
    """Frames of T terrains, K episodes of each, with all that is known of them."""

    robot: str
    joint_names: tuple[str, ...]
    """Of the J joints."""
    foot_names: tuple[str, ...]
    """Of the geoms of the feet."""
    geom_names: tuple[str, ...]
    """Of the G geoms whose touch is known: base, limbs and feet."""
    penalty_names: tuple[str, ...]
    """Of the P penalties."""
    dt: float
    """Control step [s]."""
    labels: tuple[str, ...]
    """What each terrain is, in words, shape (T,)."""
    genes: NDArray[np.float32] | None
    """Genes, shape (T, num_genes), of terrains that were given by them."""
    seeds: NDArray[np.uint32]
    """Seed of each terrain's episodes, shape (T,)."""
    outcome: NDArray[np.uint8]
    """:class:`kernels.episode.Outcome` of each episode, shape (T, K)."""
    invalidity: NDArray[np.uint8]
    """:class:`kernels.episode.Invalidity` of each episode, shape (T, K)."""
    fallen: NDArray[np.bool_]
    """Tilt above 60 degrees at the end, shape (T, K)."""
    duration_s: NDArray[np.float32]
    """Simulated time up to the end [s], shape (T, K)."""
    deviation: NDArray[np.float32]
    """Largest distance from the straight line between start and goal [m], shape (T, K)."""
    origin: dict[str, Any]
    """Of :func:`sim.controllers.spec.controller_identity` and :func:`sim.files.provenance.provenance`."""

    @property
    def num_episodes(self) -> int:
        """K."""
        return self.outcome.shape[1]

    def select_terrain(self, terrain: int) -> "Recording":
        """The recording of the terrain of one index alone."""
        return replace(self[terrain : terrain + 1], labels=(self.labels[terrain],))

    def result(self) -> RolloutResult:
        """What came of the recorded episodes; positions are those of the last frame, what they took is not known."""
        ends = (*np.indices(self.num_frames.shape), np.maximum(self.num_frames - 1, 0))
        invalid = (self.outcome == Outcome.INVALID)[..., None]
        return RolloutResult(
            penalties=np.where(invalid, np.nan, self.penalties[ends].astype(np.float64)),
            penalty_names=self.penalty_names,
            final_position=self.base_position[ends],
            **{name: getattr(self, name) for name in _EPISODE_ARRAYS},
        )

    def qpos(self, terrain: int, episode: int) -> NDArray[np.float64]:
        """MuJoCo's coordinates of an episode: position, quaternion w x y z, joints; shape (its frames, 7 + J)."""
        frames = slice(self.num_frames[terrain, episode])
        parts = (self.base_position, self.base_quaternion, self.joint_position)
        return np.concatenate([part[terrain, episode, frames].astype(np.float64) for part in parts], axis=1)


class RolloutRecorder:
    """Crosses lots of terrains by a rollout, one after the other; its results have the frames of all episodes.

    The episodes are those that the rollout would run without it. On the host a frame of an episode takes some 110
    bytes: 4,000 whole episodes are half a gigabyte.
    """

    def __init__(self, rollout: Rollout) -> None:
        robot = rollout.robot
        self._rollout = rollout
        self._feet = [robot.geom_names.index(name) for name in robot.foot_geoms]
        self._num_base = len(robot.base_geoms)  # the first ones
        self._columns = penalty_columns(robot.penalties)
        self._pending: deque[Terrains] = deque()

    def put(self, terrains: Terrains) -> None:
        """Queue a lot, which is crossed when it is taken."""
        self._pending.append(terrains)

    def clear(self) -> None:
        """Drop all pending lots."""
        self._pending.clear()

    def take(self, progress: Callable[[float], None] | None = None) -> RolloutResult:
        """Cross the lot that was put in first."""
        terrains = self._pending.popleft()
        shape = len(terrains), self._rollout.replicas
        self._num_frames = np.zeros(len(terrains) * self._rollout.replicas, dtype=np.int32)
        self._ended = np.zeros(len(self._num_frames), dtype=bool)
        self._frames: list[tuple[NDArray[Any], NDArray[Any], dict[str, NDArray[Any]]]] = []
        self._rollout.watch = self._add_frames
        result = self._rollout.evaluate(terrains, progress)
        self._rollout.watch = None
        arrays: dict[str, NDArray[Any]] = {}
        for name, first in self._frames[0][2].items():
            fill, dtype = (False, np.bool_) if first.dtype == np.bool_ else (np.nan, np.float32)
            array = np.full((len(self._num_frames), self._num_frames.max(), *first.shape[1:]), fill, dtype)
            for row, frame, values in self._frames:
                array[row, frame] = values[name]
            arrays[name] = array.reshape(*shape, *array.shape[1:])
        bank = self._rollout.sim.bank
        maps = bank.ground_maps()
        frames = Frames(
            **arrays,
            num_frames=self._num_frames.reshape(shape),
            heights=np.array(bank.heights[: len(terrains)].numpy(), np.float32),  # on the CPU numpy() is a view
            ground=None if maps is None else maps[: len(terrains)],
        )
        return replace(result, frames=frames)

    @np.errstate(over="ignore", invalid="ignore")  # of an episode that broke
    def _add_frames(self, ended: bool) -> None:
        """Add the present state of every robot on its way, or the last of each that ended, unless a step broke it."""
        rollout = self._rollout
        episode = rollout.episode.numpy()
        outcome = rollout.outcome.numpy()
        envs = np.flatnonzero((outcome != Outcome.RUNNING) & (episode >= 0) if ended else outcome == Outcome.RUNNING)
        if ended:
            envs = envs[~self._ended[episode[envs]]]
            self._ended[episode[envs]] = True
            envs = envs[outcome[envs] != Outcome.INVALID]
        if len(envs) == 0:
            return
        row = episode[envs]
        frame = self._num_frames[row]
        joint_q = rollout.sim.joint_q.numpy()[envs]
        force = rollout.sim.geom_force.numpy()[envs]
        force[frame == 0] = 0.0  # at the start there was no step yet, and what is there is of another episode
        command = rollout.command.numpy()[envs]
        touching = np.linalg.norm(force, axis=-1) > COLLISION_FORCE
        if ended:  # the base may have touched in an earlier physics step of the last control step
            hit = outcome[envs] == Outcome.BASE_COLLISION
            touching[hit & ~touching[:, : self._num_base].any(axis=1), : self._num_base] = True
        values = {
            "base_position": joint_q[:, :3],
            "base_quaternion": joint_q[:, [6, 3, 4, 5]],
            "joint_position": joint_q[:, 7:],
            "foot_force": np.clip(force[:, self._feet], -_MAX_FORCE, _MAX_FORCE),
            "penalties": rollout.penalty_sums.numpy()[envs][:, self._columns],
            "command": np.zeros_like(command) if ended else command,
            "touching": touching,
        }
        rounded = {name: values[name].astype(dtype) for name, dtype in FRAME_ARRAYS.items()}
        self._frames.append((row, frame, rounded))
        self._num_frames[row] += 1


def make_recording(
    robot: RobotCfg,
    policy: str,
    terrains: Terrains,
    result: RolloutResult,
    *,
    device: str,
    labels: Sequence[str],
    seed: int = 0,
) -> Recording:
    """The recording of a result with frames; ``seed`` is what the terrains' seeds were drawn with."""
    assert result.frames is not None
    space = {"policy": policy, "space": terrains.space.name, "space_sha256": terrains.space.sha256}
    return Recording(
        robot=robot.name,
        joint_names=robot.joint_names,
        foot_names=robot.foot_geoms,
        geom_names=robot.geom_names,
        penalty_names=robot.penalties,
        dt=robot.control_dt,
        labels=tuple(labels),
        genes=None if terrains.genes is None else terrains.genes.astype(np.float32),
        seeds=terrains.seeds.astype(np.uint32),
        origin={**controller_identity(robot, policy), **space, **provenance(device, seed)},
        **{name: getattr(result, name) for name in _EPISODE_ARRAYS},
        **vars(result.frames),
    )


def write_recording(path: Path, recording: Recording) -> None:
    """Writes a recording, atomically, as an ``.npz`` by custom; equal recordings give equal bytes."""
    values = {**vars(recording), **({} if recording.ground is None else vars(recording.ground))}
    del values["ground"]
    if recording.genes is not None and not is_user_space(recording.origin["space"]):
        del values["heights"]
    values |= {"format": FORMAT, "origin": json.dumps(recording.origin)}
    content = {name: np.asarray(value, FRAME_ARRAYS.get(name)) for name, value in values.items() if value is not None}
    content["geom_names"] = content["geom_names"].astype(str)  # without any they would be floats
    write_atomically(path, npz_bytes(content))


def read_recording(path: str | Path) -> Recording:
    """Reads what :func:`write_recording` wrote, as data; a ValueError if the file is damaged or of another kind."""
    path = Path(path)
    if not os.path.isfile(path):
        raise FileNotFoundError(f"no recording at {path}: commands that show crossings keep theirs in runs/recordings")
    try:
        content = read_arrays(path)
        version = str(content.pop("format", "none"))
        if version != FORMAT:
            raise ValueError(f"its format is {version}, expected '{FORMAT}'")
        values: dict[str, Any] = {"genes": None, **content}
        for name, array in content.items():
            if array.dtype.kind == "U":
                values[name] = tuple(array.tolist()) if array.ndim else str(array)
            elif array.dtype == np.float16:
                values[name] = array.astype(np.float32)
        origin = values["origin"] = json.loads(values["origin"])
        if maps := {name: values.pop(name) for name in _MAPS if name in content}:
            values["ground"] = GroundMaps(**maps)
        if "heights" not in content:
            values["heights"] = make_heights(content["genes"], get_space(origin["space"]))
        values["dt"] = float(content["dt"])
        return Recording(**values)
    except Exception as error:  # zip, zlib, npy headers and JSON answer damage with a dozen types
        raise ValueError(f"{path} must be a recording of crossings, got: {error}: record it again") from None
