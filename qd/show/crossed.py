"""Recorded crossings in numbers and figures: how they ended, what they cost, and where."""

from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from numpy.typing import NDArray

from kernels.episode import Outcome
from qd.show.figures import label_of, look_of
from sim.crossing import FALLEN_TILT_DEG
from sim.files.figures import new_figure
from sim.files.intervals import rate_words, wilson_interval
from sim.maps.picture import GOAL, LENGTH, SLIPPERY, SOFT, START, draw_heights
from sim.recording.recorder import Recording


class Ending(NamedTuple):
    """A way to end, in words and in looks that the colour-blind tell apart."""

    words: str
    color: str
    """As ``#rrggbb`` (Okabe and Ito's)."""
    marker: str
    """Matplotlib's, where the episode ended."""
    line: str
    """Matplotlib's, of the path to it."""


ENDINGS = {
    Outcome.GOAL: Ending("reached the goal", "#009e73", "o", "-"),
    Outcome.BASE_COLLISION: Ending("base collision", "#d55e00", "X", "--"),
    Outcome.TIME_OUT: Ending("out of time", "#0072b2", "s", "-."),
    Outcome.OUT: Ending("left the terrain", "#cc79a7", "^", ":"),
}
"""How a valid episode may end, the good way first."""
_INVALID = Ending("invalid: the simulation broke", "#5a5a5a", "", "")
ARRIVED, *FAILED = (ending.words for ending in ENDINGS.values())
"""The good way in words, and the others."""


def ending_of(outcome: int) -> Ending:
    """How an episode of an outcome ended, a valid one or not."""
    return ENDINGS.get(Outcome(outcome), _INVALID)


def way_to_end(outcome: int, fallen: bool) -> str:
    """How an episode ended, as one says of a robot: ``topples``."""
    ways = {Outcome.GOAL: "crosses it", Outcome.TIME_OUT: "gets stuck", Outcome.OUT: "leaves the terrain"}
    return ways.get(Outcome(outcome), "topples" if fallen else "hits the ground")


class Rate(NamedTuple):
    """Hits among episodes."""

    hits: int
    count: int

    def __str__(self) -> str:
        return rate_words(self.hits, self.count)

    @property
    def limits(self) -> str:
        """The 95 % Wilson interval in words: ``0 to 16 %``; anything possible without an episode."""
        return "{:.0f} to {:.0f} %".format(*(100.0 * limit for limit in wilson_interval(self.hits, self.count)))


@dataclass(frozen=True, kw_only=True)
class Crossed:
    """One terrain's recording; E valid episodes."""

    recording: Recording
    """Of one terrain."""
    chosen: NDArray[np.int64]
    """Valid episodes, shape (E,)."""
    penalties: NDArray[np.float64]
    """Raw penalty sums of each, in the archive's order, shape (E, P)."""
    scales: NDArray[np.float64]
    """Shape (P,)."""
    rates: dict[str, Rate]
    """By the words of :data:`ENDINGS`, and ``fallen``."""

    @property
    def ends(self) -> NDArray[np.float64]:
        """Where each episode ended, shape (E, 3) [m]."""
        last = self.recording.num_frames[0, self.chosen] - 1
        return self.recording.base_position[0, self.chosen, last].astype(np.float64)

    @property
    def outcome(self) -> NDArray[np.uint8]:
        """How each ended, shape (E,)."""
        return self.recording.outcome[0, self.chosen]

    @property
    def scaled(self) -> NDArray[np.float64]:
        """Scaled penalties, shape (E, P)."""
        return self.penalties / self.scales

    @property
    def failed_at(self) -> float | None:
        """Median of x where the episodes that did not reach the goal ended [m]; None if all did."""
        x = self.ends[self.outcome != Outcome.GOAL, 0]
        return float(np.median(x)) if len(x) else None

    def path(self, k: int) -> NDArray[np.float64]:
        """Base positions of the k-th valid episode [m], shape (frames, 3)."""
        episode = self.chosen[k]
        frames = slice(self.recording.num_frames[0, episode])
        return self.recording.base_position[0, episode, frames].astype(np.float64)


def crossed_of(recording: Recording, penalties: tuple[str, ...], scales: tuple[float, ...]) -> Crossed:
    """A recording of one terrain in numbers."""
    outcome = recording.outcome[0]
    chosen = np.flatnonzero(outcome != Outcome.INVALID)
    columns = [recording.penalty_names.index(name) for name in penalties]
    last = recording.num_frames[0, chosen] - 1
    hits = {ending.words: outcome[chosen] == end for end, ending in ENDINGS.items()}
    hits["fallen"] = recording.fallen[0, chosen]
    return Crossed(
        recording=recording,
        chosen=chosen,
        penalties=recording.penalties[0, chosen, last][:, columns].astype(np.float64),
        scales=np.asarray(scales, dtype=np.float64),
        rates={label: Rate(int(hit.sum()), len(chosen)) for label, hit in hits.items()},
    )


_STUCK = 0.3  # a robot that gets stuck is stuck once it is so near to where it ends [m]


def moment_of_failure(recording: Recording, episode: int) -> float:
    """When an episode went wrong [s]: at its base collision, or at its fall where the robot fell before that.

    A robot that ran out of time without a fall got stuck when it first came within 0.3 m of where it ended. Of every
    other episode it is the end. A fall is the one from which the robot did not rise.

    Args:
        recording: Of one terrain.
        episode: Index of the episode.
    """
    last = max(int(recording.num_frames[0, episode]) - 1, 0)
    outcome, frame = recording.outcome[0, episode], last
    if outcome in (Outcome.BASE_COLLISION, Outcome.TIME_OUT, Outcome.OUT):
        quaternion = recording.base_quaternion[0, episode, : last + 1].astype(np.float64)
        cosine = 1.0 - 2.0 * (quaternion[:, 1] ** 2 + quaternion[:, 2] ** 2)
        upright = np.flatnonzero(cosine >= np.cos(np.deg2rad(FALLEN_TILT_DEG)))
        fall = int(upright[-1]) + 1 if len(upright) else 0
        if fall <= last:
            frame = fall
        elif outcome == Outcome.TIME_OUT:
            place = recording.base_position[0, episode, : last + 1, :2].astype(np.float64)
            frame = int(np.argmax(np.linalg.norm(place - place[-1], axis=1) <= _STUCK))
    return frame * recording.dt


def typical_episode(recording: Recording, scales: dict[str, float]) -> int:
    """The episode to show: of those that end as most do, the one with the middle sum of scaled penalties."""
    outcome = recording.outcome[0]
    candidates = np.flatnonzero(outcome == np.bincount(outcome).argmax())
    last = np.maximum(recording.num_frames[0, candidates] - 1, 0)
    sums = recording.penalties[0, candidates, last].astype(np.float64)
    names = recording.penalty_names
    costs = sum(sums[:, names.index(name)] / scale for name, scale in scales.items() if name in names)
    order = np.argsort(np.broadcast_to(costs, len(candidates)), kind="stable")
    return int(candidates[order[(len(candidates) - 1) // 2]])


_NAMES = {"anymal": "ANYmal C", "cassie": "Cassie"}  # of robots, as their makers write them


def title_of(recording: Recording, controller: str = "") -> str:
    """A terrain and how most episodes ended on it: ``ANYmal C, elite 313 (trench): topples, 19 of 20``."""
    outcome = recording.outcome[0]
    valid = outcome != Outcome.INVALID
    most = int(np.bincount(outcome[valid], minlength=1).argmax())
    ended = outcome == most
    way = way_to_end(most, recording.fallen[0, ended].mean() > 0.5) if valid.any() else "no valid episode"
    who = _NAMES.get(recording.robot, recording.robot) + (f" with {controller}" if controller else "")
    return f"{who}, {recording.labels[0]}: {way}, {ended.sum()} of {valid.sum()}"


def penalties_by_place(crossed: Crossed, penalties: tuple[str, ...], edges: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scaled penalties per episode by where along x they were incurred.

    Args:
        crossed: The crossings.
        penalties: Those of the archive.
        edges: Of the places [m], shape (places + 1,); what lies outside counts in the first or last.

    Returns:
        Mean over the episodes, shape (places, P); the sum over places is the mean penalty.
    """
    recording = crossed.recording
    columns = [recording.penalty_names.index(name) for name in penalties]
    amounts = np.zeros((len(edges) - 1, len(columns)))
    for k, episode in enumerate(crossed.chosen):
        sums = recording.penalties[0, episode, : recording.num_frames[0, episode]][:, columns].astype(np.float64)
        places = np.clip(np.digitize(crossed.path(k)[1:, 0], edges) - 1, 0, len(amounts) - 1)
        np.add.at(amounts, places, np.diff(sums, axis=0))
    return amounts / (crossed.scales * max(1, len(crossed.chosen)))


_PLACE = 0.5  # length of the places that penalties are summed over [m]


def draw_crossing(crossed: Crossed, penalties: tuple[str, ...], title: str) -> Figure:
    """One terrain: its height map with the paths, its profile, and the penalties by place."""
    figure = new_figure(9.5, 8.4)
    figure.suptitle(title)
    top, profile, places = panels = figure.subplots(3, 1, sharex=True, height_ratios=(3.2, 0.9, 1.1))
    figure.colorbar(draw_map(top, crossed), ax=panels, label="height [m]", shrink=0.5, anchor=(0.0, 1.0), pad=0.01)
    _draw_profile(profile, crossed)
    _draw_places(places, crossed, penalties)
    handles = _legend(crossed)
    for name in penalties:
        look = look_of(name)
        handles.append(Patch(facecolor=look.color, hatch=look.hatch, edgecolor="white", label=label_of(name)))
    figure.legend(handles=handles, loc="outside lower center", ncols=4, frameon=False, handlelength=3)
    top.set_xlim(*_x_limits(crossed))
    return figure


def draw_map(axes: Axes, crossed: Crossed) -> Any:
    """The height map with every path, its end marked by how it ended; returns the image."""
    image = draw_heights(axes, crossed.recording.heights[0], None, crossed.recording.ground)
    for outcome, end in ENDINGS.items():
        chosen = np.flatnonzero(crossed.outcome == outcome)
        for k in chosen:
            axes.plot(*crossed.path(int(k))[:, :2].T, color=end.color, linestyle=end.line, linewidth=0.9, alpha=0.7)
        if len(chosen):
            places = crossed.ends[chosen]
            axes.scatter(*places[:, :2].T, color=end.color, marker=end.marker, s=55, edgecolors="white", zorder=3)
    return image


def _legend(crossed: Crossed) -> list[Any]:
    """Marks of the ends there are and how many, with the lines of the paths to them, of start and goal."""
    handles: list[Any] = []
    for outcome, end in ENDINGS.items():
        if count := int((crossed.outcome == outcome).sum()):
            looks: dict[str, Any] = {"color": end.color, "marker": end.marker, "linestyle": end.line}
            label = f"{end.words} ({count})"
            handles.append(Line2D([], [], **looks, label=label, markeredgecolor="white", markersize=9))
    handles += [Line2D([], [], **look) for look in (START, GOAL)]
    ground = crossed.recording.ground
    if ground is not None and (ground.friction < 1.0).any():
        handles.append(Patch(facecolor="none", edgecolor=SLIPPERY, hatch="\\\\\\", label="slippery"))
    if ground is not None and ground.time_constant_s.any():
        handles.append(Patch(facecolor="none", edgecolor=SOFT, hatch="|||", label="soft"))
    return handles


def _x_limits(crossed: Crossed) -> tuple[float, float]:
    """The terrain, and what robots left it for."""
    xs = np.concatenate([[0.0, LENGTH], crossed.ends[:, 0]])
    return float(xs.min()), float(xs.max())


def _draw_profile(axes: Axes, crossed: Crossed) -> None:
    """Heights along the straight line from start to goal."""
    heights = crossed.recording.heights[0]
    row = heights[heights.shape[0] // 2]
    x = np.linspace(0.0, LENGTH, len(row))
    axes.fill_between(x, row, min(float(row.min()), 0.0) - 0.1, color="0.75")
    axes.plot(x, row, color="0.2", linewidth=1.0)
    axes.set_ylabel("height at\ny = 4 m [m]", fontsize=9)
    axes.grid(alpha=0.3)


def _draw_places(axes: Axes, crossed: Crossed, penalties: tuple[str, ...]) -> None:
    """Scaled penalties of an episode by where they were incurred."""
    edges = np.arange(0.0, LENGTH + _PLACE / 2, _PLACE)
    amounts = penalties_by_place(crossed, penalties, edges)
    bottom = np.zeros(len(amounts))
    for penalty, amount in zip(penalties, amounts.T, strict=True):
        axes.bar(edges[:-1], amount, width=_PLACE, align="edge", bottom=bottom, **look_of(penalty).bar)
        bottom += amount
    axes.set_xlabel("x [m]")
    axes.set_ylabel(f"penalties per\n{_PLACE} m (scaled)", fontsize=9)
    axes.grid(alpha=0.3)
    axes.set_axisbelow(True)
