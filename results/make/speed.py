"""Speed of the search and of the bare physics in it, and other quoted speeds: speed.json.

The timed iterations are those of a real search, from ask to the saved checkpoint. Bare rates are measured right after,
on the terrains that the search asks for next, with the same number of robots and the same solver. Steps are counted for
robots in an episode; waiting robots are not computed.

With ``--against`` it measures nothing but searches of this checkout and of another one in turns, which takes 6 minutes.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.search.directory import Metrics, RunDirectory
from qd.search.loop import search
from qd.search.settings import SearchCfg, preset
from qd.workers.compute import Compute
from qd.workers.crosser import open_pipeline
from qd.workers.pipeline import PipelineCfg, build_simulator
from results.make.bare import bare_rates, kernel_shares, standing_rates
from results.make.common import ONCE, Script, parse, t_interval
from sim.robots.robot import RobotCfg
from sim.rollout import Rollout
from sim.terrains.spaces.registry import SUPER_GAUSSIAN, load_space
from sim.terrains.terrains import Terrains

WARM_UP = 2
WIDE = ("surrogate", "cma_mae+map_elites")
CURVE = (1024, 4096, 32768)
REPLICAS = 20
PROFILED = 22_400
"""Robots whose kernels are timed, as in a search of preset wide."""
PAPER_EPISODES = 4_000_000
ITERATION_KEYS = ("iteration_s_median", "bare_physics_ratio", "world_steps_per_s", "ground_step_ratio")
UNDER = ("conditions", "all_conditions", "route")
"""Bare rates that say what conditions cost."""
RATIOS = tuple(f"{name}_step_ratio" for name in UNDER)
KEYS = (*ITERATION_KEYS, *RATIOS, "against", "envs_curve", "wide", "flat", "kernels")
"""Keys that readers expect: null until measured."""
ROUNDS, TIMED = 4, 8
"""Searches of each checkout that are timed in turns, and iterations of each."""
TIME_CHECKOUT = """
import json, sys
from results.make import common, speed
script = common.parse(None, sys.argv[2:], "speed.json")
cfg = script.search_cfg() if script.small else speed.preset("paper", script.robot)
metrics, _ = speed.time_search(script, "against", cfg, int(sys.argv[1]))
rates = [(1.0 - row["idle_share"]) * row["robot_steps"] / row["wall_s"] for row in metrics]
print(json.dumps([script.origin["sources_sha256"], float(speed.np.median(rates))]))
"""
"""What each checkout runs, by functions that both have: a search without conditions."""


def time_search(script: Script, name: str, cfg: SearchCfg, iterations: int) -> tuple[Metrics, NDArray[np.float32]]:
    """Metrics of some iterations of a new search after the first two, and the terrains that it asks for next."""
    path = script.runs / "speed" / name
    shutil.rmtree(path, ignore_errors=True)
    cfg = replace(cfg, iterations=iterations + WARM_UP)
    search(cfg, path, script.compute)
    scheduler, metrics = RunDirectory(path).load(cfg)
    return metrics[WARM_UP:], np.concatenate([scheduler.ask(group) for group in range(cfg.scheduler.num_groups)])


def make_rollout(script: Script, num_terrains: int, num_envs: int, replicas: int) -> Rollout:
    """A simulation of the shipped controller in this process."""
    sizes: Any = {"num_terrains": num_terrains, "replicas": replicas}
    compute = Compute(script.device, workers="1", num_envs=num_envs)
    cfg = PipelineCfg(compute=compute, robot=script.robot, policy=script.policy, **sizes)
    rollout = build_simulator(cfg, num_terrains)
    assert isinstance(rollout, Rollout)
    return rollout


def time_iteration(script: Script) -> dict[str, Any]:
    """The paper's iteration, and bare physics on the same crossings.

    ``conditions_step_ratio`` is the time of a search's step with noise and lag over that of one without conditions;
    ``all_conditions_step_ratio`` with errors of what is seen too, ``route_step_ratio`` with a route's commands.
    """
    cfg = script.search_cfg() if script.small else preset("paper", script.robot)
    metrics, terrains = time_search(script, "iteration", cfg, 1 if script.small else 10)
    rate = float(np.median([(1.0 - row["idle_share"]) * row["robot_steps"] / row["wall_s"] for row in metrics]))
    rollout = make_rollout(script, len(terrains), cfg.episodes_per_iteration, cfg.replicas)
    crossed = Terrains(genes=terrains, seeds=np.arange(len(terrains)))
    bare = bare_rates(rollout, crossed, rounds=1 if script.small else 5)
    return {
        "num_envs": cfg.episodes_per_iteration,
        "iteration_s_median": float(np.median([row["wall_s"] for row in metrics])),
        "idle_share": float(np.median([row["idle_share"] for row in metrics])),
        "search_share": float(np.median([row["search_s"] / row["wall_s"] for row in metrics])),
        "world_steps_per_s": rate,
        "bare_world_steps_per_s": bare["walking"],
        "bare_world_steps_per_s_standing": bare["standing"],
        "bare_physics_ratio": rate / bare["walking"],
        "bare_physics_ratio_standing": rate / bare["standing"],
        "ground_step_ratio": bare["walking"] / bare["ground"],
        **{f"{name}_step_ratio": 1.0 + rate * (1.0 / bare[name] - 1.0 / bare["observed"]) for name in UNDER},
    }


def time_against(script: Script) -> dict[str, Any]:
    """Robot steps a second of searches without conditions, here over another checkout: ``ratio`` of the medians.

    The interval is that of the mean of the rounds' ratios.
    """
    rounds, iterations = (1, 1) if script.small else (ROUNDS, TIMED)
    flags = ["--robot", script.robot.name, "--device", script.device, *["--small"] * script.small]
    rates, sources = np.zeros((rounds, 2)), ["", ""]
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-c", TIME_CHECKOUT, str(iterations), *flags, "--out", f"{folder}/speed.json"]
        for turn in range(rounds):
            for column, checkout in enumerate((Path.cwd(), Path(script.against or ".").resolve())):
                first = os.pathsep.join([str(checkout), os.environ.get("PYTHONPATH", "")])
                how: Any = {"cwd": checkout, "env": os.environ | {"PYTHONPATH": first}}
                done = subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, **how)
                sources[column], rates[turn, column] = json.loads(done.stdout.splitlines()[-1])
    here, there = np.median(rates, axis=0).tolist()
    of_rounds = {"rates": rates.tolist(), "ratio_interval": t_interval(rates[:, 0] / rates[:, 1])}
    return {"against": {"sources_sha256": sources, "ratio": here / there, **of_rounds}}


def time_wide(script: Script) -> dict[str, Any]:
    """Times of iterations of preset wide by method, and of the paper's four million episodes."""
    numbers = {}
    for method in WIDE:
        cfg = script.search_cfg(method=method, **({} if method == "surrogate" else ONCE))
        metrics, _ = time_search(script, f"wide-{method}", cfg, 5)
        seconds = float(np.median([row["wall_s"] for row in metrics]))
        numbers[method] = {
            "iteration_s_median": seconds,
            "minutes_per_4m_episodes": PAPER_EPISODES / cfg.episodes_per_iteration * seconds / 60,
            "idle_share": float(np.median([row["idle_share"] for row in metrics])),
            "search_share": float(np.median([row["search_s"] / row["wall_s"] for row in metrics])),
        }
    return {"wide": numbers}


def time_curve(script: Script) -> dict[str, Any]:
    """Episodes a second on hard-random terrains by number of robots, each in 20 episodes."""
    counts = (4,) if script.small else CURVE
    return {"envs_curve": [time_crossings(script.robot, count, script.device, script.seed) for count in counts]}


def time_crossings(
    robot: RobotCfg, num_envs: int, device: str, seed: int, *, space: str = SUPER_GAUSSIAN.name, each: int = 20
) -> dict[str, float]:
    """Episodes a second on hard-random terrains of a space, with ``each`` episodes a robot."""
    num_terrains = max(1, num_envs * each // REPLICAS)
    drawn = load_space(space)
    genes = drawn.hard_random(num_terrains, seed)
    compute, policy = Compute(device, workers="1", num_envs=num_envs), str(robot.policy_file)
    sizes: Any = {"num_terrains": max(1, num_terrains * 4 // each), "replicas": REPLICAS}
    with open_pipeline(PipelineCfg(compute=compute, robot=robot, policy=policy, space=space, **sizes)) as evaluate:
        result = evaluate(Terrains(genes=genes, seeds=np.arange(num_terrains, dtype=np.uint32), space=drawn))
    rate = result.outcome.size / result.wall_s
    return {"num_envs": num_envs, "episodes_per_s": rate, "idle_share": result.idle_share}


def time_standing(script: Script) -> dict[str, Any]:
    """Bare physics of robots that stand on level ground, ours and mujoco_warp's, by number of robots."""
    counts = (4,) if script.small else CURVE[1:]
    rows = [standing_rates(make_rollout(script, 1, count, count)) for count in counts]
    return {"flat": [row for row in rows if row is not None]}


def time_kernels(script: Script) -> dict[str, Any]:
    """Shares of a control step's kernels in hard-random crossings; needs a GPU."""
    num_terrains = PROFILED // REPLICAS
    rollout = make_rollout(script, num_terrains, PROFILED, REPLICAS)
    genes = SUPER_GAUSSIAN.hard_random(num_terrains, script.seed)
    shares = kernel_shares(rollout, Terrains(genes=genes, seeds=np.arange(num_terrains)))
    return {"kernels_num_envs": PROFILED, "kernels": shares}


def training_rates(script: Script, device: str) -> dict[str, Any]:
    """PPO's environment steps a second with learning on a device, from train_speed.json of today's sources.

    Rates of several GPUs may be of another host. Each row of ``training`` has its command, commit and date.
    """
    rows = script.read_so_far(script.out.with_name("train_speed.json")).get("rows", [])
    known = [row for row in rows if row["device"] == device or row["gpus"] > 1]
    rates = {(row.get("peer", "")[:5], row["gpus"], row["num_envs"]): row["train_env_steps_per_s"] for row in known}
    keys = {("", 1, 4096): "", ("", 1, 8192): "_8192", ("", 2, 8192): "_2gpu", ("mjlab", 1, 4096): "_mjlab"}
    return {f"train_env_steps_per_s{key}": rates.get(row) for row, key in keys.items()} | {"training": rows}


ON_GPU: dict[str, Callable[[Script], dict[str, Any]]] = {
    "curve": time_curve,
    "iteration": time_iteration,
    "wide": time_wide,
    "flat": time_standing,
    "kernels": time_kernels,
}
IN_TRIAL = ("curve", "iteration", "flat")
"""Parts that a trial on a CPU measures too."""


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Measures all, or the parts that are named beside what is there."""
    help_against = "folder of another checkout, whose searches alone are measured beside this one's"
    script = parse(__doc__, argv, "speed.json", parts=tuple(ON_GPU), against=help_against)
    parts = ON_GPU
    if script.against is not None:
        parts = {"against": time_against}
    elif script.parts or script.small:
        parts = {name: ON_GPU[name] for name in script.parts or IN_TRIAL}
    numbers: dict[str, Any] = {}
    for measure in parts.values():
        numbers |= measure(script)
    stored = script.read_so_far(script.out)
    origin = {name: script.origin[name] for name in ("commit", "device", "date")}
    measured = stored.get("measured", {}) | {name: origin for name in parts}
    report: dict[str, Any] = dict.fromkeys(KEYS) | stored | script.origin | numbers | {"measured": measured}
    return script.add(report, training_rates(script, script.origin["device"]))


if __name__ == "__main__":
    main()
