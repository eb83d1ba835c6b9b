"""The elites of an archive as the page lists them: in orders, by cause, as a plot, and what is known of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape

import numpy as np
from numpy.typing import NDArray

from qd.archive import OUTCOMES, Archive
from qd.faults import elite_words
from qd.groups import ORDERS, VERDICTS, Elites, Ranking, rank, summary_of
from qd.minimise import MinimalTerrains
from qd.show.crossed import ARRIVED, FAILED, Crossed
from qd.show.figures import label_of
from sim.files.intervals import rate_words
from sim.spaces.base import TerrainSpace

_SHADES = ("#9ecae1", "#6baed6", "#4292c6", "#2171b5", "#08306b")  # of elites in the list's order, the first darkest
_GREY, _PICKED = "#d8d8d8", "#d55e00"
_WIDTH, _HEIGHT = 460, 320
_TOP, _BOTTOM, _LEFT, _RIGHT = 16, 104, 58, 14
_MANY = 400  # lines, beyond which they are drawn thinner
RATES = {"goal_rate": "reached the goal", "collision_rate": "base collision", "other_rate": "out of time, off it",
         "fallen_rate": "fallen"}  # fmt: skip
FITNESS_WORDS = (
    "what the search looks for: mean scaled penalties, less their spread over episodes, less a share of episodes "
    "without a base collision where others have one; whether the robot fails is said by the goal rate"
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

Column = tuple[str, int, Mapping[str, int]]
"""A head, a number of episodes, and how many of them each of the :data:`RATES` counts."""


@dataclass(frozen=True, kw_only=True)
class Choice:
    """Which elites are listed, and in which order."""

    cause: str = ""
    """What stops the robot; empty for all."""
    order: str = next(iter(ORDERS))
    """One of the :data:`qd.groups.ORDERS`."""
    kind: str = "all"
    """One of the :data:`KINDS`, or :data:`MINIMAL`."""


@dataclass(frozen=True, kw_only=True)
class Listing:
    """All elites of an archive."""

    archive: Archive
    ranking: Ranking
    minima: MinimalTerrains | None = None
    """Minimal terrains of the elites, if there are some."""

    @property
    def elites(self) -> Elites:
        """All elites."""
        return self.ranking.elites

    @cached_property
    def summary(self) -> str:
        """What the archive says of the controller, in a sentence."""
        return summary_of(self.ranking, self.archive)

    @cached_property
    def _orders(self) -> dict[str, NDArray[np.int64]]:
        return {name: self.ranking.order(name) for name in ORDERS}

    @cached_property
    def _rows_by_cause(self) -> dict[str, NDArray[np.int64]]:
        return self.ranking.by_cause()

    def listed(self, choice: Choice) -> NDArray[np.int64]:
        """Numbers of the elites that are chosen, in the chosen order."""
        chosen = self._of_kind(choice.kind)
        if choice.cause:
            chosen &= np.isin(np.arange(len(chosen)), self._rows_by_cause[choice.cause])
        order = self._orders[choice.order]
        return order[chosen[order]]

    def _of_kind(self, kind: str) -> NDArray[np.bool_]:
        if kind == MINIMAL:
            return np.isin(self.elites.numbers, [] if self.minima is None else [*self.minima.genes])
        return np.isin(self.elites.verdict, [VERDICTS.index(verdict) for verdict in KINDS[kind]])

    def kinds(self) -> dict[str, str]:
        """Kinds of elites by their words with the number of elites."""
        kinds = [*KINDS] if self.minima is None else [*KINDS, MINIMAL]
        return {f"{kind} ({int(self._of_kind(kind).sum()):,})": kind for kind in kinds}

    def causes(self) -> dict[str, str]:
        """What stops the robot by its words with the number of elites; empty for all."""
        rows = self._rows_by_cause
        return {"all": "", **{f"{cause} ({len(members):,})": cause for cause, members in rows.items()}}

    def verdict(self, number: int) -> str:
        """One of :data:`qd.groups.VERDICTS`."""
        return VERDICTS[int(self.elites.verdict[number])]

    def rows_html(self, numbers: Sequence[int]) -> str:
        """Elites one below the other, as HTML; a click on one shows it (``page.js``)."""
        return "".join(
            f'<div data-elite="{n}"><b>{n}</b> {escape(self.ranking.name(n))} <small>{self.verdict(n)}</small></div>'
            for n in numbers
        )

    def columns(self, number: int) -> Sequence[Column]:
        """What is known of the whole terrain: fresh episodes, contact resolved, and the best certifier."""
        elites, faults = self.elites, self.archive.faults
        count = int(elites.counted[number])
        head = "fresh" if elites.fresh[number] else "as found"
        columns = [(head, count, {name: elites.hits(name, number) for name in RATES})]
        if faults is not None:
            counts = {"resolved": faults.resolved_outcomes[number]}
            crossed = zip(faults.certifiers, faults.certifier_outcomes[number], strict=True)
            counts |= dict(sorted(crossed, key=lambda pair: -int(pair[1][0]))[:1])
            columns += [(head, *_counts_of(outcomes)) for head, outcomes in counts.items() if outcomes.any()]
        return columns

    def details(self, number: int) -> str:
        """All else that is known of an elite, as Markdown."""
        archive, ranking, minima = self.archive, self.ranking, self.minima
        others = int((ranking.families == ranking.families[number]).sum()) - 1
        fitness, before, iteration = self.elites.fitness[number], archive.fitness[number], archive.iteration[number]
        parts = [
            *elite_words(archive, number),
            f"{others or 'No'} other elite{'s' * (others > 1)} like it (within 6 cm).",
            f"Fitness **{fitness:.2f}** ({before:.2f} as found in iteration {iteration}): {FITNESS_WORDS}.",
        ]
        if minima is not None and number in minima.genes:
            parts.insert(0, f"**Minimal terrain**: {minima.words(number)}.")
        return "\n\n".join(parts)


def listing_of(archive: Archive, space: TerrainSpace, minima: MinimalTerrains | None = None) -> Listing:
    """The elites of an archive with at least one, and their minimal terrains."""
    return Listing(archive=archive, ranking=rank(archive, space, minima), minima=minima)


def _counts_of(outcomes: NDArray[np.integer]) -> tuple[int, dict[str, int]]:
    """Valid episodes, and how they ended, of counts by :data:`qd.archive.OUTCOMES`."""
    by_name = dict(zip(OUTCOMES, outcomes.tolist(), strict=True))
    goal, collided, *others = (count for name, count in by_name.items() if name != "invalid")
    return goal + collided + sum(others), {"goal_rate": goal, "collision_rate": collided, "other_rate": sum(others)}


def column_of(head: str, crossed: Crossed) -> Column:
    """What was recorded of a controller."""
    hits = {words: rate.hits for words, rate in crossed.rates.items()}
    counts = {
        "goal_rate": hits[ARRIVED], "collision_rate": hits[FAILED[0]], "other_rate": sum(hits[w] for w in FAILED[1:]),
        "fallen_rate": hits["fallen"],
    }  # fmt: skip
    return head, len(crossed.chosen), counts


def table_html(columns: Sequence[Column]) -> str:
    """How episodes ended, a row a way and a column a controller, with 95 % intervals (Wilson)."""
    heads = "".join(f"<th>{escape(head)}<small>{count} episodes</small></th>" for head, count, _ in columns)
    rows = []
    for name, words in RATES.items():
        cells = []
        for _, count, hits in columns:
            rate, _, interval = rate_words(hits[name], count, short=True).partition(" ") if name in hits else ("",) * 3
            cells.append(f"<td><b>{rate}</b> <small>{interval.strip('()')}</small></td>")
        rows.append(f"<tr><th>{words}</th>{''.join(cells)}</tr>")
    return f'<table class="faultline-rates"><tr><th></th>{heads}</tr>{"".join(rows)}</table>'


def plot_svg(listing: Listing, listed: NDArray[np.int64], picked: int) -> str:
    """The archive on parallel axes: a line an elite, grey if it is not listed, the picked one on top.

    The paths name their elites, so that lines can be pointed at in the browser (``page.js``).
    """
    elites, names = listing.elites, listing.archive.penalties
    values = {label_of(name): elites.ratios[:, k] for k, name in enumerate(names)} | {"fitness": elites.fitness}
    values |= {RATES[name]: getattr(elites, name) for name in ("goal_rate", "collision_rate", "fallen_rate")}
    x, bottom = np.linspace(_LEFT, _WIDTH - _RIGHT, len(values)), _HEIGHT - _BOTTOM
    ends = {label: (float(column.min()), float(column.max())) for label, column in values.items()}
    y = np.stack([bottom - (v - low) / max(high - low, 1e-9) * (bottom - _TOP)
                  for v, (low, high) in zip(values.values(), ends.values(), strict=True)], axis=1)  # fmt: skip
    parts = [_lines(x, np.delete(y, listed, axis=0), _GREY, 0.6, 0.6)]
    width = 0.8 * min(1.0, _MANY / max(len(listed), 1)) ** 0.5  # else many lines are one blue area
    # Equally many a shade, so that the first stand out whatever they are sorted by.
    for shade, numbers in zip(_SHADES, reversed(np.array_split(listed, len(_SHADES))), strict=True):
        hints = "|".join(f"{n}: {listing.ranking.name(n)}" for n in numbers.tolist())
        named = f'data-elites="{" ".join(map(str, numbers.tolist()))}" data-hints="{escape(hints)}"'
        parts.append(_lines(x, y[numbers], shade, width, 0.75, named))
    parts.append(_lines(x, y[[picked]], _PICKED, 2.5, 1.0))
    for at, (label, (low, high)) in zip(x, ends.items(), strict=True):
        decimals = 0 if label == "fitness" else 2
        parts.append(f'<line x1="{at:.0f}" y1="{_TOP}" x2="{at:.0f}" y2="{bottom}" stroke="#444"/>')
        parts += [_text(at, _TOP - 5, f"{high:.{decimals}f}"), _text(at, bottom + 12, f"{low:.{decimals}f}")]
        turned = f'transform="rotate(-52 {at:.0f} {bottom + 24})"'
        parts.append(_text(at + 4, bottom + 24, label, "end", turned))
    style = "width:100%;font-family:sans-serif;font-size:10px;fill:currentColor"
    return f'<svg viewBox="0 0 {_WIDTH} {_HEIGHT}" style="{style}" xmlns="http://www.w3.org/2000/svg">{"".join(parts)}</svg>'


def _lines(
    x: NDArray[np.float64], rows: NDArray[np.float64], color: str, width: float, opacity: float, more: str = ""
) -> str:
    """Lines over the same x as one path."""
    path = "".join("M" + "L".join(f"{a:.0f} {b:.1f}" for a, b in zip(x, row, strict=True)) for row in rows)
    style = f'fill="none" stroke="{color}" stroke-width="{width:.2f}" stroke-opacity="{opacity}"'
    return f'<path d="{path}" {style} {more}/>' if path else ""


def _text(x: float, y: float, text: str, anchor: str = "middle", more: str = "") -> str:
    return f'<text x="{x:.0f}" y="{y:.0f}" text-anchor="{anchor}" {more}>{escape(text)}</text>'
