"""The search: ask for terrains, let robots cross them, tell the emitters what became of them."""

import time
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

from qd.archive import Archive
from qd.fitness import Evaluation, evaluation_of
from qd.fresh import Open, corrected, drawn_elites, numbers_of, reevaluate
from qd.run.arguments import Job
from qd.run.directory import CONFIG_FILE, SUMMARY_FILE, Metrics, RunDirectory, archive_of, claimed, reached
from qd.run.progress import ProgressBar, clock, plan
from qd.run.settings import SearchCfg, code_of
from qd.workers.evaluator import Evaluate, episode_seeds, open_evaluator, origin_of, worker_status
from sim.files.atomic import to_json, write_atomically
from sim.files.command import command_line, naming_what_is_next

if TYPE_CHECKING:
    from qd.scheduler import Scheduler
    from sim.rollout import RolloutResult

MOST_DRAWN = 200
"""Elites that cross fresh episodes in the middle of a search (the paper's figure of mean STD)."""


def search_terrains(
    cfg: SearchCfg, run: RunDirectory, search: "Scheduler", metrics: Metrics, evaluate: Evaluate, bar: ProgressBar
) -> None:
    """The loop: runs the iterations that are left, each saved before the next begins.

    Args:
        cfg: The search.
        run: Where it is saved.
        search: Its state, told so far.
        metrics: Rows so far; one more an iteration.
        evaluate: Crosses terrains.
        bar: Shows progress.
    """
    began = time.perf_counter()
    for iteration in range(len(metrics) + 1, cfg.iterations + 1):
        genes = search.ask()
        seeds = episode_seeds(cfg.seed, iteration, len(genes))
        result = evaluate(genes, seeds, bar.within(iteration))
        found, row = take_in(cfg, search, result, iteration)
        if cfg.reevaluate_every and iteration % cfg.reevaluate_every == 0:
            row |= _look_again(cfg, found, evaluate)
        ended = time.perf_counter()
        wall_s = ended - began  # from the end of the iteration before, so saving counts
        workers = worker_status(evaluate)
        counts = {"workers": workers.workers, "retries": workers.retries} if workers else {}
        metrics.append({**row, "wall_s": wall_s, "episodes_per_s": row["episodes"] / wall_s, **counts})
        began = ended
        run.save(cfg, search, metrics, found)
        bar.show(metrics[-1], None if workers is None else str(workers))


def take_in(
    cfg: SearchCfg, search: "Scheduler", result: "RolloutResult", iteration: int
) -> tuple[Archive, dict[str, Any]]:
    """Tells a search what became of the terrains it asked for.

    Args:
        cfg: The search.
        search: Has asked; is told.
        result: The crossings.
        iteration: Number of the iteration, from 1.

    Returns:
        What the search has found, and the iteration's row of metrics but for its timing.
    """
    evaluation = evaluation_of(result, cfg.cells, cfg.fitness)
    search.tell(evaluation, iteration)
    found = archive_of(cfg, search, iteration)
    physics = {
        "physics_steps": int(result.physics_steps),
        "rollout_s": float(result.wall_s),
        "mean_duration_s": float(result.duration_s.mean()),
    }
    return found, {"iteration": iteration, **_scores(found), **_batch_row(evaluation), **physics}


def _look_again(cfg: SearchCfg, found: Archive, evaluate: Evaluate) -> dict[str, Any]:
    """How reliable some elites of this iteration are, in fresh episodes (the paper's mean STD over iterations)."""
    some = drawn_elites(found, MOST_DRAWN, cfg.seed)
    again = reevaluate([some], evaluate, cfg.fitness, num_replicas=cfg.replicas, seeds=[cfg.seed])[0]
    return numbers_of(again, cfg.cells, sampled=True)


def _scores(archive: Archive) -> dict[str, Any]:
    """How good the archive is."""
    return {
        "elites": len(archive),
        "reachable_coverage": archive.reachable_coverage,
        "qd_score": archive.qd_score,
        "mean_fitness": archive.mean_fitness,
    }


def _batch_row(evaluation: Evaluation) -> dict[str, Any]:
    """What an iteration's own terrains were like."""
    return {
        "terrains": len(evaluation.fitness),
        "episodes": int(evaluation.episodes.sum()),
        "invalid_episodes": int(evaluation.invalid_episodes.sum()),
        "invalid_terrains": int((~evaluation.valid).sum()),
        "batch_fitness": float(evaluation.fitness.mean()),
        "batch_collision_rate": float(evaluation.collision_rate.mean()),
        "batch_goal_rate": float(evaluation.goal_rate.mean()),
    }


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
    """
    cfg, run = job.cfg, RunDirectory(job.path)
    with claimed(job.path):
        loaded = run.load(cfg) if job.resumes else None
        done = len(loaded[1]) if loaded else 0
        if done > cfg.iterations:
            raise ValueError(
                f"iterations must be at least {done}, as many as {job.path} has done, got {cfg.iterations}"
            )
        print(plan(cfg, job.path, done, job.device, job.evaluator.num_workers), flush=True)
        _mention_fresh_values(job, run, done)
        own = [{**job.session, "iterations": cfg.iterations}] if done < cfg.iterations else []
        origin = {**job.origin, "sessions": [*reached(job.origin["sessions"], done), *own]}
        with naming_what_is_next("finished iterations are saved", lambda: _how_to_go_on(job)):
            with open_evaluator(job.evaluator) if done < cfg.iterations else nullcontext() as evaluate:
                search, metrics = loaded or (begin(cfg), [])
                run.write_config(cfg, origin)
                if evaluate is not None:
                    with ProgressBar(cfg.iterations, done) as bar:
                        search_terrains(cfg, run, search, metrics, evaluate, bar)
            archive = _write_found(job, run, search, metrics, origin)
        if job.reproduce:
            again = f"Go on with:  {job.reevaluate_command}"
            with naming_what_is_next("the archive is saved as found", lambda: again):
                archive = _write_corrected(job, run, archive, metrics, origin, open_evaluator)
    worst = command_line("replay", robot=job.robot, run=job.path, elite=0, policy=code_of(cfg))
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


def begin(cfg: SearchCfg) -> "Scheduler":
    """A search that has asked for nothing yet."""
    from qd.scheduler import Scheduler  # pyribs takes two seconds to import
    from sim.space import get_space

    return Scheduler(
        cfg.scheduler,
        space=get_space(cfg.space),
        num_cells=cfg.cells.num_cells,
        num_ratios=len(cfg.fitness.penalties),
        seed=cfg.seed,
    )


def _write_found(
    job: Job, run: RunDirectory, search: "Scheduler", metrics: Metrics, origin: dict[str, Any]
) -> Archive:
    """Writes figures and numbers of a search that reached its iterations, with the fresh values that still hold."""
    found = archive_of(job.cfg, search, len(metrics))
    archive = found if job.reproduce else run.with_fresh_values(found)
    by = run.read_summary().get("reproduced_by") if archive.fresh is not None else None
    write_results(run, archive, metrics, {**origin, "reproduced_by": by})
    return archive


def _write_corrected(
    job: Job, run: RunDirectory, archive: Archive, metrics: Metrics, origin: dict[str, Any], open_evaluator: Open
) -> Archive:
    """Writes the same as 40 fresh episodes of each elite correct it."""
    archive = corrected(archive, job.cfg, job.evaluator, open_evaluator, job.cfg.seed)
    # The numbers are those of the machine that searched; the elites may have been evaluated again on another.
    again = origin_of(job.device, job.cfg.seed, job.evaluator.workers)
    write_results(run, archive, metrics, {**origin, "reproduced_by": again})
    return archive


def write_results(run: RunDirectory, archive: Archive, metrics: Metrics, origin: dict[str, Any]) -> None:
    """Writes what a search leaves to look at, and says what it is.

    Args:
        run: The run directory, claimed.
        archive: What was found; with fresh values its numbers and figures have them.
        metrics: One row an iteration.
        origin: Provenance, with the sessions of the run.
    """
    from qd.show.figures import summary, write_figures

    run.write_derived(metrics, archive)
    origin = {**origin, "sessions": reached(origin["sessions"], len(metrics))}
    figures = write_figures(run.path, archive, metrics)
    gpus = 0 if origin["device"].startswith("CPU") else max((row.get("workers", 1) for row in metrics), default=1)
    numbers = summary(archive, metrics, gpus=gpus, origin=origin)
    write_atomically(run.path / SUMMARY_FILE, to_json(numbers))
    if archive.fresh is None:
        print(
            f"{len(archive):,} elites in {archive.reachable_coverage:.1%} of the reachable cells, QD score "
            f"{archive.qd_score:.0f}, mean fitness {archive.mean_fitness:.2f}, after {numbers['episodes']:,} episodes "
            f"in {clock(numbers['wall_s'])}"
        )
        print(f"Figures: {', '.join(map(str, figures))}")
        return
    print(
        f"Corrected by fresh episodes: {numbers['elites_reproduced']:,} of {len(archive):,} elites reproduced, "
        f"{numbers['corrected_coverage']:.1%} of the reachable cells, QD score {numbers['corrected_qd_score']:.0f}; "
        f"in {run.path / SUMMARY_FILE} and the figures"
    )
