"""One elite again: its numbers beside those of fresh episodes, and its terrain with the robots' paths over it."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive, read_archive
from qd.fitness import Evaluation, FitnessCfg, evaluation_of
from qd.run.cli import run_command
from qd.run.directory import CONFIG_FILE, RunDirectory, directory_of, elite_name, folder_for, newest_or_published
from qd.run.settings import refuse_unnamed_code
from qd.show.figures import save_figure
from qd.show.paths_figure import draw_paths
from qd.workers.evaluator import check_policy, episode_seeds, resolve_device
from sim.files.atomic import prepare_output
from sim.files.intervals import rate_words
from sim.policy.spec import SHIPPED, ControllerSpec, is_same, spec_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from sim.robots.robot import RobotCfg
    from sim.rollout import RolloutResult

REPLAY_STREAM = 2
"""Of the seeds of a replay's episodes (:func:`qd.workers.evaluator.episode_seeds`), which are those of a film too."""
PENALTY_UNITS = {
    "yaw_rate": "rad",
    "vel_x": "m",
    "vel_y": "m",
    "contact_force": "N s",
    "stumble": "s",
    "collision": "s",
}
"""Units of the raw penalties."""


@dataclass(frozen=True, kw_only=True)
class ReplayCfg:
    """Print one elite of an archive and draw its terrain with the robots' paths.

    Elites are numbered by descending fitness, the corrected one where all were evaluated again: 0 is the worst.
    """

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py)."""
    run: Path | None = None
    """Run directory; the newest of this robot under runs/, else its published archive."""
    elite: int = 0
    """Number of the elite."""
    policy: str | None = None
    """Controller other than the one the archive was made with; that one too, if it is code."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    replicas: int = 20
    """Episodes to run."""
    seed: int = 0
    """Seed of the fresh episodes."""
    out: Path | None = None
    """Figure to write, *.png; elite-<number>.png in the run, or of a published one in runs/<robot>-published; with
    another controller elite-<number>-<its name>.png."""


@dataclass(frozen=True, kw_only=True)
class Replay:
    """An elite and what became of it this time."""

    run: Path
    """Run directory or archive file."""
    out: Path
    """Figure to write."""
    archive: Archive
    elite: int
    heights: NDArray[np.float32]
    """Terrain [m], shape (nrow, ncol)."""
    result: "RolloutResult"
    """One terrain, with paths."""
    fresh: Evaluation
    controller: str = ""
    """Who crossed it this time, if that is another controller than the search's."""


def replay(cfg: ReplayCfg) -> Replay:
    """Crosses an elite's terrain again.

    Raises:
        FileNotFoundError: If there is no archive.
        ValueError: If there is no such elite, or robot, device or controller are not as they must be.
    """
    from sim.robots.robot import get_robot
    from sim.rollout import Rollout

    robot = get_robot(cfg.robot)
    if cfg.replicas < 1 or cfg.seed < 0:
        raise ValueError(f"replicas must be at least 1 and seed at least 0, got {cfg.replicas} and {cfg.seed}")
    run = cfg.run or newest_or_published(robot)
    archive = _archive_with(cfg, robot, run)
    searched, fitness = as_searched(run, archive)
    refuse_unnamed_code(searched, cfg.policy, run)
    searched = spec_of(searched, robot)
    policy = spec_of(cfg.policy, robot) if cfg.policy else searched
    out = cfg.out or folder_for(run, robot.name) / f"{elite_name(cfg.elite, policy, searched)}.png"
    if out.suffix != ".png":
        raise ValueError(f"out must be a file named *.png, got {out}: name for example {out / 'elite.png'}")
    prepare_output(out)
    device = resolve_device(cfg.device)
    check_policy(policy, robot, device)
    rollout = Rollout(robot, policy, num_terrains=1, num_replicas=cfg.replicas, device=device)
    seeds = episode_seeds(cfg.seed, cfg.elite, 1, stream=REPLAY_STREAM)
    result = rollout.evaluate(archive.genes[cfg.elite : cfg.elite + 1], seeds, record_paths=True)
    return Replay(
        run=run,
        out=out,
        archive=archive,
        elite=cfg.elite,
        heights=rollout.sim.bank.heights.numpy()[0],
        result=result,
        fresh=evaluation_of(result, archive.cells, fitness),
        controller="" if is_same(policy, searched) else policy,
    )


def _archive_with(cfg: ReplayCfg, robot: "RobotCfg", run: Path) -> Archive:
    """The archive of a run, which must be of the robot and have the elite."""
    archive = read_archive(run)
    if archive.robot != robot.name:
        raise ValueError(f"{run} is of {archive.robot}, got --robot {cfg.robot}: give that robot or another --run")
    if not 0 <= cfg.elite < len(archive):
        valid = f"expected 0 to {len(archive) - 1}" if len(archive) else "the archive is empty"
        raise ValueError(f"{run} has no elite {cfg.elite}: {valid}")
    check_penalties(archive, robot, run)
    return archive


def check_penalties(archive: Archive, robot: "RobotCfg", run: Path) -> None:
    """Makes sure that a robot's crossings have the penalties that an archive was searched by.

    Raises:
        ValueError: If one is not among the robot's, whose settings may have changed since the search.
    """
    unknown = [name for name in archive.penalties if name not in robot.penalties]
    if unknown:
        raise ValueError(
            f"{run} was searched by penalties that robot {robot.name} does not have: {', '.join(unknown)}; expected "
            f"some of {', '.join(robot.penalties)}: give the settings that it was searched with, or another --run"
        )


def as_searched(run: Path, archive: Archive) -> tuple[str, FitnessCfg]:
    """Controller and fitness of the search that made an archive; defaults where it lies without its config.

    Raises:
        ValueError: If the config is not that of the archive, or damaged.
    """
    folder = directory_of(run)
    if (folder / CONFIG_FILE).exists():
        cfg = RunDirectory(folder).read_cfg()
        there = (cfg.fitness.penalties, cfg.fitness.scales)
        if there != (archive.penalties, archive.scales):
            raise ValueError(
                f"{folder / CONFIG_FILE} must have the penalties and scales of its archive, "
                f"{', '.join(archive.penalties)}: {archive.scales}, got {', '.join(there[0])}: {there[1]}: put back "
                "the one that is not this run's"
            )
        return cfg.policy, cfg.fitness
    return SHIPPED, FitnessCfg(penalties=archive.penalties, scales=archive.scales)


def describe(replay: Replay) -> str:
    """An elite's numbers as they were found, those that 40 fresh episodes corrected, if any did, and those of now."""
    archive, n, fresh = replay.archive, replay.elite, replay.fresh
    cells = archive.cells
    near = bool(fresh.valid[0]) and bool(cells.are_neighbours(archive.cell[n : n + 1], fresh.cell)[0])
    columns: list[tuple[str, Archive | Evaluation, int]] = [("found", archive, n), ("now", fresh, 0)]
    if archive.fresh is not None:
        columns.insert(1, ("corrected", archive.fresh, n))
    rows = {
        "": [f"{label} ({values.episodes[k]} episodes)" for label, values, k in columns],
        "fitness": [f"{values.fitness[k]:.2f}" for _, values, k in columns],
    }
    for p, name in enumerate(archive.penalties):
        rows[f"{name} [{PENALTY_UNITS.get(name, '')}]"] = [
            _penalty(values.penalty_mean[k, p], values.penalty_std[k, p], archive.scales[p], values.ratios[k, p])
            for _, values, k in columns
        ]
    for label, name in (("base collision", "collision_rate"), ("goal reached", "goal_rate"), ("fallen", "fallen_rate")):
        counted = [(getattr(values, name)[k], _counted(values, k)) for _, values, k in columns]
        rows[label] = [rate_words(round(rate * count) if count else 0, count) for rate, count in counted]
    again = (
        f"  It {'lands in its cell or a neighbour of it' if near else 'does not land in its cell or beside it'} again."
    )
    if replay.controller:
        again = f"  Now it was crossed with {replay.controller}; all else is of the controller that was searched."
    table = [f"  {label:22}" + "".join(f"{cell:>34}" for cell in row) for label, row in rows.items()]
    return "\n".join(
        [
            f"{replay.run}, elite {n} of {len(archive):,} of {archive.robot}, found in iteration "
            f"{archive.iteration[n]}, with ratios in {cells.describe(int(archive.cell[n]))}",
            *table,
            "  Rates with their 95 % intervals (Wilson); those as found are of the episodes that made it an elite.",
            again,
        ]
    )


def _penalty(mean: float, std: float, scale: float, ratio: float) -> str:
    return f"{mean * scale:.2f} +- {std * scale:.2f} ({ratio:.0%} of all)"


def _counted(values: Archive | Evaluation, number: int) -> int:
    """Episodes that a terrain's rates are of: none of a terrain that is invalid as a whole."""
    valid = isinstance(values, Archive) or values.valid[number]  # what is found is valid, or it were no elite
    return int(values.episodes[number] - values.invalid_episodes[number]) if valid else 0


def draw(replay: Replay) -> "Figure":
    """The height map of an elite with the robots' paths, and marks where they ended, by how."""
    archive, n = replay.archive, replay.elite
    corrected = "" if archive.fresh is None else f"{archive.fresh.fitness[n]:.2f} corrected, "
    title = (
        f"{archive.robot}, elite {n} of {len(archive):,} after {archive.iterations:,} iterations: fitness "
        f"{archive.fitness[n]:.2f} as found, {corrected}"
        f"{replay.fresh.fitness[0]:.2f} in {replay.fresh.episodes[0]} fresh episodes"
    )
    if replay.controller:
        title += f"\nwith another controller than was searched: {ControllerSpec.parse(replay.controller).label}"
    return draw_paths(replay.heights, replay.result, title)


def main(cfg: ReplayCfg) -> None:
    """The command."""
    done = replay(cfg)
    print(describe(done))
    save_figure(done.out, draw(done))
    print(f"Figure: {done.out}")


if __name__ == "__main__":
    run_command(ReplayCfg, main)
