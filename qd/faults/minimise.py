"""Minimal terrains: the fewest parts of a failing terrain on which the controller still fails, and which is the cause.

Robots cross some of a terrain's parts alone, 20 episodes each; a subset fails if under half of them reach the goal. A
minimal terrain is a failing subset of which no smaller subset fails; 40 fresh episodes check it. Pushes come as late as
they still make it fail. Then its heights are scaled down together as long as it still fails.
"""

import math
from collections import Counter
from collections.abc import Generator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import combinations, cycle
from pathlib import Path
from typing import Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qd.faults import numbers as faults
from qd.faults.causes import find_effects
from qd.faults.families import VERDICTS, find_verdicts
from qd.faults.judge import STAGES, Judging, elite_seeds, open_judging
from qd.faults.searches import Search, find_search
from qd.search.archive import OUTCOMES, Archive, goal_rates, no_outcomes
from qd.search.fitness import FAILING_GOAL_RATE
from qd.show.figures import draw_minimal, save_figure
from qd.workers.compute import Compute
from qd.workers.seeds import Stream
from sim.files.atomic import to_json, write_atomically
from sim.files.command import choose_elites, command_line
from sim.files.npz import npz_bytes
from sim.terrains.bank import make_heights
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.terrains import Terrains

FIGURE_FILE = "minimal.png"
MAX_PARTS = 10  # parts of a terrain whose subsets, 1,024 at most, are all crossed if need be
_MOMENTS = 8  # at equal distances, from which the latest of a push is chosen
_SCALE_STEPS = 5  # halvings of the interval that holds the least scale which still fails: it is known to 1/32
_LEAST_EFFECT_M = 1e-4  # a part that changes no height by more is none
_ROW_EPISODES = 5  # of a row of genes; the episodes of a trial are spread over workers by rows

How = Literal["exhaustive", "greedy"]
Parts = tuple[int, ...]  # numbers of some parts of a terrain, rising


class Trial(NamedTuple):
    """Some parts of a terrain, to be crossed."""

    parts: Parts
    scale: float = 1.0  # what their heights are multiplied by
    moments: tuple[tuple[int, float], ...] = ()  # when some parts come [s], if not as in the terrain
    fresh: bool = False  # whether to cross in 40 episodes, with other seeds than the 20 by which a subset is found

    @property
    def rows(self) -> int:
        """Rows of genes that its episodes take."""
        return (faults.FRESH_EPISODES if self.fresh else faults.EPISODES) // _ROW_EPISODES


@dataclass(kw_only=True)
class Case:
    """A failing terrain that is taken apart; outcomes are by :data:`qd.search.archive.OUTCOMES`, shape (4,)."""

    parts: Parts  # parts that change it, in the order in which they are taken away
    how: How  # exhaustive: subsets are crossed from the smallest on. Greedy: parts are taken away one at a time
    flat: Parts = ()  # parts without heights to scale: patches of ground, conditions; these alone are not scaled
    counts: dict[Trial, NDArray[np.int64]] = field(default_factory=dict)  # outcomes of each trial
    minimal: Parts = ()  # parts that it takes to fail, once it was taken apart
    later: Mapping[int, tuple[float, float]] = field(default_factory=dict)  # when a part comes, and at the latest [s]
    moments: tuple[tuple[int, float], ...] = ()  # the latest at which parts come while it fails, if later [s]
    scale: float | None = None  # least scale of their heights that was crossed and fails; None if they cannot be scaled
    passing_scale: float | None = None  # largest scale below it that was crossed and does not fail, if any

    @property
    def whole(self) -> Parts:
        """All its parts."""
        return tuple(sorted(self.parts))

    @property
    def fresh(self) -> NDArray[np.int64]:
        """Outcomes of the 40 fresh episodes on the minimal terrain."""
        return self.counts[Trial(self.minimal, moments=self.moments, fresh=True)]

    @property
    def without(self) -> dict[int, NDArray[np.int64]]:
        """Outcomes on the minimal terrain without one of its parts, by the part."""
        return {part: self.counts[self.best_trial(_rest(self.minimal, part))] for part in self.minimal}

    def fails(self, trial: Trial) -> bool:
        """Whether the controller fails it; too many invalid episodes say nothing."""
        return bool(goal_rates(self.counts[trial]) < FAILING_GOAL_RATE)

    def best_trial(self, parts: Parts) -> Trial:
        """The fresh trial of some parts if it was crossed, else that of 20 episodes; at the moments of the case."""
        moments = tuple(moment for moment in self.moments if moment[0] in parts)
        fresh = Trial(parts, moments=moments, fresh=True)
        return fresh if fresh in self.counts else Trial(parts, moments=moments)

    def cause(self, rank: Mapping[int, float]) -> int | None:
        """The part without which most robots arrive, among equals that of the largest ``rank``; None without parts."""
        rates = {part: float(goal_rates(counts)) for part, counts in self.without.items()}
        return max(rates, key=lambda part: (np.nan_to_num(rates[part], nan=-1.0), rank[part]), default=None)


Steps = Generator[list[Trial], None, Any]  # yields trials to cross; then their outcomes are in the case


def find_minimal(case: Case) -> Steps:
    """Finds the minimal terrain of a case, and the least scale of its heights by halving."""
    case.minimal = yield from _exhaustive(case) if case.how == "exhaustive" else _greedy(case)
    case.moments = yield from _find_latest(case)
    if set(case.minimal) <= set(case.flat):
        return
    case.scale, passing = 1.0, 0.0
    for _ in range(_SCALE_STEPS):
        trial = Trial(case.minimal, scale=(passing + case.scale) / 2, moments=case.moments)
        yield from _missing(case, trial)
        if case.fails(trial):
            case.scale = trial.scale
        else:
            passing = trial.scale
    case.passing_scale = passing or None


def _find_latest(case: Case) -> Steps:
    """The latest moments at which the terrain still fails, in fresh episodes too, and no part can be left out."""
    moments = ()
    for part, (time_s, latest) in case.later.items():
        if part in case.minimal:
            times = [time_s + (latest - time_s) * (k + 1) / _MOMENTS for k in range(_MOMENTS)]
            trials = [Trial(case.minimal, moments=(*moments, (part, round(time, 3)))) for time in times]
            yield from _missing(case, *trials)
            if failing := [trial for trial in trials if case.fails(trial)]:
                moments = failing[-1].moments
    if not moments:
        return ()
    fresh = Trial(case.minimal, moments=moments, fresh=True)
    smaller = [
        Trial(_rest(case.minimal, part), moments=tuple(moment for moment in moments if moment[0] != part))
        for part in case.minimal
    ]
    yield from _missing(case, fresh, *smaller)
    return moments if case.fails(fresh) and not any(map(case.fails, smaller)) else ()


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
    left = space.at_moments(space.without(genes[None], gone), dict(trial.moments))
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
    parts = np.flatnonzero(effects.changes(_LEAST_EFFECT_M)).tolist()
    if how == "exhaustive" and len(parts) > MAX_PARTS:
        raise ValueError(f"how must be greedy with over {MAX_PARTS} parts, got {len(parts)} of elite {number}")
    scalable = space.scaled(genes[None], 0.5) is not None
    return Case(
        parts=tuple(sorted(parts, key=lambda part: (*effects.way(part, half_width), part))),
        how=how or ("exhaustive" if on_gpu and len(parts) <= MAX_PARTS else "greedy"),
        flat=tuple(part for part in parts if not scalable or np.abs(effects.heights[part]).max() <= _LEAST_EFFECT_M),
        later=space.moments(genes),
        counts={Trial(tuple(parts), fresh=True): faults.fresh_counts(archive, number)},
    )


def take_apart(archive: Archive, cases: Mapping[int, Case], judging: Judging) -> None:
    """Finds the minimal terrains of some elites, by number, all together; subsets of one have the same starts."""
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


def minimise(
    run: Path,
    *,
    compute: Compute,
    elite: str | None = None,
    how: How | None = None,
    judged: bool = False,
    certifiers: Mapping[str, str] | None = None,
    robot: str | None = None,
    policy: str | None = None,
    space: str | None = None,
) -> faults.MinimalTerrains | None:
    """Finds minimal terrains of failing elites of a run and writes them beside those that it has of other elites.

    Elites are named by numbers, or ``all``; by default they are 200 on a GPU and 3 on the CPU, faults first. With
    ``judged`` minimal terrains are crossed with contact resolved and by certifiers. Returns what the run has now; None
    without a failing elite.
    """
    search = find_search(run, robot=robot, policy=policy, space=space)
    with open_judging(search, compute, certifiers, ask=judged) as judging:
        archive = search.read_archive()
        numbers = sorted(_choose_failing(archive, elite, search, max_elites=200 if compute.on_gpu else 3))
        half_width = search.robot.half_width
        cases = {n: open_case(archive, n, search.space, half_width, how, on_gpu=compute.on_gpu) for n in numbers}
        take_apart(archive, cases, judging)
        elites = _as_elites(archive, cases, search.space)
        if judged:
            for stage in ("resolved", "others"):
                elites = STAGES[stage].run(elites, judging)
        if not numbers:
            print(f"{run}: none of {len(archive):,} elites fails.")
        verdicts = [VERDICTS[verdict] for verdict in find_verdicts(elites)]
        entries = {
            n: _entry(archive, n, cases[n], search) | {"verdict": verdicts[row], **faults.judgement(elites, row)}
            for row, n in enumerate(numbers)
        }
        genes = dict(zip(numbers, elites.genes, strict=True))
        if stored := faults.read_minimal(run, archive):
            entries = {entry["elite"]: entry for entry in stored.numbers["elites"]} | entries
            genes = stored.genes | genes
        if not entries:
            return None
        result = _write(judging, entries, genes)
    for number in numbers:
        verdict = f"; {entries[number]['verdict']}" if judged else ""
        print(f"Elite {number}: {result.describe(number)}{verdict}.")
    print(f"Numbers: {run / faults.MINIMAL_NUMBERS_FILE}\nFigure: {run / FIGURE_FILE}")
    return result


def _write(judging: Judging, entries: dict[int, dict[str, Any]], genes: dict[int, Any]) -> faults.MinimalTerrains:
    search = judging.search
    genes = {number: genes[number] for number in sorted(entries)}
    ordered = [entries[number] for number in genes]
    space = {"space": search.cfg.space, "space_sha256": search.cfg.space_sha256}
    content = {**judging.origin, **space, **_totals(ordered), "elites": ordered}
    arrays = {name: np.array(value) for name, value in space.items() if value is not None}
    arrays |= {"elite": np.array([*genes]), "genes": np.array([*genes.values()])}
    write_atomically(search.run / faults.MINIMAL_FILE, npz_bytes(arrays))
    write_atomically(search.run / faults.MINIMAL_NUMBERS_FILE, to_json(content))
    save_figure(search.run / FIGURE_FILE, draw_minimal(search.cfg.robot, content, genes, search.space))
    return faults.MinimalTerrains(numbers=content, genes=genes)


def _choose_failing(archive: Archive, elite: str | None, search: Search, *, max_elites: int) -> list[int]:
    """Numbers of the failing elites that are named, or of some: faults first."""
    run = search.run
    if archive.fresh is None:
        command = command_line("judge", run=run, robot=search.robot.spec)
        raise ValueError(f"{run} must have fresh episodes of its elites, got none: run `{command}`")
    failing = np.flatnonzero(archive.failing).tolist()
    if elite is None:
        verdicts = find_verdicts(archive)
        return sorted(sorted(failing, key=lambda number: -verdicts[number])[:max_elites])
    if elite.strip() == "all":
        return failing
    numbers = choose_elites(elite, range(len(archive)), f"{run} has no elite")
    if named := ", ".join(str(number) for number in numbers if number not in failing):
        raise ValueError(f"elite must name failing elites of {run}, got {named}: leave it out or try {failing[:5]}")
    return numbers


def _as_elites(archive: Archive, cases: Mapping[int, Case], space: TerrainSpace) -> Archive:
    """Minimal terrains as elites with their own genes and fresh episodes; of the rest only the names hold."""
    rows = archive.rows(np.array([*cases], np.int64))
    assert rows.fresh is not None
    counts = np.array([case.fresh for case in cases.values()], np.int64).reshape(-1, len(OUTCOMES))
    trials = {number: Trial(case.minimal, moments=case.moments) for number, case in cases.items()}
    genes = [cut_genes(archive.genes[number], trial, space) for number, trial in trials.items()]
    episodes = {"episodes": counts.sum(axis=1), "invalid_episodes": counts[:, OUTCOMES.index("invalid")]}
    fresh = replace(rows.fresh, goal_rate=goal_rates(counts), **episodes)
    unjudged: dict[str, Any] = no_outcomes(len(rows)) | dict.fromkeys(("certifiers", "certifier_sha256"), ())
    unjudged |= dict.fromkeys(("witnesses", "varied", "mujoco_c"))
    return replace(rows, genes=np.array(genes, np.float32).reshape(rows.genes.shape), fresh=fresh, **unjudged)


def _entry(archive: Archive, number: int, case: Case, search: Search) -> dict[str, Any]:
    """A minimal terrain as ``minimal.json`` has it, without its verdict."""
    space = search.space
    trials = [Trial(case.minimal, scale, case.moments) for scale in (1.0, case.scale or 1.0)]
    genes = [cut_genes(archive.genes[number], trial, space) for trial in trials]
    descriptions = space.parts(genes[0])
    effects = find_effects(genes[0], case.minimal, space)
    shapes = {part: effects.shape(index, search.robot.half_width) for index, part in enumerate(case.minimal)}
    cause = case.cause({part: abs(shape.height_m) for part, shape in shapes.items()})
    whole, scaled = make_heights(np.array(genes), space)
    without = {str(part): faults.rate_numbers(counts) for part, counts in case.without.items()}
    subsets = {trial.parts for trial in case.counts if trial.scale == 1.0 and trial.parts != case.whole}
    scaled_counts = {trial.scale: counts for trial, counts in case.counts.items() if trial.scale < 1.0}
    return {
        "elite": number,
        "cell": int(archive.cell[number]),
        "iteration": int(archive.iteration[number]),
        "bumps": list(case.minimal),
        "words": [descriptions[part] for part in case.minimal],
        "of": len(case.parts),
        "how": case.how,
        "subsets_crossed": len(subsets),
        **faults.rate_numbers(case.fresh),
        "without": {part: rate["goal_rate"] for part, rate in without.items()},
        "without_intervals": {part: rate["goal_interval"] for part, rate in without.items()},
        "cause": None if cause is None else {"bump": cause, **asdict(shapes[cause])},
        "scale": case.scale,
        "passing_scale": case.passing_scale,
        "height_m": round(float(np.abs(whole).max()), 4),
        "margin_m": None if case.scale is None else round(float(np.abs(whole - scaled).max()), 4),
        "scales": [{"scale": scale, **faults.rate_numbers(scaled_counts[scale])} for scale in sorted(scaled_counts)],
    }


def _totals(entries: Sequence[dict[str, Any]]) -> dict[str, Any]:
    """How many minimal terrains there are of each kind."""
    sizes = [len(entry["bumps"]) for entry in entries]
    margins = [entry["margin_m"] for entry in entries if entry["margin_m"] is not None]
    causes = Counter(entry["cause"]["kind"] for entry in entries if entry["cause"])
    verdicts = Counter(entry["verdict"] for entry in entries)
    judged = any(entry["resolved"] for entry in entries)
    return {
        "minimal": len(entries),
        "bumps_histogram": {str(size): count for size, count in sorted(Counter(sizes).items())},
        "bumps_median": float(np.median(sizes)) if sizes else None,
        "margin_m_median": float(np.median(margins)) if margins else None,
        "causes": dict(sorted(causes.items(), key=lambda pair: (-pair[1], pair[0]))),
        "confirmed": verdicts["confirmed"] + verdicts["fault"] if judged else None,
        "certified": verdicts["certified"] + verdicts["fault"] if judged else None,
        "faults": verdicts["fault"] if judged else None,
        "certifiers": sorted({row["controller"] for entry in entries for row in entry["certificates"]}),
    }
