"""Minimal terrains: the fewest parts of a failing terrain on which the controller still fails.

A terrain has parts, such as bumps. It is taken apart by crossing some of its parts alone, 20 episodes each. What is
crossed next follows from what was crossed before and from nothing else, so a search for minimal terrains that was
stopped goes on from the counts alone (:class:`Case`).
"""

import math
import sys
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import combinations
from typing import TYPE_CHECKING, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from tqdm import tqdm

from qd.archive import OUTCOMES, Archive, goal_rates
from qd.faults import EPISODES, outcome_counts
from qd.fitness import FAILING_GOAL_RATE
from qd.fresh import FRESH_EPISODES, Open, elite_seeds
from qd.run.progress import share_bar
from qd.workers.evaluator import EvaluatorCfg, pipeline_of
from qd.workers.invalid import invalid_reasons, invalid_words

if TYPE_CHECKING:
    from sim.spaces.base import TerrainSpace

How = Literal["exhaustive", "greedy"]
Parts = tuple[int, ...]
"""Numbers of some parts of a terrain, rising."""

SCALE_STEPS = 5
"""Halvings of the interval that holds the least scale which still fails: it is known to 1/32."""
MOST_PARTS = 10
"""Parts of a terrain whose subsets, 1,024 at most, are all crossed if need be."""

_ROW_EPISODES = 5  # of a row of genes; the episodes of a trial are spread over workers by rows
_STREAM, _FRESH_STREAM = 11, 12
_LOT = {"cuda": 3200, "cpu": EPISODES // _ROW_EPISODES}  # rows of a worker between two saves


class Trial(NamedTuple):
    """What is left of a terrain, to be crossed."""

    parts: Parts
    """Parts that are left."""
    scale: float = 1.0
    """What their heights are multiplied by."""
    fresh: bool = False
    """Whether by 40 episodes, with other seeds than the 20 by which a subset is found."""

    @property
    def episodes(self) -> int:
        """How many episodes it takes."""
        return FRESH_EPISODES if self.fresh else EPISODES


def goal_rate(counts: NDArray[np.int64]) -> float:
    """Share of the valid episodes that reached the goal, of counts of shape (4,); NaN if too many are invalid."""
    return float(goal_rates(counts))


def fails(counts: NDArray[np.int64]) -> bool:
    """Whether episodes, shape (4,), say that the controller fails; too many invalid ones say nothing."""
    return goal_rate(counts) < FAILING_GOAL_RATE


@dataclass(frozen=True, kw_only=True)
class Case:
    """A failing terrain that is taken apart."""

    parts: Parts
    """Parts that shape its ground, in the order in which they are taken away."""
    how: How
    """Exhaustive: subsets are crossed from the smallest on. Greedy: parts are taken away one at a time."""
    scalable: bool
    """Whether its heights can be scaled."""
    flat: Parts = ()
    """Parts that change no height, such as slippery patches. Where they alone are left, nothing is scaled."""
    counts: dict[Trial, NDArray[np.int64]] = field(default_factory=dict)
    """Episodes by :data:`qd.archive.OUTCOMES`, shape (4,), of what was crossed. The fresh episodes of all parts
    together, which are those of the elite, are there from the beginning."""

    @property
    def whole(self) -> Parts:
        """All its parts."""
        return tuple(sorted(self.parts))

    def fails(self, parts: Parts) -> bool | None:
        """Whether a subset fails: by its fresh episodes if it has them, else by its 20; None if it was not crossed."""
        for trial in (Trial(parts, fresh=True), Trial(parts)):
            if trial in self.counts:
                return fails(self.counts[trial])
        return None

    def scales(self, parts: Parts) -> bool:
        """Whether scaling changes what is left of its terrain."""
        return self.scalable and not set(parts) <= set(self.flat)

    def wanted(self) -> list[Trial]:
        """What is to be crossed next; nothing when the minimal terrain and its least scale are known."""
        wanted, minimum = _exhaustive(self) if self.how == "exhaustive" else _greedy(self)
        return wanted if minimum is None else _scaling(self, minimum)[0]

    def minimal(self) -> "Minimal | None":
        """The minimal terrain; None as long as something is to be crossed."""
        if self.wanted():
            return None
        _, parts = _exhaustive(self) if self.how == "exhaustive" else _greedy(self)
        assert parts is not None
        _, scale, passing = _scaling(self, parts)
        removed = {part: tuple(other for other in parts if other != part) for part in parts}
        return Minimal(
            parts=parts,
            counts=self.counts[Trial(parts, fresh=True)],
            without={part: self._best_known(rest) for part, rest in removed.items()},
            scale=scale if self.scales(parts) else None,
            passing_scale=passing,
            scales={
                trial.scale: counts
                for trial, counts in self.counts.items()
                if trial.scale != 1.0 and trial.parts == parts
            },
            subsets=len({trial.parts for trial in self.counts if trial.scale == 1.0 and trial.parts != self.whole}),
        )

    def _best_known(self, parts: Parts) -> NDArray[np.int64]:
        return self.counts.get(Trial(parts, fresh=True), self.counts[Trial(parts)])


@dataclass(frozen=True, kw_only=True)
class Minimal:
    """A minimal terrain; episodes are counted by :data:`qd.archive.OUTCOMES`, shape (4,)."""

    parts: Parts
    """Parts that it takes to fail."""
    counts: NDArray[np.int64]
    """Its 40 fresh episodes."""
    without: dict[int, NDArray[np.int64]]
    """Episodes without one of the parts, by its number."""
    scale: float | None
    """Least scale of the heights that was crossed and fails; None if there are none, or they cannot be scaled."""
    passing_scale: float | None
    """Largest scale below it that was crossed and does not fail; None if none was."""
    scales: dict[float, NDArray[np.int64]]
    """Episodes by scale."""
    subsets: int
    """How many subsets were crossed for it."""

    def cause(self, rank: Mapping[int, float]) -> int | None:
        """The part without which most robots arrive; None if the terrain fails without any part.

        Args:
            rank: Of parts without which equally many do, the one of the largest number here is meant.
        """
        rates = {part: goal_rate(counts) for part, counts in self.without.items()}
        return max(rates, key=lambda part: (np.nan_to_num(rates[part], nan=-1.0), rank[part]), default=None)


def _exhaustive(case: Case) -> tuple[list[Trial], Parts | None]:
    """What to cross next, or the smallest subset that fails: fewest parts, then lowest goal rate."""
    whole = case.whole
    for size in range(len(whole)):
        trials = [Trial(parts) for parts in combinations(whole, size)]
        missing = [trial for trial in trials if trial not in case.counts]
        if missing:
            return missing, None
        candidates = [trial for trial in trials if fails(case.counts[trial])]
        for trial in sorted(candidates, key=lambda trial: (goal_rate(case.counts[trial]), trial.parts)):
            again = trial._replace(fresh=True)
            if again not in case.counts:
                return [again], None
            if fails(case.counts[again]):
                return [], trial.parts
    return [], whole


def _greedy(case: Case) -> tuple[list[Trial], Parts | None]:
    """What to cross next, or a subset that fails, of which no part can be taken away."""
    kept, place, in_need = case.whole, 0, 0
    while in_need < len(kept):  # each part is needed since one was taken away the last time
        part, place = case.parts[place % len(case.parts)], place + 1
        if part not in kept:
            continue
        rest = tuple(other for other in kept if other != part)
        rest_fails = case.fails(rest)
        if rest_fails is None:
            return [Trial(rest)], None
        kept, in_need = (rest, 0) if rest_fails else (kept, in_need + 1)
    again = Trial(kept, fresh=True)
    return ([], kept) if again in case.counts else ([again], None)


def _scaling(case: Case, parts: Parts) -> tuple[list[Trial], float, float | None]:
    """What to cross next, the least scale that is known to fail, and the largest below it that is known not to."""
    passing, failing = 0.0, 1.0
    for _ in range(SCALE_STEPS if case.scales(parts) else 0):
        trial = Trial(parts, scale=(passing + failing) / 2)
        if trial not in case.counts:
            return [trial], failing, passing or None
        if fails(case.counts[trial]):
            failing = trial.scale
        else:
            passing = trial.scale
    return [], failing, passing or None


def fresh_counts(archive: Archive, number: int) -> NDArray[np.int64]:
    """The fresh episodes of an elite by :data:`qd.archive.OUTCOMES`, shape (4,)."""
    fresh = archive.fresh
    assert fresh is not None
    valid = int(fresh.episodes[number] - fresh.invalid_episodes[number])
    goal, collided = (round(float(rate[number]) * valid) for rate in (fresh.goal_rate, fresh.collision_rate))
    counts = {"goal": goal, "base_collision": collided, "other": valid - goal - collided}
    return np.array([counts.get(name, int(fresh.invalid_episodes[number])) for name in OUTCOMES])


def genes_of(archive: Archive, number: int, case: Case, trial: Trial, space: "TerrainSpace") -> NDArray[np.float32]:
    """Genes of what is left of an elite's terrain, shape (num_genes,)."""
    count = len(space.parts(archive.genes[number]))
    genes = space.without(archive.genes[number][None], [part for part in range(count) if part not in trial.parts])
    scaled = space.scaled(genes, trial.scale) if trial.scale != 1.0 else genes
    assert scaled is not None and set(trial.parts) <= set(case.parts)
    return scaled[0]


def minimise(
    archive: Archive,
    cases: Mapping[int, Case],
    space: "TerrainSpace",
    *,
    evaluator: EvaluatorCfg,
    open_evaluator: Open,
    seed: int,
    save: Callable[[], object],
) -> None:
    """Crosses what is wanted of some cases, all of them together, until nothing is.

    All subsets of an elite are crossed from the same starts; the fresh episodes have others. Starts follow from the
    seed and from what names the elite.

    Args:
        archive: The elites.
        cases: By number of the elite; their counts grow.
        space: Of the genes.
        evaluator: Controller, robot and device; how many terrains at once follows from the device.
        open_evaluator: Opens what crosses terrains.
        seed: The search's.
        save: Called after each lot.
    """
    wanted = _wanted(cases)
    if not wanted:
        return
    rows = sum(trial.episodes for _, trial in wanted) // _ROW_EPISODES
    if any(case.how == "exhaustive" for case in cases.values()):  # later sizes have more subsets
        subsets = sum(math.comb(len(case.parts), len(case.parts) // 2) for case in cases.values())
        rows = max(rows, subsets * EPISODES // _ROW_EPISODES)
    cfg = replace(evaluator, num_terrains=rows, num_replicas=_ROW_EPISODES, lots=1)
    lot = min(rows, _LOT[cfg.device.partition(":")[0]] * cfg.num_workers)
    cfg = replace(cfg, num_terrains=min(rows, 2 * lot))
    seeds = _Seeds(archive, seed)
    with open_evaluator(cfg) as evaluate:
        pipeline = pipeline_of(evaluate)
        while wanted:
            own = [_rows_of(archive, number, cases[number], trial, space) for number, trial in wanted]
            starts = np.concatenate([seeds.of(number, trial) for number, trial in wanted])
            whose = np.repeat(np.arange(len(wanted)), [len(genes) for genes in own])
            counts, reasons = np.zeros((len(wanted), len(OUTCOMES)), np.int64), dict[str, int]()
            with share_bar(_words(wanted, cases)) as progress:
                for part, result in pipeline.in_lots(np.concatenate(own), starts, lot, progress):
                    np.add.at(counts, whose[part], outcome_counts(result))
                    for reason, count in invalid_reasons(result).items():
                        reasons[reason] = reasons.get(reason, 0) + count
                    for (number, trial), crossed in zip(wanted, counts, strict=True):
                        if crossed.sum() == trial.episodes:
                            cases[number].counts[trial] = crossed.copy()
                    save()
            told = invalid_words(dict(sorted(reasons.items(), key=lambda one: -one[1])), int(counts.sum()))
            if told is not None:
                tqdm.write(told, file=sys.stderr)
            wanted = _wanted(cases)


def _wanted(cases: Mapping[int, Case]) -> list[tuple[int, Trial]]:
    return [(number, trial) for number, case in sorted(cases.items()) for trial in case.wanted()]


def _rows_of(archive: Archive, number: int, case: Case, trial: Trial, space: "TerrainSpace") -> NDArray[np.float32]:
    """Genes of a trial, a row for every few of its episodes."""
    return np.repeat(genes_of(archive, number, case, trial, space)[None], trial.episodes // _ROW_EPISODES, axis=0)


class _Seeds:
    """Seeds of the rows of trials, which follow from the elite alone."""

    def __init__(self, archive: Archive, seed: int) -> None:
        self._seeds = {
            fresh: elite_seeds(archive, seed, episodes // _ROW_EPISODES, stream=stream).reshape(len(archive), -1)
            for fresh, episodes, stream in ((False, EPISODES, _STREAM), (True, FRESH_EPISODES, _FRESH_STREAM))
        }

    def of(self, number: int, trial: Trial) -> NDArray[np.uint32]:
        return self._seeds[trial.fresh][number]


def _words(wanted: list[tuple[int, Trial]], cases: Mapping[int, Case]) -> str:
    """What is crossed, for a bar."""
    done = len(cases) - len({number for number, _ in wanted})
    what = sorted(set(_kinds(wanted)))
    return f"{done} of {len(cases)} elites done; crossing {len(wanted)} of {', '.join(what)}"


def _kinds(wanted: list[tuple[int, Trial]]) -> Iterator[str]:
    for _, trial in wanted:
        if trial.fresh:
            yield "40 fresh episodes"
        elif trial.scale != 1.0:
            yield "scaled heights"
        else:
            yield f"{len(trial.parts)} part{'s' * (len(trial.parts) != 1)}"
