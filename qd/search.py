"""The search: ask for terrains, let robots cross them, tell the emitters what became of them."""

import time
from contextlib import ExitStack
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.faults import confirm_all, fault_words
from qd.fitness import Evaluation, concatenated, evaluation_of
from qd.fresh import Open, corrected, drawn_elites, numbers_of, reevaluate
from qd.run.arguments import Job
from qd.run.directory import CONFIG_FILE, Metrics, RunDirectory, archive_of, claimed, reached, write_results
from qd.run.progress import ProgressBar, plan
from qd.run.settings import SearchCfg, code_of
from qd.workers.evaluator import Evaluate, episode_seeds, open_evaluator, origin_of, pipeline_of, worker_status
from qd.workers.invalid import invalid_iterations, invalid_reasons, refuse_all_invalid
from qd.workers.shards import merged
from sim.files.command import command_line, naming_what_is_next

if TYPE_CHECKING:
    from qd.scheduler import Scheduler
    from sim.rollout import RolloutResult

MOST_DRAWN = 200
"""Elites that cross fresh episodes in the middle of a search (the paper's figure of mean STD)."""


def search_terrains(
    cfg: SearchCfg, run: RunDirectory, scheduler: "Scheduler", metrics: Metrics, evaluate: Evaluate, bar: ProgressBar
) -> None:
    """Runs the iterations that are left, and saves each.

    A group of emitters that was told asks again at once, and its next terrains wait in the queue while those of the
    other groups are crossed. The order is fixed, and what a group has asked for is part of the saved state: a search
    that goes on where it was stopped is the same as one that was not.

    Args:
        cfg: The search.
        run: Where it is saved.
        scheduler: Its state, told so far.
        metrics: Rows so far; one more an iteration.
        evaluate: Crosses terrains.
        bar: Shows progress.
    """
    pipeline, num_groups = pipeline_of(evaluate), cfg.scheduler.groups
    pipeline.clear()
    num_under_way, began = 0, time.perf_counter()
    for iteration in range(len(metrics) + 1, cfg.iterations + 1):
        for group in range(num_under_way, num_groups):
            pipeline.put(scheduler.ask(group), _group_seeds(cfg, scheduler, iteration, group))
        samples = samples_elites(cfg, iteration)
        goes_ahead = iteration < cfg.iterations and not samples  # a sample is crossed with nothing else under way
        results, evaluations, search_s = [], [], 0.0
        for group in range(num_groups):
            result = pipeline.take(bar.within(iteration, group, num_groups))
            refuse_all_invalid(result)
            evaluation = evaluation_of(result, cfg.cells, cfg.fitness)
            told_at = time.perf_counter()
            scheduler.tell(evaluation, iteration, group)
            genes = scheduler.ask(group)
            search_s += time.perf_counter() - told_at
            if goes_ahead:
                pipeline.put(genes, _group_seeds(cfg, scheduler, iteration + 1, group))
            results.append(result)
            evaluations.append(evaluation)
        num_under_way = num_groups if goes_ahead else 0
        archive = archive_of(cfg, scheduler, iteration)
        row = metrics_row(archive, merged(results, join=1), concatenated(evaluations), iteration, search_s)
        if samples:
            row |= _sample_elites(cfg, archive, evaluate)
        ended = time.perf_counter()
        row |= _timing(row, ended - began, evaluate)  # from the end of the iteration before, so saving counts
        began = ended
        metrics.append(row)
        run.save(cfg, scheduler, metrics, archive)
        status = worker_status(evaluate)
        bar.show(row, None if status is None else str(status))


def _group_seeds(cfg: SearchCfg, scheduler: "Scheduler", iteration: int, group: int) -> NDArray[np.uint32]:
    """Seeds of a group's terrains, which are those of their places in the iteration."""
    return episode_seeds(cfg.seed, iteration, cfg.scheduler.num_terrains)[scheduler.places(group)]


def _timing(row: dict[str, Any], wall_s: float, evaluate: Evaluate) -> dict[str, Any]:
    status = worker_status(evaluate)
    workers = {"workers": status.workers, "retries": status.retries} if status else {}
    return {"wall_s": wall_s, "episodes_per_s": row["episodes"] / wall_s, **workers}


def samples_elites(cfg: SearchCfg, iteration: int) -> bool:
    """Whether some elites cross fresh episodes at the end of an iteration."""
    return bool(cfg.reevaluate_every) and iteration % cfg.reevaluate_every == 0


def metrics_row(
    archive: Archive, result: "RolloutResult", evaluation: Evaluation, iteration: int, search_s: float
) -> dict[str, Any]:
    """An iteration's row of metrics without its timing.

    Args:
        archive: What the search has found.
        result: The iteration's crossings.
        evaluation: What the emitters were told of them.
        iteration: Number of the iteration, from 1.
        search_s: Time that the search took to learn of them and to ask again, without crossing anything [s].
    """
    return {
        "iteration": iteration,
        **archive.scores(),
        **evaluation.means(),
        "invalid_reasons": invalid_reasons(result),
        "physics_steps": int(result.physics_steps),
        "robot_steps": int(result.robot_steps),
        "idle_share": result.idle_share,
        "rollout_s": float(result.wall_s),
        "search_s": search_s,
        "mean_duration_s": float(result.duration_s.mean()),
    }


def _sample_elites(cfg: SearchCfg, archive: Archive, evaluate: Evaluate) -> dict[str, Any]:
    """How reliable some elites of this iteration are, in fresh episodes (the paper's mean STD over iterations)."""
    sample = drawn_elites(archive, MOST_DRAWN, cfg.seed)
    fresh = reevaluate([sample], evaluate, cfg.fitness, num_replicas=cfg.replicas, seeds=[cfg.seed])[0]
    return numbers_of(fresh, cfg.cells, sampled=True)


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
    from sim.spaces.registry import get_space

    return Scheduler(
        cfg.scheduler,
        space=get_space(cfg.space, cfg.space_sha256),
        cells=cfg.cells,
        seed=cfg.seed,
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
                evaluate = None
                if done < cfg.iterations:
                    evaluate = opened.enter_context(open_evaluator(job.evaluator))
                run.write_config(cfg, origin)
                if evaluate is not None:
                    with ProgressBar(cfg.iterations, done) as bar:
                        search_terrains(cfg, run, search, metrics, evaluate, bar)
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
        for line in fault_words(archive):
            print(line)
    invalid = invalid_iterations(metrics)
    if invalid is not None:
        print(f"Warning: {invalid}")
    if len(archive):
        from sim.spaces.registry import is_own

        space = job.evaluator.space if is_own(job.evaluator.space) else None
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
