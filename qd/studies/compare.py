"""Does the search earn its cost? ``make compare`` lets it and its baselines loose on the same number of terrains.

Every method is a run of the ordinary search, in a run directory of its own that can be looked at and extended. They go
in lock-step: each iteration's terrains of all runs are crossed together, so that a GPU is full.
"""

import itertools
import time
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, nullcontext
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from qd.archive import Archive
from qd.fitness import FITNESS_FLOOR
from qd.fresh import Open, numbers_of, reevaluate
from qd.run.cli import naming_what_is_next, run_command
from qd.run.directory import Metrics, RunDirectory, archive_of, claimed
from qd.run.progress import ProgressBar
from qd.run.settings import SearchCfg, as_settings
from qd.search import begin, take_in
from qd.show.figures import save_figure
from qd.studies.compare_arguments import Arguments, Comparison, comparison_of
from qd.studies.comparison import draw_comparison, report_of
from qd.workers.evaluator import Evaluate, crew_status, episode_seeds, open_evaluator
from qd.workers.shards import taken
from sim.files.atomic import to_json, write_atomically

if TYPE_CHECKING:
    from qd.scheduler import Scheduler


@dataclass(kw_only=True)
class Entrant:
    """One run of one method."""

    method: str
    cfg: SearchCfg
    run: RunDirectory
    search: "Scheduler"
    metrics: Metrics = field(default_factory=list)
    found: Archive | None = None

    @property
    def done(self) -> int:
        """Iterations done."""
        return len(self.metrics)


def lock_step(entrants: Sequence[Entrant], evaluate: Evaluate, cfg: SearchCfg, bar: ProgressBar) -> None:
    """Runs the iterations that are left; runs behind the others, as after a kill, catch up first.

    Args:
        entrants: The runs.
        evaluate: Crosses the terrains of all of them.
        cfg: Iterations, and how often to evaluate elites again.
        bar: Shows progress.
    """
    while (done := min(entrant.done for entrant in entrants)) < cfg.iterations:
        began, iteration = time.perf_counter(), done + 1
        active = [entrant for entrant in entrants if entrant.done == done]
        asked = [entrant.search.ask() for entrant in active]
        seeds = [episode_seeds(one.cfg.seed, iteration, len(genes)) for one, genes in zip(active, asked, strict=True)]
        result = evaluate(np.concatenate(asked), np.concatenate(seeds), bar.within(iteration))
        rows, first = [], 0
        for entrant, genes in zip(active, asked, strict=True):
            part = taken(result, len(genes), first=first)
            entrant.found, row = take_in(entrant.cfg, entrant.search, part, iteration)
            rows.append(row)
            first += len(genes)
        if iteration % cfg.reevaluate_every == 0 or iteration == cfg.iterations:
            rows = [row | again for row, again in zip(rows, _again(active, evaluate), strict=True)]
        wall_s = time.perf_counter() - began
        for entrant, row in zip(active, rows, strict=True):
            entrant.metrics.append({**row, "wall_s": wall_s / len(active), "episodes_per_s": row["episodes"] / wall_s})
            assert entrant.found is not None
            entrant.run.save(entrant.cfg, entrant.search, entrant.metrics, entrant.found)
        crew = crew_status(evaluate)
        bar.show(_shown(active, wall_s), None if crew is None else str(crew))


def _again(active: Sequence[Entrant], evaluate: Evaluate) -> list[dict[str, Any]]:
    """What the elites of all runs are worth in fresh episodes."""
    archives = [entrant.found for entrant in active if entrant.found is not None]
    cfg = active[0].cfg
    seeds = [entrant.cfg.seed for entrant in active]
    found = reevaluate(archives, evaluate, cfg.fitness, num_replicas=cfg.replicas, seeds=seeds)
    return [numbers_of(again, cfg.cells) for again in found]


def _shown(active: Sequence[Entrant], wall_s: float) -> dict[str, Any]:
    """A row for the progress bar: of the run with most elites, at the speed of all."""
    best = max(active, key=lambda entrant: entrant.metrics[-1]["elites"])
    episodes = sum(entrant.metrics[-1]["episodes"] for entrant in active)
    return {**best.metrics[-1], "wall_s": wall_s, "episodes_per_s": episodes / wall_s}


def entrants_of(asked: Comparison, claims: ExitStack) -> Iterator[Entrant]:
    """The runs of a comparison, new or as far as they are.

    Args:
        asked: The comparison.
        claims: Keeps searches that extend one of the runs out of their directories until it ends.

    Raises:
        ValueError: If a run that is there has other settings, is damaged or at work, or has gone further than asked.
    """
    first, iterations = asked.cfg.seed, asked.cfg.iterations
    for method, seed in itertools.product(asked.methods, range(first, first + asked.seeds)):
        cfg, run = asked.cfg_of(method, seed), RunDirectory(asked.path / f"{method}-{seed}")
        claims.enter_context(claimed(run.path))
        search, metrics = run.load(cfg) or (begin(cfg), [])
        if len(metrics) > iterations:
            raise ValueError(
                f"iterations must be at least {len(metrics)}, as many as {run.path} has done, got {iterations}"
            )
        yield Entrant(method=method, cfg=cfg, run=run, search=search, metrics=metrics)


def compare(args: Arguments, *, open_evaluator: Open = open_evaluator) -> None:
    """The command.

    Args:
        args: What to compare.
        open_evaluator: Opens what crosses the terrains.

    Raises:
        FileNotFoundError: If there is no comparison to resume.
        ValueError: If something asked for cannot be.
        Interrupted: On Ctrl-C; all iterations that ended are saved.
        EvaluatorError: If a worker is lost; likewise.
    """
    asked = comparison_of(args)
    cfg = asked.cfg
    with ExitStack() as claims:
        claims.enter_context(claimed(asked.path))
        entrants = list(entrants_of(asked, claims))
        done = min(entrant.done for entrant in entrants)
        episodes = sum(cfg.iterations - entrant.done for entrant in entrants) * cfg.episodes_per_iteration
        print(
            f"Comparing {len(asked.methods)} methods, {asked.seeds} seeds each, {cfg.iterations} iterations of preset "
            f"{cfg.preset}: {episodes:,} episodes, and those of the elites evaluated again; runs in {asked.path}",
            flush=True,
        )
        with naming_what_is_next("finished iterations are saved", lambda: _how_to_go_on(asked)):
            with open_evaluator(asked.evaluator) if done < cfg.iterations else nullcontext() as evaluate:
                _write_configs(asked, entrants)
                if evaluate is not None:
                    with ProgressBar(cfg.iterations, done) as bar:
                        lock_step(entrants, evaluate, cfg, bar)
            _finish(asked, entrants)


def _how_to_go_on(asked: Comparison) -> str:
    if not asked.has_config:
        return "No iteration is finished: start it again"
    return f"Go on with:  {asked.resume_command}"


def _write_configs(asked: Comparison, entrants: Sequence[Entrant]) -> None:
    asked.write_config()
    for entrant in entrants:
        origin = {**asked.origin, "seed": entrant.cfg.seed, "sessions": []}
        entrant.run.write_config(replace(entrant.cfg, iterations=asked.cfg.iterations), origin)


def _finish(asked: Comparison, entrants: Sequence[Entrant]) -> None:
    """Archives, numbers and figure of a comparison that reached its iterations."""
    runs: dict[str, list[Metrics]] = {method: [] for method in asked.methods}
    for entrant in entrants:
        found = archive_of(entrant.cfg, entrant.search, entrant.done)
        entrant.run.write_derived(entrant.metrics, entrant.run.with_fresh_values(found))
        runs[entrant.method].append(entrant.metrics)
    cfg = asked.cfg
    settings = {name: as_settings(asked.cfg_of(name, cfg.seed))["scheduler"] for name in asked.methods}
    report = {
        **asked.origin,
        "robot": cfg.robot,
        "preset": cfg.preset,
        "seeds": list(range(cfg.seed, cfg.seed + asked.seeds)),
        "reachable_cells": cfg.cells.num_cells,
        "qd_score_offset": -FITNESS_FLOOR,
        **report_of(runs, settings),
    }
    figure = asked.out.with_suffix(".png")
    write_atomically(asked.out, to_json(report))
    save_figure(figure, draw_comparison(report))
    print(f"written to {asked.out} and {figure}")


if __name__ == "__main__":
    run_command(Arguments, compare)
