"""Plots of the page as SVG: the elites on parallel axes, and the penalties of a crossing over its time."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.faults import elite_words
from qd.groups import ORDERS, VERDICTS, Elites, Ranking, rank
from qd.show.crossed import ARRIVED, Rate
from qd.show.figures import label_of, look_of, mode_words
from qd.show.view.playing import Crossing
from sim.files.intervals import rate_words
from sim.spaces.base import TerrainSpace

_SHADES = ("#9ecae1", "#6baed6", "#4292c6", "#2171b5", "#08306b")  # of elites in the list's order, the first darkest
_GREY, _PICKED, _BRUSH = "#d8d8d8", "#d55e00", "#e69f00"
_WIDTH, _HEIGHT = 460, 350
_TOP, _BOTTOM, _LEFT, _RIGHT = 16, 116, 58, 32
_CURVES_HEIGHT, _MARGIN, _MARK_ROW = 170, 24, 14
_RATES = {"goal_rate": "goal reached", "collision_rate": "base collision", "fallen_rate": "fallen"}
_CROSSED = {**_RATES, "goal_rate": ARRIVED}  # as recordings name them
FITNESS_WORDS = (
    "what the search looks for: mean scaled penalties, less their spread over episodes, less a share of episodes "
    "without a base collision where others have one; whether the robot fails says the goal rate"
)
"""What fitness is, and what it is not."""
KINDS = {
    "all": VERDICTS,
    "faults": ("fault",),
    "certified": ("certified", "fault"),
    "confirmed": ("confirmed", "fault"),
    "failing": VERDICTS[1:],
    "not failing": ("",),
}
"""Kinds of elites to choose from, and their verdicts."""
MINIMAL = "with a minimal terrain"
"""One more kind, if there are some."""
_MANY = 400  # lines, beyond which they are drawn thinner
_RATE_STEP, _FITNESS_STEP = 0.01, 0.1


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One quantity of every elite."""

    name: str
    """A penalty, ``fitness`` or a rate."""
    label: str
    values: NDArray[np.float64]
    """Shape (num_elites,)."""
    low: float
    high: float
    """Ends, multiples of ``step`` around all values."""
    step: float
    """What ranges are set in."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Which elites are listed, and in which order."""

    ranges: Mapping[str, tuple[float, float]]
    """Lower and upper limit by the name of an axis, limits included."""
    order: str = next(iter(ORDERS))
    """One of the :data:`qd.groups.ORDERS`."""
    kind: str = "all"
    """One of the :data:`KINDS`, or :data:`MINIMAL`."""
    mode: int | None = None
    """Number of the failure mode; None for all."""


@dataclass(frozen=True, kw_only=True)
class Axes:
    """All elites of an archive on axes: ratios in the archive's order, fitness, rates."""

    archive: Archive
    ranking: Ranking
    axes: tuple[Axis, ...]
    minimal: tuple[int, ...] = ()
    """Numbers of the elites that have a minimal terrain."""

    @property
    def elites(self) -> Elites:
        """All elites."""
        return self.ranking.elites

    @cached_property
    def _orders(self) -> dict[str, NDArray[np.int64]]:
        return {name: self.ranking.order(name) for name in ORDERS}

    def axis(self, name: str) -> Axis:
        """The axis of a name."""
        return next(axis for axis in self.axes if axis.name == name)

    def listed(self, choice: Choice) -> NDArray[np.int64]:
        """Numbers of the elites that are chosen, in the chosen order."""
        chosen = self._of_kind(choice.kind)
        if choice.mode is not None:
            chosen &= self.ranking.modes.labels == choice.mode
        for name, (low, high) in choice.ranges.items():
            axis = self.axis(name)
            slack = 1e-6 * axis.step  # a slider's decimals are not those of float64
            chosen &= (axis.values >= low - slack) & (axis.values <= high + slack)
        order = self._orders[choice.order]
        return order[chosen[order]]

    def _of_kind(self, kind: str) -> NDArray[np.bool_]:
        if kind == MINIMAL:
            return np.isin(self.elites.numbers, self.minimal)
        return np.isin(self.elites.verdict, [VERDICTS.index(verdict) for verdict in KINDS[kind]])

    def kinds(self) -> dict[str, str]:
        """Kinds of elites by their words with the number of elites."""
        kinds = [*KINDS, MINIMAL] if self.minimal else [*KINDS]
        return {f"{kind} ({int(self._of_kind(kind).sum()):,})": kind for kind in kinds}

    def modes(self) -> dict[str, int | None]:
        """Numbers of the failure modes by their words with the number of elites; None for all."""
        modes = self.ranking.modes.modes
        named = {f"{mode.number}: {mode_words(mode)} ({len(mode.members):,})": mode.number for mode in modes}
        return {"all modes": None, **named}

    def rate_text(self, name: str, number: int) -> str:
        """A rate of an elite with its 95 % interval (Wilson), such as ``45% (31 to 60%)``."""
        return rate_words(self.elites.hits(name, number), int(self.elites.counted[number]), short=True)

    def line(self, number: int) -> str:
        """An elite on one line of the list: number, verdict, goal rate with its interval, collisions."""
        verdict, goal = self.verdict(number), self.rate_text("goal_rate", number)
        collided = self.elites.collision_rate[number]
        return f"{number}: {f'{verdict} · ' * bool(verdict)}goal {goal} · collision {collided:.0%}"

    def verdict(self, number: int) -> str:
        """One of :data:`qd.groups.VERDICTS`."""
        return VERDICTS[int(self.elites.verdict[number])]

    def hint(self, number: int) -> str:
        """An elite in a few words."""
        verdict = self.verdict(number)
        return f"elite {number}{f', {verdict}' * bool(verdict)}: goal {self.elites.goal_rate[number]:.0%}"

    def details(self, number: int, crossings: Mapping[str, Mapping[str, Rate]]) -> str:
        """All that is known of an elite, as Markdown, with rates of shown crossings by their title.

        The rates are those of :class:`qd.show.crossed.Crossed`.
        """
        archive, elites, ranking = self.archive, self.elites, self.ranking
        count, verdict = int(elites.counted[number]), self.verdict(number)
        source = f"{count} fresh episodes" if elites.fresh[number] else f"the {count} episodes that found it"
        mode = ranking.mode_of(number)
        failure = "not failing" if mode is None else f"failure mode {mode.number}: {mode_words(mode)}"
        others = int((ranking.families == ranking.families[number]).sum()) - 1
        alike = f"{others or 'no'} other elite{'s' * (others > 1)} like it"
        heads = ["95 % intervals", f"as searched, {source}"]
        heads += [f"{escape(title)}, {rates[ARRIVED].count} episodes here" for title, rates in crossings.items()]
        rows = [
            [label, self.rate_text(name, number)]
            + [rate_words(*rates[_CROSSED[name]], short=True) for rates in crossings.values()]
            for name, label in _RATES.items()
        ]
        table = "\n".join(f"| {' | '.join(cells)} |" for cells in (heads, ["---"] * len(heads), *rows))
        words = "\n".join(elite_words(archive, number))
        fitness, before, iteration = elites.fitness[number], archive.fitness[number], archive.iteration[number]
        return (
            f"**Elite {number}** of {len(elites):,}{f' · **{verdict}**' * bool(verdict)} · {failure} · {alike}\n\n"
            f"{table}\n\n{words}\n\n"
            f"Fitness **{fitness:.2f}** ({before:.2f} as found in iteration {iteration}): {FITNESS_WORDS}."
        )


def axes_of(archive: Archive, space: TerrainSpace, minimal: Sequence[int] = ()) -> Axes:
    """The axes of an archive with at least one elite; ``minimal`` are the elites that have a minimal terrain."""
    ranking = rank(archive, space)
    elites = ranking.elites
    axes = [_axis_of(name, label_of(name), elites.ratios[:, k], _RATE_STEP) for k, name in enumerate(archive.penalties)]
    axes.append(_axis_of("fitness", "fitness", elites.fitness, _FITNESS_STEP))
    rates = {name: np.asarray(getattr(elites, name)) for name in _RATES}
    axes += [_axis_of(name, label, rates[name], _RATE_STEP) for name, label in _RATES.items()]
    return Axes(archive=archive, ranking=ranking, axes=tuple(axes), minimal=tuple(minimal))


def _axis_of(name: str, label: str, values: NDArray[np.float64], step: float) -> Axis:
    """An axis as long as its values need."""
    low = float(np.floor(values.min() / step + 1e-9)) * step
    high = float(np.ceil(values.max() / step - 1e-9)) * step
    high = round(max(high, low + step), 6)
    return Axis(name=name, label=label, values=values, low=round(low, 6), high=high, step=step)


def axes_svg(axes: Axes, listed: NDArray[np.int64], ranges: Mapping[str, tuple[float, float]], picked: int) -> str:
    """The archive on parallel axes: a line an elite, grey if it is not listed, the picked one on top.

    The paths name their elites, so that lines can be pointed at in the browser (``pointing.js``).
    """
    x = np.linspace(_LEFT, _WIDTH - _RIGHT, len(axes.axes))
    y = np.stack([_height_of(axis, axis.values) for axis in axes.axes], axis=1)
    parts = [_lines(x, np.delete(y, listed, axis=0), _GREY, 0.6, 0.6)]
    width = 0.8 * min(1.0, _MANY / max(len(listed), 1)) ** 0.5  # else many lines are one blue area
    # Equally many a shade, so that the first stand out whatever they are sorted by.
    for shade, numbers in zip(_SHADES, reversed(np.array_split(listed, len(_SHADES))), strict=True):
        parts.append(_lines(x, y[numbers], shade, width, 0.75, _named(axes, numbers)))
    parts.append(_lines(x, y[[picked]], _PICKED, 2.5, 1.0))
    parts += [_axis(axis, float(place), ranges.get(axis.name)) for axis, place in zip(axes.axes, x, strict=True)]
    return _svg(_HEIGHT, parts)


def _named(axes: Axes, numbers: NDArray[np.int64]) -> str:
    """Attributes of a path that name the elites of its lines."""
    hints = "|".join(map(axes.hint, numbers.tolist()))
    return f'data-elites="{" ".join(map(str, numbers.tolist()))}" data-hints="{escape(hints)}"'


def _height_of(axis: Axis, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where values stand on their axis [pixels from the top]."""
    share = (values - axis.low) / (axis.high - axis.low)
    return _HEIGHT - _BOTTOM - share * (_HEIGHT - _TOP - _BOTTOM)


def _lines(
    x: NDArray[np.float64], rows: NDArray[np.float64], color: str, width: float, opacity: float, more: str = ""
) -> str:
    """Lines over the same x as one path."""
    path = "".join("M" + "L".join(f"{a:.0f} {b:.1f}" for a, b in zip(x, row, strict=True)) for row in rows)
    style = f'fill="none" stroke="{color}" stroke-width="{width}" stroke-opacity="{opacity}"'
    return f'<path d="{path}" {style} {more}/>' if path else ""


def _axis(axis: Axis, x: float, brushed: tuple[float, float] | None) -> str:
    """An axis with its ends, its name, and its range if it has one."""
    bottom = _HEIGHT - _BOTTOM
    parts = [f'<line x1="{x:.0f}" y1="{_TOP}" x2="{x:.0f}" y2="{bottom}" stroke="#444" stroke-width="1"/>']
    if brushed is not None:
        high, low = _height_of(axis, np.array([brushed[1], brushed[0]]))
        size = f'width="9" height="{max(low - high, 2.0):.1f}"'
        parts.append(f'<rect x="{x - 4.5:.1f}" y="{high:.1f}" {size} fill="{_BRUSH}" fill-opacity="0.75"/>')
    decimals = 0 if axis.name == "fitness" else 2
    parts.append(_text(x, _TOP - 5, f"{axis.high:.{decimals}f}", "middle"))
    parts.append(_text(x, bottom + 12, f"{axis.low:.{decimals}f}", "middle"))
    turned = f'transform="rotate(-52 {x:.0f} {bottom + 24})"'
    explained = f"<title>{escape(FITNESS_WORDS)}</title>" if axis.name == "fitness" else ""
    label = axis.label if len(axis.label) <= 22 else f"{axis.label[:21]}…"
    parts.append(f"<g>{explained}{_text(x + 4, bottom + 24, label, 'end', turned)}</g>")
    return "".join(parts)


def _text(x: float, y: float, text: str, anchor: str, more: str = "") -> str:
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}" {more}>{escape(text)}</text>'


def _svg(height: int, parts: Iterable[str]) -> str:
    style = "width:100%;font-family:sans-serif;font-size:10px;fill:currentColor"
    inner = "".join(parts)
    return f'<svg viewBox="0 0 {_WIDTH} {height}" style="{style}" xmlns="http://www.w3.org/2000/svg">{inner}</svg>'


class Curves:
    """Running penalties of one crossing, drawn once; only the line at the shown time moves."""

    def __init__(self, crossing: Crossing, penalties: Sequence[str]) -> None:
        times_s, sums, marks = crossing.times_s, crossing.penalties, crossing.marks
        self._top, self._end = _MARK_ROW * len(marks), max(float(times_s[-1]), 1e-9)
        self._bottom = bottom = self._top + _CURVES_HEIGHT - 18
        top, most = self._top + 12, max(float(np.max(sums)), 1e-9)
        chosen = np.unique([*range(0, len(times_s), max(1, len(times_s) // 200)), len(times_s) - 1])
        x = np.array([self._x(time_s) for time_s in times_s[chosen]])
        parts = [
            f'<line x1="{_MARGIN + 8}" y1="{bottom}" x2="{_WIDTH - 8}" y2="{bottom}" stroke="#444"/>',
            _text(_MARGIN + 4, top + 4, f"{most:.3g}", "end"),
            _text(_MARGIN + 4, bottom, "0", "end"),
            _text(_MARGIN + 8, bottom + 13, "penalties so far, in multiples of their scales", "start"),
            _text(_WIDTH - 8, bottom + 13, f"{self._end:.1f} s", "end"),
        ]
        for row, (time_s, words) in enumerate(marks):  # words stand on the side with more room
            at, y = self._x(time_s), _MARK_ROW * (row + 1) - 3
            side, anchor = (4, "start") if at < 0.5 * _WIDTH else (-4, "end")
            parts.append(self._upright(time_s, y - 8, 'stroke="#555" stroke-dasharray="2 3"'))
            parts.append(_text(at + side, y, f"{words}, {time_s:.1f} s", anchor))
        for column, penalty in enumerate(penalties):
            color = look_of(penalty).color
            y = bottom - sums[chosen, column] / most * (bottom - top)
            parts.append(_lines(x, y[None], color, 1.6, 1.0))
            style = f'style="fill:{color}"'
            parts.append(_text(_MARGIN + 16, top + 12 * column + 4, label_of(penalty), "start", style))
        self._drawn = "".join(parts)

    def _x(self, time_s: float) -> float:
        """Pixels from the left; a second crossing may last longer than this one."""
        return _MARGIN + 8 + min(float(time_s), self._end) / self._end * (_WIDTH - _MARGIN - 16)

    def _upright(self, time_s: float, top: int, look: str) -> str:
        x = self._x(time_s)
        return f'<line x1="{x:.1f}" y1="{top}" x2="{x:.1f}" y2="{self._bottom}" {look}/>'

    def at(self, time_s: float) -> str:
        """The curves with a line at a time [s]."""
        line = self._upright(time_s, 6, 'stroke="#d00" stroke-width="1.5"')
        return _svg(self._top + _CURVES_HEIGHT, [self._drawn, line])
