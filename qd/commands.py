"""The commands of searching and evaluating: their flags, and nothing else."""

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

import tyro
from msgspec import Meta

from qd.evaluate.labels import SetsCfg
from qd.search.methods import METHODS
from qd.search.presets import PRESETS, SchedulerCfg, read_preset
from sim.controllers.spec import parse_controllers
from sim.files.command import ControllerFlags, RobotFlag, SpaceFlag, WorkerFlags, peek, split_values
from sim.files.settings import NonNegativeFloat, NonNegativeInt, PositiveInt, Share, select_settings
from sim.robots.find import get_robot, resolve_robot

_METHOD_HELP = (
    f"Where new terrains come from: {'; '.join(f'{name}, {method.text}' for name, method in METHODS.items())}. Several "
    "are joined by +: emitters take them in turn."
)
_SETTINGS = ("preset", "iterations", "seed", "replicas", "intervals", "scheduler")


def _compute(flags: WorkerFlags) -> Any:
    """Where the flags of a command let terrains be crossed, a :class:`qd.workers.compute.Compute`."""
    from qd.workers.compute import Compute

    return Compute.resolve(flags.device, flags.workers, flags.num_envs)


@dataclass(frozen=True, kw_only=True)
class ArchiveCommand(ControllerFlags, WorkerFlags):
    """Search the terrains on which a controller fails, each in its own way.

    Every iteration lets robots cross the terrains that --method asks for, and files each terrain by the proportions of
    what went wrong. State is saved after every iteration: stop with Ctrl-C whenever you like and go on with --resume.
    With the presets wide and paper the elites are judged at the end, as `faultline judge` does.
    """

    preset: str = "small"
    """Size of the search: wide (the default on a GPU), paper (the paper's), or small (the default on the CPU)."""
    iterations: PositiveInt = 20
    """Iterations to reach; with --resume, more than before extend a finished run."""
    until: Annotated[float, Meta(gt=0, lt=1)] | None = None
    """Ends the search before, once its last tenth brought less than this share of the elites that can be expected to
    stay in their cells, such as 0.03; asked from 20 iterations with new terrains on."""
    seed: int = 0
    """Seed of everything drawn."""
    resume: Path | None = None
    """Go on with the run in this directory."""
    run_dir: Path | None = None
    """Directory of a new run; runs/<robot>-<preset>-<seed>, numbered if that exists."""
    space: str | None = None
    """Terrain space: super_gaussian, the paper's eight bumps; course, man-made elements; or one of your own,
    file.py:CLASS; behind any of them +friction, +softness, and conditions: {conditions}. super_gaussian if left
    out."""
    skip_level_ground: bool = False
    """Search though the controller of a robot of yours does not cross level ground, where every terrain stops it."""
    height: float | None = None
    """Lowers the terrains: the largest height of a bump [m], at most 0.25, and everything else alike. If left out, 0.25
    for shipped robots; for yours the height of the penalty scales: about 80 % of hard-random terrains are crossed."""
    replicas: PositiveInt = 4
    """Episodes a terrain."""
    method: Annotated[str | None, tyro.conf.arg(help=f"{_METHOD_HELP} surrogate if left out.")] = None
    scheduler: SchedulerCfg = PRESETS["small"]["scheduler"]
    penalties: Annotated[tuple[str, ...], tyro.conf.arg(name="fitness.penalties")] = ()
    """Penalties that count, for fitness, ratios and cells; all of the robot's if left out."""
    alpha: Annotated[float, tyro.conf.arg(name="fitness.alpha")] = 1.0
    """Weight of the standard deviations in the fitness."""
    lam: Annotated[float, tyro.conf.arg(name="fitness.lam")] = 2.0
    """Weight of u in the fitness, the share of episodes without base collision; u is 0 if none collided."""
    crossed: Annotated[Share | None, tyro.conf.arg(name="fitness.crossed")] = None
    """Share by which the search lowers the worth of terrains that nobody crosses: neither the robot's panel nor, at
    other speeds and a little aside, the controller itself. Only with --method surrogate and --scheduler.again. If left
    out, 0.95 with these and a panel of other controllers, else 0."""
    likely_weight: Annotated[NonNegativeFloat, tyro.conf.arg(name="fitness.likely")] = 0.0
    """Lowers the worth of terrains under unlikely conditions (--likely) in the search, by the power of their
    probability. Only in a space with conditions, with --method surrogate and --scheduler.again."""
    likely: Path | None = None
    """File that says how conditions are distributed, which the run remembers; as sim/terrains/conditions/likely.toml,
    which is taken if left out. How likely the terrain's shape is, is left out."""
    intervals: Annotated[int, tyro.conf.arg(name="fitness.intervals")] = 10
    """Intervals of each ratio."""

    @staticmethod
    def help_values() -> dict[str, str]:
        """Names of conditions."""
        from sim.terrains.conditions.kinds import CONDITIONS, GROUPS, TASKS

        return {"conditions": ", ".join(f"+{name}" for name in (*CONDITIONS, *GROUPS, *TASKS))}

    @classmethod
    def defaults(cls, argv: Sequence[str]) -> Self:
        """The flags' defaults: those of the preset, or of the run to go on with."""
        folder = peek(argv, "--resume")
        if folder is None:
            preset = peek(argv, "--preset")
            if preset is None:
                device = peek(argv, "--device")
                if device is None and not {"-h", "--help"} & {*argv}:
                    from qd.workers.compute import choose_device

                    device = choose_device(None, peek(argv, "--workers"))
                preset = "wide" if (device or "").startswith("cuda") else "small"
            return cls(preset=preset, **read_preset(preset))
        from qd.search.directory import RunDirectory

        cfg = RunDirectory(Path(folder)).read_cfg()
        settings = {name: getattr(cfg, name) for name in _SETTINGS}
        fitness = {name: getattr(cfg.fitness, name) for name in ("penalties", "alpha", "lam", "crossed")}
        return cls(**settings, **fitness, likely_weight=cfg.fitness.likely)

    def execute(self) -> None:
        """Searches, and judges what was found."""
        from qd.faults.judge import judge
        from qd.faults.searches import find_search
        from qd.search.crossed import usual_crossed
        from qd.search.directory import free_path
        from qd.search.loop import search, start_search
        from qd.search.results import print_summary
        from sim.terrains.conditions.likely import choose_likely
        from sim.terrains.spaces.registry import load_space

        self.scheduler.check_iterations(self.iterations)  # before anything is loaded
        scheduler = replace(self.scheduler, method=self.method or self.scheduler.method)
        scheduler.check_worth(crossed=self.crossed or 0.0, likely=self.likely_weight)
        compute = _compute(self)
        if self.resume is None:
            policy = None
            flags: dict[str, Any] = {"size": self.preset, "height": self.height, "compute": compute}
            flags |= {"skip_level_ground": self.skip_level_ground, "likely": self.likely}
            choose_likely(load_space(self.space), self.likely, needed=self.likely_weight > 0.0)  # or refuses
            cfg, robot = start_search(self.robot, self.policy, self.space, **flags)
        elif self.run_dir or self.likely or self.height is not None:
            raise ValueError("--resume goes on with a run as it is: leave --run-dir, --likely and --height out")
        else:
            run = find_search(self.resume, robot=self.robot, policy=self.policy, space=self.space)
            robot, policy, cfg = run.robot, run.policy, run.cfg
            space = None if self.space is None else load_space(self.space)
            if space is not None and (space.sha256 is None or space.sha256 != cfg.space_sha256):
                cfg = replace(cfg, space=space.name, space_sha256=space.sha256)
        fitness = cfg.fitness.with_penalties(self.penalties or cfg.fitness.penalties)
        settings = {name: getattr(self, name) for name in _SETTINGS} | {"scheduler": scheduler}
        crossed = usual_crossed(scheduler, robot, cfg.terrain_space) if self.crossed is None else self.crossed
        fitness = replace(fitness, alpha=self.alpha, lam=self.lam, crossed=crossed, likely=self.likely_weight)
        cfg = replace(cfg, **settings, fitness=fitness)
        path = self.resume or self.run_dir or free_path(f"{cfg.robot}-{cfg.preset}-{cfg.seed}")
        archive = search(cfg, path, compute, robot=robot, policy=policy, until=self.until)
        named: dict[str, Any] = {"robot": self.robot, "policy": self.policy, "space": self.space}
        if cfg.preset != "small":
            archive = judge(path, compute=compute, **named)
        print_summary(path, archive, **named, skip_level_ground=self.skip_level_ground)


@dataclass(frozen=True, kw_only=True)
class _RunFlags(ControllerFlags, SpaceFlag, WorkerFlags):
    """What commands that work on a run's elites share."""

    run: Path | None = None
    """Run directory; the newest of the robot under runs/."""
    certifiers: tuple[str, ...] = ()
    """The other controllers, each NAME=FILE; if left out, the robot's panel and those of RUN/certifiers."""

    def named(self) -> tuple[Path, dict[str, Any]]:
        """The run, and what the command line names beside it."""
        from qd.search.directory import find_run

        robot = get_robot(self.robot)
        return find_run(robot, self.run, published="never"), {
            "compute": _compute(self),
            "certifiers": parse_controllers(self.certifiers, robot, flag="certifiers") if self.certifiers else None,
            "robot": self.robot,
            "policy": self.policy,
            "space": self.space,
        }


@dataclass(frozen=True, kw_only=True)
class JudgeCommand(_RunFlags):
    """Say which elites of a run are faults of its controller.

    fresh, resolved and others find faults: elites that the robot fails in 40 fresh episodes and, confirmed, with finer
    physics, and that another controller passes with both, which certifies them. steered looks for ways by which the
    controller itself crosses what nobody passes, varied and mujoco_c try faults under moderate conditions and in MuJoCo
    C: docs/faults.md. Crossings are kept, but those of steered, so the same command goes on after Ctrl-C.
    """

    stages: tuple[str, ...] = ("fresh", "resolved", "others")
    """Some of fresh, resolved, others, steered, varied, mujoco_c, in the order in which to do them."""
    steered: PositiveInt | None = None
    """Terrains for which steered seeks ways at most, the hardest of each family first; 20 on the CPU and all on a GPU
    if left out."""
    skip_level_ground: bool = False
    """Judge though the controller of a robot of yours does not cross level ground."""

    def execute(self) -> None:
        """Judges the run."""
        from qd.evaluate.level import report_level_ground
        from qd.faults.judge import judge
        from qd.faults.searches import find_search
        from qd.search.results import print_summary

        run, named = self.named()
        own = {name: named[name] for name in ("robot", "policy", "space")}
        if not self.skip_level_ground:
            searched = find_search(run, **own)
            report_level_ground(searched.robot, searched.policy, named["compute"], must_walk=True)
        most = self.steered or (None if named["compute"].on_gpu else 20)
        archive = judge(run, stages=self.stages, most_steered=most, **named)
        print_summary(run, archive, **own, skip_level_ground=self.skip_level_ground)


@dataclass(frozen=True, kw_only=True)
class MinimiseCommand(_RunFlags):
    """Find the smallest terrains on which the controller still fails. Which parts of an elite's terrain are needed?

    Subsets of a failing elite's parts, such as bumps, are tried in 20 episodes each; 40 fresh ones check the smallest
    that fails. Then its heights are scaled down together as long as it still fails: the margin. The cause is the part
    without which the robot passes. minimal.json, minimal.npz and minimal.png of the run have the results of all calls.
    Crossings are kept, so the same command goes on after Ctrl-C.
    """

    elite: str | None = None
    """Numbers of failing elites: one, several as in --elite "0 3", or all that fail. If left out, 200 on a GPU and 3 on
    the CPU: faults first, then confirmed and certified ones, then others that fail."""
    how: Literal["exhaustive", "greedy"] | None = None
    """exhaustive: all subsets, from the smallest on, until one fails. greedy: parts are taken away one at a time. If
    left out, exhaustive on a GPU, and greedy on the CPU and for terrains of more than 10 parts."""
    judge: bool = False
    """Cross the minimal terrains with contact resolved and by other controllers too, as `faultline judge` does."""

    def execute(self) -> None:
        """Finds the minimal terrains, and prints them."""
        from qd.faults.minimise import minimise

        run, named = self.named()
        minimise(run, elite=self.elite, how=self.how, judged=self.judge or bool(self.certifiers), **named)


@dataclass(frozen=True, kw_only=True)
class ImportCommand:
    """Describe a controller and its robot as robot.toml and controller.toml, from what came with its weights.

    It prints both files. What is not understood is refused by its name; what is a guess says so, with its reason; what
    nobody says is left to be filled in. If nothing is, the robot crosses level ground, and a slow one gets more time.
    """

    source: tyro.conf.Positional[Path]
    """A YAML or folder of rl_sar, unitree_rl_gym, unitree_rl_lab (deploy.yaml), legged_gym, Booster Gym or LEAPP, a run
    folder of Isaac Lab, an ONNX file of mjlab or holosoma, or weights alone."""
    model: str | None = None
    """The robot's MJCF or URDF, which stays where it is, or a robot of MuJoCo Menagerie: menagerie:unitree_go2. If left
    out, the file that the source names, if it is here."""
    out: Path
    """Folder for the files, and a copy of the weights; the robot is called after it."""

    def execute(self) -> None:
        """Writes the files."""
        from sim.controllers.imports import import_controller

        if import_controller(self.source, self.model, self.out):
            from qd.evaluate.level import give_time, report_level_ground
            from qd.workers.compute import Compute

            robot, compute = get_robot(str(self.out / "robot.toml")), Compute.resolve()
            report_level_ground(give_time(robot, str(robot.policy_file), compute), None, compute)


@dataclass(frozen=True, kw_only=True)
class CheckCommand(ControllerFlags, WorkerFlags):
    """Look at a robot and its controller before anything is searched or trained.

    It prints joints and geoms as the solver holds them; whether the robot stands, and walks on flat ground, here and in
    MuJoCo C; at which height of terrain it crosses about 80 %; and which kerbs and stairs stop it. The exit status is 1
    if something must be mended (docs/robots.md). Then, or with --why, it says which one change of controller.toml or
    robot.toml makes it walk best, and the line to write.
    """

    why: bool = False
    """Say what to change even if it walks: robots walk side by side, each with one thing of the contract changed."""
    trace: Path | None = None
    """A log of the controller elsewhere, npz or csv, with a row a control step from an episode's start on: observation,
    and any of action, lin_vel, ang_vel, gravity, command, joint_pos, joint_vel (docs/controllers.md). The first column,
    step and size are named in which what its network sees, or does, differs from the contract; nothing else is done."""

    def execute(self) -> int:
        """Prints what was found; returns 1 if something has to be mended."""
        from qd.check import check_robot
        from sim.controllers.trace import compare_log

        robot = get_robot(self.robot)
        if self.trace is not None:
            policy = self.policy or str(robot.policy_file)
            differences = compare_log(self.trace, policy, robot)
            print("\n".join(differences) or f"{self.trace} agrees with {policy}.")
            return int(bool(differences))
        return int(not check_robot(robot, self.policy, compute=_compute(self), why=self.why))


@dataclass(frozen=True, kw_only=True)
class EvaluateCommand(SetsCfg, ControllerFlags, WorkerFlags):
    """Measure the rates of one controller on terrains or on a pack, or make the paper's tables of several.

    Rates say how often the controller gets through, and how large its velocity error is on flat ground. With
    --policies, --archive, --independent or --sets the command makes tables of any controllers on the same terrains.
    With --pack it says which terrains of a pack of faults a controller fails. Crossings are stored, so after Ctrl-C the
    same command goes on.

    For continuous integration (docs/testing.md), `--gate gate.toml` asks what that file says, by tests that stop once
    they are clear, of --policy, or of --policies old=A new=B. Its status is 0 for a pass, 1 for a fail, 2 for an error.
    `--pack anymal --fail-under .9` exits with status 1 if the goal rate may be lower, and `--policies old=A new=B
    --archive RUN` if B is worse on elites of RUN.
    """

    pack: str | None = None
    """Pack of faults that the controller is tested on: a folder that `faultline export` made, or a published one:
    anymal or cassie, or of a version anymal@1. --terrains takes the first of it; all on CUDA."""
    fail_under: Annotated[float, Meta(ge=0, le=1)] | None = None
    """With --pack: exit with status 1 if the lower end of the 95 % interval of the goal rate is below this."""
    gate: Path | None = None
    """Settings of a gate: tables [[check]] with pack = FOLDER or anymal@1 or cassie@1, or set = hand_crafted or
    hard_random with space; name, terrains (100), limit of the mean goal rate, margin (0.05), rounds (40), which are
    episodes of a terrain at most; and before them error (0.05) and seed (0). docs/testing.md has one."""
    junit: Path | None = None
    """With --gate: file for the verdicts as JUnit XML."""
    policies: tuple[str, ...] = ()
    """Controllers of the tables, each NAME=FILE, NAME=file.py:callable, NAME=module:callable or NAME=shipped, the first
    to compare with; base=shipped if left out. C-G, C-G@1 and C-G@2 are three seeds of one kind."""
    out: Path | None = None
    """File for the numbers. If left out: runs/<robot>-rates.json, of another controller <robot>-<its name>-rates.json,
    with a pack ...-pack.json, with a gate ...-gate.json; for tables runs/<robot>-tables/tables.json, of old and new
    compared.json."""

    def execute(self) -> int:
        """Evaluates; returns 1 if a controller is too bad."""
        if self.gate is not None:
            return self._pass_gate(self.gate)
        if self.junit is not None:
            raise ValueError("--junit goes with --gate: give the gate too")
        from qd.check import ensure_ready
        from qd.evaluate.evaluate import evaluate_rates, evaluate_tables
        from qd.evaluate.pack import PACK_FILE, evaluate_pack, find_pack, passes, read_pack
        from qd.evaluate.tables import is_regression

        makes_tables = bool(self.policies or self.sets or self.archive or self.independent)
        cfg = replace(select_settings(SetsCfg, self), sets=tuple(split_values(self.sets)))
        if self.pack is not None:
            if makes_tables or self.space is not None:
                raise ValueError("--pack goes with --policy alone, got flags of tables or --space too: leave them out")
            pack = read_pack(find_pack(self.pack))
            robot = resolve_robot(pack.content, self.robot, pack.folder / PACK_FILE, kind="pack")
            policy = self.policy or str(robot.policy_file)
            report = evaluate_pack(pack, robot, policy, cfg, compute=_compute(self), out=self.out)
            return int(self.fail_under is not None and not passes(report, self.fail_under))
        if self.fail_under is not None:
            raise ValueError("--fail-under goes with --pack: give the pack too")
        robot, compute = get_robot(self.robot), _compute(self)
        if not makes_tables:
            policy = self.policy or str(robot.policy_file)
            evaluate_rates(robot, policy, cfg, compute=compute, out=self.out)
            return 0
        if self.policy is not None:
            remedy = f"give --policies tuned={self.policy} instead of --policy"
            raise ValueError(f"tables are of named controllers: {remedy}")
        controllers = parse_controllers(self.policies, robot)
        robot = ensure_ready(robot, next(iter(controllers.values())), compute, skip_level_ground=True)
        return int(is_regression(evaluate_tables(robot, controllers, cfg, compute=compute, out=self.out)))

    def _pass_gate(self, file: Path) -> int:
        """Whether a gate says no."""
        from qd.evaluate.gate import publish_gate

        defaults = {field.name: field.default for field in fields(self)}
        own = ("gate", "junit", "out", "robot", "policy", "policies", "device", "workers", "num_envs")
        given = [name for name, value in vars(self).items() if name not in own and value != defaults[name]]
        if self.policies and self.policy is not None:
            given.append("policy")
        if given:
            flags = ", ".join(f"--{name.replace('_', '-')}" for name in given)
            raise ValueError(f"--gate says in its file what is crossed, got {flags} too: leave that out")
        robot = get_robot(self.robot)
        controllers = parse_controllers(self.policies, robot) if self.policies else {}
        if self.policies and {*controllers} != {"old", "new"}:
            raise ValueError(f"--gate compares --policies old=A new=B, got {', '.join(controllers)}: use these names")
        controllers = controllers or {"new": self.policy or str(robot.policy_file)}
        report = publish_gate(file, robot, controllers, _compute(self), self.out, self.junit)
        return int(not report["passes"])


@dataclass(frozen=True, kw_only=True)
class DoseCommand(RobotFlag, WorkerFlags):
    """Measure which real obstacle at which size stops a controller.

    One obstacle stands alone on flat ground, and one of its sizes grows: the rise of stairs, the width of a ditch; or
    the ground is level and its friction falls, or the robot's payload grows (docs/terrains.md). All values and
    controllers have the same places and seeds. Crossings are stored: the same command goes on.
    """

    policies: tuple[str, ...] = ()
    """Controllers, each NAME=FILE, NAME=file.py:callable, NAME=module:callable or NAME=shipped; base=shipped if left
    out."""
    elements: tuple[str, ...] = ()
    """Obstacles: {obstacles}; grounds: friction, softness; conditions on level ground, those that begin with map_ on
    random terrains of half their height: {conditions}. All but the conditions if left out. With other values as
    stairs_up=0.15,0.2,0.25; they may lie beyond what the space course has."""
    at: tuple[str, ...] = ()
    """Other sizes of obstacles beside the one that grows, each NAME=VALUE: tread=0.25 depth=0.3."""
    resolved: bool = False
    """Cross with contact resolved: steps of 1 ms and a contact time constant of 3 ms; about five times the work."""
    terrains: PositiveInt | None = None
    """Terrains a value; 20 on CUDA, 8 on the CPU."""
    episodes: PositiveInt | None = None
    """Episodes a terrain; 4 on CUDA, 2 on the CPU."""
    seed: NonNegativeInt = 0
    """Draws other episodes."""
    out: Path | None = None
    """File for the numbers; runs/<robot>-dose/dose.json, with contact resolved dose-resolved.json. The figure is
    written beside it as .png."""

    @staticmethod
    def help_values() -> dict[str, str]:
        """Names of doses."""
        from sim.terrains.conditions.kinds import CONDITIONS
        from sim.terrains.elements.kinds import ELEMENTS

        obstacles = (name for element in ELEMENTS.values() for name in element.doses)
        conditions = (name for name, condition in CONDITIONS.items() if condition.dose)
        return {"obstacles": ", ".join(obstacles), "conditions": ", ".join(conditions)}

    def execute(self) -> None:
        """Measures."""
        from qd.evaluate.dose import measure_dose, parse_doses

        robot = get_robot(self.robot)
        controllers = parse_controllers(self.policies, robot)
        doses = parse_doses(self.elements, self.at)
        size: dict[str, Any] = {"terrains": self.terrains, "episodes": self.episodes, "seed": self.seed}
        measure_dose(robot, controllers, doses, compute=_compute(self), resolved=self.resolved, out=self.out, **size)
