"""The elites of an archive as the page lists them: by order and cause, on a map, and what is known of each."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qd.faults.families import ORDERS, VERDICTS, Ranking, rank
from qd.faults.minimise.minimise import MinimalTerrains
from qd.faults.numbers import best_certifier, describe_judgement
from qd.search.archive import Archive
from qd.show.crossed import ARRIVED, FAILED, count_rates
from qd.show.elites import OpenedRun
from sim.crossing import CrossingCfg
from sim.files.intervals import format_rate
from sim.files.templates import open_templates
from sim.recording.recorder import Recording

TEMPLATES = open_templates(Path(__file__).parent / "templates")
"""HTML of the page."""
_GREY = "#d8d8d8"
_LISTED = "#2171b5"
_PICKED = "#d55e00"
_RATES = {
    "goal_rate": "reached the goal",
    "collision_rate": "base collision",
    "other_rate": "out of time, off it",
    "fallen_rate": "fallen",
}
FITNESS_TEXT = (
    "what the search looks for: mean scaled penalties, less their spread over episodes, less a share of episodes "
    "without a base collision where others have one; whether the robot fails is said by the goal rate"
)
"""What fitness is, and what it is not."""

Column = tuple[str, int, Mapping[str, int]]
"""A head, a number of episodes, and how many of them count for each rate of the table."""


@dataclass(frozen=True, kw_only=True)
class Listing:
    """All elites of a run, at least one."""

    opened_run: OpenedRun
    minima: MinimalTerrains | None = None

    @property
    def archive(self) -> Archive:
        """The elites."""
        return self.opened_run.archive

    @cached_property
    def ranking(self) -> Ranking:
        """All elites, their causes and families."""
        run = self.opened_run
        return rank(run.archive, run.space, self.minima, half_width=run.robot.half_width)

    @cached_property
    def _orders(self) -> dict[str, NDArray[np.int64]]:
        return {name: self.ranking.order(name) for name in ORDERS}

    @cached_property
    def _names(self) -> list[str]:
        return [self.ranking.name(number) for number in range(len(self.archive))]

    def list_elites(self, cause: str = "", order: str = next(iter(ORDERS))) -> NDArray[np.int64]:
        """Numbers of the elites of a cause, or of all, in one of the :data:`qd.faults.families.ORDERS`."""
        numbers = self._orders[order]
        return numbers[np.isin(numbers, self.ranking.by_cause()[cause])] if cause else numbers

    def causes(self) -> dict[str, str]:
        """Causes by their label with the number of elites; empty for all."""
        rows = self.ranking.by_cause()
        return {"all": "", **{f"{cause} ({len(members):,})": cause for cause, members in rows.items()}}

    def verdict(self, number: int) -> str:
        """One of :data:`qd.faults.families.VERDICTS`."""
        return VERDICTS[int(self.ranking.verdict[number])]

    def render_list(self, listed: NDArray[np.int64], picked: int) -> str:
        """HTML of the elites, one below the other; a click on one shows it (``page.js``)."""
        template = TEMPLATES.get_template("list.html")
        return template.render(listing=self, names=self._names, listed=listed.tolist(), picked=picked)

    def render_map(self, listed: NDArray[np.int64], picked: int) -> str:
        """HTML of a map of where the typical episode of each elite ends; a click on one shows it (``page.js``)."""
        drawn = [*np.setdiff1d(np.arange(len(self.archive)), listed), *listed[::-1]]
        colors = dict.fromkeys(drawn, _GREY) | dict.fromkeys(listed, _LISTED)
        colors.pop(picked)
        positions = self.ranking.end_position
        dots = [
            (number, positions[number].tolist(), color, 6 if color == _PICKED else 3)
            for number, color in (colors | {picked: _PICKED}).items()
            if np.isfinite(positions[number]).all()
        ]
        template = TEMPLATES.get_template("map.html")
        return template.render(dots=dots, names=self._names, start=CrossingCfg.start, goal=CrossingCfg.goal)

    def columns(self, number: int) -> Sequence[Column]:
        """Episodes on the whole terrain: fresh, finer contact, varied conditions, and of the best certifier."""
        ranking = self.ranking
        archive = self.archive
        head = "fresh" if ranking.is_fresh[number] else "as found"
        columns: list[Column] = [
            (head, int(ranking.counted[number]), {name: ranking.hits(name, number) for name in _RATES})
        ]
        outcomes_by_head = {"finer contact": archive.resolved_outcomes[number]}
        if archive.varied_outcomes is not None:
            outcomes_by_head["varied"] = archive.varied_outcomes[number]
        if name := best_certifier(archive, number):
            outcomes_by_head[name] = archive.certifier_outcomes[number, archive.certifiers.index(name)]
        for head, outcomes in outcomes_by_head.items():
            if outcomes.any():
                goal, collided, other, _ = outcomes.tolist()
                hits = {"goal_rate": goal, "collision_rate": collided, "other_rate": other}
                columns.append((head, sum(hits.values()), hits))
        return columns

    def details(self, number: int) -> str:
        """All else that is known of an elite, as Markdown."""
        ranking = self.ranking
        kin = int((ranking.families == ranking.families[number]).sum()) - 1
        paragraphs = [
            *describe_judgement(self.archive, number),
            f"{kin or 'No'} other elite{'s' * (kin > 1)} like it (within 6 cm).",
            f"Fitness **{ranking.fitness[number]:.2f}** ({self.archive.fitness[number]:.2f} as found in "
            f"iteration {self.archive.iteration[number]}): {FITNESS_TEXT}.",
        ]
        if self.minima is not None and number in self.minima.genes:
            paragraphs.insert(0, f"**Minimal terrain**: {self.minima.describe(number)}.")
        return "\n\n".join(paragraphs)


def count_endings(head: str, recording: Recording) -> Column:
    """The recorded episodes of a controller."""
    rates = count_rates(recording)
    hits = {label: rate.hits for label, rate in rates.items()}
    collision, *others = FAILED
    counts = {
        "goal_rate": hits[ARRIVED],
        "collision_rate": hits[collision],
        "other_rate": sum(hits[label] for label in others),
        "fallen_rate": hits["fallen"],
    }
    return head, rates[ARRIVED].count, counts


def render_rates(columns: Sequence[Column]) -> str:
    """HTML of how episodes ended: a row an ending and a column a controller, with 95 % intervals (Wilson)."""
    return TEMPLATES.get_template("rates.html").render(columns=columns, rates=_RATES, format_rate=format_rate)
