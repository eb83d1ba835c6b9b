"""What breaks published controllers, each by one import and one search: results/public.json.

FOLDER holds go2, g1 and go1 with the controllers and models of rl_sar, unitree_rl_gym and mujoco_playground. Everything
but what the network of Go1 sees, which its file does not say, is read from the publishers' files.
"""

import argparse
import json
import shutil
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from qd.check import ensure_ready
from qd.evaluate.dose import measure_dose, parse_doses
from qd.evaluate.evaluate import evaluate_rates
from qd.evaluate.level import walk
from qd.faults.judge import judge
from qd.search.directory import RunDirectory
from qd.search.loop import search
from qd.search.settings import preset
from qd.show.elites import open_run
from qd.show.replay import source_from_run
from qd.workers.compute import Compute
from qd.workers.crosser import Crosser
from qd.workers.pipeline import Engine
from results.make.common import COUNTS, agreement, crossing_rates, read_alike, runs_of_today
from results.make.pictures import take_still
from results.make.spaces import causes_of
from results.make.speed import time_crossings
from sim.controllers.imports import import_controller
from sim.device import resolve_device
from sim.files.atomic import prepare_output, to_json, write_atomically
from sim.files.provenance import provenance
from sim.files.settings import read_toml
from sim.robots.find import fitting_space, get_robot
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.base import MAX_HEIGHT
from sim.terrains.spaces.registry import SUPER_GAUSSIAN, load_space
from sim.terrains.terrains import Terrains
from train.cfg import FinetuneCfg, RunCfg
from train.finetune import train_specialist

CONTROLLERS = {  # source and model below FOLDER, and what is filled in behind the lines of controller and robot
    "go2-robot-lab": ("go2", "go2/model/urdf/go2.urdf", "", ""),
    "go2-himloco": ("go2/himloco.yaml", "go2/model/urdf/go2.urdf", "", ""),
    "g1-unitree": ("g1/g1.yaml", "g1/model/g1_12dof.xml", "", ""),
    "go1-playground": (
        "go1/go1_policy.onnx",
        "go1/model/go1_mjx_fullcollisions.xml",
        """action_scale = 0.5
observation = [
  {term = "lin_vel", at = [-0.01592, -0.06659, -0.00617]}, {term = "ang_vel"}, {term = "gravity"}, {term = "joint_pos"},
  {term = "joint_vel"}, {term = "last_action"}, {term = "command"},
]
""",
        "default_joint_pos = [0.1, 0.9, -1.8, -0.1, 0.9, -1.8, 0.1, 0.9, -1.8, -0.1, 0.9, -1.8]\n"
        "physics_dt = 0.004\ndecimation = 5\n",
    ),
}
ITERATIONS = 8
"""Of preset wide: 241,600 episodes."""
WITH_SPECIALIST = "go2-robot-lab"
"""Whose network is plain layers, and whose failures a specialist certifies."""
_RISES = "0.02,0.04,0.06,0.08,0.1,0.15,0.2,0.3"
OBSTACLES = (f"step_up={_RISES}", f"stairs_up={_RISES}", "ramp_up", "ditch", "payload")
"""Obstacles of which the size is measured that half of the robots cross."""
PICTURES = ("go2-robot-lab", "go1-playground", "g1-unitree")
"""Of whose worst failure the pages show a still."""


def fill_in(file: Path, text: str) -> None:
    """Puts settings into a TOML of an import, in place of its gaps and guesses of the same names."""
    names = [line.partition(" =")[0] for line in text.splitlines() if " = " in line and line[0].isalpha()]
    gaps = tuple(f"{prefix}{name} =" for name in names for prefix in ("", "# "))
    others = [line for line in file.read_text().splitlines(keepends=True) if not line.startswith(gaps)]
    file.write_text("".join(others) + text)


def ready(name: str, folder: Path, runs: Path, compute: Compute) -> tuple[RobotCfg, str]:
    """The robot of a controller, imported with it, and the terrain space that fits it."""
    source, model, of_controller, of_robot = CONTROLLERS[name]
    home = runs / name
    if not (home / "robot.toml").exists():
        import_controller(folder / source, folder / model, home)
        fill_in(home / "controller.toml", of_controller)
        fill_in(home / "robot.toml", of_robot)
    robot = ensure_ready(get_robot(str(home / "robot.toml")), None, compute)
    return robot, fitting_space(robot) or SUPER_GAUSSIAN.name


def measure(name: str, folder: Path, runs: Path, compute: Compute, *, seed: int, small: bool) -> dict[str, Any]:
    """Imports a controller, evaluates it, searches what breaks it, and times many robots."""
    run = runs / f"{name}-archive"
    robot, named = ready(name, folder, runs, compute)
    policy = str(robot.policy_file)
    with Crosser(robot, compute, cache=runs / "crossings") as crosser:
        walked = walk(crosser, policy, seed)
        agreed = agree(crosser, named, seed, 1 if small else 40)
    sizes: dict[str, Any] = {"terrains": 6 if small else 300, "episodes": 2 if small else 20}
    out = runs / f"{name}-rates.json"
    rates = evaluate_rates(robot, policy, compute=compute, space=named, seed=seed, out=out, **sizes)
    doses, out = parse_doses(OBSTACLES[:1] if small else OBSTACLES, ()), runs / f"{name}-dose.json"
    sizes = {"terrains": 1, "episodes": 1} if small else {}
    dose = measure_dose(robot, {name: policy}, doses, compute=compute, seed=seed, out=out, **sizes)
    cfg = preset("small" if small else "wide", robot, None, space=named)
    search(replace(cfg, seed=seed, iterations=1 if small else ITERATIONS), run, compute, robot=robot)
    archive = judge(run, stages=("fresh",) if small else ("fresh", "resolved"), compute=compute, robot=robot.spec)
    if name == WITH_SPECIALIST and not small:
        train_specialist(robot, run, FinetuneCfg.specialist(robot), RunCfg(device=compute.device))
        archive = judge(run, stages=("others",), compute=compute, robot=robot.spec)
    summary = RunDirectory(run).read_summary()
    speed = time_crossings(robot, 4 if small else 32768, compute.device, seed, space=named, each=4)
    return {
        "contract": {key: value for key, value in read_toml(Path(policy)).items() if key != "policy"},
        "space": named,
        "height": float(named.partition("@")[2] or MAX_HEIGHT),
        "check": {
            f"flat_{key}{suffix}": value
            for way, suffix in (("searched", ""), ("mujoco_c", "_mujoco_c"))
            for key, value in {**walked[way], "vx_error": abs(walked[way]["speed"] - robot.speed)}.items()
        },
        "hand_crafted": rates["hand_crafted"],
        "agreement": agreed,
        "archive": {count: summary.get(count) for count in (*COUNTS, "wall_s")},
        "causes": causes_of(archive),
        "episodes_per_s_32768": speed["episodes_per_s"],
        "dose": dose["dose"],
        "half": dose["half"],
    }


def agree(crosser: Crosser, space: str, seed: int, terrains: int) -> dict[str, Any]:
    """Mean goal rates on hard-random terrains by physics, and how far ours, resolved, lies from MuJoCo C, resolved."""
    drawn = load_space(space)
    genes = drawn.hard_random(terrains, seed + 1)
    hard_random = Terrains(genes=genes, seeds=np.arange(terrains, dtype=np.uint32), space=drawn)
    policy = str(crosser.robot.policy_file)
    engines: dict[str, Engine] = {"searched": "search", "resolved": "resolved", "mujoco_c": "mujoco_c"}
    outcome = {
        name: crosser.cross(policy, hard_random, replicas=10, engine=engine, label=f"hard-random, {engine}").outcome
        for name, engine in engines.items()
    }
    rates = {name: float(np.nanmean(crossing_rates(outcomes, "goal"))) for name, outcomes in outcome.items()}
    return {**rates, "both_resolved": agreement(outcome["resolved"], outcome["mujoco_c"], seed)}


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Measures all controllers, or those of ``--only``, and writes the file after each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="folder of the publishers' files")
    parser.add_argument("--only", nargs="+", choices=CONTROLLERS, default=list(CONTROLLERS))
    parser.add_argument("--device", help="a CUDA device if there is one")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--pictures", action="store_true", help="stills of searches that are there, and nothing else")
    parser.add_argument("--small", action="store_true", help="a trial of some minutes; it publishes nothing")
    parser.add_argument("--out", type=Path, help="file to write; results/public.json if left out")
    args = parser.parse_args(argv)
    compute = Compute(resolve_device(args.device))
    out = args.out or (Path("runs/make/small") if args.small else Path("results")) / "public.json"
    runs = out.parent / "public" if args.small else runs_of_today() / "public"
    if args.small and not args.pictures:
        shutil.rmtree(runs, ignore_errors=True)
    if args.pictures:
        for name in set(args.only) & set(PICTURES):
            opened = open_run(str(runs / name / "robot.toml"), runs / f"{name}-archive")
            take_still(source_from_run(opened), name)
        return {}
    prepare_output(out)
    origin, content = provenance(compute.device, args.seed) | {"small": args.small}, dict[str, Any]()
    read_rows = partial(read_alike, out, origin, "sources_sha256", "device", "seed", "small")
    for name in args.only:
        if name not in read_rows().get("controllers", {}):
            numbers = measure(name, args.folder, runs, compute, seed=args.seed, small=args.small)
            rows = read_rows().get("controllers", {}) | {name: numbers}  # another process may have written meanwhile
            content = origin | {"controllers": {name: rows[name] for name in CONTROLLERS if name in rows}}
            print(json.dumps({name: numbers}, indent=1), flush=True)
            write_atomically(out, to_json(content))
    return content


if __name__ == "__main__":
    main()
