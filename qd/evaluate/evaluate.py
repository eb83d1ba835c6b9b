"""How well controllers cross terrains that they were not trained on: rates of one, tables of several."""

import hashlib
from collections.abc import Mapping
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from qd.evaluate import sets as terrain_sets
from qd.evaluate import tables
from qd.evaluate.labels import COMPARED, HELD_OUT, MEASURES, RATES, SETS, SetsCfg
from qd.evaluate.level import report_level_ground
from qd.faults.numbers import EPISODES
from qd.search.archive import ARCHIVE_FILE, Archive
from qd.search.directory import RUNS, read_robot_archive, search_seed
from qd.workers.compute import Compute, check_policy
from qd.workers.crosser import Crosser
from qd.workers.pipeline import Engine
from sim.controllers.spec import controller_identity, crosser_name, describe_controllers, resolve_policy
from sim.files.command import publish
from sim.files.intervals import format_value
from sim.robots.find import get_robot, read_penalty_scales
from sim.robots.robot import RobotCfg, robot_identity
from sim.rollout import RolloutResult
from sim.terrains.spaces.registry import load_space, space_at

_SMALL = (24, 4)  # terrains a set and episodes a terrain on a machine without a GPU


def fill_sizes(
    compute: Compute, terrains: int | None, episodes: int | None, *, full: tuple[int, int], small: tuple[int, int]
) -> tuple[int, int]:
    """Terrains and episodes a terrain: where they are None, ``full`` on a GPU, else ``small``, which it prints."""
    if not compute.on_gpu and terrains is None and episodes is None:
        print(f"No GPU: {small[0]} terrains x {small[1]} episodes each instead of {full[0]} x {full[1]}.")
    default_terrains, default_episodes = full if compute.on_gpu else small
    return terrains or default_terrains, episodes or default_episodes


def crossings_folder(robot: RobotCfg) -> Path:
    """Where evaluations of a robot store crossings."""
    return RUNS / f"{robot.name}-evaluation" / "crossings"


def cross_sets(
    controllers: Mapping[str, str],
    sets: Mapping[str, terrain_sets.TerrainSet],
    robot: RobotCfg,
    compute: Compute,
    episodes: int,
    *,
    engine: Engine = "search",
    cache: Path | None = None,
    note: str = "",
    **settings: Any,
) -> dict[str, dict[str, RolloutResult]]:
    """Set -> controller -> its crossings, by ``settings`` of Crosser.cross; prints rates, ``note`` behind the set."""
    results: dict[str, dict[str, RolloutResult]] = {name: {} for name in sets}
    largest = max(map(len, sets.values()))
    for policy in controllers.values():
        report_level_ground(robot, policy, compute)
    with Crosser(robot, compute, cache=cache) as crosser:
        crossings = [*product(controllers.items(), sets.items())]
        for number, ((controller, policy), (name, terrains)) in enumerate(crossings, 1):
            label = f"{controller} on {name}{note}" + (f" ({engine})" if engine != "search" else "")
            about = {"label": f"{number} of {len(crossings)}: {label}", "room": largest, **settings}
            result = crosser.cross(policy, terrains.terrains, replicas=episodes, engine=engine, **about)
            rates = {key: float(np.nanmean(values)) for key, values in tables.terrain_rates(result).items()}
            print(f"{label}: goal {rates['goal']:.3f}, no base collision {rates['success']:.3f}", flush=True)
            results[name][controller] = result
    return results


def evaluate(
    controllers: Mapping[str, str],
    sets: Mapping[str, terrain_sets.TerrainSet] | None = None,
    *,
    robot: RobotCfg | str = "anymal",
    compute: Compute | None = None,
    episodes: int = EPISODES,
    seed: int = 0,
    cache: Path | None = None,
) -> tables.Tables:
    """The tables of controllers, policies by name of which ``shipped`` is the robot's own, on sets of terrains.

    Without ``sets`` there are 24 hand-crafted and 24 hard-random terrains, without ``compute`` the CPU crosses. The
    robot is a name or a settings file. ``seed`` is of bootstraps, ``cache`` of crossings.
    """
    robot = get_robot(robot)
    sets = sets or terrain_sets.make_sets((), _SMALL[0], seed)
    controllers = {name: resolve_policy(policy, robot) for name, policy in controllers.items()}
    others = [policy for policy in controllers.values() if policy != str(robot.policy_file)]
    scales = read_penalty_scales(robot, others[0] if others else None)
    results = cross_sets(controllers, sets, robot, compute or Compute(), episodes, reward=True, cache=cache)
    performances = {
        name: {controller: tables.measure(result, scales) for controller, result in row.items()}
        for name, row in results.items()
    }
    about = describe_controllers(controllers, robot)
    return tables.make_tables(performances, sets, robot, controllers=about, episodes=episodes, seed=seed)


def evaluate_tables(
    robot: RobotCfg, controllers: Mapping[str, str], cfg: SetsCfg, *, compute: Compute, out: Path | None = None
) -> dict[str, Any]:
    """The tables of controllers, ``old`` and ``new`` on elites that neither trained on; prints and writes them."""
    compares = {*controllers} == {"old", "new"}
    if compares:
        if cfg.archive is None:
            raise ValueError("old and new are compared on elites: give --archive RUN, or other names for tables")
        if cfg.sets or cfg.independent:
            raise ValueError("old and new are compared on --archive: leave --sets and --independent out")
        controllers = {name: controllers[name] for name in ("old", "new")}
    tables.check_seeds(controllers)
    full = (terrain_sets.paper_terrains(robot.name), EPISODES)
    terrains, episodes = fill_sizes(compute, cfg.terrains, cfg.episodes, full=full, small=_SMALL)
    archive = independent = None
    origin: dict[str, Any] = {"archive": None, "archive_sha256": None, "independent": None}
    if cfg.archive is not None:
        archive = read_robot_archive(robot, cfg.archive, cfg.space)
        sizes = {name: len(rows) for name, rows in terrain_sets.split_elites(archive)._asdict().items()}
        origin["archive"] = _describe_archive(cfg.archive, archive) | sizes
        origin["archive_sha256"] = origin["archive"].pop("sha256")
    if cfg.independent is not None:
        independent = terrain_sets.read_independent(cfg.independent, cfg.archive, robot, cfg.space)
        origin["independent"] = _describe_archive(cfg.independent, independent)
        origin["independent"]["search_seed"] = search_seed(cfg.independent)
    space = space_at(load_space(cfg.space), None, robot)
    for policy in controllers.values():
        check_policy(policy, robot, compute.device)
    if compares and archive is not None:
        sets = {COMPARED: _untrained_elites(archive, controllers, terrains, cfg)}
    else:
        sets = terrain_sets.make_sets(
            cfg.sets, terrains, cfg.seed, archive=archive, independent=independent, space=space
        )
    for name in set(HELD_OUT).intersection(sets):
        terrain_sets.check_untrained(controllers, sets[name].terrains.values, f"{cfg.archive} held out for the test")
    if independent is not None:  # all of its elites: those of a search that was trained on share ancestors
        terrain_sets.check_untrained(controllers, independent.genes, str(cfg.independent))

    def make_report() -> dict[str, Any]:
        settings: Any = {"episodes": episodes, "seed": cfg.seed, "cache": crossings_folder(robot)}
        numbers = evaluate(controllers, sets, robot=robot, compute=compute, **settings)
        return {**compute.origin(cfg.seed), **robot_identity(robot), "space": space.name, **origin, **numbers}

    file, show = ("compared.json", tables.show_comparison) if compares else ("tables.json", tables.show_tables)
    return publish(out or RUNS / f"{robot.name}-tables" / file, make_report, show)


def _untrained_elites(
    archive: Archive, controllers: Mapping[str, str], count: int, cfg: SetsCfg
) -> terrain_sets.TerrainSet:
    """Elites that no controller was trained on, of families enough to tell how far a difference may be chance."""
    trained_on = set().union(*map(terrain_sets.read_trained_on, controllers.values()))
    elites = terrain_sets.random_elites(COMPARED, archive, count, cfg.seed, trained_on)
    families = 0 if elites.families is None else len(np.unique(elites.families))
    if families < 2:
        rule = "must have elites of 2 families that no controller was trained on"
        raise ValueError(f"archive {rule}, got {len(elites)} elites of {families} in {cfg.archive}: give another")
    return elites


def _describe_archive(path: Path, archive: Archive) -> dict[str, Any]:
    digest = hashlib.sha256((path / ARCHIVE_FILE if path.is_dir() else path).read_bytes()).hexdigest()
    return {"path": str(path), "elites": len(archive), "iterations": archive.iterations, "sha256": digest}


def evaluate_rates(
    robot: RobotCfg, policy: str, cfg: SetsCfg, *, compute: Compute, out: Path | None = None
) -> dict[str, Any]:
    """What ``base.json`` has: rates of one controller and its velocity error; written under runs/ without ``out``."""
    count, episodes = fill_sizes(compute, cfg.terrains, cfg.episodes, full=(300, EPISODES), small=_SMALL)
    check_policy(policy, robot, compute.device)
    space, seed = space_at(load_space(cfg.space), None, robot), cfg.seed
    sets = {name: terrain_sets.plain_set(name, count, seed, space) for name in ("hand_crafted", "hard_random", "flat")}
    controller = crosser_name(robot, policy)

    def make_report() -> dict[str, Any]:
        settings: Any = {"penalties_from_s": tables.VELOCITY_FROM_S, "cache": crossings_folder(robot)}
        results = cross_sets({controller: policy}, sets, robot, compute, episodes, **settings)
        hand_crafted, hard_random, flat = (results[name][controller] for name in sets)
        types, levels = sets["hand_crafted"].types, sets["hand_crafted"].levels
        return {
            **compute.origin(seed),
            **controller_identity(robot, policy),
            "space": space.name,
            "hand_crafted": tables.summarise_crossings(hand_crafted, seed, types=types, levels=levels),
            "hard_random": tables.summarise_crossings(hard_random, seed),
            "flat": tables.velocity_error(flat, seed),
        }

    return publish(out or RUNS / f"{controller}-rates.json", make_report, show_rates)


def show_rates(report: dict[str, Any]) -> None:
    """Prints the rates of one controller, as ``base.json`` has them."""
    rows = []
    for name in ("hand_crafted", "hard_random"):
        groups = {SETS[name]: report[name]}
        groups |= {f"  {key}": group for key, group in (report[name]["by_type"] or {}).items()}
        groups |= {f"  level {key}": group for key, group in (report[name]["by_level"] or {}).items()}
        rows += [(label, *tables.rate_cells(group), group["terrains"]) for label, group in groups.items()]
    tables.show_table(report["policy"], ("", *map(MEASURES.__getitem__, RATES), "terrains"), rows)
    error = format_value(report["flat"]["vx_error_mean"], None)
    print(f"flat ground: v_x is off its command by {error} m/s (root mean square)")
