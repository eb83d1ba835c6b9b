"""Recorded crossings: what every robot did at every control step, for films, figures and the browser.

A recording is made while a rollout runs its ordinary episodes; nothing is simulated for it. Frame k of an episode is
the state at ``k * dt``: frame 0 the start, the last one the end of the control step in which the episode ended, up to
``dt`` after its end. The frames of an invalid episode end before the step that broke it.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Outcome
from kernels.penalties import COLLISION_FORCE, penalty_columns
from sim.controllers.spec import controller_identity
from sim.files.provenance import provenance
from sim.recording.frames import FRAME_ARRAYS, Frames
from sim.robots.robot import RobotCfg
from sim.rollout import Rollout, RolloutResult
from sim.terrains.ground import GroundMaps
from sim.terrains.terrains import Terrains

_MAX_FORCE = 60_000.0  # [N]; what a float16 can hold


@dataclass(frozen=True, kw_only=True)
class Recording:
    """T terrains, K episodes of each, up to F frames of each; NaN from ``num_frames`` on."""

    robot: str
    joint_names: tuple[str, ...]
    """Of the J joints."""
    foot_names: tuple[str, ...]
    """Of the geoms of the feet."""
    penalty_names: tuple[str, ...]
    """Of the P penalties."""
    dt: float
    """Control step [s]."""
    labels: tuple[str, ...]
    """What each terrain is, in words, shape (T,)."""
    heights: NDArray[np.float32]
    """Height grids [m], shape (T, nrow, ncol), row along y, column along x, 0.05 m apart."""
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
    num_frames: NDArray[np.int32]
    """Frames of each episode, shape (T, K)."""
    base_position: NDArray[np.float32]
    """World-local [m], shape (T, K, F, 3)."""
    base_quaternion: NDArray[np.float32]
    """Base to world frame, w x y z as MuJoCo has it, shape (T, K, F, 4)."""
    joint_position: NDArray[np.float32]
    """[rad], shape (T, K, F, J)."""
    foot_force: NDArray[np.float32]
    """Contact force on each foot in the last physics step, world frame [N], shape (T, K, F, num_feet, 3)."""
    penalties: NDArray[np.float32]
    """Raw penalty sums so far, times the physics step, shape (T, K, F, P)."""
    command: NDArray[np.float32]
    """Command of the coming control step: v_x, v_y [m/s], yaw rate [rad/s], yaw frame; 0 once ended; (T, K, F, 3)."""
    origin: dict[str, Any]
    """Of :func:`sim.controllers.spec.controller_identity` and :func:`sim.files.provenance.provenance`."""
    geom_names: tuple[str, ...]
    """Of the G geoms whose touch is known: base, limbs and feet."""
    touching: NDArray[np.bool_]
    """Whether each geom was pushed with more than 0.1 N in the last physics step, shape (T, K, F, G); the base's also
    where its collision ended the episode, whenever in the last control step that was. False from ``num_frames`` on."""
    ground: GroundMaps | None = None
    """Friction and softness of the terrains; None where ground is as always."""

    @property
    def num_episodes(self) -> int:
        """K."""
        return self.outcome.shape[1]

    def select_terrain(self, terrain: int) -> "Recording":
        """The recording of the terrain of one index alone."""
        row = slice(terrain, terrain + 1)
        frames = int(self.num_frames[terrain].max())
        cut = {name: getattr(self, name)[row, :, :frames] for name in (*FRAME_ARRAYS, "touching")}
        each = ("labels", "heights", "seeds", "outcome", "invalidity", "fallen", "duration_s", "num_frames")
        given = [name for name in ("genes", "ground") if getattr(self, name) is not None]
        return replace(self, **cut, **{name: getattr(self, name)[row] for name in (*each, *given)})

    def result(self) -> RolloutResult:
        """What came of the recorded episodes; positions are those of the last frame, what they took is not known."""
        last = np.maximum(self.num_frames - 1, 0)[..., None, None]
        penalties, position = (
            np.take_along_axis(values, last, axis=2)[:, :, 0] for values in (self.penalties, self.base_position)
        )
        invalid = (self.outcome == Outcome.INVALID)[..., None]
        return RolloutResult(
            penalties=np.where(invalid, np.nan, penalties.astype(np.float64)),
            penalty_names=self.penalty_names,
            outcome=self.outcome,
            invalidity=self.invalidity,
            fallen=self.fallen,
            duration_s=self.duration_s,
            final_position=position,
        )

    def qpos(self, terrain: int, episode: int) -> NDArray[np.float64]:
        """MuJoCo's coordinates of an episode: position, quaternion w x y z, joints; shape (its frames, 7 + J)."""
        frames = slice(self.num_frames[terrain, episode])
        parts = (self.base_position, self.base_quaternion, self.joint_position)
        return np.concatenate([part[terrain, episode, frames].astype(np.float64) for part in parts], axis=1)


class _Frames:
    """Collects the frames of a rollout's episodes, whichever robots run them (:class:`sim.rollout.Watcher`)."""

    def __init__(self, rollout: Rollout, num_terrains: int) -> None:
        self._rollout = rollout
        robot = rollout.robot
        self._shape = (num_terrains, rollout.replicas)
        self._feet = [robot.geom_names.index(name) for name in robot.foot_geoms]
        self._num_base = len(robot.base_geoms)  # the first ones
        self._columns = penalty_columns(robot.penalties)
        self._num_frames = np.zeros(num_terrains * rollout.replicas, dtype=np.int32)
        self._ended = np.zeros(len(self._num_frames), dtype=bool)
        self._frames: list[tuple[NDArray[Any], NDArray[Any], dict[str, NDArray[Any]]]] = []

    def before_step(self) -> None:
        """Add the present state of every robot on its way as a frame."""
        outcome = self._rollout.outcome.numpy()
        self._add(np.flatnonzero(outcome == Outcome.RUNNING), ended=False)

    def after_step(self) -> None:
        """Add the last frame of every episode that ended; where a step broke the state, there is none."""
        outcome = self._rollout.outcome.numpy()
        episode = self._rollout.episode.numpy()
        ended = np.flatnonzero((outcome != Outcome.RUNNING) & (episode >= 0))
        ended = ended[~self._ended[episode[ended]]]
        self._ended[episode[ended]] = True
        self._add(ended[outcome[ended] != Outcome.INVALID], ended=True)

    def _add(self, envs: NDArray[Any], *, ended: bool) -> None:
        if len(envs) == 0:
            return
        rollout = self._rollout
        row = rollout.episode.numpy()[envs]
        frame = self._num_frames[row]
        joint_q = rollout.sim.joint_q.numpy()[envs]
        force = rollout.sim.geom_force.numpy()[envs]
        force[frame == 0] = 0.0  # at the start there was no step yet, and what is there is of another episode
        command = rollout.command.numpy()[envs]
        values = {
            "base_position": joint_q[:, :3],
            "base_quaternion": joint_q[:, [6, 3, 4, 5]],
            "joint_position": joint_q[:, 7:],
            "foot_force": np.clip(force[:, self._feet], -_MAX_FORCE, _MAX_FORCE),
            "penalties": rollout.penalty_sums.numpy()[envs][:, self._columns],
            "command": np.zeros_like(command) if ended else command,
        }
        with np.errstate(over="ignore", invalid="ignore"):  # of an episode that broke
            rounded = {name: values[name].astype(dtype) for name, dtype in FRAME_ARRAYS.items()}
            rounded["touching"] = np.linalg.norm(force, axis=-1) > COLLISION_FORCE
        if ended:  # the base may have touched in an earlier physics step of the last control step
            hit = rollout.outcome.numpy()[envs] == Outcome.BASE_COLLISION
            missed = hit & ~rounded["touching"][:, : self._num_base].any(axis=1)
            rounded["touching"][missed, : self._num_base] = True
        self._frames.append((row, frame, rounded))
        self._num_frames[row] += 1

    def frames(self, heights: NDArray[np.float32], ground: GroundMaps | None) -> Frames:
        """All frames once the episodes are over."""
        longest = int(self._num_frames.max())
        arrays: dict[str, NDArray[Any]] = {}
        for name, first in self._frames[0][2].items():
            fill, dtype = (np.nan, np.float32) if name in FRAME_ARRAYS else (False, np.bool_)
            array = np.full((len(self._num_frames), longest, *first.shape[1:]), fill, dtype)
            for row, frame, values in self._frames:
                array[row, frame] = values[name]
            arrays[name] = array.reshape(*self._shape, *array.shape[1:])
        return Frames(
            num_frames=self._num_frames.reshape(self._shape), arrays=arrays, heights=heights, ground=ground
        )


class RolloutRecorder:
    """Crosses lots of terrains by a rollout, one after the other; its results have the frames of all episodes.

    The episodes are those that the rollout would run without it. On the host a frame of an episode takes some 110
    bytes: 4,000 whole episodes are half a gigabyte.
    """

    def __init__(self, rollout: Rollout) -> None:
        self._rollout = rollout
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
        collector = _Frames(self._rollout, len(terrains))
        result = self._rollout.evaluate(terrains, watcher=collector, progress=progress)
        bank = self._rollout.sim.bank
        maps = bank.ground_maps()
        heights: Any = bank.heights[: len(terrains)].numpy()
        frames = collector.frames(
            heights.copy(),  # on the CPU numpy() is a view
            None if maps is None else maps[: len(terrains)],
        )
        return replace(result, frames=frames)


def make_recording(
    robot: RobotCfg,
    policy: str,
    terrains: Terrains,
    result: RolloutResult,
    *,
    device: str,
    labels: Sequence[str] | None = None,
    seed: int = 0,
) -> Recording:
    """The recording of a result with frames; ``seed`` is what the terrains' seeds were drawn with."""
    frames = result.frames
    assert frames is not None
    return Recording(
        robot=robot.name,
        joint_names=robot.joint_names,
        foot_names=robot.foot_geoms,
        penalty_names=robot.penalties,
        geom_names=robot.geom_names,
        dt=robot.control_dt,
        labels=tuple(labels or (f"terrain {k}" for k in range(len(terrains)))),
        heights=frames.heights,
        ground=frames.ground,
        genes=None if terrains.genes is None else terrains.genes.astype(np.float32),
        seeds=terrains.seeds.astype(np.uint32),
        origin={
            **controller_identity(robot, policy),
            "policy": policy,
            "space": terrains.space.name,
            "space_sha256": terrains.space.sha256,
            **provenance(device, seed),
        },
        **{name: getattr(result, name) for name in ("outcome", "invalidity", "fallen", "duration_s")},
        num_frames=frames.num_frames,
        **frames.arrays,
    )
