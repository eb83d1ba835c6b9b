"""One crossing as it is shown: bodies, touches, forces, command and penalties at every frame, and what happens when."""

from collections import defaultdict
from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from PIL import ImageColor
from scipy.spatial.transform import Rotation

from kernels.episode import Outcome
from qd.show.crossed import find_failure_time, get_ending, leans
from sim.recording.recorder import Recording
from sim.robots.skeleton import Skeleton

_FORCE_LENGTH = 1e-3  # of an arrow [m/N]
_LEAST_FORCE = 5.0  # shown [N]
_COMMAND_HEIGHT = 0.45  # over the base [m]


@dataclass(frozen=True, kw_only=True)
class Crossing:
    """F frames of one episode."""

    dt: float
    """Time between frames [s]."""
    duration_s: float
    """Simulated time up to the end [s]."""
    ending: str
    """Outcome in words, when it came, and whether the robot has fallen."""
    positions: NDArray[np.float64]
    """Origins of the bodies, world [m], shape (F, num_bodies, 3)."""
    quaternions: NDArray[np.float64]
    """Bodies to world, w x y z, shape (F, num_bodies, 4)."""
    forces: NDArray[np.float64]
    """Arrows of the feet's contact forces, begin and end [m], shape (F, num_feet, 2, 3); small forces have length 0."""
    command: NDArray[np.float64]
    """Arrow of the velocity command from above the base, 1 m is 1 m/s, begin and end [m], shape (F, 2, 3)."""
    penalties: NDArray[np.float64]
    """Scaled sums so far, in the archive's order, shape (F, P)."""
    touching: NDArray[np.bool_]
    """Whether each recorded geom touches something, shape (F, num_geoms)."""
    marks: tuple[tuple[float, str], ...]
    """When something happens [s], and what."""
    failure_s: float
    """When it went wrong [s] (:func:`qd.show.crossed.find_failure_time`)."""

    def find_frame(self, time_s: float) -> int:
        """The frame of a time, no further than the last."""
        return min(round(time_s / self.dt), len(self.positions) - 1)


def trace_crossing(
    recording: Recording, replica: int, skeleton: Skeleton, scales: Mapping[str, float]
) -> Crossing | None:
    """One episode of a recording of one terrain; None if it broke before its first frame.

    The penalties that ``scales`` names are shown, divided by them.
    """
    frames = int(recording.num_frames[0, replica])
    if frames == 0:
        return None
    qpos = recording.qpos(0, replica)
    duration_s = float(recording.duration_s[0, replica])
    positions, quaternions = skeleton.body_poses(qpos)
    newtons = recording.foot_force[0, replica, :frames].astype(np.float64)
    is_shown = np.linalg.norm(newtons, axis=-1, keepdims=True) >= _LEAST_FORCE
    arrows = np.where(is_shown, _FORCE_LENGTH * newtons, 0.0)
    shapes = [skeleton.model.geom(name) for name in recording.foot_names]
    bodies = [foot.bodyid[0] - 1 for foot in shapes]
    turns = [Rotation.from_quat(np.roll(quaternions[:, body], -1, axis=-1)) for body in bodies]
    offsets = [turn.apply(foot.pos) for turn, foot in zip(turns, shapes, strict=True)]
    feet = positions[:, bodies] + np.stack(offsets, axis=1)
    yaw = Rotation.from_quat(np.roll(qpos[:, 3:7], -1, axis=-1)).as_euler("ZYX")[:, :1]  # commands are in its frame
    command = recording.command[0, replica, :frames].astype(np.float64) * [1.0, 1.0, 0.0]
    begin = qpos[:, :3] + [0.0, 0.0, _COMMAND_HEIGHT]
    sums = recording.penalties[0, replica, :frames].astype(np.float64)
    columns = [recording.penalty_names.index(name) for name in scales]
    return Crossing(
        dt=recording.dt,
        duration_s=duration_s,
        ending=describe_ending(recording, replica, after=f" after {duration_s:.1f} s"),
        positions=positions,
        quaternions=quaternions,
        forces=np.stack([feet, feet + arrows], axis=2),
        command=np.stack([begin, begin + Rotation.from_euler("Z", yaw).apply(command)], axis=1),
        penalties=sums[:, columns] / np.array([*scales.values()]),
        touching=recording.touching[0, replica, :frames],
        marks=find_marks(recording, replica),
        failure_s=find_failure_time(recording, replica),
    )


def describe_ending(recording: Recording, replica: int, after: str = "") -> str:
    """How an episode of one terrain ended, and whether the robot had fallen then."""
    fallen = " · fallen" if recording.fallen[0, replica] else ""
    return get_ending(recording, replica).label + after + fallen


def find_marks(recording: Recording, replica: int) -> tuple[tuple[float, str], ...]:
    """First stumble, first collision, fall, stuck and end of an episode that has frames, in the order of time.

    Stumbles and collisions are those that the penalties count; a robot without a penalty for collisions has one
    at the first recorded touch of base or limb. It falls when it leans further than the limit for the first time.
    """
    frames = int(recording.num_frames[0, replica])
    sums = recording.penalties[0, replica, :frames]
    grows = dict(zip(recording.penalty_names, (np.diff(sums, axis=0, prepend=sums[:1]) > 0.0).T, strict=True))
    bodies = [k for k, name in enumerate(recording.geom_names) if name not in recording.foot_names]
    touches = recording.touching[0, replica, :frames][:, bodies].any(axis=1)
    events: dict[str, NDArray[np.bool_]] = {
        "first stumble": grows.get("stumble", np.zeros(frames, bool)),
        "first collision": grows.get("collision", touches),
        "fall": leans(recording, replica),
    }
    marks = [(recording.dt * int(np.argmax(when)), label) for label, when in events.items() if when.any()]
    if recording.outcome[0, replica] == Outcome.TIME_OUT and not events["fall"].any():
        marks.append((find_failure_time(recording, replica), "stuck"))
    marks.append((recording.dt * (frames - 1), f"end: {get_ending(recording, replica).label}"))
    return tuple(sorted(marks, key=lambda mark: mark[0]))


def group_episodes(recording: Recording) -> list[tuple[str, list[tuple[int, str]]]]:
    """Numbers of the episodes of one terrain, from 1, and how each ended, by ending, the commonest first."""
    groups = defaultdict[str, list[tuple[int, str]]](list)
    for k in range(recording.num_episodes):
        groups[get_ending(recording, k).label].append((k + 1, f"episode {k + 1}: {describe_ending(recording, k)}"))
    commonest_first = sorted(groups.items(), key=lambda group: -len(group[1]))
    return [(f"{len(members)} of {recording.num_episodes}: {label}", members) for label, members in commonest_first]


def trace_paths(recording: Recording, every: int = 10) -> list[tuple[NDArray[np.float32], tuple[int, ...]]]:
    """The base at every tenth frame and the last [m], (num_points, 3), and the outcome's colour, by episode."""
    colors = [ImageColor.getrgb(get_ending(recording, k).color) for k in range(recording.num_episodes)]
    chosen = [[*range(0, last, every), last] if last >= 0 else [] for last in (recording.num_frames[0] - 1).tolist()]
    return [(recording.base_position[0, k, chosen[k]], color) for k, color in enumerate(colors)]
