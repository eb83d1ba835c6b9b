"""One crossing as it is shown: bodies, touches, forces, command and penalties at every frame, and what happens when."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import ImageColor

from qd.show.crossed import ending_of
from qd.show.figures import label_of
from sim.crossing import FALLEN_TILT_DEG
from sim.recording.recorder import Recording
from sim.robots.skeleton import Skeleton

_FORCE_LENGTH = 1e-3  # of an arrow [m/N]
_LEAST_FORCE = 5.0  # shown [N]
_COMMAND_LENGTH = 1.0  # of an arrow [m/(m/s)]
_COMMAND_HEIGHT = 0.45  # over the base [m]


class Mark(NamedTuple):
    """Something that happened, on the timeline."""

    time_s: float
    """When [s]."""
    words: str


@dataclass(frozen=True, kw_only=True)
class Crossing:
    """F frames of one episode."""

    dt: float
    """Time between frames [s]."""
    duration_s: float
    """Simulated time up to the end [s]."""
    ending: str
    """Outcome in words, and whether the robot had fallen."""
    positions: NDArray[np.float64]
    """Origins of the bodies, world [m], shape (F, num_bodies, 3)."""
    quaternions: NDArray[np.float64]
    """Bodies to world, w x y z, shape (F, num_bodies, 4)."""
    forces: NDArray[np.float64]
    """Arrows of the feet's contact forces, begin and end [m], of no length where there is none, (F, num_feet, 2, 3)."""
    force_newtons: NDArray[np.float64]
    """Their size [N], shape (F, num_feet)."""
    command: NDArray[np.float64]
    """Arrow of the velocity command, begin and end [m], shape (F, 2, 3)."""
    command_values: NDArray[np.float64]
    """v_x, v_y [m/s], yaw rate [rad/s], yaw frame, shape (F, 3)."""
    penalties: NDArray[np.float64]
    """Scaled sums so far, in the archive's order, shape (F, P)."""

    touching: NDArray[np.bool_] | None
    """Whether each recorded geom touches something, shape (F, num_geoms); None where that was not recorded."""
    marks: tuple[Mark, ...]
    """First stumble, first collision, fall and end, in the order of time."""

    @property
    def num_frames(self) -> int:
        """F."""
        return len(self.positions)

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Time of each frame [s], shape (F,)."""
        return self.dt * np.arange(self.num_frames, dtype=np.float64)


def crossing_of(
    recording: Recording, replica: int, skeleton: Skeleton, penalties: Sequence[str], scales: Sequence[float]
) -> Crossing | None:
    """One episode of a recording of one terrain; None of an episode that broke before its first frame.

    Args:
        recording: The recording.
        replica: Number of the episode.
        skeleton: The robot's.
        penalties: Names of the penalties to show, all of them recorded.
        scales: What to divide each by.
    """
    frames = int(recording.num_frames[0, replica])
    if frames == 0:
        return None
    qpos = recording.qpos(0, replica)
    positions, quaternions = skeleton.body_poses(qpos)
    newtons = recording.foot_force[0, replica, :frames].astype(np.float64)
    size = np.linalg.norm(newtons, axis=-1)
    arrows = np.where(size[..., None] >= _LEAST_FORCE, _FORCE_LENGTH * newtons, 0.0)
    feet = _foot_positions(recording, skeleton, positions, quaternions)
    command = recording.command[0, replica, :frames].astype(np.float64)
    columns = [recording.penalty_names.index(name) for name in penalties]
    return Crossing(
        dt=recording.dt,
        duration_s=float(recording.duration_s[0, replica]),
        ending=ending_words(recording, replica),
        positions=positions,
        quaternions=quaternions,
        forces=np.stack([feet, feet + arrows], axis=2),
        force_newtons=size,
        command=_command_arrows(qpos, command),
        command_values=command,
        penalties=recording.penalties[0, replica, :frames][:, columns].astype(np.float64) / np.asarray(scales),
        touching=None if recording.touching is None else recording.touching[0, replica, :frames],
        marks=marks_of(recording, replica),
    )


def ending_words(recording: Recording, replica: int) -> str:
    """How an episode of one terrain ended, and whether the robot had fallen then."""
    fallen = " · fallen" if recording.fallen[0, replica] else ""
    return ending_of(recording.outcome[0, replica]).words + fallen


def marks_of(recording: Recording, replica: int) -> tuple[Mark, ...]:
    """What happens in an episode of one terrain that has frames, in the order of time; what never happens has no mark.

    A stumble and a collision are those that the penalties count; a robot that is not penalised for collisions has one
    at the first recorded touch of base or limb. It falls when it leans further than the limit for the first time.

    Args:
        recording: The recording.
        replica: Number of the episode.
    """
    frames = int(recording.num_frames[0, replica])
    happened = {
        "first stumble": _grows(recording, replica, "stumble"),
        "first collision": _collides(recording, replica),
        "fall": _upright(recording.base_quaternion[0, replica, :frames]) < np.cos(np.deg2rad(FALLEN_TILT_DEG)),
    }
    found = [Mark(recording.dt * int(np.argmax(when)), words) for words, when in happened.items() if when.any()]
    found.append(Mark(recording.dt * (frames - 1), f"end: {ending_of(recording.outcome[0, replica]).words}"))
    return tuple(sorted(found, key=lambda mark: mark.time_s))


def _grows(recording: Recording, replica: int, penalty: str) -> NDArray[np.bool_]:
    """Frames up to which a penalty has grown since the one before; none of a penalty that is not recorded."""
    frames = int(recording.num_frames[0, replica])
    if penalty not in recording.penalty_names:
        return np.zeros(frames, dtype=bool)
    sums = recording.penalties[0, replica, :frames, recording.penalty_names.index(penalty)]
    return np.asarray(np.diff(sums, prepend=sums[:1]) > 0.0)


def _collides(recording: Recording, replica: int) -> NDArray[np.bool_]:
    if "collision" in recording.penalty_names or recording.touching is None:
        return _grows(recording, replica, "collision")
    bodies = [k for k, name in enumerate(recording.geom_names) if name not in recording.foot_names]
    touching = recording.touching[0, replica, : int(recording.num_frames[0, replica]), bodies]  # geoms come first
    return np.asarray(touching.any(axis=0))


def _upright(quaternions: NDArray[np.floating]) -> NDArray[np.float64]:
    """Cosine of the tilt of a base."""
    return rotated(quaternions, np.array([0.0, 0.0, 1.0]))[..., 2]


def next_mark(marks: Sequence[Mark], time_s: float) -> Mark:
    """The first mark after a time [s]; after the last one it is the first again."""
    return next((mark for mark in marks if mark.time_s > time_s + 1e-6), marks[0])


def episodes_by_outcome(recording: Recording) -> dict[str, list[int]]:
    """Episodes of one terrain by what they have in common, in words with their number; all of them first."""
    count = recording.num_episodes
    found = {f"all {count} episodes": list(range(count))}
    by_ending = Counter(map(ending_of, recording.outcome[0].tolist()))
    for ending, number in by_ending.most_common():
        alike = [k for k, outcome in enumerate(recording.outcome[0].tolist()) if ending_of(outcome) == ending]
        found[f"the {number} that ended: {ending.words}"] = alike
    fallen = np.flatnonzero(recording.fallen[0]).tolist()
    return found | ({f"the {len(fallen)} that fell": fallen} if fallen else {})


def rotated(quaternions: NDArray[np.floating], vectors: NDArray[np.floating]) -> NDArray[np.float64]:
    """Vectors turned by unit quaternions w x y z; leading axes broadcast."""
    w, axis = quaternions[..., :1], quaternions[..., 1:]
    twice = 2.0 * np.cross(axis, vectors)
    return vectors + w * twice + np.cross(axis, twice)


def _foot_positions(
    recording: Recording, skeleton: Skeleton, positions: NDArray[np.float64], quaternions: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Centres of the feet's shapes [m], shape (F, num_feet, 3)."""
    feet = [skeleton.geom(name) for name in recording.foot_names]
    bodies = [foot.body for foot in feet]
    centres = np.stack([foot.position for foot in feet])
    return positions[:, bodies] + rotated(quaternions[:, bodies], centres)


def _command_arrows(qpos: NDArray[np.float64], command: NDArray[np.float64]) -> NDArray[np.float64]:
    """The commanded velocity, from above the base; the command is given in the frame of the base's yaw."""
    forward = rotated(qpos[:, 3:7], np.array([1.0, 0.0, 0.0]))
    yaw = np.arctan2(forward[:, 1], forward[:, 0])
    x = np.cos(yaw) * command[:, 0] - np.sin(yaw) * command[:, 1]
    y = np.sin(yaw) * command[:, 0] + np.cos(yaw) * command[:, 1]
    begin = qpos[:, :3] + np.array([0.0, 0.0, _COMMAND_HEIGHT])
    return np.stack([begin, begin + _COMMAND_LENGTH * np.stack([x, y, np.zeros_like(x)], axis=1)], axis=1)


def paths_of(recording: Recording, every: int = 10) -> list[tuple[NDArray[np.float32], tuple[int, int, int]]]:
    """Way of the base in every episode: points [m], shape (num_points, 3), and the colour of its outcome.

    Args:
        recording: Of one terrain.
        every: Frames from one point to the next.
    """
    found = []
    for replica in range(recording.num_episodes):
        frames = int(recording.num_frames[0, replica])
        points = recording.base_position[0, replica, :frames]
        chosen = np.unique([*range(0, frames, every), frames - 1]) if frames else []
        color = ending_of(recording.outcome[0, replica]).color
        found.append((points[chosen], ImageColor.getrgb(color)))
    return found


def endings(recording: Recording) -> str:
    """How many episodes of one terrain ended how, such as ``12 out of time, 8 base collision``, in colours, as HTML."""
    counts = Counter(map(ending_of, recording.outcome[0].tolist()))
    return ", ".join(
        f'<span style="color:{ending.color}">{count} {ending.words}</span>' for ending, count in counts.most_common()
    )


def moment_text(crossing: Crossing, frame: int, penalties: Sequence[str], feet: Sequence[str]) -> str:
    """The numbers of a frame, as Markdown: penalties so far, forces of the feet, command, height.

    Args:
        crossing: The crossing.
        frame: Which frame.
        penalties: Names of the penalties.
        feet: Names of the feet.
    """
    v_x, v_y, yaw_rate = crossing.command_values[frame]
    forces = " · ".join(
        f"{name} {newtons:,.0f}" for name, newtons in zip(feet, crossing.force_newtons[frame], strict=True)
    )
    x, y, z = crossing.positions[frame, 0]
    sums = zip(penalties, crossing.penalties[frame], strict=True)
    rows = [f"| {label_of(name)} | {value:.2f} |" for name, value in sums]
    return "\n".join(
        [
            "| penalty so far | multiples of its scale |",
            "|---|---|",
            *rows,
            "",
            f"Forces on the feet [N]: {forces}",
            "",
            f"Command: {v_x:.2f}, {v_y:.2f} m/s, {yaw_rate:.2f} rad/s · base at {x:.2f}, {y:.2f}, {z:.2f} m",
        ]
    )
