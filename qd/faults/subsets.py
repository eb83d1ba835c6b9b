"""Minimal terrains: the fewest parts of a failing terrain on which the controller still fails, and which is the cause.

A terrain has parts, such as bumps. Robots cross some of its parts alone, 20 episodes each; a subset fails if under half
of them reach the goal. A minimal terrain is a failing subset of which no smaller subset fails; 40 fresh episodes check
it. Then its heights are scaled down together as long as it still fails.
"""

import math
from collections.abc import Generator, Mapping
from dataclasses import dataclass, field
from itertools import combinations, cycle
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qd.faults.causes import find_effects
from qd.faults.numbers import EPISODES, FRESH_EPISODES, fresh_counts
from qd.faults.stages import Judging, elite_seeds
from qd.search.archive import Archive, goal_rates
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.seeds import Stream
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.terrains import Terrains

SCALE_STEPS = 5
"""Halvings of the interval that holds the least scale which still fails: it is known to 1/32."""
MAX_PARTS = 10
"""Parts of a terrain whose subsets, 1,024 at most, are all crossed if need be."""
LEAST_EFFECT_M = 1e-4
"""A part that changes no height by more is none [m]."""

_ROW_EPISODES = 5  # of a row of genes; the episodes of a trial are spread over workers by rows

How = Literal["exhaustive", "greedy"]
Parts = tuple[int, ...]
"""Numbers of some parts of a terrain, rising."""


class Trial(NamedTuple):
    """Some parts of a terrain, to be crossed."""

    parts: Parts
    scale: float = 1.0
    """What their heights are multiplied by."""
    fresh: bool = False
    """Whether to cross in 40 episodes, with other seeds than the 20 by which a subset is found."""

    @property
    def rows(self) -> int:
        """Rows of genes that its episodes take."""
        return (FRESH_EPISODES if self.fresh else EPISODES) // _ROW_EPISODES


@dataclass(kw_only=True)
class Case:
    """A failing terrain that is taken apart; outcomes are by :data:`qd.search.archive.OUTCOMES`, shape (4,)."""

    parts: Parts
    """Parts that change it, in the order in which they are taken away."""
    how: How
    """Exhaustive: subsets are crossed from the smallest on. Greedy: parts are taken away one at a time."""
    scalable: bool
    flat: Parts = ()
    """Parts that change no height: slippery patches, conditions. A terrain of these alone is not scaled."""
    counts: dict[Trial, NDArray[np.int64]] = field(default_factory=dict)
    """Outcomes of each trial; those of all parts together, the elite's fresh ones, are there from the start."""
    minimal: Parts = ()
    """Parts that it takes to fail, once it was taken apart."""
    scale: float | None = None
    """Least scale of their heights that was crossed and fails; None if they cannot be scaled."""
    passing_scale: float | None = None
    """Largest scale below it that was crossed and does not fail; None if there is none."""

    @property
    def whole(self) -> Parts:
        """All its parts."""
        return tuple(sorted(self.parts))

    @property
    def fresh(self) -> NDArray[np.int64]:
        """Outcomes of the 40 fresh episodes on the minimal terrain."""
        return self.counts[Trial(self.minimal, fresh=True)]

    @property
    def without(self) -> dict[int, NDArray[np.int64]]:
        """Outcomes on the minimal terrain without one of its parts, by the part."""
        return {part: self.counts[self.best_trial(_rest(self.minimal, part))] for part in self.minimal}

    def fails(self, trial: Trial) -> bool:
        """Whether the controller fails it; too many invalid episodes say nothing."""
        return bool(goal_rates(self.counts[trial]) < FAILING_GOAL_RATE)

    def best_trial(self, parts: Parts) -> Trial:
        """The fresh trial of some parts if it was crossed, else that of 20 episodes."""
        fresh = Trial(parts, fresh=True)
        return fresh if fresh in self.counts else Trial(parts)

    def cause(self, rank: Mapping[int, float]) -> int | None:
        """The part without which most robots arrive, among equals that of the largest ``rank``; None without parts."""
        rates = {part: float(goal_rates(counts)) for part, counts in self.without.items()}
        return max(rates, key=lambda part: (np.nan_to_num(rates[part], nan=-1.0), rank[part]), default=None)


Steps = Generator[list[Trial], None, Any]
"""Yields trials to be crossed; their outcomes are in the counts of the case when it goes on."""


def find_minimal(case: Case) -> Steps:
    """Finds the minimal terrain of a case, and the least scale of its heights by halving."""
    case.minimal = yield from _exhaustive(case) if case.how == "exhaustive" else _greedy(case)
    if not case.scalable or set(case.minimal) <= set(case.flat):
        return
    passing = 0.0
    failing = 1.0
    for _ in range(SCALE_STEPS):
        trial = Trial(case.minimal, scale=(passing + failing) / 2)
        yield from _missing(case, trial)
        if case.fails(trial):
            failing = trial.scale
        else:
            passing = trial.scale
    case.scale = failing
    case.passing_scale = passing or None


def _rest(parts: Parts, part: int) -> Parts:
    return tuple(other for other in parts if other != part)


def _missing(case: Case, *trials: Trial) -> Steps:
    missing = [trial for trial in trials if trial not in case.counts]
    if missing:
        yield missing


def _exhaustive(case: Case) -> Steps:
    """The smallest subset that fails: fewest parts, then lowest goal rate."""
    for size in range(len(case.whole)):
        trials = [Trial(parts) for parts in combinations(case.whole, size)]
        yield from _missing(case, *trials)
        failing = [trial for trial in trials if case.fails(trial)]
        for trial in sorted(failing, key=lambda trial: (goal_rates(case.counts[trial]), trial.parts)):
            fresh = trial._replace(fresh=True)
            yield from _missing(case, fresh)
            if case.fails(fresh):
                return trial.parts
    return case.whole


def _greedy(case: Case) -> Steps:
    """A subset that fails, of which no part can be taken away."""
    while True:
        parts = case.whole
        num_needed = 0  # of the parts since one was taken away the last time
        for part in cycle(case.parts):
            if num_needed == len(parts):
                break
            if part in parts:
                rest = _rest(parts, part)
                yield from _missing(case, case.best_trial(rest))
                is_needed = not case.fails(case.best_trial(rest))
                num_needed = num_needed + 1 if is_needed else 0
                parts = parts if is_needed else rest
        fresh = Trial(parts, fresh=True)
        yield from _missing(case, fresh)
        if case.fails(fresh) or parts == case.whole:
            return parts


def cut_genes(genes: NDArray[np.float32], trial: Trial, space: TerrainSpace) -> NDArray[np.float32]:
    """Genes of the parts of a terrain that a trial crosses, shape (num_genes,)."""
    gone = [part for part in range(len(space.parts(genes))) if part not in trial.parts]
    left = space.without(genes[None], gone)
    scaled = space.scaled(left, trial.scale) if trial.scale != 1.0 else left
    assert scaled is not None
    return scaled[0]


def open_case(
    archive: Archive, number: int, space: TerrainSpace, half_width: float, how: How | None, *, on_gpu: bool
) -> Case:
    """The case of a failing elite, which has fresh values; ``how`` is what suits the device if None."""
    genes = archive.genes[number]
    num_parts = len(space.parts(genes))
    if not num_parts:
        raise ValueError(f"space must have parts(genes) and without(genes, parts), got {space.name} without parts")
    effects = find_effects(genes, range(num_parts), space)
    parts = np.flatnonzero(effects.changes(LEAST_EFFECT_M)).tolist()
    if how == "exhaustive" and len(parts) > MAX_PARTS:
        raise ValueError(f"how must be greedy with over {MAX_PARTS} parts, got {len(parts)} of elite {number}")
    return Case(
        parts=tuple(sorted(parts, key=lambda part: (*effects.way(part, half_width), part))),
        how=how or ("exhaustive" if on_gpu and len(parts) <= MAX_PARTS else "greedy"),
        scalable=space.scaled(genes[None], 0.5) is not None,
        flat=tuple(part for part in parts if np.abs(effects.heights[part]).max() <= LEAST_EFFECT_M),
        counts={Trial(tuple(parts), fresh=True): fresh_counts(archive, number)},
    )


def take_apart(archive: Archive, cases: Mapping[int, Case], judging: Judging) -> None:
    """Finds the minimal terrains of some elites, all of them together, by number of the elite.

    All subsets of an elite are crossed from the same starts, fresh episodes from others. Starts follow from the
    search's seed and from what names the elite.
    """
    search = judging.search
    seeds = {}
    for fresh, stream in ((False, Stream.MINIMISED), (True, Stream.MINIMISED_FRESH)):
        times = Trial((), fresh=fresh).rows
        seeds[fresh] = elite_seeds(archive, search.cfg.seed, times, stream=stream).reshape(-1, times)
    subsets = [math.comb(len(case.parts), len(case.parts) // 2) for case in cases.values() if case.how == "exhaustive"]
    room = max(len(cases) * Trial((), fresh=True).rows, sum(subsets) * Trial(()).rows)
    steps = {number: find_minimal(case) for number, case in sorted(cases.items())}
    while wanted := {number: trials for number, step in steps.items() if (trials := next(step, None))}:
        trials = [(number, trial) for number, missing in wanted.items() for trial in missing]
        genes = [[cut_genes(archive.genes[n], trial, search.space)] * trial.rows for n, trial in trials]
        rows = np.concatenate([seeds[trial.fresh][n] for n, trial in trials])
        terrains = Terrains(genes=np.concatenate(genes), seeds=rows, space=search.space)
        label = f"{len(cases) - len(wanted)} of {len(cases)} elites done"
        outcomes = judging.count(search.policy, terrains, label, replicas=_ROW_EPISODES, room=room)
        ends = np.cumsum([trial.rows for _, trial in trials])
        for (number, trial), counts in zip(trials, np.split(outcomes, ends[:-1]), strict=True):
            cases[number].counts[trial] = counts.sum(axis=0)
