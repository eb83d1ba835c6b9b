"""What a command line of a comparison means: a new one, or an old one that goes on."""

import os
import re
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from qd.run.arguments import evaluator_of, own_file
from qd.run.directory import RUNS, numbered, origin_in
from qd.run.next_commands import next_command
from qd.run.settings import (
    SchedulerCfg,
    SearchCfg,
    Settings,
    as_settings,
    changed,
    code_of,
    from_settings,
    measured_now,
    moved_policy,
    policy_spec,
    preset,
    refuse_changes,
    refuse_unnamed_code,
    resumed,
)
from qd.workers.evaluator import EvaluatorCfg, origin_of, resolve_device
from sim.files.atomic import is_leftover, prepare_output, read_json, to_json, write_atomically
from sim.files.intervals import MAX_T_VALUES

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg

METHODS: dict[str, dict[str, Any]] = {
    "uniform_random": {"method": "uniform_random"},
    "hard_random": {"method": "hard_random"},
    "map_elites": {"method": "map_elites"},
    "cma_me": {"method": "cma_me"},
    "cma_mae": {"method": "cma_mae", "es": "cma_es"},
    "cma_mae_sep": {"method": "cma_mae", "es": "sep_cma_es"},
    "cma_mae_narrow": {"method": "cma_mae", "es": "cma_es", "sigma0": 0.5},
    "mixed": {"method": "cma_mae+map_elites", "es": "cma_es"},
}
"""What is compared: changes of the search's settings."""

COMPARE_CONFIG_FILE = "compare.config.json"
_NAME = re.compile(r"[a-zA-Z0-9_+.,:=-]{1,200}")  # what a directory can be called, with a seed behind it
_DEFAULTS = {"methods": tuple(METHODS), "seeds": 3, "iterations": 33, "reevaluate_every": 11}


@dataclass(frozen=True, kw_only=True)
class Arguments:
    """Compare ways to search on the same number of terrains, several seeds each, all in lock-step.

    State is saved after every iteration: stop with Ctrl-C whenever you like and go on with --resume.
    """

    robot: str | None = None
    """Which robot: anymal, unless resuming; anymal, cassie, or the settings file of another (my_robot.py)."""
    preset: str | None = None
    """Size of an iteration: paper (a GPU's work) or small; by default what the device can do."""
    methods: tuple[str, ...] | None = None
    """Which methods: uniform_random, hard_random, map_elites, cma_me, cma_mae, cma_mae_sep, cma_mae_narrow (first step
    size .5), mixed (cma_mae+map_elites); all. Settings of the search after a colon make another one of it:
    cma_mae:restart-rule=20,learning-rate=0.3."""
    seeds: int | None = None
    """Runs of each method, with seeds from --seed on; 3."""
    seed: int | None = None
    """The first seed; 0."""
    iterations: int | None = None
    """Iterations of every run, 33; with --resume, more than before extend them."""
    reevaluate_every: int | None = None
    """Every so many iterations, 11, and at the end, all elites are evaluated again with 40 fresh episodes."""
    policy: str | None = None
    """Controller other than the shipped one."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    processes: int | None = None
    """Processes on the CPU, without Ray; one a core."""
    workers: int | Literal["auto"] | None = None
    """Ray workers, a GPU or CPU core each; auto: all there are."""
    worker_limit_s: float = 900.0
    """A Ray worker that gets no further for so many seconds is given up."""
    resume: Path | None = None
    """Go on with the comparison in this directory, as it was asked for."""
    run_dir: Path | None = None
    """Directory of a new comparison; runs/<robot>-compare, numbered if that exists."""
    out: Path | None = None
    """Where to write the numbers, with a figure beside them; compare.json in the comparison's directory."""


_OF_RUNS = ("preset", "seed", "iterations", "reevaluate_every", "policy")


@dataclass(frozen=True, kw_only=True)
class Comparison:
    """A comparison that can begin: everything a user may have got wrong has been looked at."""

    cfg: SearchCfg
    """What the runs share: the first one's seed, and how often all of them have their elites evaluated again."""
    methods: tuple[str, ...]
    seeds: int
    """Runs of each method."""
    path: Path
    """The comparison's directory."""
    evaluator: EvaluatorCfg
    out: Path
    """Where its numbers go."""
    origin: dict[str, Any]
    """Provenance of its beginning."""
    resume_command: str
    """How to go on with it."""

    def cfg_of(self, method: str, seed: int) -> SearchCfg:
        """Settings of one run."""
        return changed(replace(self.cfg, seed=seed), _changes(method))

    @property
    def has_config(self) -> bool:
        """Whether it has begun, so that it can be resumed."""
        return (self.path / COMPARE_CONFIG_FILE).exists()

    def write_config(self) -> None:
        """Writes what was asked for, so that resuming needs no more than the directory."""
        settings = _as_settings(self.cfg, self.methods, self.seeds)
        content = {"settings": settings, "iterations": self.cfg.iterations, **self.origin}
        write_atomically(self.path / COMPARE_CONFIG_FILE, to_json(content))


def comparison_of(args: Arguments) -> Comparison:
    """The comparison that a command line asks for.

    Raises:
        FileNotFoundError: If there is none to resume.
        ValueError: If robot, methods, device, controller, another argument or the directory is not as it must be.
    """
    from sim.robots.robot import get_robot, robot_of

    if args.resume and args.run_dir:
        raise ValueError("give --resume for a comparison that is there or --run-dir for a new one, not both")
    device = resolve_device(args.device, args.workers)
    config = _read_config(args.resume) if args.resume else None
    there = _asked_in(args.resume, config) if args.resume and config else None
    named = robot_of(there[0].robot, args.robot, args.resume) if args.resume and there else args.robot
    robot = get_robot(named or "anymal")
    if args.resume and config and there:
        refuse_unnamed_code(there[0].policy, args.policy, args.resume)
        path, origin, moved = args.resume, origin_in(config), moved_policy(there[0], args.policy)
        cfg, methods, seeds = _resumed(path, there, robot, args, moved)
    else:
        path, moved = _free_path(args.run_dir, robot.name), None
        cfg, methods, seeds = _begun(robot, device, args)
        origin = origin_of(device, cfg.seed, args.workers) | own_file(robot)
    policy = moved or policy_spec(cfg, robot)
    evaluator = evaluator_of(cfg, robot, policy, device, args.workers, runs_on_gpu=len(methods) * seeds)
    if args.out is not None:
        prepare_output(args.out)
    return Comparison(
        cfg=cfg,
        methods=methods,
        seeds=seeds,
        path=path,
        evaluator=evaluator,
        out=args.out or path / "compare.json",
        origin=origin,
        resume_command=next_command("compare", args, robot=robot.spec, resume=path, policy=moved or code_of(cfg)),
    )


_Asked = tuple[SearchCfg, tuple[str, ...], int]  # what the runs share, methods, seeds


def _begun(robot: "RobotCfg", device: str, args: Arguments) -> _Asked:
    given = {name: value for name, value in vars(args).items() if value is not None}
    asked = {**_DEFAULTS, **given}
    name = args.preset or ("paper" if device.startswith("cuda") else "small")
    cfg = measured_now(changed(preset(name, robot), {key: asked.get(key) for key in _OF_RUNS}), robot)
    return _checked(cfg, asked["methods"], asked["seeds"])


def _resumed(path: Path, there: _Asked, robot: "RobotCfg", args: Arguments, moved: str | None) -> _Asked:
    cfg, methods, seeds = there
    wanted = resumed(path, cfg, robot, {key: getattr(args, key) for key in _OF_RUNS}, moved)
    asked = (wanted, methods if args.methods is None else args.methods, seeds if args.seeds is None else args.seeds)
    refuse_changes(path, "comparison", _as_settings(*there), _as_settings(*asked))
    return _checked(*asked)


def _checked(cfg: SearchCfg, methods: tuple[str, ...], seeds: int) -> _Asked:
    unknown = [name for name in methods if name.split(":")[0] not in METHODS]
    if unknown or not methods or len(set(methods)) < len(methods):
        raise ValueError(f"methods must be some of {', '.join(METHODS)}, each once, got {', '.join(methods)}")
    _check_settings(cfg, methods)
    if not 1 <= seeds <= MAX_T_VALUES:
        raise ValueError(f"seeds must be 1 to {MAX_T_VALUES}, got {seeds}")
    if cfg.reevaluate_every < 1:
        raise ValueError(f"reevaluate_every must be at least 1, got {cfg.reevaluate_every}")
    return cfg, methods, seeds


def _check_settings(cfg: SearchCfg, methods: tuple[str, ...]) -> None:
    """That methods are different searches on the same number of terrains, with names that a directory can have."""
    names: dict[SearchCfg, str] = {}
    for name in methods:
        if not _NAME.fullmatch(name):
            raise ValueError(
                f"methods: a name must be up to 200 letters, digits and _+-.,:= without spaces, got {name!r}"
            )
        own = changed(cfg, _changes(name))
        if own in names:
            raise ValueError(f"methods: {names[own]} and {name} are the same search: leave one of them out")
        names[own] = name
        if own.scheduler.num_terrains != cfg.scheduler.num_terrains:
            raise ValueError(
                f"methods: emitters times batch_size must be {cfg.scheduler.num_terrains} as in all runs of the "
                f"comparison, got {own.scheduler.num_terrains} in {name}"
            )


def _changes(method: str) -> dict[str, Any]:
    """Changes of the search's settings that a method is, those behind its colon included."""
    name, colon, given = method.partition(":")
    found, seen = dict(METHODS[name]), set()
    kinds = {field.name: type(field.default) for field in fields(SchedulerCfg)}
    for item in given.split(",") if colon else ():
        key, _, value = item.partition("=")
        key = key.replace("-", "_")
        if key not in kinds:
            raise ValueError(f"methods: no setting named {key} in {method}: expected some of {', '.join(kinds)}")
        if key in seen:
            raise ValueError(f"methods: {key} is given twice in {method}")
        seen.add(key)
        try:
            found[key] = kinds[key](value)
        except ValueError:
            raise ValueError(f"methods: {key} must be {kinds[key].__name__}, got '{value}' in {method}") from None
    return found


def _as_settings(cfg: SearchCfg, methods: tuple[str, ...], seeds: int) -> Settings:
    return {**as_settings(cfg), "methods": list(methods), "seeds": seeds}


def _asked_in(path: Path, config: dict[str, Any]) -> _Asked:
    """What a config holds, as the types it was written from."""
    settings = dict(config["settings"])
    methods, seeds = settings.pop("methods", None), settings.pop("seeds", None)
    try:
        if (
            not isinstance(methods, list)
            or not all(isinstance(name, str) for name in methods)
            or type(seeds) is not int
        ):
            raise ValueError(f"methods and seeds must be names and a number, got {methods} and {seeds}")
        return _checked(from_settings(settings, config["iterations"]), tuple(methods), seeds)
    except ValueError as error:
        raise ValueError(f"{path / COMPARE_CONFIG_FILE}: {error}; put a copy of it back") from None


def _read_config(path: Path) -> dict[str, Any]:
    """What was asked for in a comparison's directory."""
    file = path / COMPARE_CONFIG_FILE
    if not os.path.lexists(file):
        raise FileNotFoundError(f"no comparison at {path}: it has no {COMPARE_CONFIG_FILE}; give the directory of one")
    config = read_json(file)
    if type(config.get("settings")) is not dict or type(config.get("iterations")) is not int:
        raise ValueError(f"{file} must hold settings and iterations of a comparison, got {', '.join(config)}")
    return config


def _free_path(given: Path | None, robot: str) -> Path:
    """Directory of a new comparison; never one that holds something."""
    if given is None:
        return next(path for path in numbered(RUNS, f"{robot}-compare") if not path.exists())
    if (given / COMPARE_CONFIG_FILE).exists():
        raise ValueError(f"{given} holds a comparison already: go on with --resume {given}, or give another --run-dir")
    if given.is_dir() and not all(is_leftover(path) or _is_empty(path) for path in given.iterdir()):
        raise ValueError(f"{given} is not empty and holds no comparison: give another --run-dir")
    return given


def _is_empty(path: Path) -> bool:
    """Whether it is a directory of a run that was killed before anything was written."""
    return path.is_dir() and all(map(is_leftover, path.iterdir()))
