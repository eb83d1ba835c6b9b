"""The tables of the paper, from the command line's arguments to the files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qd.archive import Archive, read_archive
from qd.workers.evaluator import EvaluatorCfg, check_policy, open_evaluator, origin_of
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.command import split_words
from sim.policy.spec import controllers_of
from sim.robots.own import robot_digest
from train.evaluate.cfg import EvaluateCfg, Size, size_of
from train.evaluate.crossings import Open, cross_all
from train.evaluate.held_out import check_held_out
from train.evaluate.kept import KeptCrossings, controller_hash
from train.evaluate.measures import measure
from train.evaluate.seeds import check_seeds
from train.evaluate.sets import FROM_ARCHIVE, SETS, EliteSplit, TerrainSet, check_names, make_sets, split_elites
from train.evaluate.table_figure import write_figure
from train.evaluate.table_print import print_tables
from train.evaluate.tables import make_tables


@dataclass(frozen=True, kw_only=True)
class _Plan:
    """An evaluation that can begin: everything a user may have got wrong has been looked at."""

    size: Size
    evaluator: EvaluatorCfg
    """Where to cross; controllers and sets are filled in."""
    scales: tuple[float, ...]
    controllers: dict[str, str]
    sets: dict[str, TerrainSet]
    archive: dict[str, Any] | None
    """Where the generated terrains come from, as JSON values."""
    kept: Path
    """Folder of crossings."""
    out: Path
    """File of the numbers."""


def _plan_of(cfg: EvaluateCfg) -> _Plan:
    if cfg.policy is not None:
        raise ValueError(f"tables are of named controllers: give --policies NAME={cfg.policy} instead of --policy")
    size = size_of(cfg)
    robot = size.robot
    controllers = controllers_of(cfg.policies, robot)
    archive = None if cfg.archive is None else read_archive(cfg.archive)
    split = None if archive is None else split_elites(archive, robot.name, cfg.split_seed)
    names = split_words(cfg.sets) or [name for name in SETS if archive is not None or name not in FROM_ARCHIVE]
    check_names(names, has_archive=archive is not None)
    run_dir = cfg.run_dir or Path("runs") / f"{robot.name}-tables"
    kept, out = run_dir / "crossings", cfg.out or run_dir / "tables.json"
    if out.suffix != ".json":
        raise ValueError(f"out must be a file named *.json, beside which the figure is written as .png, got {out}")
    for file in (out, out.with_suffix(".png"), kept / "any"):
        prepare_output(file)
    scales = robot.read_penalty_scales()
    for policy in controllers.values():
        check_policy(policy, robot, size.device)
    check_seeds(controllers)
    sets = make_sets(names, size.terrains, cfg.seed, archive=archive, split=split)
    for name in FROM_ARCHIVE:
        if name in sets:
            check_held_out(controllers, sets[name].terrains, cfg.split_seed)
    return _Plan(
        size=size,
        evaluator=_evaluator_of(size, cfg),
        scales=scales,
        controllers=controllers,
        sets=sets,
        archive=_about(cfg, archive, split),
        kept=kept,
        out=out,
    )


def _evaluator_of(size: Size, cfg: EvaluateCfg) -> EvaluatorCfg:
    return EvaluatorCfg(
        robot=size.robot,
        policy="",
        num_terrains=size.terrains,
        num_replicas=size.episodes,
        device=size.device,
        workers=cfg.workers,
        reward=True,
    )


def _about(cfg: EvaluateCfg, archive: Archive | None, split: EliteSplit | None) -> dict[str, Any] | None:
    if archive is None or split is None:
        return None
    parts = {
        "elites": len(archive),
        "iterations": archive.iterations,
        "train": len(split.train),
        "test": len(split.test),
    }
    return {"path": str(cfg.archive), **parts, "split_seed": cfg.split_seed}


def evaluate_tables(cfg: EvaluateCfg, *, open_evaluator: Open = open_evaluator) -> dict[str, Any]:
    """Cross every set with every controller, print the tables, write them and their figure; returns their content.

    Args:
        cfg: What to evaluate, on what, where.
        open_evaluator: Opens what crosses terrains.

    Raises:
        ValueError: If something asked for cannot be had; raised before any long work.
        FileNotFoundError: If there is no archive; likewise.
        EvaluatorError: If a worker is lost; what was crossed is kept.
    """
    plan = _plan_of(cfg)
    size, robot = plan.size, plan.size.robot
    kept = KeptCrossings(
        plan.kept,
        robot=robot.name,
        robot_sha256=robot_digest(robot),
        episodes=size.episodes,
        device=size.device,
    )
    results = cross_all(plan.controllers, plan.sets, plan.evaluator, kept, open_evaluator=open_evaluator)
    crossed = {name: {who: measure(one, plan.scales) for who, one in row.items()} for name, row in results.items()}
    about = {who: {"policy": policy, "sha256": controller_hash(policy)} for who, policy in plan.controllers.items()}
    report = {
        **origin_of(size.device, cfg.seed, cfg.workers),
        "robot": robot.name,
        "episodes": size.episodes,
        "controllers": about,
        "archive": plan.archive,
        **make_tables(crossed, plan.sets, robot, cfg.seed),
    }
    print_tables(report)
    write_atomically(plan.out, to_json(report))
    figure = plan.out.with_suffix(".png")
    write_figure(figure, report)
    print(f"\nwritten to {plan.out} and {figure}")
    return report
