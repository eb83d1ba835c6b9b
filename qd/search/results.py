"""What a search has found, when it ends by that, and what it leaves: metrics, archive, numbers, figures, last lines."""

from contextlib import suppress
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.markup import escape

from qd.faults.families import rank, summarise_search
from qd.faults.numbers import fault_numbers, found_numbers, read_minimal
from qd.search.archive import Archive, Subject, no_outcomes, read_archive
from qd.search.directory import SUMMARY_FILE, Metrics, RunDirectory
from qd.search.fitness import Evaluation
from qd.search.pool import chance_to_stay
from qd.search.progress import clock
from qd.search.scheduler import Scheduler
from qd.search.settings import SearchCfg
from qd.show.figures import write_figures
from qd.workers.invalid import invalid_iterations, invalid_reasons
from sim.files.atomic import to_json, write_atomically
from sim.files.command import command_line, say
from sim.files.settings import select_settings
from sim.files.templates import open_templates
from sim.robots.find import resolve_robot
from sim.rollout import RolloutResult

_BATCH = ("fitness", "collision_rate", "goal_rate")
UNTIL_FROM = 20
"""Iterations that must have crossed anything new before a search is judged by the last tenth of them."""
_FRESH_NUMBERS = (
    "elites_same_cell", "elites_reproduced", "reevaluated", "corrected_qd_score", "corrected_coverage",
    "corrected_elites", "mean_fitness_corrected", "mean_std", "mean_std_interval", "failing_distinct",
    "faults_distinct",
)  # fmt: skip
_TEMPLATES = open_templates(Path(__file__).parent / "templates")
_TEMPLATES.filters["escape_markup"] = escape


def build_archive(cfg: SearchCfg, scheduler: Scheduler, iterations: int) -> Archive:
    """What a search has found after a number of iterations."""
    elites: dict[str, Any] = scheduler.elites()
    elites |= no_outcomes(len(elites["cell"])) | vars(select_settings(Subject, cfg))
    return Archive(penalties=cfg.fitness.penalties, scales=cfg.fitness.scales, iterations=iterations, **elites)


def describe_metrics(archive: Archive, result: RolloutResult, evaluation: Evaluation) -> dict[str, Any]:
    """The metrics of the archive's last iteration without the search's times, by what all groups crossed."""
    return {
        "iteration": archive.iterations,
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


def find_last_iteration(cfg: SearchCfg, metrics: Metrics, until: float | None) -> int:
    """The iteration that ends a search, by its metrics alone: after a last tenth of too little, all settles."""
    shares = {row["iteration"]: row["last_tenth"] for row in metrics if row["last_tenth"] is not None}
    ends = [number + 1 + cfg.scheduler.settling for number, share in shares.items() if share < (until or 0.0)]
    return min([cfg.iterations, *(end for end in ends if end >= len(metrics))])


def compute_last_tenth(archive: Archive, metrics: Metrics) -> float | None:
    """Share of the elites to stay that were found in the last tenth of the iterations which crossed anything new.

    Elites count by :func:`qd.search.pool.chance_to_stay`. None without elites, and of fewer than 20 such iterations.
    """
    exploring = [row["iteration"] for row in metrics if row["terrains"]]
    if len(exploring) < UNTIL_FROM or not len(archive):
        return None
    chance = chance_to_stay(archive, archive.cells)
    late = archive.iteration >= exploring[-(len(exploring) // 10)]
    return float(chance[late].sum() / chance.sum())


def read_finished(run: RunDirectory, cfg: SearchCfg, until: float | None) -> Archive | None:
    """The archive of a search that has done its iterations, judged or not; None of others. It needs no checkpoint."""
    if run.exists():
        run.check_settings(cfg)
        with suppress(OSError, ValueError):  # files are made again
            archive = read_archive(run.path)
            last = find_last_iteration(cfg, run.read_metrics(), until)
            if archive.iterations == run.read_summary().get("iterations") == last:
                return archive
    return None


def write_results(run: RunDirectory, archive: Archive, metrics: Metrics) -> None:
    """Writes archive, figures and numbers of a search, and prints what it found."""
    origin = {name: value for name, value in run.read_config().items() if name not in ("settings", "iterations")}
    run.write_derived(metrics, archive)
    figures = write_figures(run.path, archive, metrics)
    numbers = {
        **origin,
        **archive.named(),
        **{name: getattr(archive, name) for name in ("space", "space_sha256")},
        **found_numbers(archive, metrics),
        **dict.fromkeys(_FRESH_NUMBERS),
        **fault_numbers(archive),
        "gpus": 0 if origin["device"].startswith("CPU") else max(row.get("workers", 1) for row in metrics),
    }
    write_atomically(run.path / SUMMARY_FILE, to_json(numbers))
    score = f"QD score {archive.qd_score:.0f}, mean fitness {archive.mean_fitness:.2f}"
    effort = f"after {numbers['episodes']:,} episodes in {clock(numbers['wall_s'])}"
    say(f"{len(archive):,} elites in {archive.reachable_coverage:.1%} of the reachable cells, {score}, {effort}")
    if labelled := sum(row.get("labelled", 0) for row in metrics):
        count = sum(row["labelled_crossed"] for row in metrics)
        print(f"Of {labelled:,} failing elites that were tried, somebody crosses {count:,}.")
    if (share := metrics[-1]["last_tenth"]) is not None:
        print(f"Its last tenth brought {share:.0%} of the elites that can be expected to stay.")
    print(f"Figures: {', '.join(map(str, figures))}")
    if invalid := invalid_iterations(metrics):
        print(f"Warning: {invalid}")


def print_summary(
    run: Path,
    archive: Archive,
    *,
    robot: str | None = None,
    policy: str | None = None,
    space: str | None = None,
    skip_level_ground: bool = False,
) -> None:
    """Prints what a run's archive says of the controller, by flags of its command; nothing without elites."""
    if not len(archive):
        return
    half_width = resolve_robot(archive.named(), robot, run).half_width
    ranking = rank(archive, archive.terrain_space, read_minimal(run, archive), judged=True, half_width=half_width)
    if not len(ranking):
        return
    number = ranking.worst(1)[0]
    flags = {"run": run, "robot": robot, "space": space}
    judge = {**flags, "policy": policy, "skip_level_ground": skip_level_ground}
    text = _TEMPLATES.get_template("summary.txt").render(
        archive=archive, ranking=ranking, summary=summarise_search(ranking, archive), number=number,
        name=ranking.name(ranking.find_row(number)),
        view=command_line("view", **flags, policies=[f"searched={policy}"] if policy else []),
        report=command_line("report", **flags, policy=policy),
        replay=command_line("replay", **flags, elite=number, policy=policy),
        judge=command_line("judge", **judge), steered=command_line("judge", **judge, stages="steered"),
        finetune=command_line("finetune", robot=robot, specialist=run, policy=policy, space=space),
    )  # fmt: skip
    console = Console(highlight=False)
    console.print(text.rstrip(), soft_wrap=not console.is_terminal)
