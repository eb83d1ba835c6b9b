"""How fast the search runs beside the bare physics it is made of.

The iterations timed are those of a real search, ask to saved checkpoint, in a directory that is thrown away. The bare
rates are measured right after, on the terrains of the last of them, with as many environments and the same solver.
"""

import tempfile
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

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
from sim.files.provenance import provenance
from sim.files.settings import check, setting
from sim.robots.identity import identity

_WARM_UP = 2
_CURVE_REPLICAS = 16


@dataclass(frozen=True, kw_only=True)
class Speed(OfRobot, OnDevice):
    """Time a preset's iteration, the bare physics of the same crossings, and episodes a second over env counts.

    The bare rate is that of contacts and solver alone: `walking` in the crossings' own motion, replayed from recorded
    states and joint targets, and `standing` holding the default pose at the start.
    """

    preset: str = "paper"
    """Whose iteration is timed."""
    run: Path | None = None
    """Time the last iterations of this run, made on this GPU, instead of running a search for it."""
    iterations: int = setting(20, least=1)
    """Iterations timed, after two that are not."""
    steps: int = setting(1000, least=1)
    """Physics steps of the bare measurement."""
    curve: tuple[int, ...] = (1024, 2048, 4096, 8192, 16384, 32768)
    """Numbers of environments of the curve, multiples of 16; none to leave it out."""
    train_speed: Path | None = None
    """Output of `faultline train-speed`, whose rates are taken over."""
    out: Path | None = None
    """Where to write; printed alone if left out."""

    def execute(self) -> None:
        """Times and publishes."""
        publish(self.out, lambda: measure(self), show_json)


def time_iterations(cfg: SearchCfg, evaluator: EvaluatorCfg) -> tuple[Metrics, NDArray[Any]]:
    """Runs a search from the start; its metrics rows, and the terrains of its last iteration."""
    search, metrics, crossed = begin(cfg), list[dict[str, Any]](), list[NDArray[Any]]()
    with (
        tempfile.TemporaryDirectory() as folder,
        open_evaluator(evaluator) as evaluate,
        ProgressBar(cfg.iterations, 0) as bar,
    ):

        def remembering(terrains: NDArray, seeds: NDArray, progress: Any = None) -> Any:
            crossed[:] = [terrains]
            return evaluate(terrains, seeds, progress)

        search_terrains(cfg, RunDirectory(Path(folder)), search, metrics, remembering, bar)
    return metrics, crossed[0]


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
    cfg, made_on = run.read_cfg(), run.read_config()["device"]
    if made_on != device_name:
        raise ValueError(f"--run {folder} was made on {made_on}, the bare rate would be that of {device_name}")
    search, metrics = run.load(cfg) or (None, [])
    if search is None or len(metrics) < count + _WARM_UP:
        raise ValueError(f"--run {folder} must have at least {count + _WARM_UP} iterations, got {len(metrics)}")
    return cfg, metrics[-count:], search.ask()


def time_curve(evaluator: EvaluatorCfg, terrains: NDArray[Any], counts: tuple[int, ...]) -> list[dict[str, float]]:
    """Episodes a second of one evaluation over numbers of environments, terrains repeated as needed."""
    rows = []
    for count in counts:
        num_terrains = count // _CURVE_REPLICAS
        genes = terrains[np.arange(num_terrains) % len(terrains)]
        seeds = np.arange(num_terrains, dtype=np.uint32)
        with open_evaluator(replace(evaluator, num_terrains=num_terrains, num_replicas=_CURVE_REPLICAS)) as evaluate:
            result = evaluate(genes, seeds)
        rows.append(
            {
                "num_envs": count,
                "episodes_per_s": count / result.wall_s,
                "world_steps_per_s": count * result.physics_steps / result.wall_s,
            }
        )
        print(f"  {count:>6} environments: {rows[-1]['episodes_per_s']:,.0f} episodes/s", flush=True)
    return rows


def training_rates(file: Path | None) -> dict[str, float | None]:
    """PPO's env-steps a second with learning, as `faultline train-speed` wrote them; None where it did not run."""
    try:
        rows = read_json(file)["training"] if file else []
        rate = {row["num_envs"]: float(row["train_env_steps_per_s"]) for row in rows}
    except (KeyError, TypeError, ValueError) as error:
        raise ValueError(f"{file} must be the output of faultline train-speed, but: {error}: give its --out") from None
    return {"train_env_steps_per_s": rate.get(4096), "train_env_steps_per_s_8192": rate.get(8192)}


def measure(args: Speed) -> dict[str, Any]:
    """Everything of ``speed.json``.

    Raises:
        ValueError: If something asked for cannot be had.
    """
    from sim.bench.physics import measure_bare_physics
    from sim.robots.robot import get_robot, robot_of

    check(args)
    if any(count < 1 or count % _CURVE_REPLICAS for count in args.curve):
        raise ValueError(f"curve must be multiples of {_CURVE_REPLICAS}, got {args.curve}")
    robot, device = get_robot(args.robot or "anymal"), resolve_device(args.device)
    training = training_rates(args.train_speed)
    if args.run is not None:
        if not device.startswith("cuda"):
            raise ValueError(f"--run needs a CUDA device, got {device}: a run on the CPU has several workers")
        cfg, metrics, terrains = read_iterations(args.run, args.iterations, provenance(device, 0)["device"])
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
    rollout: Any = build_rollout(evaluator, evaluator.num_terrains)
    seeds = episode_seeds(cfg.seed, cfg.iterations, len(terrains))
    bare = measure_bare_physics(rollout, terrains, seeds, steps=args.steps)
    del rollout
    rates = [num_envs * row["physics_steps"] / row["wall_s"] for row in metrics]
    running = [num_envs * row["mean_duration_s"] / robot.physics_dt / row["wall_s"] for row in metrics]
    return {
        **provenance(device, cfg.seed),
        **identity(robot, policy),
        "preset": args.preset if args.run is None else None,
        "run": None if args.run is None else str(args.run),
        "num_envs": num_envs,
        "iteration_s_median": float(np.median([row["wall_s"] for row in metrics])),
        "bare_physics_ratio": float(np.median(rates)) / bare.walking,
        "bare_physics_ratio_standing": float(np.median(rates)) / bare.standing,
        "world_steps_per_s": float(np.median(rates)),
        "running_world_steps_per_s": float(np.median(running)),
        "bare_world_steps_per_s": bare.walking,
        "bare_world_steps_per_s_standing": bare.standing,
        **training,
        "envs_curve": time_curve(evaluator, terrains, args.curve) or None,
    }
