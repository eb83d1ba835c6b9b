"""How fast the search runs beside the bare physics it is made of.

The iterations timed are those of a real search, ask to saved checkpoint, in a directory that is thrown away. The bare
rates are measured right after, on the terrains of the last of them, with as many environments and the same solver.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qd.run.arguments import evaluator_of
from qd.run.directory import Metrics, RunDirectory
from qd.run.progress import ProgressBar
from qd.run.settings import SearchCfg, as_settings, changed, own_policy, policy_spec, preset
from qd.search import begin, search_terrains
from qd.workers.evaluator import EvaluatorCfg, build_rollout, episode_seeds, open_evaluator, resolve_device
from sim.files.atomic import read_json
from sim.files.command import OfRobot, OnDevice, publish, show_json
from sim.files.records import identity, provenance
from sim.files.settings import check, setting

if TYPE_CHECKING:
    from qd.scheduler import Scheduler

_WARM_UP = 2
_CURVE_REPLICAS = 20
_EPISODES_A_ROBOT = 20
_PAPER_EPISODES = 4_000_000  # of the paper's search


@dataclass(frozen=True, kw_only=True)
class Speed(OfRobot, OnDevice):
    """Time a preset's iteration, the bare physics of the same crossings, and episodes a second over env counts.

    The bare rate is that of contacts and solver alone. `walking` replays the crossings' own motion from recorded states
    and joint targets. `standing` holds the default pose at the start. `ground_step_ratio` is what such a step costs on
    ground with friction and softness of its own over what it costs without.
    """

    preset: str = "paper"
    """Whose iteration is timed."""
    run: Path | None = None
    """Time the last iterations of this run, made on this GPU, instead of running a search for it."""
    iterations: int = setting(20, least=1)
    """Iterations timed, after two that are not."""
    steps: int = setting(1000, least=1)
    """Physics steps of the bare measurement."""
    curve: tuple[int, ...] = setting((1024, 2048, 4096, 8192, 16384, 32768), least=1)
    """Numbers of robots of the curve. Each robot runs 20 episodes. Give none to leave the curve out."""
    kernels: tuple[int, ...] = setting((), least=1)
    """Numbers of robots with which every kernel of a control step is timed, on a GPU."""
    wide: Path | None = None
    """Run of preset wide, made on this GPU, whose iterations are reported too."""
    before: Path | None = None
    """speed.json of another commit, made on this GPU. Its curve is written beside the new one."""
    train_speed: tuple[Path, ...] = ()
    """Outputs of `faultline train-speed`, on one and on two GPUs. Their rates are copied."""
    timeline: Path | None = None
    """Draw into this file which robot ran which episode when, with and without the queue. The terrains are elites of
    --run, or else hard-random ones. Nothing is timed."""
    out: Path | None = None
    """Where to write; printed alone if left out."""

    def execute(self) -> None:
        """Times and publishes."""
        if self.timeline is not None:
            from qd.show.timeline import draw_timeline

            draw_timeline(self.timeline, self.robot or "anymal", self.run, resolve_device(self.device))
            return
        publish(self.out, lambda: measure(self), show_json)


def time_iterations(cfg: SearchCfg, evaluator: EvaluatorCfg) -> tuple[Metrics, NDArray[Any]]:
    """Runs a search from the start; its metrics rows, and the terrains it would ask for next."""
    search, metrics = begin(cfg, evaluator.device)
    with (
        tempfile.TemporaryDirectory() as folder,
        open_evaluator(evaluator) as evaluate,
        ProgressBar(cfg.iterations, 0) as bar,
    ):
        search_terrains(cfg, RunDirectory(Path(folder)), search, metrics, evaluate, bar)
    return metrics, _asked(cfg, search)


def _asked(cfg: SearchCfg, search: "Scheduler") -> NDArray[Any]:
    return np.concatenate([search.ask(group) for group in range(cfg.scheduler.groups)])


def read_iterations(folder: Path, count: int, device_name: str) -> tuple[SearchCfg, Metrics, NDArray[Any]]:
    """Settings of a run, metrics rows of its last iterations, and the terrains it would ask for next.

    Args:
        folder: Run directory.
        count: Iterations wanted.
        device_name: What the run must have been made on.

    Raises:
        ValueError: If the run is damaged, too short, or of another device.
    """
    run = RunDirectory(folder)
    cfg = run.read_cfg()
    _refuse_another_device(run, "--run", device_name)
    search, metrics = run.load(cfg) or (None, [])
    if search is None or len(metrics) < count + _WARM_UP:
        raise ValueError(f"--run {folder} must have at least {count + _WARM_UP} iterations, got {len(metrics)}")
    return cfg, metrics[-count:], _asked(cfg, search)


def _refuse_another_device(run: RunDirectory, flag: str, device_name: str) -> None:
    made_on = run.read_config()["device"]
    if made_on != device_name:
        raise ValueError(
            f"{flag} {run.path} was made on {made_on}, the rates beside it would be those of {device_name}"
        )


def wide_numbers(folder: Path, device_name: str) -> dict[str, float | None]:
    """What a search of preset wide takes, over all its iterations but the first two.

    Raises:
        ValueError: If the run is of another preset or device, damaged, or too short.
    """
    run = RunDirectory(folder)
    cfg = run.read_cfg()
    if cfg.preset != "wide":
        raise ValueError(f"--wide {folder} must be a run of preset wide, got one of {cfg.preset}")
    _refuse_another_device(run, "--wide", device_name)
    metrics = run.read_metrics()[_WARM_UP:]
    if not metrics:
        raise ValueError(f"--wide {folder} must have more than {_WARM_UP} iterations, got {run.iterations_done()}")
    wall_s = sum(row["wall_s"] for row in metrics)
    waited = sum(row["idle_share"] * row["robot_steps"] for row in metrics)
    return {
        "iterations": len(metrics),
        "iteration_s_median": float(np.median([row["wall_s"] for row in metrics])),
        "idle_share": waited / sum(row["robot_steps"] for row in metrics),
        "search_share": search_share(metrics),
        "minutes_per_4m_episodes": _PAPER_EPISODES / (len(metrics) * cfg.episodes_per_iteration) * wall_s / 60,
    }


def search_share(metrics: Metrics) -> float | None:
    """Share of an iteration in which the search learns and asks, the median; None if a run of before did not say."""
    shares = [row["search_s"] / row["wall_s"] for row in metrics if "search_s" in row]
    return float(np.median(shares)) if shares else None


def time_curve(evaluator: EvaluatorCfg, terrains: NDArray[Any], counts: tuple[int, ...]) -> list[dict[str, float]]:
    """Episodes a second over numbers of robots, each of which runs 20 episodes; terrains repeated as needed."""
    rows = []
    for count in counts:
        num_terrains = max(1, count * _EPISODES_A_ROBOT // _CURVE_REPLICAS)
        at_once = -(-num_terrains // 5)  # four episodes a robot under way, by halves
        genes = terrains[np.arange(num_terrains) % len(terrains)]
        seeds = np.arange(num_terrains, dtype=np.uint32)
        sizes = {"num_envs": count, "num_terrains": at_once, "num_replicas": _CURVE_REPLICAS}
        with open_evaluator(replace(evaluator, **sizes)) as evaluate:
            result = evaluate(genes, seeds)
        rows.append(
            {
                "num_envs": count,
                "episodes_per_s": result.outcome.size / result.wall_s,
                "world_steps_per_s": result.robot_steps / result.wall_s,
                "idle_share": result.idle_share,
            }
        )
        rate, idle = rows[-1]["episodes_per_s"], rows[-1]["idle_share"]
        print(f"  {count:>6} robots: {rate:,.0f} episodes/s, {idle:.1%} idle", flush=True)
    return rows


def kernel_shares(evaluator: EvaluatorCfg, terrains: NDArray[Any], num_envs: int) -> dict[str, Any]:
    """:func:`sim.bench.physics.profile_kernels` of so many robots' crossings; terrains repeated as needed."""
    from sim.bench.physics import profile_kernels

    num_terrains = -(-num_envs // _CURVE_REPLICAS)
    sizes = {"num_envs": num_envs, "num_terrains": num_terrains, "num_replicas": _CURVE_REPLICAS}
    rollout: Any = build_rollout(replace(evaluator, **sizes), num_terrains)
    rollout.put(terrains[np.arange(num_terrains) % len(terrains)], np.arange(num_terrains, dtype=np.uint32))
    return {"num_envs": num_envs, "kernels": profile_kernels(rollout)}


def training_rates(files: tuple[Path, ...]) -> dict[str, float | None]:
    """PPO's env-steps a second with learning, as `faultline train-speed` wrote them; None where it did not run."""
    rate = dict[tuple[int, int], float]()
    for file in files:
        try:
            rows = read_json(file)["training"]
            rate |= {(row["gpus"], row["num_envs"]): float(row["train_env_steps_per_s"]) for row in rows}
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(
                f"{file} must be the output of faultline train-speed, but: {error}: give its --out"
            ) from None
    return {
        "train_env_steps_per_s": rate.get((1, 4096)),
        "train_env_steps_per_s_8192": rate.get((1, 8192)),
        "train_env_steps_per_s_2gpu": rate.get((2, 8192)),
    }


def measure(args: Speed) -> dict[str, Any]:
    """Everything of ``speed.json``.

    Raises:
        ValueError: If a flag's value cannot be used.
    """
    from sim.bench.physics import measure_bare_physics, measure_ground
    from sim.robots.robot import get_robot, robot_of

    check(args)
    robot, device = get_robot(args.robot or "anymal"), resolve_device(args.device)
    name = provenance(device, 0)["device"]
    training = training_rates(args.train_speed)
    before = None if args.before is None else _curve_of(args.before, name)
    wide = None if args.wide is None else wide_numbers(args.wide, name)
    if (args.run or args.kernels) and not device.startswith("cuda"):
        raise ValueError(f"--run and --kernels need a CUDA device, got {device}")
    if args.run is not None:
        cfg, metrics, terrains = read_iterations(args.run, args.iterations, name)
        robot = robot_of(as_settings(cfg), args.robot, args.run)
        policy = own_policy(args.run, cfg, robot)
    else:
        cfg = changed(preset(args.preset, robot), {"iterations": args.iterations + _WARM_UP})
        policy, metrics, terrains = policy_spec(cfg, robot), [], None
    # In one process, as bare physics is measured.
    evaluator = evaluator_of(cfg, robot, policy, device, "1")
    if terrains is None:
        metrics, terrains = time_iterations(cfg, evaluator)
        metrics = metrics[_WARM_UP:]
    num_envs = cfg.episodes_per_iteration
    rollout: Any = build_rollout(replace(evaluator, num_envs=num_envs), evaluator.num_terrains)
    seeds = episode_seeds(cfg.seed, cfg.iterations, len(terrains))
    bare = measure_bare_physics(rollout, terrains, seeds, steps=args.steps)
    ground = measure_ground(rollout, terrains, seeds, steps=args.steps)
    del rollout
    rates = [row["robot_steps"] / row["wall_s"] for row in metrics]
    running = [(1.0 - row["idle_share"]) * rate for row, rate in zip(metrics, rates, strict=True)]
    return {
        **provenance(device, cfg.seed),
        **identity(robot, policy),
        "preset": args.preset if args.run is None else None,
        "run": None if args.run is None else str(args.run),
        "num_envs": num_envs,
        "iteration_s_median": float(np.median([row["wall_s"] for row in metrics])),
        "idle_share": float(np.median([row["idle_share"] for row in metrics])),
        "search_share": search_share(metrics),
        "bare_physics_ratio": float(np.median(rates)) / bare.walking,
        "bare_physics_ratio_standing": float(np.median(rates)) / bare.standing,
        "world_steps_per_s": float(np.median(rates)),
        "running_world_steps_per_s": float(np.median(running)),
        "bare_world_steps_per_s": bare.walking,
        "bare_world_steps_per_s_standing": bare.standing,
        "ground_step_ratio": ground,
        **training,
        "envs_curve": time_curve(evaluator, terrains, args.curve) or None,
        "before": before,
        "wide": wide,
        "kernels": [kernel_shares(evaluator, terrains, count) for count in args.kernels] or None,
    }


def _curve_of(file: Path, device_name: str) -> dict[str, Any]:
    """Commit, date and curve of a speed.json.

    Raises:
        ValueError: If it is none, or of another device.
    """
    found = read_json(file)
    if not isinstance(found.get("envs_curve"), list) or found.get("device") != device_name:
        raise ValueError(
            f"--before {file} must be a speed.json with a curve of {device_name}, got one of {found.get('device')}"
        )
    return {key: found.get(key) for key in ("commit", "date", "envs_curve")}
