"""Does the search earn its cost? ``make compare`` lets it and its baselines loose on the same number of terrains.

Every method is a run of the ordinary search, in a run directory of its own that can be looked at and extended. They go
in lock-step: each iteration's terrains of all runs are crossed together, so that a GPU is full.
"""

import itertools
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from qd.archive import Archive
from qd.cli import Interrupted, run_command
from qd.comparison import draw_comparison, report_of
from qd.fitness import FITNESS_FLOOR
from qd.progress import ProgressBar
from qd.reevaluate import numbers_of, reevaluate
from qd.report import save_figure
from qd.run_directory import CONFIG_FILE, Metrics, RunDirectory, archive_of, claimed, numbered
from qd.search import begin, take_in
from qd.settings import SearchCfg, as_settings, changed, measured_now, policy_spec, preset
from qd.shards import taken
from qd.workers import (
    Evaluate,
    EvaluatorCfg,
    EvaluatorError,
    check_policy,
    crew_status,
    episode_seeds,
    open_evaluator,
    origin_of,
    resolve_device,
)
from sim.files import prepare_output, to_json, write_atomically

if TYPE_CHECKING:
    from qd.scheduler import Scheduler

METHODS: dict[str, dict[str, Any]] = {
    "uniform_random": {"method": "uniform_random"},
    "hard_random": {"method": "hard_random"},
    "map_elites": {"method": "map_elites"},
    "cma_me": {"method": "cma_me"},
    "cma_mae": {"method": "cma_mae", "es": "cma_es"},
    "cma_mae_sep": {"method": "cma_mae", "es": "sep_cma_es"},
    "cma_mae_narrow": {"method": "cma_mae", "es": "cma_es", "sigma0": 0.5},
    "mixed": {"method": "mixed", "es": "cma_es"},
}
"""What is compared: changes of the search's settings."""

_RUNS = Path("runs")


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Compare ways to search on the same number of terrains, several seeds each, all in lock-step.

    State is saved after every iteration: stop with Ctrl-C whenever you like and go on with --resume.
    """

    robot: str = "anymal"
    """Which robot."""
    preset: str | None = None
    """Size of an iteration: paper (a GPU's work) or small."""
    methods: tuple[str, ...] = tuple(METHODS)
    """Which methods: uniform_random, hard_random, map_elites, cma_me, cma_mae, cma_mae_sep, cma_mae_narrow (first step
    size .5), mixed."""
    seeds: int = 3
    """Runs of each method, with seeds from --seed on."""
    seed: int = 0
    """The first seed."""
    iterations: int = 33
    """Iterations of every run."""
    reevaluate_every: int = 11
    """Every so many iterations, and at the end, all elites are evaluated again with 40 fresh episodes."""
    policy: str | None = None
    """Controller other than the shipped one."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    processes: int | None = None
    """Processes on the CPU, without Ray; one a core."""
    workers: int | Literal["auto"] | None = None
    """Ray workers, a GPU or CPU core each; auto: all there are."""
    worker_limit_s: float = 900.0
    """A Ray worker that gets no further for so many seconds is given up."""
    resume: Path | None = None
    """Go on with the comparison in this directory; give the other flags again as they were."""
    run_dir: Path | None = None
    """Directory of a new comparison; runs/<robot>-compare, numbered if that exists."""
    out: Path | None = None
    """Where to write the numbers, with a figure beside them; compare.json in the run directory if left out."""


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


def lock_step(entrants: Sequence[Entrant], evaluate: Evaluate, args: Arguments, bar: ProgressBar) -> None:
    """Runs the iterations that are left; runs behind the others, as after a kill, catch up first.

    Args:
        entrants: The runs.
        evaluate: Crosses the terrains of all of them.
        args: Iterations, and how often to evaluate elites again.
        bar: Shows progress.
    """
    while (done := min(entrant.done for entrant in entrants)) < args.iterations:
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
        if iteration % args.reevaluate_every == 0 or iteration == args.iterations:
            rows = [row | again for row, again in zip(rows, _again(active, evaluate), strict=True)]
        wall_s = time.perf_counter() - began
        for entrant, row in zip(active, rows, strict=True):
            entrant.metrics.append({**row, "wall_s": wall_s / len(active), "episodes_per_s": row["episodes"] / wall_s})
            assert entrant.found is not None
            entrant.run.save(as_settings(entrant.cfg), entrant.search, entrant.metrics, entrant.found)
        crew = crew_status(evaluate)
        bar.show(_shown(entrants, wall_s), None if crew is None else str(crew))


def _again(active: Sequence[Entrant], evaluate: Evaluate) -> list[dict[str, Any]]:
    """What the elites of all runs are worth in fresh episodes."""
    archives = [entrant.found for entrant in active if entrant.found is not None]
    cfg = active[0].cfg
    seeds = [entrant.cfg.seed for entrant in active]
    found = reevaluate(archives, evaluate, cfg.fitness, num_replicas=cfg.replicas, seeds=seeds)
    return [numbers_of(again, cfg.cells) for again in found]


def _shown(entrants: Sequence[Entrant], wall_s: float) -> dict[str, Any]:
    """A row for the progress bar: of the run with most elites, at the speed of all."""
    best = max(entrants, key=lambda entrant: entrant.metrics[-1]["elites"])
    episodes = sum(entrant.metrics[-1]["episodes"] for entrant in entrants)
    return {**best.metrics[-1], "wall_s": wall_s, "episodes_per_s": episodes / wall_s}


def entrants_of(args: Arguments, cfg: SearchCfg, path: Path, origin: dict[str, Any]) -> Iterator[Entrant]:
    """The runs of a comparison, new or as far as they are.

    Raises:
        ValueError: If a run that is there has other settings, or is damaged.
    """
    for method, seed in itertools.product(args.methods, range(args.seed, args.seed + args.seeds)):
        one = changed(replace(cfg, seed=seed, iterations=args.iterations), METHODS[method])
        run = RunDirectory(path / f"{method}-{seed}")
        there = (run.path / CONFIG_FILE).exists()
        if not there:
            run.path.mkdir(exist_ok=True)
            run.write_config(as_settings(one), args.iterations, {**origin, "seed": seed})
        search, metrics = (run.load(as_settings(one)) if there else None) or (begin(one), [])
        if len(metrics) > args.iterations:
            raise ValueError(f"{run.path} has {len(metrics)} iterations, got --iterations {args.iterations}: give more")
        yield Entrant(method=method, cfg=one, run=run, search=search, metrics=metrics)


def checked(args: Arguments) -> tuple[SearchCfg, EvaluatorCfg]:
    """The settings that all methods share, and what crosses their terrains; everything a user may get wrong is seen.

    Raises:
        ValueError: If a method is unknown or named twice, or another argument is not as it must be.
    """
    from sim.robot import get_robot

    unknown = [name for name in args.methods if name not in METHODS]
    if unknown or not args.methods or len(set(args.methods)) < len(args.methods):
        raise ValueError(f"methods must be some of {', '.join(METHODS)}, each once, got {', '.join(args.methods)}")
    for name in ("seeds", "iterations", "reevaluate_every"):
        if getattr(args, name) < 1:
            raise ValueError(f"{name} must be at least 1, got {getattr(args, name)}")
    if args.resume and args.run_dir:
        raise ValueError("give --resume for a comparison that is there or --run-dir for a new one, not both")
    if args.resume and not args.resume.is_dir():
        raise FileNotFoundError(f"no comparison at {args.resume}: give the directory of one")
    robot = get_robot(args.robot)
    device = resolve_device(args.device, args.workers)
    on_gpu = device.startswith("cuda")
    changes = {"seed": args.seed, "policy": args.policy, "reevaluate_every": 0}
    cfg = measured_now(changed(preset(args.preset or ("paper" if on_gpu else "small"), robot), changes), robot)
    policy = policy_spec(cfg, robot)
    check_policy(policy, cfg.robot, device)
    runs = len(args.methods) * args.seeds
    evaluator = EvaluatorCfg(
        robot=cfg.robot,
        policy=policy,
        num_terrains=cfg.scheduler.num_terrains * (runs if on_gpu else 1),  # a CPU is full with one run's
        num_replicas=cfg.replicas,
        device=device,
        num_processes=args.processes,
        workers=args.workers,
        worker_limit_s=args.worker_limit_s,
    )
    return cfg, evaluator


def compare(args: Arguments) -> None:
    """The command.

    Raises:
        ValueError: If something asked for cannot be.
        Interrupted: On Ctrl-C; all iterations that ended are saved.
        EvaluatorError: If a worker is lost; likewise.
    """
    cfg, evaluator = checked(args)
    name = f"{cfg.robot}-compare"
    path = args.resume or args.run_dir or next(path for path in numbered(_RUNS, name) if not path.exists())
    if args.out is not None:
        prepare_output(args.out)
    with claimed(path):
        origin = origin_of(evaluator.device, args.seed, args.workers)
        entrants = list(entrants_of(args, cfg, path, origin))
        episodes = sum(args.iterations - entrant.done for entrant in entrants) * cfg.episodes_per_iteration
        print(
            f"Comparing {len(args.methods)} methods, {args.seeds} seeds each, {args.iterations} iterations of preset "
            f"{cfg.preset}: {episodes:,} episodes, and those of the elites evaluated again; runs in {path}",
            flush=True,
        )
        try:
            done = min(entrant.done for entrant in entrants)
            if done < args.iterations:
                with open_evaluator(evaluator) as evaluate, ProgressBar(args.iterations, done) as bar:
                    lock_step(entrants, evaluate, args, bar)
        except KeyboardInterrupt:
            raise Interrupted(f"Stopped; finished iterations are saved. Go on with --resume {path}") from None
        except (EvaluatorError, OSError) as error:
            raise EvaluatorError(f"{error}. Go on with --resume {path}") from None
        _finish(args, cfg, path, entrants, origin)


def _finish(args: Arguments, cfg: SearchCfg, path: Path, entrants: Sequence[Entrant], origin: dict[str, Any]) -> None:
    runs: dict[str, list[Metrics]] = {method: [] for method in args.methods}
    for entrant in entrants:
        found = archive_of(as_settings(entrant.cfg), entrant.search, entrant.done)
        entrant.run.write_derived(entrant.metrics, found)
        runs[entrant.method].append(entrant.metrics)
    settings = {name: as_settings(changed(cfg, METHODS[name]))["scheduler"] for name in args.methods}
    report = {
        **origin,
        "robot": cfg.robot,
        "preset": cfg.preset,
        "seeds": list(range(args.seed, args.seed + args.seeds)),
        "reachable_cells": cfg.cells.num_cells,
        "qd_score_offset": -FITNESS_FLOOR,
        **report_of(runs, settings),
    }
    out = args.out or path / "compare.json"
    write_atomically(out, to_json(report))
    save_figure(out.with_suffix(".png"), draw_comparison(report))
    print(f"written to {out} and {out.with_suffix('.png')}")


if __name__ == "__main__":
    run_command(Arguments, compare)
