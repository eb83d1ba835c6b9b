"""How fast the search runs beside the bare physics it is made of, and what else is quoted of speed: speed.json.

The iterations timed are those of a real search, ask to saved checkpoint. Bare rates are measured right after, on the
terrains that it asks for next, with as many robots and the same solver. Steps count of robots that have an episode:
nothing is computed for those that wait.

The file is written after each part. A part that today's sources and packages have on this device is not measured
again; parts of another GPU are dropped. On the CPU there is one, which joins those of any GPU.
"""

import shutil
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from importlib.util import find_spec
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
import warp as wp
from numpy.typing import NDArray

from qd.search.archive import read_archive
from qd.search.directory import Metrics, RunDirectory
from qd.search.fitness import FAILING_GOAL_RATE
from qd.search.loop import search
from qd.search.scheduler import Scheduler
from qd.search.settings import SearchCfg, preset
from qd.workers.cross import Crossings
from qd.workers.evaluator import EvaluatorCfg, build_rollout, episode_seeds, open_evaluator
from results.make.agreement import compare, cross_in_all_ways
from results.make.bare import bare_rates, kernel_shares, standing_rates
from results.make.common import ONCE, Script, parse
from sim.robots.robot import RobotCfg
from sim.rollout import Rollout
from sim.terrains.spaces.registry import SUPER_GAUSSIAN, load_space

WARM_UP = 2
WIDE = ("surrogate", "cma_mae+map_elites")
CURVE = (1024, 4096, 32768)
REPLICAS = 20
PROFILED = 22_400
"""Robots whose kernels are timed: as many as a search of preset wide has."""
PAPER_EPISODES = 4_000_000
KEYS = ("iteration_s_median", "bare_physics_ratio", "world_steps_per_s", "ground_step_ratio", "conditions_step_ratio",
        "envs_curve", "wide", "flat", "kernels", "agreement", "cpu")  # fmt: skip
"""What others read: null until it is measured."""


def time_search(script: Script, name: str, cfg: SearchCfg, iterations: int) -> tuple[Metrics, NDArray[np.float32]]:
    """Metrics rows of some iterations of a new search after the first two, and the terrains that it asks for next."""
    path = script.runs / "speed" / name
    shutil.rmtree(path, ignore_errors=True)
    cfg = replace(cfg, iterations=iterations + WARM_UP)
    search(cfg, path, script.compute)
    saved = RunDirectory(path).load(cfg)
    assert saved is not None
    scheduler, metrics = saved
    return metrics[WARM_UP:], np.concatenate([scheduler.ask(group) for group in range(cfg.scheduler.num_groups)])


def rollout_of(script: Script, num_terrains: int, num_envs: int, replicas: int) -> Rollout:
    """A simulation of the shipped controller in this process."""
    cfg = EvaluatorCfg(
        robot=script.robot, policy=script.policy, num_terrains=num_terrains, num_replicas=replicas,
        device=script.device, workers="1", num_envs=num_envs,
    )  # fmt: skip
    rollout = build_rollout(cfg, num_terrains)
    assert isinstance(rollout, Rollout)
    return rollout


def time_iteration(script: Script) -> dict[str, Any]:
    """The paper's iteration beside bare physics on the same crossings.

    ``conditions_step_ratio`` is a step of the search with what conditions add to one, over a step without.
    """
    cfg = script.search_cfg() if script.small else preset("paper", script.robot)
    metrics, terrains = time_search(script, "iteration", cfg, 1 if script.small else 10)
    rate = float(np.median([(1.0 - row["idle_share"]) * row["robot_steps"] / row["wall_s"] for row in metrics]))
    rollout = rollout_of(script, len(terrains), cfg.episodes_per_iteration, cfg.replicas)
    bare = bare_rates(rollout, terrains, np.arange(len(terrains), dtype=np.uint32), rounds=1 if script.small else 3)
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
        "conditions_step_ratio": 1.0 + rate * (1.0 / bare["conditions"] - 1.0 / bare["ground"]),
    }


def time_wide(script: Script) -> dict[str, Any]:
    """Iterations of preset wide by method, and what the paper's four million episodes take by them."""
    numbers = {}
    for method in WIDE:
        cfg = script.search_cfg(method=method, **({} if method == "surrogate" else ONCE))
        with remembering() as asked:
            metrics, _ = time_search(script, f"wide-{method}", cfg, 5)
        seconds = float(np.median([row["wall_s"] for row in metrics]))
        numbers[method] = {
            "iteration_s_median": seconds,
            "minutes_per_4m_episodes": PAPER_EPISODES / cfg.episodes_per_iteration * seconds / 60,
            "idle_share": float(np.median([row["idle_share"] for row in metrics])),
            "search_share": float(np.median([row["search_s"] / row["wall_s"] for row in metrics])),
        }
        if method == "surrogate":  # what it costs beyond its crossings
            again = cross_again(script, cfg, asked[: -2 * cfg.scheduler.num_groups])
            numbers[method]["crossings_s_median"] = float(np.median(again))
    return {"wide": numbers}


@contextmanager
def remembering() -> Iterator[list[NDArray[np.float32]]]:
    """The terrains that searches ask for, lot by lot; at the end those of two iterations that are not crossed."""
    asked, ask = [], Scheduler.ask

    def remember(self: Scheduler, group: int = 0, *, new: bool = True) -> NDArray[np.float32]:
        asked.append(ask(self, group, new=new))
        return asked[-1]

    with patch.object(Scheduler, "ask", remember):
        yield asked


def cross_again(script: Script, cfg: SearchCfg, lots: list[NDArray[np.float32]]) -> list[float]:
    """Seconds of each iteration after the first two, of a search's crossings without the search.

    Lots of the first iteration are left out, in which nothing can be crossed again; later ones are equal.
    """
    num_groups, num_terrains = cfg.scheduler.num_groups, cfg.scheduler.num_terrains
    iterations, lots = range(2, len(lots) // num_groups + 1), lots[num_groups:]
    seeds = np.concatenate([episode_seeds(cfg.seed, iteration, num_terrains) for iteration in iterations])
    evaluator = EvaluatorCfg(
        robot=script.robot, policy=script.policy, num_terrains=num_terrains, num_replicas=cfg.replicas,
        lots=num_groups, device=script.device, workers="1",
    )  # fmt: skip
    with open_evaluator(evaluator) as pipeline:
        lots_ended = [time.perf_counter() for _ in pipeline.in_lots(np.concatenate(lots), seeds, len(lots[0]))]
    return np.diff(lots_ended[num_groups - 1 :: num_groups])[WARM_UP - 2 :].tolist()


def time_curve(script: Script) -> dict[str, Any]:
    """Episodes a second on hard-random terrains over numbers of robots, each of which runs 20 episodes."""
    counts = (4,) if script.small else CURVE
    return {"envs_curve": [time_crossings(script.robot, count, script.device, script.seed) for count in counts]}


def time_crossings(
    robot: RobotCfg, num_envs: int, device: str, seed: int, *, space: str = SUPER_GAUSSIAN.name, each: int = 20
) -> dict[str, float]:
    """Episodes a second of robots that cross hard-random terrains of a space, by ``each`` episodes a robot."""
    num_terrains = max(1, num_envs * each // REPLICAS)
    genes = load_space(space).hard_random(num_terrains, seed)
    cfg = EvaluatorCfg(
        robot=robot, policy=str(robot.policy_file), num_terrains=max(1, num_terrains * 4 // each), space=space,
        num_replicas=REPLICAS, num_envs=num_envs, device=device, workers="1",
    )  # fmt: skip
    with open_evaluator(cfg) as evaluate:
        result = evaluate(genes, np.arange(num_terrains, dtype=np.uint32))
    rate = result.outcome.size / result.wall_s
    return {"num_envs": num_envs, "episodes_per_s": rate, "idle_share": result.idle_share}


def time_standing(script: Script) -> dict[str, Any]:
    """Bare physics of robots that stand on level ground beside mujoco_warp's own, over numbers of robots."""
    counts = (4,) if script.small else CURVE[1:]
    rows = [standing_rates(rollout_of(script, 1, count, count)) for count in counts]
    return {"flat": [row for row in rows if row is not None]}


def time_kernels(script: Script) -> dict[str, Any]:
    """Shares of a control step's kernels in hard-random crossings; on a GPU alone."""
    num_terrains = PROFILED // REPLICAS
    rollout = rollout_of(script, num_terrains, PROFILED, REPLICAS)
    genes = SUPER_GAUSSIAN.hard_random(num_terrains, script.seed)
    shares = kernel_shares(rollout, genes, np.arange(num_terrains, dtype=np.uint32))
    return {"kernels_num_envs": PROFILED, "kernels": shares}


def measure_agreement(script: Script) -> dict[str, Any]:
    """Agreement with finer physics and MuJoCo C on a few hard-random terrains, so that no rate stands without it."""
    terrains, episodes = 1 if script.small else 40, 10
    genes = SUPER_GAUSSIAN.hard_random(terrains, script.seed)
    with Crossings(script.robot, script.compute, cache=script.runs / "crossings") as crossings:
        outcome = cross_in_all_ways(script, crossings, "hard-random", genes, SUPER_GAUSSIAN.name, episodes=episodes)
    return {"agreement": {"episodes": episodes, **compare(outcome, np.arange(terrains), script.seed)}}


def time_cpu(script: Script) -> dict[str, Any]:
    """What a user without a GPU waits for: the whole archive command of preset small, whose kernels are compiled."""
    run, kernels = script.runs / "speed" / "cpu", Path(str(wp.config.kernel_cache_dir))
    words = ("archive", "--robot", script.robot.name, "--preset", "small", "--device", "cpu", "--run-dir", str(run))
    for _ in range(2):
        shutil.rmtree(run, ignore_errors=True)
        compiled, began = set(kernels.iterdir()), time.perf_counter()
        subprocess.run([sys.executable, "-m", "faultline", *words], check=True)
        wall_s = time.perf_counter() - began
        if compiled == set(kernels.iterdir()):
            break  # else the first run compiled some
    view, archive = time_view(script.robot.name, script.runs / "speed"), read_archive(run)
    found = {"elites": len(archive), "failing_as_found": int((archive.goal_rate < FAILING_GOAL_RATE).sum())}
    return {"cpu": {**script.origin, "archive_wall_s": wall_s, **found, **view}}


def time_view(robot: str, folder: Path) -> dict[str, float | None]:
    """What a user waits for from `faultline view` to the page and to a failure that plays in it, with warm kernels.

    The archive is the published one, no recording of it is stored, and a browser without a screen opens the page.
    """
    browser_file = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
    if browser_file is None or find_spec("playwright") is None:
        return {"view_to_page_s": None, "view_to_failure_s": None}
    from playwright.sync_api import sync_playwright

    cache = folder / "recordings"
    shutil.rmtree(cache, ignore_errors=True)
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = str(free.getsockname()[1])
    words = ("view", "--run", f"results/{robot}/archive", "--port", port, "--cache", str(cache))
    with sync_playwright() as started:
        flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
        page = started.chromium.launch(executable_path=browser_file, args=flags).new_page()
        began = time.perf_counter()
        with subprocess.Popen([sys.executable, "-m", "faultline", *words], stdout=subprocess.PIPE, text=True) as server:
            assert server.stdout is not None
            next(line for line in server.stdout if line.startswith("Open "))
            served_s = time.perf_counter() - began
            page.goto(f"http://127.0.0.1:{port}")
            page.wait_for_function("document.querySelector('#faultline [aria-label=Pause]')", timeout=300_000)
            plays_s = time.perf_counter() - began
            server.terminate()
            server.communicate()
    return {"view_to_page_s": served_s, "view_to_failure_s": plays_s}


def training_rates(script: Script, device: str) -> dict[str, Any]:
    """PPO's environment steps a second with learning on a device, as train_speed.py wrote them with today's sources.

    Those of several GPUs are of a host that has them, whose GPUs may be others. Each row of ``training`` has command,
    commit and date of its own.
    """
    rows = script.read_so_far(script.out.with_name("train_speed.json")).get("rows", [])
    rates = {(row.get("peer", "")[:5], row["gpus"], row["num_envs"]): row["train_env_steps_per_s"] for row in rows
             if row["device"] == device or row["gpus"] > 1}  # fmt: skip
    keys = {("", 1, 4096): "", ("", 1, 8192): "_8192", ("", 2, 8192): "_2gpu", ("mjlab", 1, 4096): "_mjlab"}
    return {f"train_env_steps_per_s{key}": rates.get(row) for row, key in keys.items()} | {"training": rows}


PARTS: dict[str, Callable[[Script], dict[str, Any]]] = {
    "curve": time_curve, "iteration": time_iteration, "wide": time_wide, "flat": time_standing,
    "kernels": time_kernels, "agreement": measure_agreement, "cpu": time_cpu,
}  # fmt: skip
ON_GPU = ("wide", "kernels")
"""Parts that take a GPU, in a trial too."""


def parts_here(script: Script) -> list[str]:
    """The parts that a device can measure; in a trial a CPU makes most of a GPU's."""
    if script.small and script.device == "cpu":
        return [part for part in PARTS if part not in (*ON_GPU, "cpu")]
    return [part for part in PARTS if (part == "cpu") == (script.device == "cpu")]


def report_so_far(script: Script, part: str) -> dict[str, Any]:
    """What the file says that may stand beside a part that is measured now; ``measured`` are the parts that it has."""
    report = script.read_so_far(script.out)
    measured, of_cpu = report.get("measured", {}), report.get("cpu") or {}
    made_here = all(
        (of_cpu if part == "cpu" else report).get(name) == script.origin[name] for name in ("device", "versions")
    )
    if not made_here and part == "cpu":
        measured = {name: made for name, made in measured.items() if name != "cpu"}
    elif not made_here:
        measured = {name: made for name, made in measured.items() if name == "cpu"}
        report = {"cpu": of_cpu} if of_cpu else {}
    return report | {"measured": measured}


def main(argv: Sequence[str] | None = None) -> dict[str, Any]:
    """Measures the parts that are missing."""
    script = parse(__doc__, argv, "speed.json", parts=tuple(PARTS))
    possible, report = parts_here(script), dict[str, Any]()
    if not set(script.parts) <= set(possible):
        raise ValueError(f"parts must be of {', '.join(possible)} on {script.device}, got {', '.join(script.parts)}")
    for part in script.parts or possible:
        report = report_so_far(script, part)
        if part not in report["measured"]:
            numbers = PARTS[part](script)
            report = report_so_far(script, part)  # another part may have been written meanwhile
            report = {**script.origin, **report} if part == "cpu" else {**report, **script.origin}
            report |= numbers
            report["measured"][part] = {name: script.origin[name] for name in ("commit", "device", "date")}
        report = script.add(dict.fromkeys(KEYS) | report, training_rates(script, report["device"]))
    return report


if __name__ == "__main__":
    main()
