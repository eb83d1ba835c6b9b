"""The search as a command: what its flags mean, for a new run or one that goes on."""

import itertools
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from qd.run.directory import CONFIG_FILE, RUNS, RunDirectory, numbered, origin_in
from qd.run.settings import (
    SearchCfg,
    as_settings,
    changed,
    code_of,
    differences,
    is_searched,
    kept_penalties,
    measured_now,
    moved_policy,
    policy_spec,
    preset,
    refuse_changes,
    refuse_unnamed_code,
    resumed,
)
from qd.workers.evaluator import EvaluatorCfg, check_policy, origin_of, resolve_device
from sim.files.atomic import is_leftover
from sim.files.command import OnGround, Where, Who, command_line
from sim.policy.spec import controller_hash

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg
    from sim.spaces.base import TerrainSpace


@dataclass(frozen=True, kw_only=True)
class Archive(Who, OnGround, Where):
    """Search the terrains on which a controller fails, each in its own way.

    Every iteration lets robots cross the terrains that --method asks for, and files each terrain by the proportions of
    what went wrong. State is saved after every iteration: stop with Ctrl-C whenever you like and go on with --resume.
    """

    preset: str | None = None
    """Size of the search: wide (the default on a GPU), paper (the paper's), or small (the default on the CPU)."""
    iterations: int | None = None
    """Iterations to reach; with --resume, more than before extend a finished run."""
    seed: int | None = None
    """Seed of everything drawn; 0."""
    resume: Path | None = None
    """Go on with the run in this directory."""
    run_dir: Path | None = None
    """Directory of a new run; runs/<robot>-<preset>-<seed>, numbered if that exists."""
    space: str | None = None
    """Terrain space: super_gaussian, the paper's eight bumps; course, man-made elements; or one of your own,
    file.py:CLASS. super_gaussian if left out."""
    replicas: int | None = None
    """Episodes a terrain."""
    method: str | None = None
    """Where terrains come from: surrogate (the default), cma_mae (the paper's), cma_me, map_elites, hard_random,
    uniform_random; several joined by +."""
    emitters: int | None = None
    """Emitters."""
    batch_size: int | None = None
    """Terrains an emitter asks for in an iteration."""
    groups: int | None = None
    """Groups of emitters that ask and are told in turn, so that robots do not wait for the last of an iteration."""
    learning_rate: float | None = None
    """Step of a cell's acceptance threshold."""
    sigma0: float | None = None
    """First step size of an emitter; what the terrain space has, 2 of super_gaussian and 0.5 of course."""
    restart_rule: str | None = None
    """When emitters restart: a number of iterations, basic or no_improvement."""
    es: str | None = None
    """Evolution strategy: cma_es or sep_cma_es."""
    crossover_share: float | None = None
    """Share of what a surrogate varies that takes parts, such as bumps, from a further elite; .3."""
    intervals: int | None = None
    """Intervals of each ratio."""
    without: tuple[str, ...] | None = None
    """Penalties to leave out of fitness, ratios and cells, such as stumble collision."""
    alpha: float | None = None
    """Weight of the standard deviations in the fitness."""
    lam: float | None = None
    """Weight in the fitness of u, the share of episodes without base collision; u is 0 if none collided."""
    reevaluate_every: int | None = None
    """After every so many iterations up to 200 elites cross 40 fresh episodes each. 0: never."""
    reproduce: Literal["auto", "yes", "no"] = "auto"
    """Cross every elite again in 40 fresh episodes at the end. auto: with presets wide and paper."""
    confirm: Literal["auto", "yes", "no"] = "auto"
    """Cross the elites that fail in these with contact resolved too. auto: with presets wide and paper."""

    def execute(self) -> None:
        """Runs the search."""
        from qd.search import run_search

        run_search(job_of(self))


_NOT_SETTINGS = (
    "device", "workers", "num_envs", "robot", "resume", "run_dir", "without", "reproduce", "confirm", "ground",
)  # fmt: skip
_SESSION = ("command", "commit", "device")


@dataclass(frozen=True, kw_only=True)
class Job:
    """A search that can begin: all that a user may have got wrong is checked."""

    cfg: SearchCfg
    path: Path
    """The run directory."""
    resumes: bool
    """Whether the directory holds the run already."""
    evaluator: EvaluatorCfg
    reproduce: bool
    """Whether the elites are evaluated again at the end."""
    confirm: bool
    """Whether those that fail then are crossed with contact resolved; only after fresh episodes."""
    origin: dict[str, Any]
    """Provenance of the run's beginning, and the sessions before this one."""
    session: dict[str, Any]
    """Command, commit and device of this session."""
    resume_command: str
    """How to go on with it."""
    reevaluate_command: str
    """How to evaluate its elites again once it has found them."""
    confirm_command: str
    """How to cross the failing ones with contact resolved."""

    @property
    def device(self) -> str:
        """Warp device name."""
        return self.evaluator.device

    @property
    def robot(self) -> str:
        """What the command line calls the robot."""
        robot = self.evaluator.robot
        return robot if isinstance(robot, str) else robot.spec


def job_of(args: Archive) -> Job:
    """The job that a command line asks for.

    Raises:
        FileNotFoundError: If there is no run to resume.
        ValueError: If robot, preset, device, controller, space, a setting or the run directory is not as it must be.
    """
    from sim.robots.find import get_robot, robot_of
    from sim.spaces.registry import is_own

    if args.confirm == "yes" and args.reproduce == "no":
        raise ValueError("--confirm yes needs the fresh episodes that --reproduce no leaves out: give one of the two")
    if args.resume and args.run_dir:
        raise ValueError("give --resume for a run that is there or --run-dir for a new one, not both")
    there = RunDirectory(args.resume).read_cfg() if args.resume else None
    robot = (
        robot_of(as_settings(there), args.robot, args.resume)
        if there and args.resume
        else get_robot(args.robot or "anymal")
    )
    device = resolve_device(args.device, args.workers)
    changes = {name: value for name, value in asdict(args).items() if name not in _NOT_SETTINGS}
    space, of_space = _space_of(args, there)
    changes |= of_space
    if args.without is not None:
        changes["penalties"] = kept_penalties(robot, args.without)
    moved = None
    if args.resume and there:
        refuse_unnamed_code(there.policy, args.policy, args.resume)
        moved = moved_policy(there, args.policy)
        path, cfg = args.resume, resumed(args.resume, there, robot, changes, moved)
        refuse_changes(path, "run", as_settings(there), as_settings(cfg))
    else:
        name = args.preset or ("wide" if device.startswith("cuda") else "small")
        cfg = measured_now(changed(preset(name, robot, args.policy), changes), robot)
        path = _free_path(args, cfg, robot)
        if told := robot.scaled_by_another(policy_spec(cfg, robot)):
            print(told)
    now = origin_of(device, cfg.seed, args.workers)
    named = moved or code_of(cfg)
    at_end = {name: _at_end(getattr(args, name), cfg) for name in ("reproduce", "confirm")}
    later = {
        "robot": robot.spec, "run": path, "policy": named, "space": space.name if is_own(space.name) else None,
        "device": args.device, "workers": args.workers,
    }  # fmt: skip
    return Job(
        cfg=cfg,
        path=path,
        resumes=there is not None,
        evaluator=evaluator_of(
            cfg, robot, moved or policy_spec(cfg, robot), device, args.workers, num_envs=args.num_envs
        ),
        reproduce=at_end["reproduce"] or args.confirm == "yes",
        confirm=at_end["confirm"] and args.reproduce != "no",
        origin=origin_in(RunDirectory(path).read_config()) if there else {**now, **own_file(robot), "sessions": []},
        session={name: now[name] for name in _SESSION},
        resume_command=_resume_command(robot, path, args, named),
        reevaluate_command=command_line("reevaluate", **later),
        confirm_command=command_line("confirm", **later),
    )


def _space_of(args: Archive, there: SearchCfg | None) -> "tuple[TerrainSpace, dict[str, Any]]":
    """The terrain space of a search, loaded, and what it changes of the settings.

    Raises:
        ValueError: If there is none of that name, it does not work, or the run's own is not named or has changed.
    """
    from sim.ground import split_name
    from sim.spaces.registry import get_space, load_space

    base = args.space if there is None or args.space else split_name(there.space)[0]
    given = load_space(base, args.ground) if there is None or args.space or args.ground else None
    if there is None:
        assert given is not None
        space = given
        sigma0 = space.sigma0 if args.sigma0 is None else args.sigma0
        return space, {"space": space.name, "space_sha256": space.sha256, "sigma0": sigma0}
    moved = given is not None and given.sha256 is not None and given.sha256 == there.space_sha256
    if given is not None and given.name != there.space and not moved:
        return given, {"space": given.name, "space_sha256": given.sha256}  # which the run refuses
    return get_space(there.space, there.space_sha256), {"space": None}


def check_certifiers(certifiers: Mapping[str, str], cfg: SearchCfg, robot: "RobotCfg", device: str) -> None:
    """Loads certifiers and tries them.

    Args:
        certifiers: Controllers by name.
        cfg: The search whose controller they are to certify.
        robot: Its robot.
        device: Warp device name.

    Raises:
        ValueError: If one is the controller of the search, is there twice, cannot be loaded or does not fit the robot.
    """
    there: dict[str | None, str] = {}
    for name, policy in certifiers.items():
        if is_searched(cfg, policy, robot):
            raise ValueError(
                f"certifier {name} ({policy}) is the controller that is searched, expected another: a controller "
                "cannot certify itself"
            )
        digest = controller_hash(policy)
        if digest in there:
            raise ValueError(f"certifiers {there[digest]} and {name} are the same controller: leave one of them out")
        there |= {} if digest is None else {digest: name}
        try:
            check_policy(policy, robot, device)
        except ValueError as error:
            raise ValueError(f"certifier {name} does not fit {robot.name}: {error}") from error


def _at_end(asked: str, cfg: SearchCfg) -> bool:
    return asked == "yes" or (asked == "auto" and cfg.preset != "small")


def own_file(robot: "RobotCfg") -> dict[str, Any]:
    """For the origin of a run: where the settings of a robot that is not shipped were."""
    return {} if robot.settings_file is None else {"robot_file": str(robot.settings_file)}


def _resume_command(robot: "RobotCfg", path: Path, args: Archive, policy: str | None) -> str:
    from sim.spaces.registry import is_own

    at_end = {name: None if getattr(args, name) == "auto" else getattr(args, name) for name in ("reproduce", "confirm")}
    return command_line(
        "archive", robot=robot.spec, resume=path, policy=policy, space=args.space if is_own(args.space or "") else None,
        device=args.device, workers=args.workers, num_envs=args.num_envs, **at_end,
    )  # fmt: skip


def evaluator_of(
    cfg: SearchCfg,
    robot: "RobotCfg",
    policy: str,
    device: str,
    workers: str | None,
    *,
    num_envs: int | None = None,
) -> EvaluatorCfg:
    """What evaluates an iteration's terrains all at once, with a controller that was tried.

    Args:
        cfg: The search.
        robot: Its robot.
        policy: Controller.
        device: Warp device name.
        workers: Who crosses them, as on a command line.
        num_envs: Robots at once; as many as the device is good for if None.

    Raises:
        ValueError: If the controller cannot be loaded or does not fit the robot.
    """
    from sim.spaces.registry import get_space

    check_policy(policy, robot, device)
    return EvaluatorCfg(
        robot=robot,
        policy=policy,
        num_terrains=cfg.scheduler.num_terrains,
        num_replicas=cfg.replicas,
        device=device,
        workers=workers,
        lots=cfg.scheduler.groups,
        num_envs=num_envs,
        space=get_space(cfg.space, cfg.space_sha256).name,  # where its code is now
    )


def _free_path(args: Archive, cfg: SearchCfg, robot: "RobotCfg") -> Path:
    """Directory of a new run; never one that holds something."""
    if args.run_dir is None:
        name = f"{cfg.robot}-{cfg.preset}-{cfg.seed}"
        path = next(path for path in numbered(RUNS, name) if not path.exists())
        _mention_unfinished(name, cfg, args, robot)
        return path
    if (args.run_dir / CONFIG_FILE).exists():
        different = differences(as_settings(RunDirectory(args.run_dir).read_cfg()), as_settings(cfg))
        if different:
            found = f"{args.run_dir} holds a run of other settings"
            raise ValueError(f"{found}: {', '.join(different)}: give another --run-dir")
        command = _resume_command(robot, args.run_dir, args, code_of(cfg))
        raise ValueError(f"{args.run_dir} holds this run already: go on with `{command}`")
    if args.run_dir.is_dir() and not all(map(is_leftover, args.run_dir.iterdir())):
        raise ValueError(f"{args.run_dir} is not empty and holds no run: give another --run-dir")
    return args.run_dir


def _mention_unfinished(name: str, cfg: SearchCfg, args: Archive, robot: "RobotCfg") -> None:
    """Says so where the new run repeats one that was stopped; starting over is still the user's to choose."""
    for path in itertools.takewhile(Path.exists, numbered(RUNS, name)):
        run = RunDirectory(path)
        try:
            there, done = run.read_cfg(), run.iterations_done()
        except (OSError, ValueError):
            continue
        if done < there.iterations and not differences(as_settings(there), as_settings(cfg)):
            state = f"stopped after {done} of {there.iterations} iterations"
            print(f"{path} holds the same search, {state}. Go on with:")
            print(f"  {_resume_command(robot, path, args, code_of(cfg))}")
