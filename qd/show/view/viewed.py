"""The run that the viewer shows: its elites as the page lists them, and the controllers that cross them.

What a user may have got wrong is refused before a page opens.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qd.faults.families import ORDERS, VERDICTS, Ranking
from qd.faults.numbers import best_certifier, describe_judgement
from qd.show.crossed import count_rates
from qd.show.elites import OpenedRun, open_run
from qd.show.recordings import CrossingRequest, request_elite
from qd.workers.compute import check_policy
from sim.controllers.spec import ControllerSpec, parse_controllers
from sim.files.intervals import format_rate
from sim.files.templates import open_templates
from sim.rates import rate_labels
from sim.recording.recorder import Recording
from sim.terrains.maps.picture import places

SEARCHED = "searched controller"  # on the page, if no other is given
TEMPLATES = open_templates(Path(__file__).parent / "templates")
_GREY = "#d8d8d8"
_LISTED = "#2171b5"
_PICKED = "#d55e00"
FITNESS_TEXT = (
    "what the search looks for: mean scaled penalties, less their spread over episodes, less a share of episodes "
    "without a base collision where others have one; whether the robot fails is said by how often it passes"
)

Column = tuple[str, int, Mapping[str, int]]
"""A head, a number of episodes, and how many of them count for each rate of the table."""


@dataclass(frozen=True, kw_only=True)
class ViewedRun(OpenedRun):
    """What the viewer shows: a run of at least one elite."""

    elite: int | None = None  # which to show first; None for the first of the list
    minimal: bool = False  # whether the first terrain is the elite's minimal one
    controllers: dict[str, str]  # file or code of each, by its name; empty if the search's controller is lost
    note: str = ""  # why there is no controller; empty if there is one

    @cached_property
    def ranking(self) -> Ranking:
        """All elites, their causes and families."""
        return self.rank()

    @cached_property
    def _names(self) -> list[str]:
        return [self.ranking.name(number) for number in range(len(self.archive))]

    def minimal_genes(self, elite: int) -> NDArray[np.float32] | None:
        """Genes of the minimal terrain of an elite; None if it has none."""
        return None if self.minima is None else self.minima.genes.get(elite)

    def request(self, elite: int, controller: str | None, *, minimal: bool = False) -> CrossingRequest | None:
        """A controller's crossings of an elite, or of its minimal terrain if it has one; None without a controller."""
        if controller is None:
            return None
        genes = self.minimal_genes(elite) if minimal else None
        return request_elite(self.archive, elite, policy=self.controllers[controller], minimal=genes)

    def find_certifier(self, number: int) -> tuple[str | None, str]:
        """Name of the controller that passes a failing elite most often, or why there is none to show."""
        archive = self.archive
        name = self.certifier(number)
        if name is not None and self.controllers.get(name) == self.certifiers()[name]:
            return name, ""
        if not archive.certified_by_controllers[number]:
            return None, "No other controller is known to pass it." if archive.failing[number] else ""
        names = compress(archive.certifiers, archive.certificates[number].tolist())
        return None, f"{' and '.join(names)} passes it, but is not at hand: name its file with --policies."

    def list_elites(self, cause: str = "", order: str = next(iter(ORDERS))) -> NDArray[np.int64]:
        """Numbers of the elites of a cause, or of all, in one of the :data:`qd.faults.families.ORDERS`."""
        numbers = self.ranking.order(order)
        return numbers[np.isin(numbers, self.ranking.by_cause()[cause])] if cause else numbers

    def causes(self) -> dict[str, str]:
        """Causes by their label with the number of elites; empty for all."""
        rows = self.ranking.by_cause()
        return {"all": "", **{f"{cause} ({len(members):,})": cause for cause, members in rows.items()}}

    def render_list(self, listed: NDArray[np.int64], picked: int) -> str:
        """HTML of the elites, one below the other; a click on one shows it (``page.js``)."""
        verdicts = [VERDICTS[verdict] for verdict in self.ranking.verdict.tolist()]
        template = TEMPLATES.get_template("list.html")
        return template.render(names=self._names, verdicts=verdicts, listed=listed.tolist(), picked=picked)

    def render_map(self, listed: NDArray[np.int64], picked: int) -> str:
        """HTML of a map of where the typical episode of each elite ends; a click on one shows it (``page.js``)."""
        others = np.setdiff1d(np.arange(len(self.archive)), listed).tolist()
        looks: dict[int, tuple[str, int]] = dict.fromkeys(others, (_GREY, 3))
        looks |= dict.fromkeys(listed[::-1].tolist(), (_LISTED, 3))
        del looks[picked]  # it is drawn over the others
        looks[picked] = (_PICKED, 6)
        ends = self.ranking.end_position.tolist()
        dots = [(number, ends[number], *look) for number, look in looks.items() if np.isfinite(ends[number]).all()]
        template = TEMPLATES.get_template("map.html")
        return template.render(dots=dots, names=self._names, places=places(self.space.asks))

    def columns(self, number: int) -> Sequence[Column]:
        """Episodes on the whole terrain: fresh, finer contact, varied conditions, and of the best certifier."""
        ranking, archive = self.ranking, self.archive
        rates = rate_labels(self.space.asks)
        hits = {name: ranking.hits(name, number) for name in rates}
        first = "fresh" if ranking.is_fresh[number] else "as found"
        columns: list[Column] = [(first, int(ranking.counted[number]), hits)]
        further = {"finer contact": archive.resolved_outcomes[number]}
        if archive.varied is not None:
            further["varied"] = archive.varied.searched[number]
        if name := best_certifier(archive, number):
            further[name] = archive.certifier_outcomes[number, archive.certifiers.index(name)]
        for head, ends in further.items():
            if ends.any():
                columns.append((head, int(ends[:3].sum()), dict(zip(rates, ends[:3].tolist(), strict=False))))
        return columns

    def details(self, number: int) -> str:
        """All else that is known of an elite, as Markdown."""
        ranking = self.ranking
        kin = int((ranking.families == ranking.families[number]).sum()) - 1
        minimal = "" if self.minima is None or number not in self.minima.genes else self.minima.describe(number)
        found = f"{self.archive.fitness[number]:.2f} as found in iteration {self.archive.iteration[number]}"
        paragraphs = [
            *[f"**Minimal terrain**: {minimal}."] * bool(minimal),
            *describe_judgement(self.archive, number),
            f"{kin or 'No'} other elite{'s' * (kin > 1)} like it.",
            f"Fitness **{ranking.fitness[number]:.2f}** ({found}): {FITNESS_TEXT}.",
        ]
        return "\n\n".join(paragraphs)


def count_endings(head: str, recording: Recording) -> Column:
    """The recorded episodes of a controller."""
    rates = count_rates(recording)
    return head, rates["goal_rate"].count, {name: rate.hits for name, rate in rates.items()}


def render_rates(columns: Sequence[Column], rates: Mapping[str, str]) -> str:
    """HTML of how episodes ended: a row a rate and a column a controller, with 95 % intervals (Wilson)."""
    return TEMPLATES.get_template("rates.html").render(columns=columns, rates=rates, format_rate=format_rate)


def open_viewed_run(
    run: Path | None = None,
    *,
    robot: str | None = None,
    elite: str = "",
    minimal: str | None = None,
    policies: Sequence[str] = (),
    space: str | None = None,
    likely: Path | None = None,
) -> ViewedRun:
    """What a user asks to see, by the flags of ``faultline view``."""
    opened_run = open_run(robot, run, space=space, likely=likely)
    if not len(opened_run.archive):
        raise ValueError(f"{opened_run.path} has no elites yet: let its search go on, or give another --run")
    if elite and minimal:
        raise ValueError(f"elite and minimal both say what to open, got '{elite}' and '{minimal}': leave one out")
    number = None
    if elite or minimal is not None:
        number, *others = (terrain.number for terrain in opened_run.terrains(elite, minimal))
        if others:
            raise ValueError(f"elite must be one number, since the viewer opens one, got '{elite or minimal}'")
    controllers, note = _find_controllers(policies, opened_run)
    return ViewedRun(**vars(opened_run), elite=number, minimal=minimal is not None, controllers=controllers, note=note)


def _find_controllers(policies: Sequence[str], opened_run: OpenedRun) -> tuple[dict[str, str], str]:
    """The controllers by name, and why there are none."""
    certifiers = opened_run.certifiers()
    if any(map(str.strip, policies)):
        controllers = parse_controllers(policies, opened_run.robot)
        for policy in controllers.values():
            check_policy(policy, opened_run.robot, "cpu")
        return controllers | {name: file for name, file in certifiers.items() if name not in controllers}, ""
    searched, _ = opened_run.as_searched()
    try:
        if ControllerSpec.parse(searched).runs_code:
            raise ValueError(f"the search's controller {searched} is code, and what a run names is never run")
        policy = opened_run.policy()
        check_policy(policy, opened_run.robot, "cpu")
    except ValueError as error:
        return {}, f"{error}; name a controller with --policies to see crossings"
    return {SEARCHED: policy, **certifiers}, ""
