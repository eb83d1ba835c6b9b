"""The search: ask for terrains, let robots cross them, tell the emitters what became of them."""

import time
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.faults.families import rank, summarise
from qd.faults.minimise.results import read_minimal
from qd.faults.numbers import fault_numbers, found_numbers
from qd.search.archive import Archive, no_outcomes, read_archive
from qd.search.directory import SUMMARY_FILE, Metrics, RunDirectory, claimed
from qd.search.fitness import Evaluation, evaluate_rollout, join_evaluations
from qd.search.pool import chance_to_stay
from qd.search.progress import Bar, clock, describe_iteration, describe_search
from qd.search.scheduler import Scheduler
from qd.search.settings import SearchCfg
from qd.show.figures import write_figures
from qd.workers.compute import Compute, check_policy
from qd.workers.crosser import open_pipeline
from qd.workers.invalid import invalid_iterations, invalid_reasons, refuse_all_invalid
from qd.workers.pipeline import Pipeline, PipelineCfg
from qd.workers.seeds import episode_seeds
from qd.workers.shards import join_results
from sim.controllers.spec import ControllerSpec, resolve_policy
from sim.files.atomic import to_json, write_atomically
from sim.files.command import Interrupted, command_line, say
from sim.robots.find import get_robot, resolve_robot, scaled_by_another
from sim.robots.robot import RobotCfg
from sim.rollout import RolloutResult
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.registry import get_space, is_own
from sim.terrains.terrains import Terrains

UNTIL_FROM = 20
"""Iterations that must have crossed anything new before a search is judged by the last tenth of them."""
_SAME = ("robot", "robot_sha256", "policy_sha256", "space", "space_sha256", "penalty_definition", "intervals",
         "collision_bit")  # fmt: skip
_BATCH = ("fitness", "collision_rate", "goal_rate")
_BY_FRESH_EPISODES = (
    "elites_same_cell", "elites_reproduced", "reevaluated", "corrected_qd_score", "corrected_coverage",
    "corrected_elites", "mean_fitness_corrected", "mean_std", "mean_std_interval",
)  # fmt: skip


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

    It ends before once its last tenth brought a share of the elites below ``until`` (:func:`last_tenth`), and what it
    asked for by then is crossed and settled. Nothing is written before the simulation stands; whatever stops a search,
    all iterations that ended are saved. A robot that is not shipped is given, and a controller that lies elsewhere than
    ``cfg`` says. The archive has what judging says of its elites if nothing was left to do.
    """
    robot = robot or get_robot(cfg.robot)
    if unknown := set(cfg.fitness.penalties) - set(robot.penalties):
        known = ", ".join(robot.penalties)
        raise ValueError(f"fitness.penalties must be some of {robot.name}'s, {known}, got {', '.join(sorted(unknown))}")
    policy = policy or resolve_policy(cfg.policy, robot)
    check_policy(policy, robot, compute.device)
    space, run = get_space(cfg.space, cfg.space_sha256), RunDirectory(path)
    crossing = PipelineCfg(
        compute=compute,
        robot=robot,
        policy=policy,
        num_terrains=cfg.scheduler.num_terrains,
        replicas=cfg.replicas,
        lots=cfg.scheduler.num_groups,
        space=space.name,  # where its code is now
    )
    with claimed(path):
        if (finished := run.read_finished(cfg)) is not None:
            say(describe_search(cfg, path, cfg.iterations, compute.device, crossing.num_workers))
            return finished
        saved = run.load(cfg)
        if saved is None:
            scheduler = Scheduler(cfg.scheduler, space=space, cells=cfg.cells, fitness=cfg.fitness, seed=cfg.seed)
            metrics = []
        else:
            scheduler, metrics = saved
        scheduler.compute_on(compute.device)
        done, last = len(metrics), _last_iteration(cfg, metrics, until)
        say(describe_search(replace(cfg, iterations=last), path, done, compute.device, crossing.num_workers))
        if note := scaled_by_another(robot, policy):
            print(note)
        if done < last:
            try:
                with open_pipeline(crossing) as pipeline:
                    run.begin_session(cfg, compute.origin(cfg.seed), done)
                    with Bar(f"iteration {done + 1}/{last}: compiling and evaluating", last, done) as bar:
                        _run_iterations(cfg, space, run, scheduler, metrics, pipeline, bar, until)
            except KeyboardInterrupt:
                again = _command_to_resume(path, robot, policy, space.name, until)
                raise Interrupted(f"Stopped; finished iterations are saved: go on with `{again}`") from None
        if len(metrics) < cfg.iterations:
            say(f"Ended by --until {until:g} after {len(metrics)} of {cfg.iterations} iterations.")
        archive = archive_of(cfg, scheduler, len(metrics))
        if (stored := _written_archive(run, archive)) is not None:
            return stored
        _write_results(run, archive, metrics)
    return archive


def _command_to_resume(path: Path, robot: RobotCfg, policy: str, space: str, until: float | None) -> str:
    """The command that goes on with a search; code that it needs is named."""
    own = {
        "robot": robot.spec if robot.settings_file else None,
        "policy": policy if ControllerSpec.parse(policy).runs_code else None,
        "space": space if is_own(space) else None,
    }
    return command_line("archive", resume=path, until=until, **own)


def _run_iterations(
    cfg: SearchCfg, space: TerrainSpace, run: RunDirectory, scheduler: Scheduler, metrics: Metrics,
    pipeline: Pipeline, bar: Bar, until: float | None,
) -> None:  # fmt: skip
    """Runs the iterations that are left, and saves each.

    A group of emitters that was told asks again at once, and its next terrains wait in the queue while those of the
    other groups are crossed. The order is fixed, and what a group has asked for is part of the saved state: a search
    that goes on where it was stopped is the same as one that was not.
    """
    num_groups = cfg.scheduler.num_groups

    def put(genes: NDArray[np.float32], iteration: int, group: int) -> None:
        """Its seeds are those of the group's places in the iteration."""
        seeds = episode_seeds(cfg.seed, iteration, cfg.scheduler.num_terrains)[scheduler.group_rows(group)]
        pipeline.put(Terrains(genes=genes, seeds=seeds[: len(genes)], space=space))

    pipeline.clear()
    num_under_way, began = 0, time.perf_counter()
    last, settling = _last_iteration(cfg, metrics, until), cfg.scheduler.settling
    while (iteration := len(metrics) + 1) <= last:
        for group in range(num_under_way, num_groups):
            put(scheduler.ask(group, new=iteration <= last - settling), iteration, group)
        goes_ahead = iteration < last
        results, evaluations, search_s, num_new = [], [], 0.0, 0
        for group in range(num_groups):
            result = pipeline.take(bar.within(iteration - 1 + group / num_groups, 1 / num_groups))
            refuse_all_invalid(result)
            evaluation = evaluate_rollout(result, cfg.cells, cfg.fitness)
            emitters_began = time.perf_counter()
            num_new += scheduler.tell(evaluation, iteration, group)
            # Behind the last iteration as well: if more follow, they begin with new terrains.
            genes = scheduler.ask(group, new=not last - settling <= iteration < last)
            search_s += time.perf_counter() - emitters_began
            if goes_ahead:
                put(genes, iteration + 1, group)
            results.append(result)
            evaluations.append(evaluation)
        num_under_way = num_groups if goes_ahead else 0
        archive = archive_of(cfg, scheduler, iteration)
        row = _metrics_row(archive, join_results(results, join=1), join_evaluations(evaluations), iteration)
        row |= {"search_s": search_s, "terrains": num_new}
        ended = time.perf_counter()
        wall_s = ended - began  # from the end of the iteration before, so saving counts
        row |= {"wall_s": wall_s, "episodes_per_s": row["episodes"] / wall_s}
        if (status := pipeline.status()) is not None:
            row |= status._asdict()
        began = ended
        metrics.append(row)
        row["last_tenth"] = last_tenth(archive, metrics)
        run.save(cfg, scheduler, metrics, archive)
        last = _last_iteration(cfg, metrics, until)
        bar.move_to(iteration, describe_iteration(row, last, status))


def _last_iteration(cfg: SearchCfg, metrics: Metrics, until: float | None) -> int:
    """The iteration that ends a search, by the metrics alone: so a search that goes on ends where it would have.

    Behind the one whose last tenth brought too little, what it asked for is crossed, and then all settles. A search
    that went on past that end is judged anew.
    """
    ends = (
        row["iteration"] + 1 + cfg.scheduler.settling
        for row in metrics
        if until is not None and row["last_tenth"] is not None and row["last_tenth"] < until
    )
    return min(cfg.iterations, next((end for end in ends if end >= len(metrics)), cfg.iterations))


def last_tenth(archive: Archive, metrics: Metrics) -> float | None:
    """Share of the elites to stay that were found in the last tenth of the iterations which crossed anything new.

    Elites count by their chance to stay in their cells (:func:`qd.search.pool.chance_to_stay`). None without elites,
    and of fewer than 20 such iterations.
    """
    exploring = [row["iteration"] for row in metrics if row["terrains"]]
    if len(exploring) < UNTIL_FROM or not len(archive):
        return None
    chance = chance_to_stay(archive, archive.cells)
    found_late = archive.iteration >= exploring[-(len(exploring) // 10)]
    return float(chance[found_late].sum() / chance.sum())


def _metrics_row(archive: Archive, result: RolloutResult, evaluation: Evaluation, iteration: int) -> dict[str, Any]:
    """An iteration's row of metrics without the search's times."""
    return {
        "iteration": iteration,
        "elites": len(archive),
        **{name: getattr(archive, name) for name in ("reachable_coverage", "qd_score", "mean_fitness")},
        "expected_same_cell": float(chance_to_stay(archive, archive.cells).sum()),
        "episodes": int(evaluation.episodes.sum()),
        "invalid_episodes": int(evaluation.invalid_episodes.sum()),
        "invalid_terrains": int((~evaluation.valid).sum()),
        **{f"batch_{name}": float(getattr(evaluation, name).mean()) for name in _BATCH},
        "invalid_reasons": invalid_reasons(result),
        "physics_steps": int(result.physics_steps),
        "robot_steps": int(result.robot_steps),
        "idle_share": result.idle_share,
        "rollout_s": float(result.wall_s),
        "mean_duration_s": float(result.duration_s.mean()),
    }


def archive_of(cfg: SearchCfg, scheduler: Scheduler, iterations: int) -> Archive:
    """What a search has found after a number of iterations."""
    elites: dict[str, Any] = scheduler.elites()
    return Archive(
        **{name: getattr(cfg, name) for name in _SAME},
        penalties=cfg.fitness.penalties,
        scales=cfg.fitness.scales,
        iterations=iterations,
        **elites,
        **no_outcomes(len(elites["cell"])),
    )


def say_what_stops_the_robot(
    run: Path, archive: Archive, *, robot: str | None = None, policy: str | None = None, space: str | None = None
) -> None:
    """Prints the last lines of a search or a judging: what stops the robot, the worst terrain, and what comes next.

    Robot, controller and space are as the command line names them, if it does.
    """
    if not len(archive):
        return
    ranking = rank(
        archive, get_space(archive.space, archive.space_sha256), read_minimal(run, archive), judged=True,
        half_width=resolve_robot(archive.named(), robot, run).footprint[1],
    )  # fmt: skip
    if not len(ranking):
        return
    say((summarise(ranking, archive), "bold"), "." if archive.fresh else ", as found, not crossed again.")
    number = ranking.worst(1)[0]
    if ranking.failing.any():
        say(f"Worst: elite {number}, {ranking.name(ranking.find_row(number))}.")
    flags = {"run": run, "robot": robot, "space": space}
    view = command_line("view", **flags, policies=[f"searched={policy}"] if policy else [])
    report = command_line("report", **flags, policy=policy)
    replay = command_line("replay", **flags, elite=number, policy=policy)
    say("Next: ", (view, "cyan"), ", ", (report, "cyan"), " or ", (replay, "cyan"))
    if archive.fresh is None:
        say((command_line("judge", **flags, policy=policy), "cyan"), " says which of them are faults.")
    elif not archive.certifiers:
        train = command_line("finetune", robot=robot, specialist=run, policy=policy, space=space)
        say((train, "cyan"), " trains a controller to cross them: without another one no fault is known.")


def _written_archive(run: RunDirectory, archive: Archive) -> Archive | None:
    """The archive of a run's file where it is this one, judged or not, and its numbers lie beside it."""
    try:
        stored = read_archive(run.path)
    except (OSError, ValueError):
        return None  # it is made again
    is_whole = stored.has_same_elites(archive) and run.read_summary().get("iterations") == archive.iterations
    return stored if is_whole else None


def _write_results(run: RunDirectory, archive: Archive, metrics: Metrics) -> None:
    """Writes archive, figures and numbers of a search, and prints what it found."""
    config = run.read_config()
    origin = {name: value for name, value in config.items() if name not in ("settings", "iterations")}
    run.write_derived(metrics, archive)
    figures = write_figures(run.path, archive, metrics)
    numbers = {
        **origin,
        **archive.named(),
        "space": archive.space,
        "space_sha256": archive.space_sha256,
        **found_numbers(archive, metrics),
        **dict.fromkeys(_BY_FRESH_EPISODES),
        **fault_numbers(archive),
        "gpus": 0 if origin["device"].startswith("CPU") else max(row.get("workers", 1) for row in metrics),
    }
    write_atomically(run.path / SUMMARY_FILE, to_json(numbers))
    say(
        f"{len(archive):,} elites in {archive.reachable_coverage:.1%} of the reachable cells, QD score "
        f"{archive.qd_score:.0f}, mean fitness {archive.mean_fitness:.2f}, after {numbers['episodes']:,} episodes "
        f"in {clock(numbers['wall_s'])}"
    )
    if (share := metrics[-1]["last_tenth"]) is not None:
        print(f"Its last tenth brought {share:.0%} of the elites that can be expected to stay.")
    print(f"Figures: {', '.join(map(str, figures))}")
    if invalid := invalid_iterations(metrics):
        print(f"Warning: {invalid}")
