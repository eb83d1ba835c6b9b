"""What a command line of the search means: a new run, or an old one that goes on."""

import itertools
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from qd.next_commands import Placed, next_command
from qd.run_directory import CONFIG_FILE, RunDirectory, differences, numbered
from qd.settings import (
    SearchCfg,
    Settings,
    as_settings,
    changed,
    file_hash,
    kept_penalties,
    measured_now,
    policy_spec,
    preset,
)
from qd.workers import EvaluatorCfg, check_policy, origin_of, resolve_device
from sim.files import is_leftover

if TYPE_CHECKING:
    from sim.robot import RobotCfg

_RUNS = Path("runs")


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Search the terrains on which a controller fails, each in its own way.

    Every iteration asks CMA-MAE for terrains, lets robots cross them, and files each terrain by the proportions of what
    went wrong. State is saved after every iteration: stop with Ctrl-C whenever you like and go on with --resume.
    """

    robot: str | None = None
    """Which robot: anymal, unless resuming."""
    preset: str | None = None
    """Size of the search: paper (a GPU's work) or small (minutes on a CPU); by default what the device can do."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    iterations: int | None = None
    """Iterations to reach; with --resume, more than before extend a finished run."""
    policy: str | None = None
    """Controller other than the shipped one: an rsl_rl checkpoint, a TorchScript or ONNX file, or module:callable."""
    seed: int | None = None
    """Seed of everything drawn; 0."""
    resume: Path | None = None
    """Go on with the run in this directory."""
    run_dir: Path | None = None
    """Directory of a new run; runs/<robot>-<preset>-<seed>, numbered if that exists."""
    replicas: int | None = None
    """Episodes a terrain."""
    method: str | None = None
    """Where terrains come from: cma_mae, cma_me, map_elites, directions, hard_random, uniform_random, joined by +."""
    emitters: int | None = None
    """Emitters."""
    batch_size: int | None = None
    """Terrains an emitter asks for in an iteration."""
    learning_rate: float | None = None
    """Step of a cell's acceptance threshold."""
    sigma0: float | None = None
    """First step size of an emitter."""
    restart_rule: str | None = None
    """When emitters restart: a number of iterations, basic or no_improvement."""
    es: str | None = None
    """Evolution strategy: cma_es or sep_cma_es."""
    intervals: int | None = None
    """Intervals of each ratio."""
    without: tuple[str, ...] | None = None
    """Penalties to leave out of fitness, ratios and cells, such as stumble collision."""
    alpha: float | None = None
    """Weight of the standard deviations in the fitness."""
    lam: float | None = None
    """Weight of the share of episodes without collision in the fitness."""
    reevaluate_every: int | None = None
    """Every so many iterations, look at up to 200 elites again in 40 fresh episodes; 0: never."""
    processes: int | None = None
    """Processes on the CPU, without Ray; one a core."""
    workers: int | Literal["auto"] | None = None
    """Search on so many Ray workers, a GPU or a CPU core each; auto: as many as there are. RAY_ADDRESS names a running
    cluster; without it they are this machine's."""
    worker_limit_s: float = 300.0
    """A Ray worker that gets no further for so many seconds is given up, and its terrains go to another; building its
    simulation has a limit of its own."""
    reproduce: Literal["auto", "yes", "no"] = "auto"
    """Evaluate every elite again with 40 fresh episodes at the end; auto: with preset paper."""


_NOT_SETTINGS = ("device", "resume", "run_dir", "without", "processes", "workers", "worker_limit_s", "reproduce")


@dataclass(frozen=True, kw_only=True)
class Job:
    """A search that can begin: everything a user may have got wrong has been looked at."""

    cfg: SearchCfg
    path: Path
    """The run directory."""
    resumes: bool
    """Whether the directory holds the run already."""
    evaluator: EvaluatorCfg
    reproduce: bool
    """Whether the elites are evaluated again at the end."""
    origin: dict[str, Any]
    """Provenance of the run's beginning."""
    resume_command: str
    """How to go on with it."""
    reevaluate_command: str
    """How to evaluate its elites again once it has found them."""

    @property
    def device(self) -> str:
        """Warp device name."""
        return self.evaluator.device


def job_of(args: Arguments) -> Job:
    """The job that a command line asks for.

    Raises:
        FileNotFoundError: If there is no run to resume.
        ValueError: If robot, preset, device, controller, a setting or the run directory is not as it must be.
    """
    from sim.robot import get_robot

    if args.resume and args.run_dir:
        raise ValueError("give --resume for a run that is there or --run-dir for a new one, not both")
    there = RunDirectory(args.resume).read_cfg() if args.resume else None
    robot = get_robot(args.robot or (there.robot if there else "anymal"))
    device = resolve_device(args.device, args.workers)
    changes = {name: value for name, value in asdict(args).items() if name not in _NOT_SETTINGS}
    if args.without is not None:
        changes["penalties"] = kept_penalties(robot, args.without)
    moved = None
    if args.resume and there:
        moved = moved_policy(there, args.policy)
        path, cfg = args.resume, resumed(args.resume, there, robot, changes, moved)
        refuse_changes(path, "run", as_settings(there), as_settings(cfg))
        origin = origin_in(RunDirectory(path).read_config())
    else:
        name = args.preset or ("paper" if device.startswith("cuda") else "small")
        cfg = measured_now(changed(preset(name, robot), changes), robot)
        path, origin = _free_path(args, cfg), origin_of(device, cfg.seed, args.workers)
    policy = moved or policy_spec(cfg, robot)
    return Job(
        cfg=cfg,
        path=path,
        resumes=there is not None,
        evaluator=evaluator_of(cfg, policy, device, args),
        reproduce=args.reproduce == "yes" or (args.reproduce == "auto" and cfg.preset == "paper"),
        origin=origin,
        resume_command=_resume_command(cfg.robot, path, args, moved),
        reevaluate_command=next_command("reevaluate", args, robot=cfg.robot, run=path, policy=moved),
    )


def _resume_command(robot: str, path: Path, args: Arguments, moved: str | None) -> str:
    reproduce = None if args.reproduce == "auto" else args.reproduce
    return next_command("archive", args, robot=robot, resume=path, policy=moved, reproduce=reproduce)


def evaluator_of(cfg: SearchCfg, policy: str, device: str, args: Placed, *, runs_on_gpu: int = 1) -> EvaluatorCfg:
    """What evaluates an iteration's terrains all at once, with a controller that was tried.

    Args:
        cfg: The search.
        policy: Controller.
        device: Warp device name.
        args: Where to work.
        runs_on_gpu: Searches a GPU crosses the terrains of at once; a CPU is full with one's.

    Raises:
        ValueError: If the controller cannot be loaded or does not fit the robot.
    """
    check_policy(policy, cfg.robot, device)
    return EvaluatorCfg(
        robot=cfg.robot,
        policy=policy,
        num_terrains=cfg.scheduler.num_terrains * (runs_on_gpu if device.startswith("cuda") else 1),
        num_replicas=cfg.replicas,
        device=device,
        num_processes=args.processes,
        workers=args.workers,
        worker_limit_s=args.worker_limit_s,
    )


def origin_in(config: dict[str, Any]) -> dict[str, Any]:
    """Where a run comes from, as its config has it."""
    return {name: value for name, value in config.items() if name not in ("settings", "iterations")}


def moved_policy(there: SearchCfg, given: str | None) -> str | None:
    """The file given for a run's controller, if it is the run's own in another place."""
    same = given is not None and there.policy_sha256 is not None and file_hash(Path(given)) == there.policy_sha256
    return given if same else None


def resumed(path: Path, there: SearchCfg, robot: "RobotCfg", changes: Settings, moved: str | None) -> SearchCfg:
    """The settings that a run would go on with.

    Args:
        path: Its directory.
        there: Its settings.
        robot: Its robot as it is now.
        changes: What the command line gives, as :func:`qd.settings.changed` takes it.
        moved: Where the run's controller is now, if elsewhere.

    Raises:
        ValueError: If its controller is lost, or a setting is out of range.
    """
    if moved is not None:
        changes = {**changes, "policy": None}
    wanted = measured_now(changed(there, changes), robot)
    if moved is not None:
        return replace(wanted, policy_sha256=there.policy_sha256)
    if wanted.policy == there.policy and there.policy_sha256 is not None and wanted.policy_sha256 is None:
        raise ValueError(
            f"{path} was searched with the controller in {policy_spec(there, robot)}, got no such file now: put it "
            "back, or say where it is now with --policy"
        )
    return wanted


def refuse_changes(path: Path, what: str, there: Settings, wanted: Settings) -> None:
    """Nothing but its number of iterations may change where something goes on.

    Raises:
        ValueError: If a setting differs.
    """
    different = differences(there, wanted)
    if different:
        raise ValueError(
            f"{path} holds a {what} of other settings: {', '.join(different)}: start a new {what} for those"
        )


def _free_path(args: Arguments, cfg: SearchCfg) -> Path:
    """Directory of a new run; never one that holds something."""
    if args.run_dir is None:
        name = f"{cfg.robot}-{cfg.preset}-{cfg.seed}"
        path = next(path for path in numbered(_RUNS, name) if not path.exists())
        _mention_unfinished(name, cfg, args)
        return path
    if (args.run_dir / CONFIG_FILE).exists():
        different = differences(as_settings(RunDirectory(args.run_dir).read_cfg()), as_settings(cfg))
        if different:
            found = f"{args.run_dir} holds a run of other settings"
            raise ValueError(f"{found}: {', '.join(different)}: give another --run-dir")
        command = _resume_command(cfg.robot, args.run_dir, args, None)
        raise ValueError(f"{args.run_dir} holds this run already: go on with `{command}`")
    if args.run_dir.is_dir() and not all(map(is_leftover, args.run_dir.iterdir())):
        raise ValueError(f"{args.run_dir} is not empty and holds no run: give another --run-dir")
    return args.run_dir


def _mention_unfinished(name: str, cfg: SearchCfg, args: Arguments) -> None:
    """Says so where the new run repeats one that was stopped; starting over is still the user's to choose."""
    for path in itertools.takewhile(Path.exists, numbered(_RUNS, name)):
        run = RunDirectory(path)
        try:
            there, done = run.read_cfg(), run.iterations_done()
        except (OSError, ValueError):
            continue
        if done < there.iterations and as_settings(there) == as_settings(cfg):
            state = f"stopped after {done} of {there.iterations} iterations"
            print(f"{path} holds the same search, {state}. Go on with:")
            print(f"  {_resume_command(cfg.robot, path, args, None)}")
