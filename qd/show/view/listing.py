"""The elites of an archive as the page lists them: in orders, by cause, as a plot, and what is known of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from html import escape

import numpy as np
from numpy.typing import NDArray

from qd.faults.families import ORDERS, VERDICTS, Ranking, rank
from qd.faults.minimise.minimise import MinimalTerrains
from qd.faults.numbers import certifier_of, elite_words
from qd.search.archive import Archive
from qd.show.crossed import ARRIVED, FAILED, count_rates
from sim.crossing import CrossingCfg
from sim.files.intervals import format_rate
from sim.recording.recorder import Recording
from sim.terrains.spaces.base import TerrainSpace

_GREY, _LISTED, _PICKED = "#d8d8d8", "#2171b5", "#d55e00"
RATES = {"goal_rate": "reached the goal", "collision_rate": "base collision", "other_rate": "out of time, off it",
         "fallen_rate": "fallen"}  # fmt: skip
FITNESS_WORDS = (
    "what the search looks for: mean scaled penalties, less their spread over episodes, less a share of episodes "
    "without a base collision where others have one; whether the robot fails is said by the goal rate"
)
"""What fitness is, and what it is not."""

Column = tuple[str, int, Mapping[str, int]]
"""A head, a number of episodes, and how many of them each of the :data:`RATES` counts."""


@dataclass(frozen=True, kw_only=True)
class Listing:
    """All elites of an archive."""

    archive: Archive
    """It has at least one."""
    space: TerrainSpace
    minima: MinimalTerrains | None = None

    @cached_property
    def ranking(self) -> Ranking:
        """All elites, their causes and families."""
        return rank(self.archive, self.space, self.minima)

    @cached_property
    def _orders(self) -> dict[str, NDArray[np.int64]]:
        return {name: self.ranking.order(name) for name in ORDERS}

    def listed(self, cause: str = "", order: str = next(iter(ORDERS))) -> NDArray[np.int64]:
        """Numbers of the elites of a cause, or of all, in one of the :data:`qd.faults.families.ORDERS`."""
        numbers = self._orders[order]
        return numbers[np.isin(numbers, self.ranking.by_cause()[cause])] if cause else numbers

    def causes(self) -> dict[str, str]:
        """What stops the robot by its words with the number of elites; empty for all."""
        rows = self.ranking.by_cause()
        return {"all": "", **{f"{cause} ({len(members):,})": cause for cause, members in rows.items()}}

    def verdict(self, number: int) -> str:
        """One of :data:`qd.faults.families.VERDICTS`."""
        return VERDICTS[int(self.ranking.elites.verdict[number])]

    def rows_html(self, numbers: Sequence[int]) -> str:
        """Elites one below the other, as HTML; a click on one shows it (``page.js``)."""
        return "".join(
            f'<div data-elite="{n}"><b>{n}</b> {escape(self.ranking.name(n))} <small>{self.verdict(n)}</small></div>'
            for n in numbers
        )

    def columns(self, number: int) -> Sequence[Column]:
        """What is known of the whole terrain: fresh episodes, finer contact, varied conditions, the best certifier."""
        elites, faults = self.ranking.elites, self.archive.faults
        count = int(elites.counted[number])
        head = "fresh" if elites.fresh[number] else "as found"
        columns: list[Column] = [(head, count, {name: elites.hits(name, number) for name in RATES})]
        if faults is not None:
            counts = {"finer contact": faults.resolved_outcomes[number]}
            if faults.varied_outcomes is not None:
                counts["varied"] = faults.varied_outcomes[number]
            if name := certifier_of(self.archive, number):
                counts[name] = faults.certifier_outcomes[number, faults.certifiers.index(name)]
            for head, outcomes in counts.items():
                goal, collided, other, _ = outcomes.tolist()
                hits = {"goal_rate": goal, "collision_rate": collided, "other_rate": other}
                columns += [(head, sum(hits.values()), hits)] * bool(outcomes.any())
        return columns

    def details(self, number: int) -> str:
        """All else that is known of an elite, as Markdown."""
        archive, ranking, minima = self.archive, self.ranking, self.minima
        others = int((ranking.families == ranking.families[number]).sum()) - 1
        fitness, before, iteration = (of[number] for of in (ranking.elites.fitness, archive.fitness, archive.iteration))
        parts = [
            *elite_words(archive, number),
            f"{others or 'No'} other elite{'s' * (others > 1)} like it (within 6 cm).",
            f"Fitness **{fitness:.2f}** ({before:.2f} as found in iteration {iteration}): {FITNESS_WORDS}.",
        ]
        if minima is not None and number in minima.genes:
            parts.insert(0, f"**Minimal terrain**: {minima.words(number)}.")
        return "\n\n".join(parts)


def count_endings(head: str, recording: Recording) -> Column:
    """What was recorded of a controller."""
    rates = count_rates(recording)
    hits = {words: rate.hits for words, rate in rates.items()}
    counts = {
        "goal_rate": hits[ARRIVED], "collision_rate": hits[FAILED[0]], "other_rate": sum(hits[w] for w in FAILED[1:]),
        "fallen_rate": hits["fallen"],
    }  # fmt: skip
    return head, rates[ARRIVED].count, counts


def table_html(columns: Sequence[Column]) -> str:
    """How episodes ended, a row a way and a column a controller, with 95 % intervals (Wilson)."""
    heads = "".join(f"<th>{escape(head)}<small>{count} episodes</small></th>" for head, count, _ in columns)
    rows = []
    for name, words in RATES.items():
        cells = []
        for _, count, hits in columns:
            rate, _, interval = format_rate(hits[name], count, short=True).partition(" ") if name in hits else ("",) * 3
            cells.append(f"<td><b>{rate}</b> <small>{interval.strip('()')}</small></td>")
        rows.append(f"<tr><th>{words}</th>{''.join(cells)}</tr>")
    return f'<table class="faultline-rates"><tr><th></th>{heads}</tr>{"".join(rows)}</table>'


def map_svg(listing: Listing, listed: NDArray[np.int64], picked: int) -> str:
    """From above, where the typical episode of each elite ends: grey if it is not listed; a click on one shows it."""
    elites, shown, dots = listing.ranking.elites, set(listed.tolist()), []
    for number in (*np.setdiff1d(elites.numbers, listed).tolist(), *reversed(listed.tolist()), picked):
        x, y = elites.end_position[number]
        if np.isfinite(x + y):
            color, radius = (_PICKED, 6) if number == picked else (_LISTED if number in shown else _GREY, 3)
            words = escape(f"{number}: {listing.ranking.name(number)}")
            place = f'cx="{20 * x:.0f}" cy="{160 - 20 * y:.0f}" r="{radius}"'
            dots.append(f'<circle data-elite="{number}" {place} fill="{color}"><title>{words}</title></circle>')
    ends = "".join(
        f'<text x="{20 * x:.0f}" y="{154 - 20 * y:.0f}" text-anchor="middle" class="place">{words}</text>'
        for words, (x, y) in {"start": CrossingCfg.start, "goal": CrossingCfg.goal}.items()
    )
    frame = '<rect width="320" height="160" fill="none" stroke="#adb5bd"/>'
    style = "width:100%;font-family:sans-serif;font-size:11px;fill:currentColor;overflow:visible"
    return f'<svg viewBox="0 0 320 160" style="{style}">{frame}{"".join(dots)}{ends}</svg>'
