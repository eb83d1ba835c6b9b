"""Elites again with fresh episodes: what they are worth, free of the luck that made them elites.

An elite is the best of many noisy evaluations and flatters itself; its 40 fresh episodes do not. Which episodes those
are follows from the run's seed and from what names an elite, its cell and the iteration that found it, so that on the
CPU they give the same numbers whenever they are run.
"""

from collections.abc import Callable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.archive import ARCHIVE_FILE, Archive, FreshValues, read_archive, write_archive
from qd.descriptors import Cells
from qd.fitness import FITNESS_FLOOR, FitnessCfg, evaluation_of
from qd.run.arguments import evaluator_of
from qd.run.directory import SUMMARY_FILE, RunDirectory, claimed, find_run
from qd.run.progress import share_bar
from qd.run.settings import SearchCfg, as_settings, is_searched, own_policy
from qd.workers.evaluator import Evaluate, EvaluatorCfg, open_evaluator, origin_of, resolve_device
from qd.workers.invalid import tell_invalid
from qd.workers.shards import taken
from sim.files.atomic import to_json, write_atomically
from sim.files.command import InSpace, Where, Who
from sim.files.intervals import bootstrap_interval, wilson_interval
from sim.files.records import identity
from sim.policy.spec import spec_of

FRESH_EPISODES = 40
"""Episodes that each elite is evaluated again with."""
_BIT_EPISODES = 20  # the collision bit is "any collision", which more episodes than the search's would bias

_FRESH_STREAM = 1
_DRAW_STREAM = 3

Open = Callable[[EvaluatorCfg], AbstractContextManager[Evaluate]]
"""Opens what crosses terrains."""


def reevaluate(
    archives: Sequence[Archive],
    evaluate: Evaluate,
    fitness: FitnessCfg,
    *,
    num_replicas: int,
    seeds: Sequence[int],
    progress: Callable[[float], None] | None = None,
) -> list[FreshValues]:
    """Evaluates every elite of some archives again with 40 fresh episodes, all of them together.

    Args:
        archives: The elites.
        evaluate: Crosses terrains.
        fitness: Weights of the fitness, with the archives' penalties.
        num_replicas: Episodes a terrain that ``evaluate`` gives; terrains are crossed as often as makes 40.
        seeds: The search's seed, one an archive; the episodes are drawn apart from the search's own.
        progress: Called with the share done.

    Returns:
        One an archive.

    Raises:
        ValueError: If ``evaluate`` gives another number of episodes.
        AllInvalidError: If none of them is valid.
    """
    times = -(-FRESH_EPISODES // num_replicas)
    counts = [len(archive) for archive in archives]
    if not sum(counts):
        return [_nothing(archive.cells) for archive in archives]
    genes = np.concatenate([archive.genes for archive in archives]).repeat(times, axis=0)
    drawn = [
        elite_seeds(archive, seed, times, stream=_FRESH_STREAM) for archive, seed in zip(archives, seeds, strict=True)
    ]
    result = evaluate(genes, np.concatenate(drawn), progress)
    tell_invalid(result, "fresh episodes")
    if result.base_collision.shape[1] != num_replicas:
        raise ValueError(f"evaluate must give {num_replicas} episodes, got {result.base_collision.shape[1]}")
    found, first = [], 0
    for archive, count in zip(archives, counts, strict=True):
        own = _regrouped(taken(result, count * times, first=first * times), times) if count else None
        found.append(_nothing(archive.cells) if own is None else _held_against(archive, own, fitness))
        first += count
    return found


def elite_seeds(archive: Archive, seed: int, times: int = 1, *, stream: int) -> NDArray[np.uint32]:
    """Seeds of episodes on elites, which follow from what names an elite: its cell and the iteration that found it.

    Args:
        archive: The N elites.
        seed: The search's.
        times: Seeds an elite.
        stream: Sets apart what must not share its episodes.

    Returns:
        Those of an elite in succession, shape (N * times,).
    """
    names = zip(archive.iteration.tolist(), archive.cell.tolist(), strict=True)
    rows = [np.random.SeedSequence([seed, *name], spawn_key=(stream,)).generate_state(times) for name in names]
    return np.concatenate([np.zeros(0, np.uint32), *rows]).astype(np.uint32)


def _regrouped(result: Any, times: int) -> Any:
    """A result whose terrains come ``times`` times in succession as one of 40 episodes a terrain."""
    arrays = {}
    for name, value in vars(result).items():
        if isinstance(value, np.ndarray):
            grouped = value.reshape(-1, times * value.shape[1], *value.shape[2:])
            arrays[name] = grouped[:, :FRESH_EPISODES]
    return replace(result, **arrays)


def _held_against(archive: Archive, result: Any, fitness: FitnessCfg) -> FreshValues:
    cells = archive.cells
    fresh = evaluation_of(result, cells, fitness)
    collided = (result.base_collision & ~result.invalid)[:, :_BIT_EPISODES].any(axis=1)
    cell = cells.cell_of(fresh.ratios, collided)
    counted = np.where(fresh.valid, fresh.episodes - fresh.invalid_episodes, 0)  # an invalid terrain says nothing
    hits = np.rint(fresh.collision_rate * counted).astype(int)
    limits = np.array([wilson_interval(*row) for row in zip(hits.tolist(), counted.tolist(), strict=True)])
    return FreshValues(
        **{**vars(fresh), "cell": cell},
        collision_low=limits[:, 0],
        collision_high=limits[:, 1],
        reproduced=fresh.valid & cells.are_neighbours(archive.cell, cell),
    )


def _nothing(cells: Cells) -> FreshValues:
    rates, counts, columns = np.zeros(0), np.zeros(0, np.int64), np.zeros((0, cells.num_ratios))
    return FreshValues(
        fitness=rates, ratios=columns, cell=counts, penalty_mean=columns, penalty_std=columns, collision_rate=rates,
        goal_rate=rates, fallen_rate=rates, invalid_episodes=counts, episodes=counts, collision_low=rates,
        collision_high=rates, reproduced=np.zeros(0, dtype=bool),
    )  # fmt: skip


def corrected(archive: Archive, cfg: SearchCfg, evaluator: EvaluatorCfg, open_evaluator: Open, seed: int) -> Archive:
    """An archive with what 40 fresh episodes of each elite say, the worst terrain as they confirm it first.

    Args:
        archive: As found.
        cfg: Its search.
        evaluator: What to cross terrains with, where; how many at once follows from the search.
        open_evaluator: Opens it.
        seed: Seed of the fresh episodes.
    """
    print(f"Evaluating {len(archive):,} elites again with {FRESH_EPISODES} fresh episodes each.", flush=True)
    at_once = max(1, cfg.episodes_per_iteration // FRESH_EPISODES)
    evaluator = replace(evaluator, num_terrains=at_once, num_replicas=FRESH_EPISODES)
    with open_evaluator(evaluator) as evaluate, share_bar("fresh episodes") as progress:
        fresh = reevaluate(
            [archive], evaluate, cfg.fitness, num_replicas=FRESH_EPISODES, seeds=[seed], progress=progress
        )
    return archive.corrected_by(fresh[0])


def drawn_elites(archive: Archive, most: int, seed: int) -> Archive:
    """An archive of some elites, drawn at random without replacement; all of them where there are no more than wanted.

    Args:
        archive: The elites.
        most: How many to draw.
        seed: The search's seed; the iterations done are drawn with too.
    """
    if len(archive) <= most:
        return archive
    rng = np.random.default_rng(np.random.SeedSequence([seed, archive.iterations], spawn_key=(_DRAW_STREAM,)))
    return archive.rows(np.sort(rng.choice(len(archive), most, replace=False)))


def numbers_of(again: FreshValues, cells: Cells, *, sampled: bool = False) -> dict[str, Any]:
    """The numbers of a re-evaluation, as metrics and reports have them.

    Args:
        again: What fresh episodes say.
        cells: The archive's cells.
        sampled: Whether it is of some elites only: what sums over all of them is left out then.
    """
    std = again.std()
    numbers = {
        "reevaluated": len(again.reproduced),
        "reproduced": int(again.reproduced.sum()),
        "mean_std": float(std.mean()) if len(std) else None,
        "mean_std_interval": bootstrap_interval(std, 0),
        "corrected_mean_fitness": float(again.fitness[again.valid].mean()) if len(std) else None,
    }
    if sampled:
        return numbers
    kept = again.corrected_elites()
    return numbers | {
        "failing": int(again.failing.sum()),
        "corrected_elites": len(kept),
        "corrected_coverage": len(kept) / cells.num_cells,
        "corrected_qd_score": float((again.fitness[kept] - FITNESS_FLOOR).sum()),
    }


@dataclass(frozen=True, kw_only=True)
class Reevaluate(Who, Where, InSpace):
    """Evaluate every elite of a run again with 40 fresh episodes.

    An elite is the best of many noisy evaluations. Its fresh episodes say what it is worth. The command writes the
    run's archive, numbers and figures again with them, and sorts elites by descending corrected fitness. With another
    controller than the searched one (--policy) it writes archive-<its name>.npz and archive-<its name>.json instead.
    """

    run: Path | None = None
    """Run directory; the newest of the robot under runs/."""
    seed: int | None = None
    """Seed of the fresh episodes; the run's."""

    def execute(self) -> None:
        """Runs the command."""
        reevaluate_run(self)


def reevaluate_run(args: Reevaluate, *, open_evaluator: Open = open_evaluator) -> Archive:
    """Evaluates all elites of a run again and writes what it leaves with their fresh values.

    Args:
        args: Which run, and where to work. ``policy`` may be another controller than the run's.
        open_evaluator: Opens what crosses the terrains.

    Returns:
        The corrected archive.

    Raises:
        FileNotFoundError: If there is no run.
        ValueError: If the run is damaged or empty, its robot or controller is another now, or an argument is not as it
            must be.
        Interrupted: On Ctrl-C; the run is as it was.
        EvaluatorError: If a worker is lost; likewise.
    """
    from sim.robots.find import get_robot, robot_of
    from sim.spaces.registry import get_space, load_space

    path = find_run(get_robot(args.robot), args.run, published="never")
    run = RunDirectory(path)
    cfg = run.read_cfg()
    if args.space is not None:
        load_space(args.space)
    get_space(cfg.space, cfg.space_sha256)
    robot = robot_of(as_settings(cfg), args.robot, path)
    seed = cfg.seed if args.seed is None else args.seed
    if seed < 0:
        raise ValueError(f"seed must be at least 0, got {seed}")
    device = resolve_device(args.device, args.workers)
    policy = own_policy(path, cfg, robot) if args.policy is None else spec_of(args.policy, robot)
    if not is_searched(cfg, policy, robot):
        raise ValueError(f"policy must be the controller that was searched, {cfg.policy}, got {policy}")
    evaluator = evaluator_of(cfg, robot, policy, device, args.workers, num_envs=args.num_envs)
    with claimed(path):
        archive = corrected(read_archive(path), cfg, evaluator, open_evaluator, seed)
        by = {**origin_of(device, seed, args.workers), **identity(robot, policy)}
        _write_corrected(run, archive, by)
    return archive


def _write_corrected(run: RunDirectory, archive: Archive, by: dict[str, Any]) -> None:
    from qd.show.figures import summary, write_figures

    metrics, before = run.read_metrics(), run.read_summary()
    write_archive(run.path / ARCHIVE_FILE, archive)
    write_figures(run.path, archive, metrics)
    numbers = summary(archive, metrics, gpus=before.get("gpus", 0), origin={})
    write_atomically(run.path / SUMMARY_FILE, to_json({**before, **numbers, "reproduced_by": by}))
