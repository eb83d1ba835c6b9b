"""The elites of an archive by what is known best of each, in groups and in orders to show them in.

Kin are terrains so much alike that they are not independent. Families are kin of kin; distinct terrains are no kin. A
cause groups failing elites on which parts of one kind stop the robot, such as ridges.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields, replace
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse.csgraph import connected_components
from scipy.spatial.distance import cdist

from kernels.episode import Kind, Outcome
from qd.faults.causes import UNCLEAR, describe_commonest, find_causes
from qd.faults.numbers import TEMPLATES, MinimalTerrains, count_faults, fault_numbers
from qd.search.archive import Archive
from qd.search.fitness import FAILING_GOAL_RATE, Evaluation
from sim.crossing import CrossingCfg
from sim.rates import SUCCESS, way_to_end
from sim.terrains.bank import make_heights
from sim.terrains.conditions.kinds import condition_genes
from sim.terrains.conditions.likely import Disturbance, find_log_likelihood
from sim.terrains.spaces.base import ShippedSpace, TerrainSpace
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.spaces.wider import WiderSpace

VERDICTS = ("", "failing", "certified", "confirmed", "fault")  # from the least to the most
KIN_M = 0.06  # terrains of bumps up to 0.25 m are kin if their heights differ by less (RMS) [m]: no two random ones
_KIN_SHARE = 0.25  # of a condition's range
_EVERY = 2  # nodes; distances are compared at 0.1 m
_BANK = 50  # height maps that are made at once
_FLAT_M = 1e-3  # RMS height of a flat space [m]

ORDERS = {
    "cause": "faults first, one a cause",
    "fault": "faults first",
    "likely": "faults first, the most likely conditions first",
    "goal_rate": "passed, the least first",
    "collision_rate": "base collision, the most first",
    "fallen_rate": "fallen, the most first",
    "fitness": "fitness, the highest first",
    "family": "families of like terrains",
}
"""Orders of elites, with their labels; ``likely`` only where it is known how conditions are distributed."""


def find_verdicts(archive: Archive) -> NDArray[np.int64]:
    """The verdict on each elite as its index in :data:`VERDICTS`, shape (N,)."""
    conditions = [archive.is_fault, archive.confirmed, archive.certified, archive.failing]
    return np.select(conditions, [4, 3, 2, 1], 0).astype(np.int64)


@dataclass(frozen=True, kw_only=True)
class Ranking(Evaluation):
    """N elites by what is known best of each: values of fresh episodes where valid ones exist, else as found."""

    numbers: NDArray[np.int64]  # number of each elite in the archive, shape (N,), ascending
    is_fresh: NDArray[np.bool_]  # whether the values are of fresh episodes, shape (N,)
    verdict: NDArray[np.int64]  # index in VERDICTS, shape (N,); without fresh episodes by those that found it
    causes: tuple[str, ...]  # by the minimal terrain, else the typical episode; empty where the robot does not fail
    families: NDArray[np.int64]  # family of each, shape (N,), numbered from 1 by its worst member
    asks: Kind = Kind.CROSS  # what robots are asked for
    log_likelihood: NDArray[np.float64] | None = None  # of the conditions of each, shape (N,), if known

    @property
    def orders(self) -> dict[str, str]:
        """The orders that are known, with their labels."""
        return {name: label for name, label in ORDERS.items() if name != "likely" or self.log_likelihood is not None}

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def failing(self) -> NDArray[np.bool_]:
        """Whether under half of the episodes succeed, shape (N,)."""
        return self.goal_rate < FAILING_GOAL_RATE

    def find_row(self, number: int) -> int:
        """Row of an elite by its number in the archive."""
        return int(np.searchsorted(self.numbers, number))

    def hits(self, rate: str, row: int) -> int:
        """Episodes of the elite in a row that a rate counts."""
        return round(float(getattr(self, rate)[row]) * int(self.counted[row]))

    def ending(self, row: int) -> tuple[str, str]:
        """How most robots that fail an elite end, or that it is passed, and the name of the rate that counts them."""
        if not self.failing[row]:
            return SUCCESS[self.asks], "goal_rate"
        end, collided = self.end_position[row], float(self.collision_rate[row])
        is_out = (end <= CrossingCfg.lower).any() or (end >= CrossingCfg.upper).any()
        outcome = Outcome.STRAYED if self.asks != Kind.CROSS else Outcome.OUT if is_out else Outcome.TIME_OUT
        rate, share = "other_rate", 1.0
        if collided >= self.other_rate[row]:
            outcome, rate, share = Outcome.BASE_COLLISION, "collision_rate", collided
        fallen = bool(2 * self.fallen_rate[row] > share)
        return way_to_end(outcome, self.asks, fallen=fallen), "fallen_rate" if fallen else rate

    def name(self, row: int) -> str:
        """An elite by its cause and ending: ``ridge: gets stuck, 19 of 20``; others ``reaches the goal, 18 of 20``."""
        ending, rate = self.ending(row)
        cause = f"{self.causes[row]}: " if self.failing[row] else ""
        return f"{cause}{ending}, {self.hits(rate, row)} of {self.counted[row]}"

    def by_cause(self) -> dict[str, NDArray[np.int64]]:
        """Rows of the failing elites by cause, the worst first; the commonest cause first, the unclear last."""
        severity = self.by_severity()
        causes = np.array(self.causes)[severity]
        rows = {cause: severity[causes == cause] for cause in dict.fromkeys(causes.tolist()) if cause}
        return dict(sorted(rows.items(), key=lambda pair: (pair[0] == UNCLEAR, -len(pair[1]))))

    def by_severity(self) -> NDArray[np.int64]:
        """Rows by how badly the robot fares, shape (N,), the worst first: by verdict, rates, and fitness at last."""
        # Fitness alone does not order by failure: it prizes trouble that is the same in every episode.
        return np.lexsort((-self.fitness, -self.fallen_rate, -self.collision_rate, self.goal_rate, -self.verdict))

    def order(self, by: str = "cause") -> NDArray[np.int64]:
        """Rows of all elites, shape (N,), in one of the :data:`ORDERS`; ties are by severity.

        ``cause`` begins with the worst terrain of each cause, no two of one family where that can be had: faults first,
        then the commonest cause. The worst failing terrain of each other family follows, then the rest.
        """
        severity = self.by_severity()
        if by == "fault":
            return severity
        if by == "likely":
            assert self.log_likelihood is not None  # see orders
            return severity[np.lexsort((-self.log_likelihood[severity], -self.verdict[severity]))]
        if by != "cause":
            values = self.families if by == "family" else np.asarray(getattr(self, by))
            sign = 1 if by in ("family", "goal_rate") else -1
            return severity[np.argsort(sign * values[severity], kind="stable")]
        families, leading = self.families.tolist(), dict[int, int]()  # leading families by row
        for rows in self.by_cause().values():
            leader = next((row for row in rows.tolist() if families[row] not in leading.values()), int(rows[0]))
            leading[leader] = families[leader]
        leading = dict(sorted(leading.items(), key=lambda pair: -int(self.verdict[pair[0]])))
        for row in severity[self.failing[severity]].tolist():
            if families[row] not in leading.values():
                leading[row] = families[row]
        return np.array([*leading, *severity[~np.isin(severity, [*leading])]], dtype=np.int64)

    def worst(self, count: int) -> list[int]:
        """Numbers of the first terrains of the order ``cause``."""
        return self.numbers[self.order()[:count]].tolist()


def rank(
    archive: Archive,
    space: TerrainSpace,
    minima: MinimalTerrains | None = None,
    *,
    half_width: float,
    judged: bool = False,
    numbers: Sequence[int] | None = None,
    likely: Mapping[str, Disturbance] | None = None,
) -> Ranking:
    """The ranking of an archive that has elites.

    Minimal terrains say best what the cause is. ``judged`` leaves out elites with invalid fresh episodes; ``numbers``
    are elites to rank alone. ``likely`` says how conditions are distributed.
    """
    chosen = np.arange(len(archive)) if numbers is None else np.array(numbers, np.int64)
    if judged and archive.fresh is not None:
        chosen = chosen[archive.fresh.valid[chosen]]
    archive = archive.rows(chosen)
    values, is_fresh = best_values(archive)
    families = find_families(archive.genes, space) if archive.family is None else archive.family
    causes = find_failing_causes(archive, space, half_width) if archive.cause is None else archive.cause
    entries = minima.numbers["elites"] if minima else []
    minimal_causes = {entry["elite"]: entry["cause"]["kind"] for entry in entries if entry["cause"]}
    known = zip(chosen.tolist(), causes.tolist(), strict=True)
    ranking = Ranking(
        **values,
        numbers=chosen,
        is_fresh=is_fresh,
        verdict=np.maximum(find_verdicts(archive), values["goal_rate"] < FAILING_GOAL_RATE),
        causes=tuple(cause and minimal_causes.get(number, cause) for number, cause in known),
        families=families,
        asks=space.asks,
        log_likelihood=find_log_likelihood(space.condition_rows(archive.genes), likely) if likely else None,
    )
    worst_first = dict.fromkeys(families[ranking.by_severity()].tolist())
    by_worst = {family: number for number, family in enumerate(worst_first, 1)}
    return replace(ranking, families=np.array([by_worst[family] for family in families.tolist()], np.int64))


def best_values(archive: Archive) -> tuple[dict[str, NDArray[Any]], NDArray[np.bool_]]:
    """The evaluation of each elite by fresh episodes where valid ones exist, else as found, and where they do."""
    values = {field.name: np.asarray(getattr(archive, field.name)) for field in fields(Evaluation)}
    if archive.fresh is None:
        return values, np.zeros(len(archive), bool)
    is_fresh = archive.fresh.valid
    for name, value in values.items():
        values[name] = np.where(is_fresh.reshape(-1, *[1] * (value.ndim - 1)), getattr(archive.fresh, name), value)
    return values, is_fresh


def find_failing_causes(archive: Archive, space: TerrainSpace, half_width: float) -> NDArray[np.str_]:
    """What stops the robot on each elite where its typical episode ends, shape (N,); empty where it does not fail."""
    values, _ = best_values(archive)
    failing = values["goal_rate"] < FAILING_GOAL_RATE
    causes = np.full(len(archive), "", object)
    causes[failing] = find_causes(archive.genes[failing], values["end_position"][failing], space, half_width)
    return causes.astype(np.str_)


def find_families(genes: NDArray[np.float32], space: TerrainSpace) -> NDArray[np.int64]:
    """Family of each terrain, kin of kin, by genes (N, num_genes): (N,), from 0 in the order of first members."""
    _, families = connected_components(kin_distances(genes, space) < 1.0, directed=False)
    return families.astype(np.int64)


def pick_distinct(distances: NDArray[np.float64], least: float = 1.0) -> NDArray[np.bool_]:
    """Which terrains are distinct, at least so far from each one picked before, by distances (N, N); shape (N,)."""
    distinct = np.zeros(len(distances), bool)
    for row, to_others in enumerate(distances):
        distinct[row] = (to_others[distinct] >= least).all()
    return distinct


def judged_numbers(
    archive: Archive, space: TerrainSpace, likely: Mapping[str, Disturbance] | None = None
) -> dict[str, Any]:
    """The numbers of faults, how many are distinct, and where distributions of conditions are known, the likeliest."""
    numbers = fault_numbers(archive)
    distances = kin_distances(archive.genes[archive.failing], space)
    faults = archive.is_fault[archive.failing]
    for name, known, some in (
        ("failing", numbers["failing"], distances),
        ("faults", numbers["faults_panel"], distances[faults][:, faults]),
    ):
        numbers[f"{name}_distinct"] = None if known is None else int(pick_distinct(some).sum())
    if likely:
        values = find_log_likelihood(space.condition_rows(archive.genes), likely)
        numbers["likeliest"] = likeliest = dict[str, dict[str, Any] | None]()
        for name, some in (("failing", archive.failing), ("faults", archive.is_fault)):
            elite = max(np.flatnonzero(some & np.isfinite(values)).tolist(), key=values.__getitem__, default=None)
            likeliest[name] = None if elite is None else {"elite": elite, "log_likelihood": float(values[elite])}
    return numbers


def kin_distances(genes: NDArray[np.float32], space: TerrainSpace) -> NDArray[np.float64]:
    """Distances of terrains, genes of shape (N, num_genes), to each other, shape (N, N); below 1 they are kin.

    The larger of two: heights' over :data:`KIN_M`, scaled to the space, and a condition's over a quarter of its range.
    """
    if not len(genes):
        return np.zeros((0, 0))
    banks = [make_heights(genes[first : first + _BANK], space, every=_EVERY) for first in range(0, len(genes), _BANK)]
    maps = np.concatenate([bank.reshape(len(bank), -1).astype(np.float64) for bank in banks])
    ranges = np.array([gene.high - gene.low for gene in condition_genes()])
    conditions = space.condition_rows(genes)[:, :-1] / (_KIN_SHARE * ranges)
    height = height_over_paper(space.inner if isinstance(space, WiderSpace) else space)
    return np.maximum(rms_distances(maps, maps) / (KIN_M * height), cdist(conditions, conditions, "chebyshev"))


@cache
def height_over_paper(space: TerrainSpace) -> float:
    """Height of a space without ground and conditions over the paper's, of a user's by the RMS of random terrains."""
    if isinstance(space, ShippedSpace):
        return space.height_share
    user, paper = (each.hard_random(_BANK, 0) for each in (space, SUPER_GAUSSIAN))
    heights = (make_heights(user, space), make_heights(paper, every=_EVERY))
    rms_user, rms_paper = (float(np.sqrt(maps.var(axis=(1, 2)).mean())) for maps in heights)
    return max(rms_user, _FLAT_M) / rms_paper


def rms_distances(maps: NDArray[np.float64], others: NDArray[np.float64]) -> NDArray[np.float64]:
    """Root mean square distances of height maps [m], shape (T, num_nodes), to others, (N, num_nodes): shape (T, N)."""
    # In double, since squares are subtracted from each other.
    squares = (maps**2).sum(axis=1)[:, None] + (others**2).sum(axis=1) - 2.0 * (maps @ others.T)
    return np.sqrt(np.maximum(squares, 0.0) / maps.shape[1])


def summarise_search(ranking: Ranking, archive: Archive) -> str:
    """What a search says of the controller, in one plain sentence."""
    failing = int(ranking.failing.sum())
    commonest = next(iter(ranking.by_cause()), UNCLEAR)
    cause = describe_commonest(commonest) if failing > 1 else f"cause: {commonest}"
    asked = failing and (archive.certifiers or archive.witnesses is not None)
    among = archive.is_fault if archive.is_fault.any() else archive.certified
    judged = {"asked": asked, "certified": archive.certified.sum()}
    judged["others"] = archive.certified_by_controllers[among].any()
    judged["steered"] = not archive.certifiers or not archive.certified_by_controllers[among].all()
    counts = {"count": len(ranking), "failing": failing, "faults": count_faults(archive), **judged}
    return TEMPLATES.get_template("summary.txt").render(cause="" if commonest == UNCLEAR else cause, **counts)
