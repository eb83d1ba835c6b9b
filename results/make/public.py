"""What breaks public controllers, each by one import and one search: results/public.json.

FOLDER holds clones of REPOSITORIES, each under its own name. What a publisher's files do not say is filled in below.
With ``--route`` each is searched on routes alone: results/public_route.json, 3 minutes a controller.
"""

import argparse
import hashlib
import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from qd.check import ensure_ready, ensure_stray
from qd.evaluate.dose import measure_dose, parse_doses
from qd.evaluate.evaluate import evaluate_rates
from qd.evaluate.labels import SetsCfg
from qd.evaluate.level import measure_level_ground
from qd.faults.families import Ranking
from qd.faults.judge import judge
from qd.faults.minimise import minimise
from qd.search.directory import RunDirectory
from qd.search.loop import search
from qd.search.settings import preset
from qd.show.elites import open_run
from qd.show.replay import source_from_run
from qd.workers.compute import Compute
from qd.workers.crosser import Crosser
from results.make.common import COUNTS, read_alike, runs_of_today
from results.make.pictures import film_failure
from results.make.publishers import LEAGUE, PUBLISHERS, read_mjcf, walk
from sim.controllers.imports import import_controller
from sim.device import resolve_device
from sim.files.atomic import prepare_output, read_json, to_json, write_atomically
from sim.files.command import command_line
from sim.files.provenance import provenance
from sim.files.settings import read_toml
from sim.robots.find import fitting_space, get_robot, read_stray
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.base import MAX_HEIGHT
from sim.terrains.spaces.registry import SUPER_GAUSSIAN, at_height

CONTROLLERS = LEAGUE["controllers"]
ITERATIONS = 1
"""Of preset wide, at the height that fits."""
ROUTE_ITERATIONS = 6
"""... on routes."""
ROBOTS_AT_ONCE = 4096
"""On a GPU, where many of these processes run side by side."""
COMMON_EMITTERS = 20
"""A quarter of preset wide's, of the one iteration at each of the common heights: 4,400 episodes."""
HEIGHTS = (0.05, 0.1, 0.2)
"""Of terrains that all controllers cross, and that are searched against all [m]."""
_RISES = "0.02,0.04,0.06,0.08,0.1,0.15,0.2,0.3"
OBSTACLES = (f"step_up={_RISES}", f"stairs_up={_RISES}", "payload", "delay")
"""Of which the size is measured that half of the robots cross."""
RATES = SetsCfg(terrains=100, episodes=10)
"""Of a set, and of a terrain."""


def fill_in(file: Path, text: str) -> None:
    """Puts settings into a TOML of an import, in place of its gaps and guesses of the same names."""
    names = [line.partition(" =")[0] for line in text.splitlines() if " = " in line and line[0].isalpha()]
    gaps = tuple(f"{prefix}{name} =" for name in names for prefix in ("", "# "))
    others = [line for line in file.read_text().splitlines(keepends=True) if not line.startswith(gaps)]
    file.write_text("".join(others) + text)


def copy_model(model: Path) -> Path:
    """A model, or a copy beside it without meshes that are not there, ground, air, and contact margins of 1 mm."""
    if model.suffix == ".urdf":
        return model
    spec, missing = read_mjcf(model)
    margins = [geom for geom in spec.geoms if geom.margin]
    if not (missing or margins or spec.worldbody.geoms):
        return model
    for geom in margins:
        geom.margin = 0.0
    for geom in list(spec.worldbody.geoms):
        spec.delete(geom)
    spec.option.density = 0.0
    spec.compile()
    copy = model.with_name(f"{model.stem}.league.xml")
    copy.write_text(spec.to_xml())
    return copy


def ready(name: str, folder: Path, runs: Path, compute: Compute) -> RobotCfg:
    """The robot of a controller, imported with it, with time for a crossing and scales."""
    chosen, home = CONTROLLERS[name], runs / name
    if not (home / "robot.toml").exists():
        model = folder / chosen["model"] if "model" in chosen else PUBLISHERS[name](folder).model
        import_controller(folder / chosen["source"], copy_model(model), home)
        for part in ("controller", "robot"):
            fill_in(home / f"{part}.toml", chosen.get(part, ""))
    return ensure_ready(get_robot(str(home / "robot.toml")), None, compute)


def search_at(
    robot: RobotCfg,
    space: str,
    run: Path,
    compute: Compute,
    *,
    seed: int,
    small: bool,
    emitters: int | None = None,
    iterations: int = 1,
    stages: tuple[str, ...] = ("fresh",),
) -> tuple[Ranking, dict[str, Any]]:
    """A search of terrains of a space, judged: its elites ranked, and its counts."""
    cfg = preset("small" if small else "wide", robot, None, space=space)
    cfg = replace(cfg, seed=seed, iterations=iterations)
    if emitters and not small:
        cfg = replace(cfg, scheduler=replace(cfg.scheduler, emitters=emitters, groups=emitters // 10))
    search(cfg, run, compute, robot=robot)
    judge(run, stages=stages, compute=compute, robot=robot.spec)
    ranking, summary = open_run(robot.spec, run).rank(judged=True), RunDirectory(run).read_summary()
    return ranking, {count: summary.get(count) for count in (*COUNTS, "wall_s")}


def measure(name: str, folder: Path, runs: Path, compute: Compute, *, seed: int, small: bool) -> dict[str, Any]:
    """Level ground, rates and a search at common heights, sizes of obstacles, and a search with a minimal failure."""
    chosen, run = CONTROLLERS[name], runs / f"{name}-archive"
    robot, publisher = ready(name, folder, runs, compute), PUBLISHERS[name](folder)
    policy = str(robot.policy_file)
    with Crosser(robot, compute, cache=runs / "crossings") as crosser:
        walks = measure_level_ground(crosser, policy, mujoco_c=True)
    by_publisher = walk(publisher, episodes=2 if small else 20, speed=robot.speed, duration_s=robot.max_duration_s)
    rates, sizes = dict[str, Any](), SetsCfg(terrains=4, episodes=1) if small else RATES
    for height in HEIGHTS[: 1 if small else None]:
        out, at = runs / f"{name}-rates-{height:g}.json", at_height(SUPER_GAUSSIAN, height).name
        report = evaluate_rates(robot, policy, replace(sizes, space=at, seed=seed), compute=compute, out=out)
        common = runs / f"{name}-archive-{height:g}"
        searched = search_at(robot, at, common, compute, seed=seed, small=small, emitters=COMMON_EMITTERS)
        rates[f"{height:g}"] = {key: report[key] for key in ("hand_crafted", "hard_random")} | {"search": searched[1]}
    doses, out = parse_doses(OBSTACLES[:1] if small else OBSTACLES, ()), runs / f"{name}-dose.json"
    terrains = 1 if small else None
    dose = measure_dose(robot, {name: policy}, doses, compute=compute, terrains=terrains, seed=seed, out=out)
    space = fitting_space(robot) or SUPER_GAUSSIAN.name
    iterations, stages = (1, ("fresh",)) if small else (ITERATIONS, ("fresh", "resolved", "steered"))
    ranking, counts = search_at(
        robot, space, run, compute, seed=seed, small=small, iterations=iterations, stages=stages
    )
    families = dict(zip(ranking.families[ranking.failing], ranking.numbers[ranking.failing], strict=True))
    worst = None if not families else int(families[min(families)])
    if worst is not None:
        minimise(run, compute=compute, elite=str(worst), robot=robot.spec)
    model = chosen.get("model", publisher.model.relative_to(folder))
    files = (folder / chosen["source"], publisher.model, publisher.network)
    hashes = {str(f.relative_to(folder)): hashlib.sha256(f.read_bytes()).hexdigest() for f in files if f.is_file()}
    flags = {"preset": "wide", "iterations": ITERATIONS, "space": space}
    return {
        **LEAGUE["repositories"][Path(chosen["source"]).parts[0]],
        **chosen,
        "sha256": hashes,
        "contract": {key: value for key, value in read_toml(Path(policy)).items() if key != "policy"},
        "commands": [
            f"faultline import {chosen['source']} --model {model} --out mine/{name}",
            command_line("archive", robot=f"mine/{name}/robot.toml", **flags),
        ],
        "max_duration_s": robot.max_duration_s,
        "height": float(space.partition("@")[2] or MAX_HEIGHT),
        "check": {
            **{f"flat_{key}": value for key, value in walks["searched"].items()},
            **{f"flat_{key}_mujoco_c": value for key, value in walks["mujoco_c"].items()},
            **{f"flat_{key}_publisher": value for key, value in by_publisher.items()},
            "publisher_loop": PUBLISHERS[name].func.__doc__,
        },
        "rates": rates,
        "dose": dose["dose"],
        "half": dose["half"],
        "archive": counts,
        "failing_families": counts["failing_families"],
        "faults_witness": counts["faults_witness"],
        "causes": {cause: len(rows) for cause, rows in ranking.by_cause().items()},
        "minimal": worst,
    }


def measure_route(name: str, folder: Path, runs: Path, compute: Compute, *, seed: int, small: bool) -> dict[str, Any]:
    """A search of routes on terrains of the height that fits, with how far the controller may be off a route."""
    robot = ready(name, folder, runs, compute)
    ensure_stray(robot, None, compute)
    space = f"{fitting_space(robot) or SUPER_GAUSSIAN.name}+command"
    iterations, stages = (1, ("fresh",)) if small else (ROUTE_ITERATIONS, ("fresh", "resolved"))
    how: dict[str, Any] = {"seed": seed, "small": small, "iterations": iterations, "stages": stages}
    ranking, counts = search_at(robot, space, runs / f"{name}-route", compute, **how)
    return {
        **LEAGUE["repositories"][Path(CONTROLLERS[name]["source"]).parts[0]],
        "space": space,
        "stray_m": read_stray(robot),
        "max_duration_s": robot.max_duration_s,
        "archive": counts,
        "causes": {cause: len(rows) for cause, rows in ranking.by_cause().items()},
    }


def draw_film(name: str, runs: Path) -> None:
    """The failure on the minimal terrain of a search, as a GIF of the pages; it needs a renderer and no GPU."""
    opened = open_run(str(runs / name / "robot.toml"), runs / f"{name}-archive")
    if opened.minima is None:
        return
    source = source_from_run(opened, minimal=str(opened.minima.numbers["elites"][0]["elite"]))
    film_failure(source, name, f"{name}, a minimal terrain", f"results/public.json#controllers/{name}/archive")


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Measures all controllers, or those of ``--only``, and writes the file after each; what is there stays."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the publishers' repositories")
    parser.add_argument("--only", nargs="+", choices=CONTROLLERS, default=list(CONTROLLERS))
    parser.add_argument("--device", help="a CUDA device if there is one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--films", action="store_true", help="films of searches that are there, and nothing else")
    parser.add_argument("--route", action="store_true", help="searches of routes, and nothing else")
    parser.add_argument("--small", action="store_true", help="a trial of some minutes; it publishes nothing")
    parser.add_argument("--out", type=Path, help="file to write; results/public.json or public_route.json if left out")
    args = parser.parse_args(argv)
    device = resolve_device(args.device)
    compute = Compute(device, num_envs=ROBOTS_AT_ONCE if device.startswith("cuda") else None)
    route = "_route" if args.route else ""
    out = args.out or (Path("runs/make/small") if args.small else Path("results")) / f"public{route}.json"
    runs = out.parent / "public" if args.small else runs_of_today() / "public"
    if args.films:
        for name in args.only:
            draw_film(name, runs)
        return {}
    if args.small:
        shutil.rmtree(runs, ignore_errors=True)
    prepare_output(out)
    origin = provenance(compute.device, args.seed) | {"small": args.small}

    def read_numbers(file: Path) -> dict[str, Any]:
        return read_alike(file, origin, "sources_sha256", "device", "seed", "small").get("numbers", {})

    files = {name: runs / f"{name}{route}.json" for name in CONTROLLERS}  # one each, since several processes may run
    for name in args.only:
        if not (numbers := read_numbers(files[name])):
            numbers = (measure_route if route else measure)(
                name, args.folder.resolve(), runs, compute, seed=args.seed, small=args.small
            )
        write_atomically(files[name], to_json(origin | {"numbers": numbers}))
        rows = {name: row for name, file in files.items() if (row := read_numbers(file))}
        write_atomically(out, to_json(origin | {"controllers": rows}))
        print(json.dumps({name: numbers}, indent=1), flush=True)
    return read_json(out)


if __name__ == "__main__":
    main()
