"""The search: ask for terrains, let robots cross them, tell the emitters what became of them."""

import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.faults import confirm_all, fault_words, search_words
from qd.fitness import Evaluation, concatenated, evaluation_of
from qd.fresh import Open, corrected, drawn_elites, numbers_of, reevaluate
from qd.gate import Gate, certifier_seeds, groups_behind, open_gate, rates_of
from qd.run.arguments import Job
from qd.run.directory import (
    CONFIG_FILE,
    Metrics,
    RunDirectory,
    archive_of,
    claimed,
    episodes_in,
    reached,
    write_results,
)
from qd.run.progress import ProgressBar, plan
from qd.run.settings import SearchCfg, code_of
from qd.workers.evaluator import Evaluate, episode_seeds, open_evaluator, origin_of, pipeline_of, worker_status
from qd.workers.invalid import invalid_iterations, invalid_reasons, refuse_all_invalid
from qd.workers.shards import merged, taken
from sim.files.command import command_line, naming_what_is_next

if TYPE_CHECKING:
    from qd.scheduler import Scheduler
    from sim.rollout import RolloutResult

MOST_DRAWN = 200
"""Elites that cross fresh episodes in the middle of a search (the paper's figure of mean STD)."""


class Crossed(NamedTuple):
    """Terrains of one search that the controller has crossed, of a group or of a whole iteration."""

    result: "RolloutResult"
    evaluation: Evaluation
    search_s: float = 0.0
    """Time that the search took to learn of them and to ask again, without crossing anything [s]."""


def search_terrains(
    cfg: SearchCfg,
    run: RunDirectory,
    search: "Scheduler",
    metrics: Metrics,
    evaluate: Evaluate,
    bar: ProgressBar,
    gate: Gate | None = None,
) -> None:
    """The loop: runs the iterations that are left, and saves each.

    Args:
        cfg: The search.
        run: Where it is saved.
        search: Its state, told so far.
        metrics: Rows so far; one more an iteration.
        evaluate: Crosses terrains.
        bar: Shows progress.
        gate: The certifiers of a search for certified failures.

    Raises:
        AllInvalidError: If no episode of a group is valid; the iterations before are saved.
    """
    left = range(len(metrics) + 1, cfg.iterations + 1)
    began = time.perf_counter()
    for iteration, (crossed,) in crossed_iterations([(cfg, search)], left, evaluate, bar, gate):
        found = archive_of(cfg, search, iteration)
        row = row_of(cfg, found, crossed, iteration)
        if looks_again(cfg, iteration):
            row |= _look_again(cfg, found, evaluate)
        ended = time.perf_counter()
        wall_s = ended - began  # from the end of the iteration before, so saving counts
        workers = worker_status(evaluate)
        counts = {"workers": workers.workers, "retries": workers.retries} if workers else {}
        metrics.append({**row, "wall_s": wall_s, "episodes_per_s": episodes_in(row) / wall_s, **counts})
        began = ended
        run.save(cfg, search, metrics, found)
        bar.show(metrics[-1], None if workers is None else str(workers))


def crossed_iterations(
    searches: "Sequence[tuple[SearchCfg, Scheduler]]",
    iterations: range,
    evaluate: Evaluate,
    bar: ProgressBar,
    gate: Gate | None = None,
) -> "Iterator[tuple[int, list[Crossed]]]":
    """Lets the groups of some searches ask, have their terrains crossed, and tells them, in turn.

    A group that was told asks again at once, and its next terrains wait in the queue while those of the other groups
    are crossed. The order is fixed, and what a group has asked for is part of the saved state: a search that goes on
    where it was stopped is the same as one that was not.

    In a search for certified failures a group is told when its certifiers have come back too, which is some groups
    later: those are crossed by the controller meanwhile.

    Args:
        searches: Settings and states; all have as many groups and episodes a terrain. They are crossed together.
        iterations: Which to run.
        evaluate: Crosses terrains.
        bar: Shows progress.
        gate: The certifiers, if one of the searches has some.

    Yields:
        Number of an iteration whose groups were all told, and what each search crossed in it. Nothing is under way
        before an iteration at whose end elites cross fresh episodes (:func:`looks_again`) goes on.
    """
    cfg, pipeline = searches[0][0], pipeline_of(evaluate)
    groups, under_way = range(cfg.scheduler.groups), 0
    behind = 0 if gate is None else groups_behind(len(groups))
    pipeline.clear()
    if gate is not None:
        gate.clear()

    def put(iteration: int, group: int) -> None:
        parts = [_group_terrains(own, search, iteration, group) for own, search in searches]
        pipeline.put(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))

    for iteration in iterations:
        for group in groups[under_way:]:
            put(iteration, group)
        ahead = iteration + 1 in iterations and not looks_again(cfg, iteration)
        results: list[list[Crossed]] = []
        waiting: deque[int] = deque()
        for group in groups:
            result = pipeline.take(bar.within(iteration, group, len(groups)))
            results.append(_crossed(searches, result, group))
            if gate is not None:
                _ask_certifiers(gate, searches, results[group], iteration, group)
            waiting.append(group)
            while len(waiting) > (behind if group < groups[-1] else 0):
                done = waiting.popleft()
                results[done] = _tell(searches, results[done], gate, iteration, done)
                if ahead:
                    put(iteration + 1, done)
        under_way = len(groups) if ahead else 0
        yield iteration, [_joined(own) for own in zip(*results, strict=True)]


def _group_terrains(
    cfg: SearchCfg, search: "Scheduler", iteration: int, group: int
) -> "tuple[NDArray[np.float32], NDArray[np.uint32]]":
    """Genes that a group asks for, and their seeds, which are those of their place in the iteration."""
    seeds = episode_seeds(cfg.seed, iteration, cfg.scheduler.num_terrains)
    return search.ask(group), seeds[search.places(group)]


def _crossed(searches: "Sequence[tuple[SearchCfg, Scheduler]]", result: "RolloutResult", group: int) -> list[Crossed]:
    """What the controller made of a group's terrains, one a search."""
    found, first = [], 0
    for cfg, search in searches:
        places = search.places(group)
        own = taken(result, places.stop - places.start, first=first)
        first += places.stop - places.start
        refuse_all_invalid(own)
        found.append(Crossed(own, evaluation_of(own, cfg.cells, cfg.fitness)))
    return found


def _joined(groups: Sequence[Crossed]) -> Crossed:
    """The groups of an iteration, one after the other."""
    evaluation = concatenated([one.evaluation for one in groups])
    return Crossed(merged([one.result for one in groups], join=1), evaluation, sum(one.search_s for one in groups))


def _ask_certifiers(
    gate: Gate,
    searches: "Sequence[tuple[SearchCfg, Scheduler]]",
    crossed: Sequence[Crossed],
    iteration: int,
    group: int,
) -> None:
    """Lets certifiers cross what a group's terrains the controller did not, those of all searches together."""
    parts = [
        (search.ask(group)[asked], certifier_seeds(cfg, iteration, search.places(group))[asked])
        for (cfg, search), one in zip(searches, crossed, strict=True)
        if cfg.certified_by
        for asked in [one.evaluation.not_crossed]
    ]
    gate.put(*(np.concatenate(arrays) for arrays in zip(*parts, strict=True)))


def _tell(
    searches: "Sequence[tuple[SearchCfg, Scheduler]]",
    crossed: Sequence[Crossed],
    gate: Gate | None,
    iteration: int,
    group: int,
) -> list[Crossed]:
    """Tells a group of emitters of each search what became of its terrains, lets it ask again, and takes the time."""
    counts, first, told = None if gate is None else gate.take(), 0, []
    for (cfg, search), one in zip(searches, crossed, strict=True):
        rates = None
        if cfg.certified_by and counts is not None:
            asked = one.evaluation.not_crossed
            last = first + int(asked.sum())
            rates, first = rates_of(asked, counts[first:last]), last
        began = time.perf_counter()
        search.tell(one.evaluation, iteration, group, rates)
        search.ask(group)
        told.append(one._replace(search_s=time.perf_counter() - began))
    return told


def looks_again(cfg: SearchCfg, iteration: int) -> bool:
    """Whether elites cross fresh episodes at the end of an iteration."""
    return bool(cfg.reevaluate_every) and iteration % cfg.reevaluate_every == 0


def row_of(cfg: SearchCfg, found: Archive, crossed: Crossed, iteration: int) -> dict[str, Any]:
    """An iteration's row of metrics without its timing.

    Args:
        cfg: The search.
        found: What it has found.
        crossed: The iteration's crossings.
        iteration: Number of the iteration, from 1.
    """
    result, evaluation = crossed.result, crossed.evaluation
    certified = {}
    if found.certificates is not None:
        asked = int(evaluation.not_crossed.sum()) * len(cfg.certified_by)
        certified = {
            "certifier_episodes": asked * cfg.certify_episodes,
            "certified_elites": int(found.certificates.certified.sum()),
        }
    return {
        "iteration": iteration,
        **found.scores(),
        **evaluation.means(),
        **certified,
        "invalid_reasons": invalid_reasons(result),
        "physics_steps": int(result.physics_steps),
        "robot_steps": int(result.robot_steps),
        "idle_share": result.idle_share,
        "rollout_s": float(result.wall_s),
        "search_s": crossed.search_s,
        "mean_duration_s": float(result.duration_s.mean()),
    }


def _look_again(cfg: SearchCfg, found: Archive, evaluate: Evaluate) -> dict[str, Any]:
    """How reliable some elites of this iteration are, in fresh episodes (the paper's mean STD over iterations)."""
    some = drawn_elites(found, MOST_DRAWN, cfg.seed)
    again = reevaluate([some], evaluate, cfg.fitness, num_replicas=cfg.replicas, seeds=[cfg.seed])[0]
    return numbers_of(again, cfg.cells, sampled=True)


def begin(
    cfg: SearchCfg, device: str, loaded: "tuple[Scheduler, Metrics] | None" = None
) -> "tuple[Scheduler, Metrics]":
    """A search and its metrics: one that goes on, or one that has asked for nothing yet.

    Args:
        cfg: The search.
        device: Warp device of what it computes beside the simulation.
        loaded: One that goes on.
    """
    search, metrics = loaded or (_new(cfg), [])
    search.compute_on(device)
    return search, metrics


def _new(cfg: SearchCfg) -> "Scheduler":
    from qd.scheduler import Scheduler  # pyribs takes two seconds to import
    from sim.space import get_space

    return Scheduler(
        cfg.scheduler,
        space=get_space(cfg.space, cfg.space_sha256),
        cells=cfg.cells,
        seed=cfg.seed,
        num_certifiers=len(cfg.certified_by),
    )


def run_search(job: Job, *, open_evaluator: Open = open_evaluator) -> Archive:
    """Runs a search to its end: the loop, figures, numbers, and what to do next.

    Args:
        job: What to do; nothing is written before the simulation stands.
        open_evaluator: Opens what crosses the terrains.

    Returns:
        The archive.

    Raises:
        ValueError: If the run directory does not fit the job.
        Interrupted: On Ctrl-C or SIGTERM; all iterations that ended are saved.
        EvaluatorError: If a worker is lost; likewise.
        AllInvalidError: If no episode of an iteration is valid; likewise.
    """
    cfg, run = job.cfg, RunDirectory(job.path)
    with claimed(job.path):
        loaded = run.load(cfg) if job.resumes else None
        done = len(loaded[1]) if loaded else 0
        if done > cfg.iterations:
            raise ValueError(
                f"iterations must be at least {done}, as many as {job.path} has done, got {cfg.iterations}"
            )
        search, metrics = begin(cfg, job.device, loaded)
        print(plan(cfg, job.path, done, job.device, job.evaluator.num_workers), flush=True)
        _mention_fresh_values(job, run, done)
        own = [{**job.session, "iterations": cfg.iterations}] if done < cfg.iterations else []
        origin = {**job.origin, "sessions": [*reached(job.origin["sessions"], done), *own]}
        with naming_what_is_next("finished iterations are saved", lambda: _how_to_go_on(job)):
            with ExitStack() as opened:
                evaluate = gate = None
                if done < cfg.iterations:
                    evaluate = opened.enter_context(open_evaluator(job.evaluator))
                    gate = opened.enter_context(open_gate(cfg, job.certifiers, job.evaluator, open_evaluator))
                run.write_config(cfg, origin)
                if evaluate is not None:
                    with ProgressBar(cfg.iterations, done) as bar:
                        search_terrains(cfg, run, search, metrics, evaluate, bar, gate)
            found = archive_of(cfg, search, len(metrics))
            archive = run.with_fresh_values(found)
            write_results(run, archive, metrics, origin)
        if job.reproduce:
            again = f"Go on with:  {job.reevaluate_command}"
            with naming_what_is_next("the archive is saved as found", lambda: again):
                archive = run.with_faults(corrected(found, cfg, job.evaluator, open_evaluator, cfg.seed))
                # The run's numbers are of the machine that searched, the fresh episodes of this one.
                by = origin_of(job.device, cfg.seed, job.evaluator.workers)
                write_results(run, archive, metrics, origin, reproduced_by=by)
        if job.confirm:
            later = f"Go on with:  {job.confirm_command}"
            with naming_what_is_next("what was crossed is kept", lambda: later):
                archive = confirm_all(run, archive, job.evaluator, open_evaluator, cfg.seed)
        for line in (*search_words(archive), *fault_words(archive)):
            print(line)
    invalid = invalid_iterations(metrics)
    if invalid is not None:
        print(f"Warning: {invalid}")
    if len(archive):
        from sim.space import to_be_named

        space = to_be_named(job.evaluator.space)
        worst = command_line("replay", robot=job.robot, run=job.path, elite=0, policy=code_of(cfg), space=space)
        print(f"Next, see the worst terrain:  {worst}")
    return archive


def _mention_fresh_values(job: Job, run: RunDirectory, done: int) -> None:
    """Says so before a run loses what fresh episodes said of its elites."""
    if job.resumes and not job.reproduce and done < job.cfg.iterations and run.fresh_archive():
        print(
            "Its elites were evaluated again with fresh episodes; the first new iteration drops those values. "
            f"Afterwards:  {job.reevaluate_command}"
        )


def _how_to_go_on(job: Job) -> str:
    if not (job.path / CONFIG_FILE).exists():
        return "No iteration is finished: start it again"
    return f"Go on with:  {job.resume_command}"
