"""The elites of an archive by what is known best of each, in groups and in orders to show them in.

Elites are grouped in two ways. Families: terrains that are much alike, so that they are not independent of each other.
Causes: failing elites on which a part of the same kind stops the robot, such as a ridge.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components

from kernels.episode import Outcome
from qd.faults.causes import HALF_WIDTH, UNCLEAR, causes_at, commonest_words
from qd.faults.minimise.results import MinimalTerrains
from qd.faults.numbers import count_faults
from qd.search.archive import Archive
from qd.search.fitness import FAILING_GOAL_RATE, Evaluation
from sim.crossing import CrossingCfg
from sim.robots.shipped import ROBOTS
from sim.terrains.bank import heights_of
from sim.terrains.spaces.base import TerrainSpace

VERDICTS = ("", "failing", "certified", "confirmed", "fault")
"""From the least to the most: what is certified alone, the controller may cross with contact resolved."""
KIN_M = 0.06
"""Terrains whose heights differ by less (root mean square) are kin [m]. Of 850 hard-random terrains no two are."""
_EVERY = 2  # nodes; distances are compared at 0.1 m
_BANK = 50  # height maps that are made at once

ORDERS = {
    "cause": "faults first, one a cause",
    "fault": "faults first",
    "goal_rate": "goal rate, the lowest first",
    "collision_rate": "base collision, the most first",
    "fallen_rate": "fallen, the most first",
    "fitness": "fitness, the highest first",
    "family": "families of like terrains",
}
"""Orders of elites, in words."""


def verdicts_of(archive: Archive) -> NDArray[np.int64]:
    """The verdict on each elite as its place in :data:`VERDICTS`, shape (N,)."""
    failing, confirmed, certified = archive.failing, archive.confirmed, archive.certified
    conditions = [confirmed & certified, confirmed, certified, failing]
    return np.select(conditions, [4, 3, 2, 1], 0).astype(np.int64)


def verdict_of(archive: Archive, number: int) -> str:
    """The verdict on one elite in a word."""
    return VERDICTS[int(verdicts_of(archive)[number])]


_WAYS = {
    Outcome.GOAL: "crosses it",
    Outcome.BASE_COLLISION: "hits the ground",
    Outcome.TIME_OUT: "gets stuck",
    Outcome.OUT: "leaves the terrain",
    Outcome.INVALID: "breaks the simulation",
}


def way_to_end(outcome: int, fallen: bool) -> str:
    """How an episode ended, as one says of a robot: ``topples`` of one that fell and did not arrive."""
    return "topples" if fallen and outcome not in (Outcome.GOAL, Outcome.INVALID) else _WAYS[Outcome(outcome)]


@dataclass(frozen=True, kw_only=True)
class Elites(Evaluation):
    """N elites by what fresh episodes say of each where it has valid ones, else as they were found.

    Lower numbers have a higher fitness.
    """

    numbers: NDArray[np.int64]
    """Number of each elite in the archive, shape (N,), ascending."""
    fresh: NDArray[np.bool_]
    """Whether the values are of fresh episodes, shape (N,)."""
    verdict: NDArray[np.int64]
    """Place in :data:`VERDICTS`, shape (N,). Without fresh episodes those that found it say whether it fails."""

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def failing(self) -> NDArray[np.bool_]:
        """Whether under half of the robots reach the goal, shape (N,)."""
        return self.goal_rate < FAILING_GOAL_RATE

    @property
    def other_rate(self) -> NDArray[np.float64]:
        """Share that neither arrived nor collided: out of time or off the terrain, shape (N,)."""
        return np.clip(1.0 - self.goal_rate - self.collision_rate, 0.0, 1.0)

    def rows(self, chosen: NDArray[np.int64]) -> "Elites":
        """The elites in some rows, in their order."""
        return Elites(**{field.name: getattr(self, field.name)[chosen] for field in fields(self)})

    def place_of(self, number: int) -> int:
        """Row of an elite by its number in the archive."""
        return int(np.searchsorted(self.numbers, number))

    def hits(self, rate: str, place: int) -> int:
        """Episodes of the elite in a row that a rate counts."""
        return round(float(getattr(self, rate)[place]) * int(self.counted[place]))

    def ending(self, row: int) -> tuple[str, str]:
        """How most robots that fail an elite end, in words, and the name of the rate that counts them."""
        collided, place = self.collision_rate[row], self.end_position[row]
        is_out = (place <= CrossingCfg.lower).any() or (place >= CrossingCfg.upper).any()
        outcome, rate = Outcome.OUT if is_out else Outcome.TIME_OUT, "other_rate"
        if collided >= self.other_rate[row]:
            outcome, rate = Outcome.BASE_COLLISION, "collision_rate"
        fallen = 2 * self.fallen_rate[row] > (collided if outcome == Outcome.BASE_COLLISION else 1.0)
        return way_to_end(outcome, fallen), "fallen_rate" if fallen else rate

    def by_severity(self) -> NDArray[np.int64]:
        """Rows by how badly the robot fares, shape (N,), the worst first: by verdict, rates, and fitness at last.

        Fitness alone does not order by failure: it prizes trouble that is the same in every episode.
        """
        return np.lexsort((-self.fitness, -self.fallen_rate, -self.collision_rate, self.goal_rate, -self.verdict))


def elites_of(archive: Archive, *, judged: bool = False) -> Elites:
    """The elites of an archive, in its order; ``judged`` leaves out those whose fresh episodes are invalid."""
    values = {field.name: np.asarray(getattr(archive, field.name)) for field in fields(Evaluation)}
    is_fresh = np.zeros(len(archive), bool)
    if (fresh := archive.fresh) is not None:
        is_fresh = fresh.valid
        for name, value in values.items():
            values[name] = np.where(is_fresh.reshape(-1, *[1] * (value.ndim - 1)), getattr(fresh, name), value)
    verdict = np.maximum(verdicts_of(archive), values["goal_rate"] < FAILING_GOAL_RATE)
    elites = Elites(numbers=np.arange(len(archive)), fresh=is_fresh, verdict=verdict, **values)
    return elites.rows(np.flatnonzero(is_fresh)) if judged and fresh is not None else elites


def families_of(genes: NDArray[np.float32], space: TerrainSpace) -> NDArray[np.int64]:
    """Number of the family of each terrain, from 0 in the order of its first member, shape (N,).

    Who descends from whom is not recorded. Terrains within :data:`KIN_M` are kin, and kin of kin are one family. Genes
    have shape (N, num_genes).
    """
    if not len(genes):
        return np.zeros(0, np.int64)
    banks = [heights_of(genes[first : first + _BANK], space, every=_EVERY) for first in range(0, len(genes), _BANK)]
    maps = np.concatenate([bank.reshape(len(bank), -1).astype(np.float64) for bank in banks])
    _, families = connected_components(rms_distances(maps, maps) < KIN_M, directed=False)
    return families.astype(np.int64)


def rms_distances(maps: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square distances of height maps [m], shape (T, num_nodes), to others, (N, num_nodes): shape (T, N).

    They are double, since their squares are subtracted from each other.
    """
    squares = (maps**2).sum(axis=1)[:, None] + (others**2).sum(axis=1) - 2.0 * maps @ others.T
    return np.sqrt(np.maximum(squares, 0.0) / maps.shape[1])


@dataclass(frozen=True, kw_only=True)
class Ranking:
    """N elites, why they stop the robot, and their families, in orders to show them in."""

    elites: Elites
    causes: tuple[str, ...]
    """What stops the robot on each, such as ``ridge``: the cause of its minimal terrain, or where there is none of the
    place where its typical episode ends (:func:`qd.faults.causes.causes_at`). Empty of an elite that does not fail."""
    families: NDArray[np.int64]
    """Family of each, shape (N,), numbered from 1 by its worst member."""

    def name(self, row: int) -> str:
        """An elite by its own cause and ending: ``ridge: gets stuck, 19 of 20``; ``crossed, 18 of 20`` of others."""
        elites = self.elites
        if not elites.failing[row]:
            return f"crossed, {elites.hits('goal_rate', row)} of {elites.counted[row]}"
        ending, rate = elites.ending(row)
        return f"{self.causes[row]}: {ending}, {elites.hits(rate, row)} of {elites.counted[row]}"

    def by_cause(self) -> dict[str, NDArray[np.int64]]:
        """Rows of the failing elites by cause, within each the worst first; the commonest first, the unclear last."""
        rows: dict[str, list[int]] = {}
        for row in self.elites.by_severity().tolist():
            if self.causes[row]:
                rows.setdefault(self.causes[row], []).append(row)
        commonest = sorted(rows, key=lambda cause: (cause == UNCLEAR, -len(rows[cause])))
        return {cause: np.array(rows[cause], np.int64) for cause in commonest}

    def order(self, by: str = "cause") -> NDArray[np.int64]:
        """Rows of all elites, shape (N,), in one of the :data:`ORDERS`; ties are by severity.

        ``cause`` begins with the worst terrain of each cause, no two of one family where that can be had: faults first,
        then the commonest cause. The worst failing terrain of each other family follows, then the rest.
        """
        severity = self.elites.by_severity()
        if by == "fault":
            return severity
        if by == "cause":
            return self._leading(severity)
        values = self.families if by == "family" else np.asarray(getattr(self.elites, by))
        sign = 1 if by in ("family", "goal_rate") else -1
        return severity[np.argsort(sign * values[severity], kind="stable")]

    def _leading(self, severity: NDArray[np.int64]) -> NDArray[np.int64]:
        families = self.families.tolist()
        leading: dict[int, int] = {}  # families by row
        for rows in self.by_cause().values():
            leader = next((row for row in rows.tolist() if families[row] not in leading.values()), int(rows[0]))
            leading[leader] = families[leader]
        leading = dict(sorted(leading.items(), key=lambda pair: -int(self.elites.verdict[pair[0]])))
        for row in severity[self.elites.failing[severity]].tolist():
            if families[row] not in leading.values():
                leading[row] = families[row]
        return np.array([*leading, *severity[~np.isin(severity, [*leading])]], dtype=np.int64)

    def worst(self, count: int) -> list[int]:
        """Numbers of the first terrains of the order ``cause``."""
        return self.elites.numbers[self.order()[:count]].tolist()


def rank(
    archive: Archive,
    space: TerrainSpace,
    minima: MinimalTerrains | None = None,
    *,
    judged: bool = False,
    numbers: Sequence[int] | None = None,
) -> Ranking:
    """The ranking of an archive that has elites.

    Minimal terrains say best what the cause is. ``judged`` leaves out elites whose fresh episodes are invalid;
    ``numbers`` are elites to rank alone, one a row.
    """
    elites = elites_of(archive, judged=judged)
    elites = elites if numbers is None else elites.rows(np.searchsorted(elites.numbers, numbers))
    archive = archive.rows(elites.numbers)
    families = families_of(archive.genes, space) if archive.family is None else archive.family
    by_worst = {family: place for place, family in enumerate(dict.fromkeys(families[elites.by_severity()].tolist()), 1)}
    causes = causes_of(elites, archive, space) if archive.cause is None else archive.cause
    entries = [] if minima is None else minima.numbers["elites"]
    of_minimal = {entry["elite"]: entry["cause"]["kind"] for entry in entries if entry["cause"]}
    rows = zip(elites.numbers.tolist(), causes.tolist(), strict=True)
    return Ranking(
        elites=elites,
        causes=tuple(of_minimal.get(number, cause) if cause else "" for number, cause in rows),
        families=np.array([by_worst[family] for family in families.tolist()], np.int64),
    )


def causes_of(elites: Elites, archive: Archive, space: TerrainSpace) -> NDArray[np.str_]:
    """What stops the robot on each elite where its typical episode ends, shape (N,); empty where it does not fail."""
    failing, half_width = elites.failing, ROBOTS[archive.robot].footprint[1] if archive.robot in ROBOTS else HALF_WIDTH
    causes = np.full(len(elites), "", object)
    causes[failing] = causes_at(archive.genes[failing], elites.end_position[failing], space, half_width)
    return causes.astype(np.str_)


def summary_of(ranking: Ranking, archive: Archive) -> str:
    """What a search says of the controller, in one plain sentence."""
    elites, by_cause = ranking.elites, ranking.by_cause()
    failing = int(elites.failing.sum())
    if len(elites) == 1:
        words = ["The only terrain stops the robot" if failing else "The robot crosses the only terrain"]
    elif not failing:
        words = [f"The robot crosses all {len(elites):,} terrains"]
    else:
        words = [f"{failing:,} of {len(elites):,} terrains {'stops' if failing == 1 else 'stop'} the robot"]
    commonest = next(iter(by_cause), UNCLEAR)
    if commonest != UNCLEAR:
        words.append(commonest_words(commonest) if failing > 1 else f"cause: {commonest}")
    if failing and archive.counts.certifiers:
        faults, crosses = count_faults(archive), "another controller of this robot crosses"
        if faults is None:
            words.append(f"{crosses} {archive.certified.sum() or 'none'} of them")
        elif faults == 0:
            words.append("none is known to be a fault")
        else:
            words.append(f"1 is a fault: {crosses} it" if faults == 1 else f"{faults:,} are faults: {crosses} them")
    return "; ".join(words)
