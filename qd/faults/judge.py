"""Judging: which elites of a search are faults of its controller, stage by stage.

Episodes follow from the run's seed and what names an elite. Crossings are kept in the run, so that judging can go on.
"""

import time
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import compress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Kind
from qd.check import ensure_stray
from qd.evaluate.sets import plain_set
from qd.faults import numbers as faults
from qd.faults.families import find_failing_causes, find_families, judged_numbers
from qd.faults.searches import Search, check_certifiers, find_certifiers, find_search
from qd.faults.steer import LINE_M, SteerCfg, measure_line, seek_witnesses
from qd.search.archive import OUTCOMES, Archive, CrossedAgain, FreshValues, goal_rates, no_witnesses, write_archive
from qd.search.directory import METRICS_FILE, SUMMARY_FILE, RunDirectory, claimed
from qd.search.fitness import BIT_EPISODES, FAILING_GOAL_RATE, FitnessCfg, evaluate_rollout
from qd.show import figures
from qd.workers.compute import Compute, check_policy
from qd.workers.crosser import Crosser
from qd.workers.pipeline import PipelineCfg, build_simulator
from qd.workers.seeds import Stream
from sim.controllers.spec import controller_hash, controller_identity
from sim.files.atomic import read_json, to_json, write_atomically
from sim.mujoco_c.model import NO_SOFTNESS
from sim.rollout import RolloutResult
from sim.terrains.spaces.base import MAX_HEIGHT
from sim.terrains.spaces.registry import at_height
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from sim.terrains.spaces.wider import varied_genes, varied_space
from sim.terrains.terrains import Terrains

_LINE_TERRAINS = 100  # that show how far plain crossings are from the straight line
MUJOCO_C_FAULTS, MUJOCO_C_EPISODES = 150, (6, 4)
"""Faults that are crossed in MuJoCo C, and episodes of each; the second only where the first do not decide."""
_WITNESS_WORDS = {3: "on the line", 2: "beside it", 1: "around"}


@dataclass(frozen=True, kw_only=True)
class Judging:
    """A search whose elites are judged, other controllers by name, and the service that crosses terrains."""

    search: Search
    certifiers: Mapping[str, str]
    crosser: Crosser
    most_steered: int | None = None  # terrains for which the stage steered looks for witnesses at most
    step: str = ""  # what bars say before their label

    @property
    def origin(self) -> dict[str, Any]:
        """Provenance of what is judged."""
        search = self.search
        return self.crosser.compute.origin(search.cfg.seed) | controller_identity(search.robot, search.policy)

    def elite_terrains(self, archive: Archive, rows: NDArray[np.int64] | slice, stream: Stream) -> Terrains:
        """Some elites as terrains, with the seeds of a stream."""
        seeds = elite_seeds(archive, self.search.cfg.seed, stream=stream)
        return Terrains(genes=archive.genes[rows], seeds=seeds[rows], space=self.search.space)

    def count(
        self, policy: str, terrains: Terrains, label: str, *, limit_m: float = np.inf, **settings: Any
    ) -> NDArray[np.int64]:
        """Outcomes on terrains, (num_terrains, 4), of 20 episodes each unless ``settings`` of Crosser.cross differ."""
        settings = {"replicas": faults.EPISODES, **settings, "invalid_ok": True, "label": self.step + label}
        return count_outcomes(self.crosser.cross(policy, terrains, **settings), limit_m)


@contextmanager
def open_judging(
    search: Search, compute: Compute, certifiers: Mapping[str, str] | None, *, ask: bool
) -> Iterator[Judging]:
    """Tries the controller, and certifiers if they are asked; keeps other commands out of the run, crossings in it."""
    check_policy(search.policy, search.robot, compute.device)
    certifiers = find_certifiers(search) if certifiers is None else certifiers
    if ask:
        check_certifiers(certifiers, search, compute.device)
    with claimed(search.run), Crosser(search.robot, compute, cache=search.run / "crossings") as crosser:
        yield Judging(search=search, certifiers=certifiers, crosser=crosser)


def elite_seeds(archive: Archive, seed: int, times: int = 1, *, stream: int) -> NDArray[np.uint32]:
    """Seeds on N elites, ``times`` for each, (N * times,), by the search's seed, and the elite's cell and iteration."""
    names = zip(archive.iteration.tolist(), archive.cell.tolist(), strict=True)
    rows = [np.random.SeedSequence([seed, *name], spawn_key=(stream,)).generate_state(times) for name in names]
    return np.concatenate([np.zeros(0, np.uint32), *rows]).astype(np.uint32)


def count_outcomes(result: RolloutResult, limit_m: float = np.inf) -> NDArray[np.int64]:
    """Episodes by :data:`qd.search.archive.OUTCOMES`, (T, 4); beyond ``limit_m`` from the line is not the goal."""
    flags = (result.reached_goal & (result.deviation <= limit_m), result.base_collision, result.invalid)
    goal, collided, invalid = (flag.sum(axis=1) for flag in flags)
    return np.stack([goal, collided, result.invalid.shape[1] - goal - collided - invalid, invalid], axis=1)


def cross_fresh(archive: Archive, judging: Judging) -> Archive:
    """Crosses every elite in 40 fresh episodes, since it was lucky; orders the archive by the corrected fitness."""
    search = judging.search
    terrains = judging.elite_terrains(archive, slice(None), Stream.FRESH)
    label = f"{judging.step}fresh episodes"
    result = judging.crosser.cross(search.policy, terrains, replicas=faults.FRESH_EPISODES, label=label)
    corrected = archive.corrected_by(fresh_values(archive, result, search.cfg.fitness))
    if not np.array_equal(archive.cell, corrected.cell):
        print(f"Elites of {search.run} are numbered anew: by their fresh episodes, the hardest first.", flush=True)
    return with_families(corrected, search)


def fresh_values(archive: Archive, result: RolloutResult, fitness: FitnessCfg) -> FreshValues:
    """The values of an archive's elites by 40 fresh episodes on each."""
    cells = archive.cells
    fresh = evaluate_rollout(result, cells, fitness)
    collided = (result.base_collision & ~result.invalid)[:, :BIT_EPISODES].any(axis=1)
    cell = cells.find_cells(fresh.ratios, collided)
    reproduced = fresh.valid & cells.are_neighbours(archive.cell, cell)
    return FreshValues(**{**vars(fresh), "cell": cell}, reproduced=reproduced)


def with_families(archive: Archive, search: Search) -> Archive:
    """The archive with the family and the cause of each elite, as its fresh episodes have it."""
    families = find_families(archive.genes, search.space)
    causes = find_failing_causes(archive, search.space, search.robot.half_width)
    return replace(archive, family=families, cause=causes)


def cross_resolved(archive: Archive, judging: Judging) -> Archive:
    """Crosses the failing elites in 20 episodes with contact resolved: in steps of 1 ms."""
    rows = np.flatnonzero(archive.failing)
    terrains = judging.elite_terrains(archive, rows, Stream.RESOLVED)
    outcomes = archive.resolved_outcomes.copy()
    outcomes[rows] = judging.count(judging.search.policy, terrains, "contact resolved", engine="resolved")
    return replace(archive, resolved_outcomes=outcomes)


def cross_by_others(archive: Archive, judging: Judging) -> Archive:
    """Lets certifiers cross the failing elites in 20 episodes, and where they cross half with contact resolved, too.

    Outcomes of certifiers not asked stay; another controller of the name replaces them.
    """
    rows = np.flatnonzero(archive.failing)
    for name, policy in judging.certifiers.items():
        terrains = judging.elite_terrains(archive, rows, Stream.OTHERS)
        outcomes = judging.count(policy, terrains, name)
        crossed = goal_rates(outcomes) >= FAILING_GOAL_RATE
        terrains = judging.elite_terrains(archive, rows[crossed], Stream.OTHERS_RESOLVED)
        resolved = np.zeros_like(outcomes)
        resolved[crossed] = judging.count(policy, terrains, f"{name}, contact resolved", engine="resolved")
        stored = dict(zip(archive.certifiers, archive.certifier_sha256, strict=True))
        hashes = stored | {name: str(controller_hash(policy))}
        column = [*hashes].index(name)
        columns: dict[str, Any] = {"certifier_outcomes": outcomes, "certifier_resolved_outcomes": resolved}
        for field, values in columns.items():
            table = np.pad(getattr(archive, field), ((0, 0), (0, len(hashes) - len(stored)), (0, 0)))
            if hashes != stored:  # what another controller of the name did is gone
                table[:, column] = 0
            table[rows, column] = values
            columns[field] = table
        if hashes != stored:
            columns |= {"varied": None, "mujoco_c": None}
            if (witnesses := archive.witnesses) is not None:
                by = np.flatnonzero(witnesses.walker == name)
                columns["witnesses"] = witnesses.updated(by, no_witnesses(len(by), witnesses.limit_m))
        archive = replace(archive, certifiers=tuple(hashes), certifier_sha256=tuple(hashes.values()), **columns)
    return archive


def _check_steered(archive: Archive, judging: Judging, before: Collection[str]) -> None:
    if judging.search.space.asks != Kind.CROSS:
        problem = f"no way is sought where robots are told how to move, as in {judging.search.space.name}"
        raise ValueError(f"{problem}: leave the stage steered out")


def cross_steered(archive: Archive, judging: Judging) -> Archive:
    """Looks for ways across confirmed elites that no controller certifies, at first one a family: witnesses."""
    search, crosser = judging.search, judging.crosser
    open_cases = archive.confirmed if archive.resolved_outcomes.any() else archive.failing
    first, others = split_families(archive, np.flatnonzero(open_cases & ~archive.certified_by_controllers))
    rows = np.sort(np.concatenate([np.sort(first), others])[: judging.most_steered])
    if not len(rows):
        print("There is no terrain left for which to seek a way.", flush=True)
        return replace(archive, witnesses=archive.witnesses or no_witnesses(len(archive), LINE_M))
    crossed = {*zip(archive.certifiers, archive.certifier_sha256, strict=True)}
    walkers = {faults.SEARCHED: search.policy}
    walkers |= {name: f for name, f in judging.certifiers.items() if (name, controller_hash(f)) in crossed}
    cfg = SteerCfg()
    terrains = judging.elite_terrains(archive, rows, Stream.STEERED)
    times = len(walkers) * cfg.seeds
    seeds = elite_seeds(archive, search.cfg.seed, times, stream=Stream.STEERED).reshape(-1, times)[rows]
    before = archive.witnesses
    if before is None or not (before.walker != "").any():
        level = at_height(SUPER_GAUSSIAN, MAX_HEIGHT * search.space.height_share)
        plain = plain_set("hard_random", _LINE_TERRAINS, search.cfg.seed, level, "validation").terrains
        before = no_witnesses(len(archive), measure_line(crosser, search.policy, plain, judging.step))
    rng = np.random.default_rng(np.random.SeedSequence([search.cfg.seed], spawn_key=(Stream.STEERED,)))
    some = seek_witnesses(crosser, walkers, terrains, seeds, before.limit_m, rng=rng, label=judging.step, cfg=cfg)
    found = [f"{(some.kind == kind).sum()} {words}" for kind, words in _WITNESS_WORDS.items()]
    print(f"Steered, robots cross {', '.join(found)}, of {len(rows)} terrains not certified before.", flush=True)
    witnesses = before.updated(rows, some)
    mujoco_c = archive.mujoco_c if np.array_equal(witnesses.way, before.way) else None
    return replace(archive, witnesses=witnesses, mujoco_c=mujoco_c)


def _check_faults(archive: Archive, judging: Judging, before: Collection[str], name: str, *certifying: str) -> None:
    """Refuses a search without faults by the stages ``certifying``, and certifiers that are not at hand."""
    certified = archive.certified if "steered" in certifying else archive.certified_by_controllers
    found = certified & (archive.confirmed | ("resolved" in before))
    if {*certifying}.isdisjoint(before) and ("fresh" in before or not found.any()):
        rule = f"stages must have {' or '.join(certifying)} before {name}"
        raise ValueError(f"{rule}: {judging.search.run} has no faults that it can cross")
    _check_certifiers(archive, judging, steered="steered" in certifying, renewed="others" in before)


def _check_certifiers(archive: Archive, judging: Judging, *, steered: bool = False, renewed: bool = False) -> None:
    """Refuses faults whose certifier has no file, or another one unless certificates are ``renewed`` before."""
    hashes = {name: str(controller_hash(policy)) for name, policy in judging.certifiers.items()}
    certify = {*compress(archive.certifiers, np.any(archive.certificates[archive.is_fault], axis=0).tolist())}
    if archive.witnesses is not None and steered:
        certify |= {*archive.witnesses.walker[archive.is_fault & ~archive.certified_by_controllers].tolist()}
    stored = dict(zip(archive.certifiers, archive.certifier_sha256, strict=True))
    names = [name for name in sorted(certify - {faults.SEARCHED}) if hashes.get(name) != stored.get(name, "")]
    if lost := [name for name in names if not (renewed and name in hashes)]:
        rule = f"certifiers must be those that certify faults of {judging.search.run}"
        remedy = "give the files by --certifiers, or other controllers of these names and the stage others, too"
        raise ValueError(f"{rule}, got none or another file for {', '.join(lost)}: {remedy}")


def _cross_by_certifiers(
    archive: Archive, judging: Judging, asked: NDArray[np.bool_], cross: Callable[..., NDArray[np.int64]]
) -> NDArray[np.int64]:
    """Outcomes of each certifier on the elites that it is ``asked`` to cross, both of shape (N, C, ...)."""
    outcomes = np.zeros_like(archive.certifier_outcomes)
    for column, name in enumerate(archive.certifiers):
        if len(rows := np.flatnonzero(asked[:, column])):
            outcomes[rows, column] = cross(judging.certifiers[name], rows, name)
    return outcomes


def _check_varied(archive: Archive, judging: Judging, before: Collection[str]) -> None:
    """Refuses a search that cannot have conditions, too."""
    _check_faults(archive, judging, before, "varied", "others")
    if before:  # else the stage itself finds out at once
        search = judging.search
        local = Compute(judging.crosser.compute.device if judging.crosser.compute.on_gpu else "cpu")
        sizes: dict[str, Any] = {"num_terrains": 1, "replicas": 1, "space": varied_space(search.space).name}
        build_simulator(PipelineCfg(compute=local, robot=search.robot, policy=search.policy, **sizes), 1)


def cross_varied(archive: Archive, judging: Judging) -> Archive:
    """Crosses faults under 20 draws of loads, motors, delays, noise and friction, by controller and certifiers."""
    _check_certifiers(archive, judging)
    search = judging.search
    rows = np.flatnonzero(archive.confirmed & archive.certified_by_controllers)
    space = varied_space(search.space)
    seeds = elite_seeds(archive, search.cfg.seed, faults.EPISODES, stream=Stream.VARIED).reshape(-1, faults.EPISODES)

    def cross(policy: str, rows: NDArray[np.int64], label: str) -> NDArray[np.int64]:
        genes = [varied_genes(search.space, archive.genes[row], seeds[row]) for row in rows]
        drawn = np.array(genes, np.float32).reshape(-1, space.num_genes)
        terrains = Terrains(genes=drawn, seeds=seeds[rows].ravel(), space=space)
        outcomes = judging.count(policy, terrains, f"{label}, varied conditions", replicas=1)
        return outcomes.reshape(-1, faults.EPISODES, len(OUTCOMES)).sum(axis=1)

    searched = np.zeros_like(archive.resolved_outcomes)
    searched[rows] = cross(search.policy, rows, "searched")
    certifiers = _cross_by_certifiers(archive, judging, archive.certificates & archive.confirmed[:, None], cross)
    archive = replace(archive, varied=CrossedAgain(searched=searched, certifiers=certifiers))
    print(f"{archive.robust.sum()} of {len(rows)} faults are robust: faults under varied conditions, too.", flush=True)
    return archive


def _check_mujoco_c(archive: Archive, judging: Judging, before: Collection[str]) -> None:
    """Refuses soft ground, too, which MuJoCo C cannot have."""
    if "softness" in judging.search.space.ground:
        raise ValueError(NO_SOFTNESS)
    _check_faults(archive, judging, before, "mujoco_c", "others", "steered")


def try_in_mujoco_c(archive: Archive, judging: Judging) -> Archive:
    """Crosses faults in MuJoCo C with contact resolved, by the controller, and where it fails by a certifier."""
    _check_certifiers(archive, judging, steered=True)
    search = judging.search
    rounds = len(MUJOCO_C_EPISODES)
    seeds = elite_seeds(archive, search.cfg.seed, rounds, stream=Stream.MUJOCO_C).reshape(-1, rounds)

    def cross(policy: str, rows: NDArray[np.int64], name: str, ways: Any = None, **how: Any) -> NDArray[np.int64]:
        outcomes = np.zeros((len(rows), len(OUTCOMES)), np.int64)
        for number, replicas in enumerate(MUJOCO_C_EPISODES):
            undecided = ~is_decided(outcomes, sum(MUJOCO_C_EPISODES))
            chosen = rows[undecided]
            steering = None if ways is None else np.repeat(ways[undecided][:, None], replicas, axis=1)
            genes, drawn = archive.genes[chosen], seeds[chosen, number]
            terrains = Terrains(genes=genes, seeds=drawn, space=search.space, steering=steering)
            how |= {"replicas": replicas, "engine": "mujoco_c"}
            outcomes[undecided] += judging.count(policy, terrains, f"{name} in MuJoCo C", **how)
        return outcomes

    rows = draw_faults(archive, search.cfg.seed, MUJOCO_C_FAULTS)
    searched = np.zeros_like(archive.resolved_outcomes)
    searched[rows] = cross(search.policy, rows, "searched")
    failing = rows[goal_rates(searched[rows]) < FAILING_GOAL_RATE]
    asked = np.zeros_like(archive.certificates)
    for row in failing.tolist():
        asked[row] = [name == faults.best_certifier(archive, row) for name in archive.certifiers]
    certifiers = _cross_by_certifiers(archive, judging, asked, cross)
    steered = np.zeros_like(searched)
    if (witnesses := archive.witnesses) is not None:
        failing = failing[~archive.certified_by_controllers[failing]]
        walkers = {faults.SEARCHED: search.policy, **judging.certifiers}
        for name in np.unique(witnesses.walker[failing]).tolist():
            rows_of = failing[witnesses.walker[failing] == name]
            ways, limit_m = witnesses.way[rows_of], witnesses.limit_m
            steered[rows_of] = cross(walkers[name], rows_of, f"{name} steered", ways, limit_m=limit_m)
    archive = replace(archive, mujoco_c=CrossedAgain(searched=searched, certifiers=certifiers, steered=steered))
    print(f"{archive.holds_in_mujoco_c.sum()} of {len(rows)} faults hold in MuJoCo C.", flush=True)
    return archive


def draw_faults(archive: Archive, seed: int, count: int) -> NDArray[np.int64]:
    """Rows of at most ``count`` random faults, a fault of each family before a second one of any."""
    rng = np.random.default_rng(np.random.SeedSequence([seed], spawn_key=(Stream.MUJOCO_C,)))
    first, others = split_families(archive, rng.permutation(np.flatnonzero(archive.is_fault)))
    return np.concatenate([rng.permutation(first), others])[:count]


def split_families(archive: Archive, rows: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """The first row of each family, the families in order, and the other rows, in their order."""
    assert archive.family is not None
    _, first = np.unique(archive.family[rows], return_index=True)
    return rows[first], np.delete(rows, first)


def is_decided(counts: NDArray[np.int64], episodes: int) -> NDArray[np.bool_]:
    """Whether outcomes so far, (N, 4), decide if half of ``episodes`` reach the goal, (N,); too many invalid do not."""
    goal, collided, other, _ = counts.T
    lead, rest = goal - collided - other, episodes - counts.sum(axis=1)
    return ((lead >= rest) | (lead < -rest)) & ~np.isnan(goal_rates(counts))


class Stage(NamedTuple):
    """A step of judging."""

    run: Callable[[Archive, Judging], Archive]  # returns the archive with the stage's columns filled anew
    asks_certifiers: bool = True  # whether certifiers cross terrains in it
    check: Callable[[Archive, Judging, Collection[str]], None] = lambda *_: None
    """Refuses what cannot be judged after some stages."""


STAGES = {
    "fresh": Stage(cross_fresh, asks_certifiers=False),
    "resolved": Stage(cross_resolved, asks_certifiers=False),
    "others": Stage(cross_by_others),
    "steered": Stage(cross_steered, check=_check_steered),
    "varied": Stage(cross_varied, check=_check_varied),
    "mujoco_c": Stage(try_in_mujoco_c, check=_check_mujoco_c),
}


def judge(
    run: Path,
    *,
    compute: Compute,
    stages: Sequence[str] = ("fresh", "resolved", "others"),
    certifiers: Mapping[str, str] | None = None,
    robot: str | None = None,
    policy: str | None = None,
    space: str | None = None,
    most_steered: int | None = None,
) -> Archive:
    """Judges the elites of a search in stages, and writes the run's archive, numbers and figures after each.

    ``stages`` are some of :data:`STAGES`, ``certifiers`` other controllers by name, by default those at hand; robot,
    policy and space are as :func:`qd.faults.searches.find_search` takes them.
    """
    if unknown := [name for name in stages if name not in STAGES]:
        raise ValueError(f"stages must be some of {', '.join(STAGES)}, got {', '.join(unknown)}")
    ask = any(STAGES[name].asks_certifiers for name in stages)
    search = find_search(run, robot=robot, policy=policy, space=space)
    if search.space.asks == Kind.ROUTE:
        ensure_stray(search.robot, search.policy, compute)
    with open_judging(search, compute, certifiers, ask=ask) as judging:
        archive = search.read_archive()
        if archive.fresh is None and stages and stages[0] != "fresh":
            raise ValueError(f"stages must begin with fresh, got none: {run} has no fresh episodes")
        for index, name in enumerate(stages):
            STAGES[name].check(archive, judging, stages[:index])
        for number, name in enumerate(stages, 1):
            step, began = f"{number} of {len(stages)}: ", time.perf_counter()
            archive = STAGES[name].run(archive, replace(judging, step=step, most_steered=most_steered))
            _write(archive, judging, name, time.perf_counter() - began)
    return archive


def _write(archive: Archive, judging: Judging, stage: str, wall_s: float) -> None:
    run = RunDirectory(judging.search.run)
    assert archive.fresh is not None
    file = run.path / SUMMARY_FILE
    numbers = read_json(file) if file.exists() else {}
    numbers = {name: value for name, value in numbers.items() if name not in faults.FURTHER_NUMBERS}
    metrics = run.read_metrics() if (run.path / METRICS_FILE).exists() else []
    if len(metrics) >= archive.iterations:  # a search that was stopped has not written its numbers
        numbers |= faults.found_numbers(archive, metrics[: archive.iterations])
    search = judging.search
    numbers |= faults.fresh_numbers(archive, archive.fresh)
    numbers |= judged_numbers(archive, search.space, search.cfg.fitness.disturbances)
    numbers["judged_by"] = numbers.get("judged_by", {}) | {stage: judging.origin | {"wall_s": wall_s}}
    write_archive(run.path, archive)
    write_atomically(file, to_json(numbers))
    if metrics:
        figures.write_figures(run.path, archive, metrics)
