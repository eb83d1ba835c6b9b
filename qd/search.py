"""The search: ask for terrains, let robots cross them, tell the emitters what became of them."""

import time
from contextlib import nullcontext
from typing import TYPE_CHECKING, Any

from qd.archive import Archive
from qd.fitness import evaluation_of
from qd.fresh import Open, corrected, drawn_elites, numbers_of, reevaluate
from qd.run.arguments import Job
from qd.run.directory import CONFIG_FILE, Metrics, RunDirectory, archive_of, claimed, reached, write_results
from qd.run.progress import ProgressBar, plan
from qd.run.settings import SearchCfg, code_of
from qd.workers.evaluator import Evaluate, episode_seeds, open_evaluator, origin_of, worker_status
from qd.workers.invalid import invalid_iterations, invalid_reasons, refuse_all_invalid
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

    Raises:
        AllInvalidError: If no episode of an iteration is valid; those before are saved.
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

    Raises:
        AllInvalidError: If no episode is valid; the search is as it was.
    """
    refuse_all_invalid(result)
    evaluation = evaluation_of(result, cfg.cells, cfg.fitness)
    search.tell(evaluation, iteration)
    found = archive_of(cfg, search, iteration)
    physics = {
        "physics_steps": int(result.physics_steps),
        "rollout_s": float(result.wall_s),
        "mean_duration_s": float(result.duration_s.mean()),
    }
    invalid = {"invalid_reasons": invalid_reasons(result)}
    return found, {"iteration": iteration, **found.scores(), **evaluation.means(), **invalid, **physics}


def _look_again(cfg: SearchCfg, found: Archive, evaluate: Evaluate) -> dict[str, Any]:
    """How reliable some elites of this iteration are, in fresh episodes (the paper's mean STD over iterations)."""
    some = drawn_elites(found, MOST_DRAWN, cfg.seed)
    again = reevaluate([some], evaluate, cfg.fitness, num_replicas=cfg.replicas, seeds=[cfg.seed])[0]
    return numbers_of(again, cfg.cells, sampled=True)


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
            found = archive_of(cfg, search, len(metrics))
            archive = found if job.reproduce else run.with_fresh_values(found)
            write_results(run, archive, metrics, origin)
        if job.reproduce:
            again = f"Go on with:  {job.reevaluate_command}"
            with naming_what_is_next("the archive is saved as found", lambda: again):
                archive = corrected(archive, cfg, job.evaluator, open_evaluator, cfg.seed)
                # The run's numbers are of the machine that searched, the fresh episodes of this one.
                by = origin_of(job.device, cfg.seed, job.evaluator.workers)
                write_results(run, archive, metrics, origin, reproduced_by=by)
    invalid = invalid_iterations(metrics)
    if invalid is not None:
        print(f"Warning: {invalid}")
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
