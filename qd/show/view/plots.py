"""Plots of the page as SVG: the elites on parallel axes, and the penalties of a crossing over its time."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from html import escape

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.elites import Elites, elites_of
from qd.show.figures import label_of, look_of
from sim.files.intervals import rate_words

_SHADES = ("#9ecae1", "#6baed6", "#4292c6", "#2171b5", "#08306b")  # of elites by fitness, the worst darkest
_GREY, _PICKED, _BRUSH = "#d8d8d8", "#d55e00", "#e69f00"
_WIDTH, _HEIGHT = 460, 350
_TOP, _BOTTOM, _LEFT, _RIGHT = 16, 116, 58, 16
_CURVES_HEIGHT, _MARGIN, _MARK_ROW = 170, 24, 14
_RATES = {"collision_rate": "base collision", "goal_rate": "goal reached", "fallen_rate": "fallen"}
_RATE_STEP, _FITNESS_STEP = 0.01, 0.1


@dataclass(frozen=True, kw_only=True)
class Axis:
    """One quantity of every elite."""

    name: str
    """Key of the axis: a penalty, ``fitness`` or a rate."""
    label: str
    """In words, one line."""
    values: NDArray[np.float64]
    """Shape (num_elites,)."""
    low: float
    """Lower end, a multiple of ``step`` not above any value."""
    high: float
    """Upper end, above ``low`` and not below any value."""
    step: float
    """What ranges are set in."""


@dataclass(frozen=True, kw_only=True)
class Axes:
    """All elites of an archive on axes: ratios in the archive's order, fitness, rates."""

    archive: Archive
    elites: Elites
    axes: tuple[Axis, ...]

    def axis(self, name: str) -> Axis:
        """The axis of a name."""
        return next(axis for axis in self.axes if axis.name == name)

    def within(self, ranges: dict[str, tuple[float, float]]) -> NDArray[np.int64]:
        """Numbers of the elites that lie in all ranges, limits included, worst first.

        Args:
            ranges: Lower and upper limit by the name of an axis; an axis without one is not looked at.
        """
        kept = np.ones(len(self.elites), dtype=bool)
        for name, (low, high) in ranges.items():
            axis = self.axis(name)
            slack = 1e-6 * axis.step  # a slider's decimals are not those of float64
            kept &= (axis.values >= low - slack) & (axis.values <= high + slack)
        return np.flatnonzero(kept)

    def rate_text(self, name: str, number: int) -> str:
        """A rate of an elite with its 95 % interval (Wilson), such as ``45% (31 to 60%)``."""
        return rate_words(self.elites.hits(name, number), int(self.elites.counted[number]), short=True)

    def line(self, number: int) -> str:
        """An elite on one line of the list: number, fitness, rates."""
        collided, goal = (self.rate_text(name, number) for name in ("collision_rate", "goal_rate"))
        return f"{number}: {self.elites.fitness[number]:.1f} · collision {collided} · goal {goal}"

    def details(self, number: int) -> str:
        """All that the archive says of an elite, as Markdown."""
        archive, elites = self.archive, self.elites
        count = elites.counted[number]
        of = f"{count} fresh episodes" if elites.fresh[number] else f"the {count} episodes that found it"
        lines = [
            f"**Elite {number}** of {len(elites)} · fitness **{elites.fitness[number]:.2f}** "
            f"({archive.fitness[number]:.2f} as found in iteration {archive.iteration[number]})",
            "",
            f"| as searched | of {of}, 95 % interval |",
            "|---|---|",
            *(f"| {label} | {self.rate_text(name, number)} |" for name, label in _RATES.items()),
        ]
        return "\n".join(lines)


def axes_of(archive: Archive) -> Axes:
    """The axes of an archive that has elites."""
    elites = elites_of(archive)
    axes = [_axis_of(name, label_of(name), elites.ratios[:, k], _RATE_STEP) for k, name in enumerate(archive.penalties)]
    axes.append(_axis_of("fitness", "fitness", elites.fitness, _FITNESS_STEP))
    rates = {name: np.asarray(getattr(elites, name)) for name in _RATES}
    axes += [_axis_of(name, label, rates[name], _RATE_STEP) for name, label in _RATES.items()]
    return Axes(archive=archive, elites=elites, axes=tuple(axes))


def _axis_of(name: str, label: str, values: NDArray[np.float64], step: float) -> Axis:
    """An axis as long as its values need: 0 to 1 at most for what is a share."""
    low = float(np.floor(values.min() / step + 1e-9)) * step
    high = float(np.ceil(values.max() / step - 1e-9)) * step
    if high <= low:
        high = low + step
    return Axis(name=name, label=label, values=values, low=round(low, 6), high=round(high, 6), step=step)


def axes_svg(axes: Axes, kept: NDArray[np.int64], ranges: dict[str, tuple[float, float]], picked: int | None) -> str:
    """The archive on parallel axes: a line an elite, grey outside the ranges, the picked one on top.

    Args:
        axes: Of all elites.
        kept: Numbers of those in the ranges.
        ranges: Range of each brushed axis.
        picked: Number of the picked elite, if any.
    """
    x = np.linspace(_LEFT, _WIDTH - _RIGHT, len(axes.axes))
    y = np.stack([_height_of(axis, axis.values) for axis in axes.axes], axis=1)
    dropped = np.setdiff1d(np.arange(len(axes.elites)), kept)
    parts = [_lines(x, y[dropped], _GREY, 0.6, 0.6)]
    # Equally many a shade, so that the worst stand out whatever the range of fitness.
    for shade, numbers in zip(_SHADES, reversed(np.array_split(kept, len(_SHADES))), strict=True):
        parts.append(_lines(x, y[numbers], shade, 0.8, 0.75))
    if picked is not None:
        parts.append(_lines(x, y[[picked]], _PICKED, 2.5, 1.0))
    parts += [_axis(axis, float(place), ranges.get(axis.name)) for axis, place in zip(axes.axes, x, strict=True)]
    return _svg(_HEIGHT, parts)


def _height_of(axis: Axis, values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Where values stand on their axis [pixels from the top]."""
    share = (values - axis.low) / (axis.high - axis.low)
    return _HEIGHT - _BOTTOM - share * (_HEIGHT - _TOP - _BOTTOM)


def _lines(x: NDArray[np.float64], rows: NDArray[np.float64], color: str, width: float, opacity: float) -> str:
    """Lines over the same x as one path."""
    path = "".join("M" + "L".join(f"{a:.0f} {b:.1f}" for a, b in zip(x, row, strict=True)) for row in rows)
    style = f'fill="none" stroke="{color}" stroke-width="{width}" stroke-opacity="{opacity}"'
    return f'<path d="{path}" {style}/>' if path else ""


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
    parts.append(_text(x + 4, bottom + 24, _shortened(axis.label), "end", turned))
    return "".join(parts)


def _shortened(label: str) -> str:
    """A label that has room under the axes."""
    return label if len(label) <= 22 else f"{label[:21]}…"


def _text(x: float, y: float, text: str, anchor: str, more: str = "") -> str:
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}" {more}>{escape(text)}</text>'


def _svg(height: int, parts: Iterable[str]) -> str:
    style = "width:100%;font-family:sans-serif;font-size:10px;fill:currentColor"
    inner = "".join(parts)
    return f'<svg viewBox="0 0 {_WIDTH} {height}" style="{style}" xmlns="http://www.w3.org/2000/svg">{inner}</svg>'


class Curves:
    """Running penalties of one crossing, drawn once; only the mark of the shown time moves."""

    def __init__(
        self,
        times_s: NDArray[np.floating],
        sums: NDArray[np.floating],
        penalties: Sequence[str],
        marks: Sequence[tuple[float, str]] = (),
    ) -> None:
        """Draw the curves.

        Args:
            times_s: Time of each frame [s], shape (num_frames,).
            sums: Scaled penalty sums so far, shape (num_frames, num_penalties).
            penalties: Their names.
            marks: Times [s] and words of what happened, above the curves.
        """
        self._top = _MARK_ROW * len(marks)
        self._end = max(float(times_s[-1]), 1e-9)
        most = max(float(np.max(sums)), 1e-9)
        step = max(1, len(times_s) // 200)
        chosen = np.unique([*range(0, len(times_s), step), len(times_s) - 1])
        x = self._x(times_s[chosen])
        bottom, top = self._top + _CURVES_HEIGHT - 18, self._top + 12
        parts = [
            *(self._mark(row, when, words) for row, (when, words) in enumerate(marks)),
            f'<line x1="{_MARGIN + 8}" y1="{bottom}" x2="{_WIDTH - 8}" y2="{bottom}" stroke="#444"/>',
            _text(_MARGIN + 4, top + 4, f"{most:.3g}", "end"),
            _text(_MARGIN + 4, bottom, "0", "end"),
            _text(_MARGIN + 8, bottom + 13, "penalties so far, in multiples of their scales", "start"),
            _text(_WIDTH - 8, bottom + 13, f"{self._end:.1f} s", "end"),
        ]
        for column, penalty in enumerate(penalties):
            color = look_of(penalty).color
            y = bottom - np.asarray(sums[chosen, column], dtype=np.float64) / most * (bottom - top)
            parts.append(_lines(x, y[None], color, 1.6, 1.0))
            parts.append(
                _text(_MARGIN + 16, top + 12 * column + 4, label_of(penalty), "start", f'style="fill:{color}"')
            )
        self._drawn = "".join(parts)

    def _x(self, times_s: NDArray[np.floating]) -> NDArray[np.float64]:
        return _MARGIN + 8 + np.asarray(times_s, dtype=np.float64) / self._end * (_WIDTH - _MARGIN - 16)

    def _mark(self, row: int, time_s: float, words: str) -> str:
        """A dashed line at a time [s], and its words in a row of their own, on the side with more room."""
        x = float(self._x(np.array([time_s]))[0])
        y, bottom = _MARK_ROW * (row + 1) - 3, self._top + _CURVES_HEIGHT - 18
        line = f'<line x1="{x:.1f}" y1="{y - 8}" x2="{x:.1f}" y2="{bottom}" stroke="#555" stroke-dasharray="2 3"/>'
        side, anchor = (4, "start") if x < 0.5 * _WIDTH else (-4, "end")
        return line + _text(x + side, y, f"{words}, {time_s:.1f} s", anchor)

    def at(self, time_s: float) -> str:
        """The curves with a mark at a time [s]."""
        x = float(self._x(np.array([time_s]))[0])
        bottom = self._top + _CURVES_HEIGHT - 18
        mark = f'<line x1="{x:.1f}" y1="6" x2="{x:.1f}" y2="{bottom}" stroke="#d00" stroke-width="1.5"/>'
        return _svg(self._top + _CURVES_HEIGHT, [self._drawn, mark])
