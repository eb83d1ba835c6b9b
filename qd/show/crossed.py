"""Recorded crossings in numbers and figures: how they ended, and where."""

import textwrap
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from kernels.episode import FALLEN_GRAVITY_Z, Kind, Outcome
from sim.files.figures import new_figure
from sim.files.intervals import format_rate, wilson_interval
from sim.rates import typical_outcome, way_to_end
from sim.recording.recorder import Recording
from sim.robots.robot import ROBOTS
from sim.terrains.maps.picture import LENGTH, MARKS, SLIPPERY, SOFT, draw_heights, places
from sim.terrains.terrains import asked_of


class Ending(NamedTuple):
    """How an episode ended, with a label and looks that the colour-blind tell apart: Okabe and Ito's colours."""

    label: str
    color: str = "#5a5a5a"
    marker: str = ""
    line: str = ""  # of the path


_LOOKS = {
    Outcome.GOAL: ("#009e73", "o", "-"),
    Outcome.BASE_COLLISION: ("#d55e00", "X", "--"),
    Outcome.TIME_OUT: ("#0072b2", "s", "-."),
    Outcome.OUT: ("#cc79a7", "^", ":"),
    Outcome.TILT: ("#e69f00", "v", "--"),
    Outcome.STRAYED: ("#f0e442", "D", ":"),
}


def all_endings(asks: Kind) -> dict[Outcome, Ending]:
    """How a valid episode of robots that are asked for something may end, the good way first."""
    return {outcome: Ending(way_to_end(outcome, asks), *look) for outcome, look in _LOOKS.items()}


def get_ending(recording: Recording, episode: int) -> Ending:
    """How an episode of one terrain ended, a valid one or not."""
    outcome = Outcome(recording.outcome[0, episode])
    return Ending(way_to_end(outcome, asked_of(recording.ground)), *_LOOKS.get(outcome, ()))


class Rate(NamedTuple):
    """Hits among episodes."""

    hits: int
    count: int

    def __str__(self) -> str:
        return format_rate(self.hits, self.count)

    @property
    def limits(self) -> str:
        """The 95 % Wilson interval: ``0 to 16 %``; 0 to 100 % without an episode."""
        return "{:.0f} to {:.0f} %".format(*(100.0 * limit for limit in wilson_interval(self.hits, self.count)))


def count_rates(recording: Recording) -> dict[str, Rate]:
    """How valid episodes of one terrain ended, by names of rates as a :class:`qd.faults.families.Ranking` has them."""
    outcome = recording.outcome[0]
    valid = outcome != Outcome.INVALID
    goal, collided = outcome == Outcome.GOAL, outcome == Outcome.BASE_COLLISION
    hits = {"goal_rate": goal, "collision_rate": collided, "other_rate": valid & ~goal & ~collided}
    hits["fallen_rate"] = recording.fallen[0] & valid
    return {name: Rate(int(hit.sum()), int(valid.sum())) for name, hit in hits.items()}


_STUCK = 0.3  # a robot is stuck once it is so near to where it ends [m]


def leans(recording: Recording, episode: int) -> NDArray[np.bool_]:
    """At which frames of an episode of one terrain the base leans by more than 60 degrees, shape (frames,)."""
    quaternion = recording.base_quaternion[0, episode, : recording.num_frames[0, episode]].astype(np.float64)
    cosine = 1.0 - 2.0 * (quaternion[:, 1] ** 2 + quaternion[:, 2] ** 2)
    return cosine < -float(FALLEN_GRAVITY_Z)


def find_failure_time(recording: Recording, episode: int) -> float:
    """When an episode of one terrain went wrong [s]: at its base collision, or at a fall before that.

    A robot that ran out of time without a fall got stuck when it first came within 0.3 m of where it ended. Of every
    other episode it is the end. A fall is the one from which the robot did not rise.
    """
    frame = last = max(int(recording.num_frames[0, episode]) - 1, 0)
    outcome = recording.outcome[0, episode]
    if outcome in (Outcome.BASE_COLLISION, Outcome.TIME_OUT, Outcome.OUT):
        upright = np.flatnonzero(~leans(recording, episode))
        fall = int(upright[-1]) + 1 if len(upright) else 0
        if fall <= last:
            frame = fall
        elif outcome == Outcome.TIME_OUT:
            position = recording.base_position[0, episode, : last + 1, :2].astype(np.float64)
            frame = int(np.argmax(np.linalg.norm(position - position[-1], axis=1) <= _STUCK))
    return frame * recording.dt


def find_typical_episode(recording: Recording, scales: dict[str, float], ending: int | None = None) -> int:
    """The episode of median cost among those with the typical outcome, or with a given one."""
    outcome = recording.outcome[0]
    candidates = np.flatnonzero(outcome == (typical_outcome(outcome) if ending is None else ending))
    last = np.maximum(recording.num_frames[0, candidates] - 1, 0)
    sums = recording.penalties[0, candidates, last].astype(np.float64)
    names = recording.penalty_names
    costs = sum(sums[:, names.index(name)] / scale for name, scale in scales.items() if name in names)
    order = np.argsort(np.broadcast_to(costs, len(candidates)), kind="stable")
    return int(candidates[order[(len(candidates) - 1) // 2]])


def find_ghost_episode(recording: Recording, episode: int, scales: dict[str, float]) -> int:
    """The episode of another controller to show beside one: the same start, or if only others arrive a typical one."""
    arrived = recording.outcome[0] == Outcome.GOAL
    return episode if arrived[episode] or not arrived.any() else find_typical_episode(recording, scales, Outcome.GOAL)


def draw_time_line(acting: Sequence[tuple[str, float, float]], recording: Recording) -> Figure:
    """What acts on the robots of one terrain, from when to when [s], and when their episodes went wrong."""
    figure = new_figure(11.0, 0.8 + 0.45 * len(acting))
    axes = figure.subplots()
    for row, (_, first, last) in enumerate(acting):
        if first == last:
            axes.plot([first], [row], "v", color="#d55e00")
        else:
            axes.barh(row, last - first, left=first, height=0.6, color="#56b4e9")
    for episode in np.flatnonzero(~np.isin(recording.outcome[0], (Outcome.GOAL, Outcome.INVALID))):
        axes.axvline(find_failure_time(recording, int(episode)), color="#000000", alpha=0.3, linewidth=1.0)
    labels = [textwrap.fill(text, 52) for text, *_ in acting]
    axes.set_yticks(range(len(acting)), labels=labels, fontsize="small")
    axes.set(xlabel="time [s]; a line where a robot fails", xlim=(0.0, max(last for *_, last in acting) + 0.5))
    axes.set_ylim(len(acting) - 0.5, -0.5)
    return figure


def make_title(recording: Recording, controller: str = "") -> str:
    """A terrain and how most episodes ended on it: ``ANYmal C, elite 313 (trench): topples, 19 of 20``."""
    robot = ROBOTS[recording.robot].label if recording.robot in ROBOTS else recording.robot
    head = robot + f" with {controller}" * bool(controller) + f", {recording.labels[0]}"
    outcome = recording.outcome[0]
    valid = outcome != Outcome.INVALID
    if not valid.any():
        return f"{head}: no valid episode"
    typical = int(typical_outcome(outcome))
    hits = outcome == typical
    fallen = recording.fallen[0]
    falls = typical != Outcome.GOAL and fallen[hits].mean() > 0.5
    count = (fallen & valid if falls else hits).sum()
    return f"{head}: {way_to_end(typical, asked_of(recording.ground), fallen=falls)}, {count} of {valid.sum()}"


def draw_crossing(recording: Recording, title: str) -> Figure:
    """One terrain: its height map with the paths of the valid episodes, and its profile."""
    figure = new_figure(9.5, 6.4)
    figure.suptitle(title)
    top, profile = panels = figure.subplots(2, 1, sharex=True, height_ratios=(3.2, 0.9))
    ground = recording.ground
    figure.colorbar(
        draw_heights(top, recording.heights[0], ground),
        ax=panels,
        label="height [m]",
        shrink=0.5,
        anchor=(0.0, 1.0),
        pad=0.01,
    )
    handles = [*_draw_paths(top, recording), *(Line2D([], [], **MARKS[name]) for name in places(asked_of(ground)))]
    if ground is not None:
        patches = {"slippery": (SLIPPERY, ground.friction < 1.0), "soft": (SOFT, ground.time_constant_s > 0.0)}
        handles += [Patch(color=color, alpha=0.5, label=label) for label, (color, at) in patches.items() if at.any()]
    row = recording.heights[0, recording.heights.shape[1] // 2]  # along the straight line from start to goal
    x = np.linspace(0.0, LENGTH, len(row))
    profile.fill_between(x, row, min(float(row.min()), 0.0) - 0.1, color="0.75")
    profile.plot(x, row, color="0.2", linewidth=1.0)
    profile.set_xlabel("x [m]")
    profile.set_ylabel("height at\ny = 4 m [m]", fontsize=9)
    profile.grid(alpha=0.3)
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, handlelength=3)
    return figure


def _draw_paths(axes: Axes, recording: Recording) -> list[Any]:
    """Draws every path and how it ended; returns a handle with a count for each ending."""
    handles: list[Any] = []
    xs = [0.0, LENGTH]
    for outcome, ending in all_endings(asked_of(recording.ground)).items():
        paths = [recording.qpos(0, k)[:, :2] for k in np.flatnonzero(recording.outcome[0] == outcome).tolist()]
        if not paths:
            continue
        mark: dict[str, Any] = {"color": ending.color, "marker": ending.marker}
        for path in paths:
            axes.plot(*path.T, color=ending.color, linestyle=ending.line, linewidth=0.9, alpha=0.7)
            xs += path[:, 0].tolist()
        axes.scatter(*np.stack([path[-1] for path in paths], axis=1), s=55, edgecolors="white", zorder=3, **mark)
        mark |= {"linestyle": ending.line, "markeredgecolor": "white", "markersize": 9}
        handles.append(Line2D([], [], **mark, label=f"{ending.label} ({len(paths)})"))
    axes.set_xlim(min(xs), max(xs))  # robots may leave the terrain
    return handles
