"""The search: ask for terrains, let robots cross them, evaluate, tell the emitters, save."""

import time
from contextlib import nullcontext
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kernels.episode import Kind
from qd.check import ensure_ready, ensure_stray
from qd.faults.numbers import count_episodes
from qd.search.archive import Archive
from qd.search.crossed import Labeller
from qd.search.directory import Metrics, RunDirectory, claimed
from qd.search.fitness import FAILING_GOAL_RATE, evaluate_rollout, join_evaluations
from qd.search.progress import Bar
from qd.search.results import (
    build_archive,
    compute_last_tenth,
    describe_metrics,
    find_last_iteration,
    read_finished,
    write_results,
)
from qd.search.scheduler import Scheduler
from qd.search.settings import SearchCfg, preset
from qd.workers.compute import Compute, check_policy
from qd.workers.crosser import open_pipeline
from qd.workers.invalid import WARNED_SHARE, format_reasons, refuse_all_invalid
from qd.workers.pipeline import Pipeline, PipelineCfg
from qd.workers.seeds import episode_seeds
from sim.controllers.described import observed_terms
from sim.controllers.spec import SHIPPED, ControllerSpec, resolve_policy
from sim.files.command import BEGAN, Interrupted, command_line, say
from sim.robots.find import get_robot, scaled_by_another
from sim.robots.robot import RobotCfg
from sim.rollout import RolloutResult
from sim.terrains.spaces.registry import at_height, check_conditions, is_user_space, load_space, space_at
from sim.terrains.terrains import Terrains


def start_search(
    robot: str | None,
    policy: str | None,
    space: str | None,
    *,
    size: str,
    height: float | None,
    compute: Compute,
    skip_level_ground: bool = False,
    likely: Path | None = None,
) -> tuple[SearchCfg, RobotCfg]:
    """Settings of a new search, by a preset's name and flags, and its robot, checked and with penalty scales."""
    terrain_space = load_space(space)
    if height is not None:
        terrain_space = at_height(terrain_space, height)
    wanted = get_robot(robot)
    check_conditions(terrain_space.conditions, wanted, observed_terms(policy or wanted.policy_file))
    ready = ensure_ready(wanted, policy, compute, skip_level_ground=skip_level_ground)
    terrain_space = space_at(terrain_space, height, ready)
    name, sha256 = terrain_space.name, terrain_space.sha256
    return preset(size, ready, policy, space=name, space_sha256=sha256, likely=likely), ready


def search(
    cfg: SearchCfg,
    path: Path,
    compute: Compute,
    *,
    robot: RobotCfg | None = None,
    policy: str | None = None,
    until: float | None = None,
) -> Archive:
    """Searches, or goes on with the search in the run directory ``path``, until it has done its iterations.

    It ends earlier once its last tenth brought a share of the elites below ``until``
    (:func:`qd.search.results.compute_last_tenth`). ``robot`` is given if it is not shipped, ``policy`` if the
    controller lies elsewhere than ``cfg`` says. The archive is a judged one if nothing was left to do after it.
    """
    robot = robot or get_robot(cfg.robot)
    if unknown := set(cfg.fitness.penalties) - set(robot.penalties):
        known = ", ".join(robot.penalties)
        raise ValueError(f"fitness.penalties must be some of {robot.name}'s, {known}, got {', '.join(sorted(unknown))}")
    policy = policy or resolve_policy(cfg.policy, robot)
    check_policy(policy, robot, compute.device)
    space = cfg.terrain_space
    if space.asks == Kind.ROUTE:
        ensure_stray(robot, policy, compute)
    run = RunDirectory(path)
    crossing = PipelineCfg(
        compute=compute, robot=robot, policy=policy, num_terrains=cfg.scheduler.num_terrains, replicas=cfg.replicas,
        lots=cfg.scheduler.num_groups, space=space.name,  # where its code is now
    )  # fmt: skip
    with claimed(path):
        archive = read_finished(run, cfg, until)
        scheduler: Any
        scheduler, metrics = run.load(cfg) if archive is None else (None, run.read_metrics())
        done = len(metrics)
        last = find_last_iteration(cfg, metrics, until)
        controller = "its own controller" if cfg.policy == SHIPPED else cfg.policy
        say(
            f"{path}: {last - done:,} of {last:,} iterations to go, each of {cfg.scheduler.num_terrains} terrains x "
            f"{cfg.replicas} episodes of {cfg.robot} with {controller} on {cfg.space}; in all "
            f"{(last - done) * cfg.episodes_per_iteration:,} episodes by {crossing.num_workers} on {compute.device}; "
            f"preset {cfg.preset}, seed {cfg.seed}, {cfg.cells.num_cells:,} reachable cells"
        )
        if note := scaled_by_another(robot, policy):
            print(note)
        if done < last:
            how: dict[str, Any] = {"space": space, "cells": cfg.cells, "fitness": cfg.fitness, "seed": cfg.seed}
            scheduler = scheduler or Scheduler(cfg.scheduler, **how)
            scheduler.compute_on(compute.device)
            labeller = Labeller(cfg, robot, policy, compute, metrics) if cfg.fitness.crossed else None
            try:
                with open_pipeline(crossing) as pipeline, labeller or nullcontext():
                    run.begin_session(cfg, compute.origin(cfg.seed), done)
                    with Bar(f"iteration {done + 1}/{last}: compiling and evaluating", last, done) as bar:
                        _run_iterations(cfg, run, scheduler, metrics, pipeline, labeller, bar, until)
            except KeyboardInterrupt:
                code = {  # which must be named again
                    "robot": robot.spec if robot.settings_file else None,
                    "policy": policy if ControllerSpec.parse(policy).runs_code else None,
                    "space": space.name if is_user_space(space.name) else None,
                }
                again = command_line("archive", resume=path, until=until, **code)
                raise Interrupted(f"Stopped; finished iterations are saved: go on with `{again}`") from None
        if len(metrics) < cfg.iterations:
            say(f"Ended by --until {until:g} after {len(metrics)} of {cfg.iterations} iterations.")
        if archive is None:
            archive = build_archive(cfg, scheduler, len(metrics))
            write_results(run, archive, metrics)
    return archive


def _run_iterations(
    cfg: SearchCfg, run: RunDirectory, scheduler: Scheduler, metrics: Metrics, pipeline: Pipeline,
    labeller: Labeller | None, bar: Bar, until: float | None,
) -> None:  # fmt: skip
    """Runs the iterations that are left in a fixed order, so that a search that goes on is one that never stopped."""
    space, num_groups = cfg.terrain_space, cfg.scheduler.num_groups
    last = find_last_iteration(cfg, metrics, until)

    def ask(group: int, iteration: int) -> NDArray[np.float32]:
        settles = last - cfg.scheduler.settling < iteration <= last
        return scheduler.ask(group, new=not settles)  # after the last iteration too: more would begin with new ones

    def put(genes: NDArray[np.float32], group: int, iteration: int) -> None:
        if iteration <= last:
            seeds = episode_seeds(cfg.seed, iteration, cfg.scheduler.num_terrains)[scheduler.group_rows(group)]
            pipeline.put(Terrains(genes=genes, seeds=seeds[: len(genes)], space=space))

    pipeline.clear()
    began = time.perf_counter()
    for group in range(num_groups):
        put(ask(group, len(metrics) + 1), group, len(metrics) + 1)
    while (iteration := len(metrics) + 1) <= last:
        results, evaluations = [], []
        num_new, search_s = 0, 0.0
        for group in range(num_groups):
            results.append(pipeline.take(bar.within(iteration - 1 + group / num_groups, 1 / num_groups)))
            refuse_all_invalid(results[-1])
            evaluations.append(evaluate_rollout(results[-1], cfg.cells, cfg.fitness))
            if not metrics:
                failing = [(evaluation.goal_rate < FAILING_GOAL_RATE).sum() for evaluation in evaluations]
                if failing[-1] and not any(failing[:-1]):
                    seconds = time.monotonic() - BEGAN
                    print(f"After {seconds:.0f} s the first {failing[-1]} failing terrains.", flush=True)
            emitters_began = time.perf_counter()
            num_new += scheduler.tell(evaluations[-1], iteration, group)
            genes = ask(group, iteration + 1)
            search_s += time.perf_counter() - emitters_began
            put(genes, group, iteration + 1)
        archive = build_archive(cfg, scheduler, iteration)
        row = describe_metrics(archive, RolloutResult.join(results), join_evaluations(evaluations))
        if labeller is not None:
            row |= labeller.label(scheduler, iteration, partial(bar.move_to, iteration))
        wall_s = time.perf_counter() - began  # from the end of the iteration before, so saving counts
        began += wall_s
        row |= {"search_s": search_s, "terrains": num_new, "wall_s": wall_s}
        row["episodes_per_s"] = count_episodes([row]) / wall_s
        if status := pipeline.status():
            row |= status._asdict()
        metrics.append(row)
        row["last_tenth"] = compute_last_tenth(archive, metrics)
        run.save(cfg, scheduler, metrics, archive)
        last = find_last_iteration(cfg, metrics, until)
        invalid = row["invalid_episodes"] / row["episodes"]
        why = f"{invalid:.0%} invalid ({format_reasons(row['invalid_reasons'])}), " if invalid > WARNED_SHARE else ""
        by = f" by {status}" if status else ""
        elites = f"{row['elites']:,} elites ({row['expected_same_cell']:,.0f} to stay)"
        speed = f"{row['episodes_per_s']:.0f} episodes/s{by}, fitness {row['mean_fitness']:.2f}"
        bar.move_to(iteration, f"iteration {min(iteration + 1, last)}/{last}: {elites}, {why}{speed}")
