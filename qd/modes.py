"""Failure modes: failing elites grouped by how the controller struggles and how its crossings end.

Ward's agglomerative clustering on the shares of the penalties and the rates of goal, base collision and fall: all
fractions, none weighted. The number of groups is the largest whose mean silhouette (Rousseeuw 1987) is within 0.05 of
the best: of divisions that separate about as well, the finer one says more.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from qd.elites import Elites
from qd.fitness import FAILING_GOAL_RATE

MAX_MODES = 7
"""Most groups that are tried: as many as colours and markers stay apart."""
TOLERANCE = 0.05
"""How far below the best silhouette that of a finer division may lie."""
_COMMON = 0.25  # share of the crossings from which on an end is named
_MEANS = ("goal_rate", "collision_rate", "other_rate", "fallen_rate", "fitness")
_MIN_ELITES = 10  # of fewer a silhouette says nothing


@dataclass(frozen=True, kw_only=True)
class Mode:
    """One group."""

    number: int
    """From 1, the group with the lowest goal rate first."""
    members: NDArray[np.int64]
    """Rows of the elites, shape (num_members,)."""
    typical: int
    """Number, in the archive, of the elite nearest to all others of the group (its medoid)."""
    ratios: NDArray[np.float64]
    """Mean share of each penalty, shape (P,)."""
    goal_rate: float
    """Mean over the members; the next three likewise."""
    collision_rate: float
    other_rate: float
    """Neither at the goal nor ended by a collision."""
    fallen_rate: float
    fitness: float
    marked_by: str
    """Penalty whose share stands out most against all elites that were grouped."""

    @property
    def failing(self) -> bool:
        """Whether under half of its robots reach the goal."""
        return self.goal_rate < FAILING_GOAL_RATE

    @property
    def ending(self) -> str:
        """How most of its crossings end, in words; both ways of two that are common, the goal only where it leads."""
        ends = {
            "reaches the goal": self.goal_rate,
            "topples" if self.fallen_rate >= 0.5 else "strikes the terrain": self.collision_rate,
            "gets stuck": self.other_rate,
        }
        first, *others = sorted(ends, key=lambda end: -ends[end])
        second = next(end for end in others if end != "reaches the goal")
        return first if ends[second] < _COMMON else f"{first} or {second}"

    @property
    def deed(self) -> str:
        """The same of the robot, in a sentence."""
        return self.ending.replace("strikes the terrain", "strikes the terrain with its base")


@dataclass(frozen=True, kw_only=True)
class Modes:
    """All groups, and how well each number of them separates."""

    modes: list[Mode]
    labels: NDArray[np.int64]
    """Number of the group of each elite, 0 of one in no group, shape (N,)."""
    silhouettes: Mapping[int, float]
    """Mean silhouette by number of groups; empty of too few elites to divide."""


def failure_modes(elites: Elites) -> Modes:
    """Groups the failing elites; a terrain that is crossed is in no group.

    Args:
        elites: All elites; where none fails there is no group.
    """
    failing = np.flatnonzero(elites.failing)
    labels = np.zeros(len(elites), np.int64)
    if not len(failing):
        return Modes(modes=[], labels=labels, silhouettes={})
    found = find_modes(elites.rows(failing))
    labels[failing] = found.labels
    return replace(found, modes=[replace(mode, members=failing[mode.members]) for mode in found.modes], labels=labels)


def find_modes(elites: Elites) -> Modes:
    """Groups all of some elites.

    Args:
        elites: At least one.
    """
    from scipy.spatial.distance import pdist, squareform

    features = np.column_stack([elites.ratios, elites.goal_rate, elites.collision_rate, elites.fallen_rate])
    distances = squareform(pdist(features))
    labels, silhouettes = np.ones(len(elites), np.int64), {}
    if len(elites) >= _MIN_ELITES and distances.any():
        from scipy.cluster.hierarchy import fcluster, linkage
        from sklearn.metrics import silhouette_score

        tree = linkage(features, "ward")
        divisions = {count: fcluster(tree, count, "maxclust") for count in range(2, MAX_MODES + 1)}
        silhouettes = {
            count: float(silhouette_score(distances, own, metric="precomputed"))
            for count, own in divisions.items()
            if len(np.unique(own)) == count
        }
        enough = max(silhouettes.values(), default=0.0) - TOLERANCE
        good = [count for count, value in silhouettes.items() if value >= enough]
        labels = divisions[max(good)] if good else labels  # ties may leave no division to judge
    groups = [np.flatnonzero(labels == label) for label in np.unique(labels)]
    groups.sort(key=lambda rows: float(elites.goal_rate[rows].mean()))
    modes = [_mode(number, rows, elites, distances) for number, rows in enumerate(groups, start=1)]
    numbered = np.zeros(len(elites), np.int64)
    for mode in modes:
        numbered[mode.members] = mode.number
    return Modes(modes=modes, labels=numbered, silhouettes=silhouettes)


def _mode(number: int, rows: NDArray[np.int64], elites: Elites, distances: NDArray[np.float64]) -> Mode:
    ratios = elites.ratios[rows].mean(axis=0)
    spread = np.maximum(elites.ratios.std(axis=0), np.finfo(float).tiny)
    alone = len(rows) == len(elites)  # nothing to stand out against but its own mean: the largest share then
    standing_out = ratios if alone else (ratios - elites.ratios.mean(axis=0)) / spread
    return Mode(
        number=number,
        members=rows,
        typical=int(elites.numbers[rows[distances[np.ix_(rows, rows)].sum(axis=1).argmin()]]),
        ratios=ratios,
        marked_by=elites.penalties[int(standing_out.argmax())],
        **{name: float(getattr(elites, name)[rows].mean()) for name in _MEANS},
    )
