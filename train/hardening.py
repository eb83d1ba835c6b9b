"""A hardening at work: which steps there are, which of them are done, and what they say together.

Every step is a run of its own: a search with its verdicts, or a training. What is done is read off these runs, so that
a hardening that was killed anywhere goes on where it was. ``rounds.json`` follows from them, but for which trainings
were kept: that is written there, and decided again from the crossings if it is lost.
"""

import signal
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

from qd.archive import Archive, read_archive
from qd.evaluate.evaluate import EPISODES, sizes_for
from qd.evaluate.sets import paper_terrains
from qd.judge import Stage as Judging
from qd.judge import judge, panel_of
from qd.run.directory import ROUNDS_FILE, RunDirectory, claimed
from qd.run.settings import SearchCfg, differences, preset
from qd.search import search
from qd.workers.evaluator import Compute, OpenEvaluator, check_policy, open_evaluator, resolve_device
from sim.files.atomic import is_leftover, read_json
from sim.files.command import Interrupted, command_line, naming_what_is_next
from sim.files.records import identity
from sim.files.settings import check
from sim.policy.spec import certifier_hash, controller_hash, controllers_of, is_same
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from sim.spaces.base import TerrainSpace
from sim.spaces.registry import is_own, load_space
from train.cfg import LARGE, FinetuneCfg, RunCfg
from train.choice import choose, known_choice
from train.finetune import finetune
from train.harden import Harden
from train.ppo.checkpoint import CHECKPOINT, read_start
from train.ppo.training import POLICY
from train.rounds import begin, divisible, read_rounds, record, tell

BASE = "base"
"""Name of the controller that a hardening begins with."""
_GPU_EPISODES = 400_000
_SEEDS = 100  # of searches and trainings, apart between hardenings of one seed and the next


@dataclass(frozen=True, kw_only=True)
class Tune:
    """One fine-tuning."""

    run: Path
    """Its directory."""
    start: Path | None
    """What it begins with: a controller, or the checkpoint of the training before, whose critic comes along; the
    shipped controller if None."""
    before: str
    """The controller that it begins with, as it is searched and evaluated."""
    archives: tuple[Path, ...]
    """Runs of the searches whose elites it trains on; of none: on hard-random terrains."""
    seed: int
    kept: bool | None = None
    """Whether the hardening goes on with what it makes, or with what was before; None where that is to be seen."""

    @property
    def policy(self) -> str:
        """The controller that it makes."""
        return str(self.run / POLICY)

    @property
    def after(self) -> str:
        """The controller that the hardening goes on with."""
        return self.before if self.kept is False else self.policy


@dataclass(frozen=True, kw_only=True)
class Stage:
    """A controller: the trainings that lead to it, and the search against it."""

    controller: str
    """Its name in ``rounds.json``."""
    policy: str
    """Its file."""
    chain: tuple[Tune, ...]
    """All trainings from the base to it; none of the base."""
    search: Path
    """Run of the search."""
    seed: int
    """Of the search."""
    compared: str = ""
    """Key in ``comparisons``; empty for a round."""

    @property
    def tunes(self) -> tuple[Tune, ...]:
        """The trainings since the stage before."""
        return self.chain if self.compared else self.chain[-1:]


@dataclass(frozen=True, kw_only=True)
class Hardening:
    """A hardening that can begin or go on: what a user may have got wrong is checked."""

    flags: Harden
    robot: RobotCfg
    path: Path
    device: str
    space: TerrainSpace
    compute: Compute
    terrains: int
    """Of each set of the evaluation."""
    episodes: int
    """On each of them."""
    search_iterations: int
    tune_sizes: dict[str, int]
    """Of each training: robots, terrains at a time, iterations, and how often terrains are exchanged."""
    settings: dict[str, Any]
    """What makes it what it is, as JSON values."""
    compared: dict[str, int]
    """What the rounds are compared with, and of how many trainings each comparison is."""
    open_evaluator: OpenEvaluator

    @property
    def stages(self) -> list[Stage]:
        """All controllers in order, as far as is known which they are: the base, one a round, those to compare with."""
        rounds = self.flags.rounds
        found = [Stage(controller=BASE, policy=self.base, chain=(), search=self.search_run(0), seed=self.seed(0))]
        archives = [self.search_run(number) for number in range(rounds)]
        chain = self._chain([(f"tune-{number}", tuple(archives[:number])) for number in range(1, rounds + 1)])
        for number, tune in enumerate(chain, start=1):
            found.append(
                Stage(
                    controller=f"round-{number}", policy=tune.after, chain=chain[:number],
                    search=self.search_run(number), seed=self.seed(number),
                )
            )  # fmt: skip
        for kind, trainings in self.compared.items():
            names, trained_on = [f"tune-{kind}-{number}" for number in range(1, trainings + 1)], ()
            if kind == "first_archive":
                trained_on = (archives[0],)
                if not (self.path / names[0]).exists():  # as that of comparisons begun by older versions
                    names[0] = "tune-1"  # the first round's training is the same
            chain = self._chain([(name, trained_on) for name in names])
            search = self.path / f"search-{kind}-{trainings}"
            stage = Stage(
                controller=kind, policy=chain[-1].after, chain=chain, search=search, seed=self.seed(trainings),
                compared=kind,
            )  # fmt: skip
            found.append(stage)
        return found

    def _chain(self, trainings: list[tuple[str, tuple[Path, ...]]]) -> tuple[Tune, ...]:
        """Trainings of which each begins where the last one that was kept ended, by name and what they train on."""
        found, start, before = [], self.flags.policy, self.base
        for number, (name, archives) in enumerate(trainings, start=1):
            run = self.path / name
            tune = Tune(run=run, start=start, before=before, archives=archives, seed=self.seed(number))
            tune = replace(tune, kept=True if self.flags.keep == "last" else known_choice(self, tune))
            start, before = run / CHECKPOINT if tune.kept is not False else start, tune.after
            found.append(tune)
        return tuple(found)

    @property
    def base(self) -> str:
        """The controller that it begins with."""
        return str(self.flags.policy or self.robot.policy_file)

    def search_run(self, number: int) -> Path:
        """Run of the search against the controller of a round; 0: of the base."""
        return self.path / f"search-{number}"

    def seed(self, number: int) -> int:
        """Seed of a round: searches of one seed would begin with the same terrains, some of which are held out.

        From 100 on, so that it is apart from searches of seed 0, 1 and so on, on whose elites controllers are tested.
        """
        return _SEEDS * (self.flags.seed + 1) + number

    def certifiers(self, policy: str) -> dict[str, str]:
        """Who certifies the faults of a controller, by name: the panel, or those named, without itself.

        Raises:
            ValueError: If nobody is left.
        """
        if not self.flags.by:
            return {name: file for name, file in panel_of(self.robot).items() if not is_same(file, policy)}
        named = controllers_of(self.flags.by, self.robot, flag="by")
        found = {name: file for name, file in named.items() if not is_same(file, policy)}
        if not found:
            raise ValueError(f"by must name a certifier other than {policy}, got {', '.join(named)}: name another one")
        return found

    def is_searched(self, stage: Stage) -> bool:
        """Whether the search against a controller is over, its fresh episodes included."""
        run = RunDirectory(stage.search)
        archive = judged_archive(run)
        whole = run.read_summary().get("judged_by")  # a kill may come between the archive and its numbers
        return archive is not None and archive.iterations >= self.search_iterations and bool(whole)

    def is_judged(self, stage: Stage) -> bool:
        """Whether its faults are counted too."""
        return self.is_searched(stage) and "others" in RunDirectory(stage.search).read_summary()["judged_by"]

    def is_tuned(self, tune: Tune) -> bool:
        """Whether a training is over."""
        try:
            done = read_json(Path(tune.policy).with_suffix(".train.json")).get("iterations")
        except (OSError, ValueError):
            return False
        return Path(tune.policy).exists() and isinstance(done, int) and done >= self.tune_sizes["iterations"]

    def is_settled(self, stage: Stage) -> bool:
        """Whether its trainings are over, and it is known which of them were kept."""
        return all(self.is_tuned(tune) and tune.kept is not None for tune in stage.tunes)

    @property
    def command(self) -> str:
        """The command that goes on with it."""
        given = {one.name: getattr(self.flags, one.name) for one in fields(self.flags)}
        changed_ = {one.name: given[one.name] for one in fields(self.flags) if given[one.name] != one.default}
        kept = {name: value for name, value in changed_.items() if value != ()}
        return command_line("harden", **{**kept, "run_dir": self.path})


def hardening_of(flags: Harden, *, open_evaluator: OpenEvaluator = open_evaluator) -> Hardening:
    """What a command line asks for, checked.

    Raises:
        ValueError: If robot, controller, certifiers, device, a size or the directory is not as it must be.
    """
    check(flags)
    if "first_archive" in flags.against and flags.rounds < 2:
        raise ValueError("against first_archive needs rounds of at least 2, got 1: with 1 it is the first round itself")
    robot, device = get_robot(flags.robot), resolve_device(flags.device, flags.workers)
    policy = flags.policy or robot.policy_file
    read_start(policy, robot)
    check_policy(str(policy), robot, device)
    space = load_space(flags.space, flags.ground)
    flags = replace(flags, space=flags.space and space.name, ground=None)
    on_cuda = device.startswith("cuda")
    sizes = {name: getattr(flags, name) for name in ("emitters", "batch_size", "replicas")}
    searched = search_cfg(flags, robot, str(policy), space, "wide" if on_cuda else "small")
    an_iteration = searched.episodes_per_iteration
    wanted = flags.search_episodes or (_GPU_EPISODES if on_cuda else searched.iterations * an_iteration)
    tuned = {name: getattr(flags, f"tune_{name}") or 0 for name in ("iterations", "num_envs", "terrains")}
    large = {} if robot.name == "cassie" else LARGE
    tuning = replace(FinetuneCfg.of(robot), **tuned).sized(robot, device, **large)
    tuning.check(robot)
    compute, full = Compute(device, flags.workers, flags.num_envs), (paper_terrains(robot.name), EPISODES)
    terrains, episodes = sizes_for(compute, flags.terrains, flags.episodes, full=full, small=(24, 4))
    found = Hardening(
        flags=flags,
        robot=robot,
        path=flags.run_dir or Path("runs") / f"{robot.name}-harden-{flags.seed}",
        device=device,
        space=space,
        compute=compute,
        terrains=terrains,
        episodes=episodes,
        search_iterations=-(-wanted // an_iteration),
        tune_sizes={name: getattr(tuning, name) for name in tuned},
        settings={},
        compared=dict.fromkeys(flags.against, flags.rounds),
        open_evaluator=open_evaluator,
    )
    found = replace(found, settings=_settings_of(found, searched, sizes))
    found = replace(found, compared={**_known_comparisons(found), **found.compared})
    for certifier in found.certifiers(str(policy)).values():
        check_policy(certifier, robot, device)
    _refuse_another(found)
    for stage in found.stages:
        _refuse_changed(found, stage)
    return found


def _known_comparisons(job: Hardening) -> dict[str, int]:
    """What the rounds were compared with before, and of how many trainings: it stays in the tables.

    Of one whose runs are no longer all there only the row is kept.
    """
    rows = read_rounds(job.path).get("comparisons", {})
    known = replace(job, compared={kind: row["rounds"] for kind, row in rows.items()})
    there = [stage for stage in known.stages if stage.compared and known.is_searched(stage)]
    return {stage.compared: len(stage.chain) for stage in there if all(map(job.is_tuned, stage.chain))}


def _settings_of(job: Hardening, search: SearchCfg, sizes: dict[str, Any]) -> dict[str, Any]:
    flags, episodes = job.flags, search.episodes_per_iteration * job.search_iterations
    searched = {"preset": search.preset, "method": search.scheduler.method, **sizes, "episodes": episodes}
    recipe = {**vars(job.robot.tuning), **({"draw": flags.draw} if flags.draw else {})}
    return {
        **identity(job.robot, job.base),
        "seed": flags.seed,
        "space": job.space.name,
        "search": searched,
        "tune": {**job.tune_sizes, "noise_of": BASE, **recipe},
        "keep": flags.keep,
        "evaluation": {"terrains": job.terrains, "episodes": job.episodes},
    }


def _refuse_another(job: Hardening) -> None:
    """Refuses a directory that holds something else, or a hardening of other settings.

    Raises:
        ValueError: If it does.
    """
    path = job.path
    if (path / ROUNDS_FILE).exists():
        content = read_rounds(path)
        different = differences(content.get("settings", {}), job.settings)
        if different:
            raise ValueError(
                f"{path} holds a hardening of other settings: {', '.join(different)}: give those (a recipe's in tuning "
                "of the robot's settings; what is null was begun by an older version), or another --run-dir"
            )
        done = len(content.get("rounds", [])) - 1
        if job.flags.rounds < done:
            raise ValueError(f"rounds must be at least {done}, as many as {path} has done, got {job.flags.rounds}")
    elif path.is_dir() and not all(map(is_leftover, path.iterdir())):
        raise ValueError(f"{path} is not empty and holds no {ROUNDS_FILE}: give another --run-dir")


def _refuse_changed(job: Hardening, stage: Stage) -> None:
    """Refuses a search that is no longer the hardening's: its numbers would not compare with those of the others.

    Raises:
        ValueError: If it was made longer, its controller is another now, a training before it is gone, or one certified
            that is not asked elsewhere.
    """
    archive = judged_archive(RunDirectory(stage.search))
    if archive is None:
        return
    if archive.iterations > job.search_iterations:
        raise ValueError(
            f"{stage.search} must have {job.search_iterations} iterations, as all searches of its hardening, got "
            f"{archive.iterations}: put a copy of it back, or give another --run-dir"
        )
    lost = [tune.run for tune in stage.chain if not job.is_tuned(tune)]
    if lost:
        raise ValueError(
            f"{lost[0]} must be there, whole, as {stage.search} was searched after it: put a copy of it back, or give "
            "another --run-dir"
        )
    # Choices that are to be made again may fall on any of its trainings.
    is_known = all(tune.kept is not None for tune in stage.chain)
    candidates = [stage.policy] if is_known else [job.base, *(tune.policy for tune in stage.chain)]
    digests = set(map(controller_hash, candidates))
    if None not in digests and archive.policy_sha256 not in digests:
        raise ValueError(
            f"{stage.policy} must be the controller that {stage.search} was searched with, got another: put it back, "
            f"or what choices in {ROUNDS_FILE} said, or give another --run-dir"
        )
    asked = {certifier_hash(*one) for one in job.certifiers(stage.policy).items()}
    there = archive.faults and dict(zip(archive.faults.certifiers, archive.faults.certifier_sha256, strict=True))
    others = [name for name, one in (there or {}).items() if one not in asked]
    if others:
        raise ValueError(
            f"all searches of {job.path} must have the same certifiers, got certificates of {', '.join(others)} in "
            f"{stage.search.name}, who is not asked now: name all of them by --by"
        )


def harden(flags: Harden, *, open_evaluator: OpenEvaluator = open_evaluator) -> int:
    """Runs what is left of a hardening; returns the exit status 0, also where the time is up.

    Args:
        flags: What is asked for.
        open_evaluator: Opens what crosses terrains.

    Raises:
        As :meth:`train.harden.Harden.execute`.
    """
    job = hardening_of(flags, open_evaluator=open_evaluator)
    go_on = f"Go on with:  {job.command}"
    with _time_limit(flags.max_seconds) as is_up:
        try:
            with claimed(job.path), naming_what_is_next("what is finished is kept", lambda: go_on):
                begin(job)
                for number in range(len(job.stages)):
                    _run(job, number)
        except Interrupted as stop:
            if not is_up():
                raise
            print(f"The time is up. {stop}")
            return 0
    tell(read_json(job.path / ROUNDS_FILE))
    print(f"The hardened controller:  {job.stages[flags.rounds].policy}")
    print(f"Next, see it on one page:  {command_line('report', robot=job.robot.spec, run=job.path)}")
    return 0


@contextmanager
def _time_limit(seconds: float | None) -> Iterator[Callable[[], bool]]:
    """Interrupts as Ctrl-C does after so many seconds; gives what says whether it did."""
    rung: list[int] = []

    def ring(kind: int, _frame: object) -> None:
        rung.append(kind)
        if not callable(signal.getsignal(signal.SIGINT)):  # a shell has its background jobs ignore Ctrl-C
            raise KeyboardInterrupt
        signal.raise_signal(signal.SIGINT)

    if seconds is None:
        yield lambda: False
        return
    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield lambda: bool(rung)
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)


def _run(job: Hardening, number: int) -> None:
    """All that is left to be done for a controller."""
    for place in range(len(job.stages[number].tunes)):
        tune = job.stages[number].tunes[place]  # what it begins with follows from which of those before were kept
        if not job.is_tuned(tune):
            print(f"\n=== {job.stages[number].controller}: training, in {tune.run}", flush=True)
            _tune(job, tune)
        if job.stages[number].tunes[place].kept is None:
            choose(job, tune)
    stage = job.stages[number]
    _refuse_changed(job, stage)  # a training made anew, or a choice
    if stage.tunes and not job.is_searched(stage):
        record(job)
    if not job.is_judged(stage):
        print(f"\n=== {stage.controller}: search, in {stage.search}", flush=True)
        _search(job, stage)
        _judge(job, stage)
    record(job)


def _tune(job: Hardening, tune: Tune) -> None:
    """Trains, or goes on; raises KeyboardInterrupt where it was asked to stop."""
    flags = job.flags
    cfg = FinetuneCfg.of(job.robot)
    noise_of = job.base if tune.start != flags.policy else None
    recipe = replace(cfg.recipe, draw=flags.draw or cfg.recipe.draw, noise_of=noise_of)
    cfg = replace(
        cfg, **job.tune_sizes, seed=tune.seed, policy=None if tune.start is None else str(tune.start),
        archive=tuple(map(str, divisible(tune.archives))), mix="generated" if tune.archives else "hard-random",
        space=job.space.name if is_own(job.space.name) or not tune.archives else None, recipe=recipe,
    )  # fmt: skip
    finetune(job.robot, cfg, tune.run, RunCfg(device=flags.device))


def _search(job: Hardening, stage: Stage) -> None:
    """Searches against a controller, or goes on; ends with fresh episodes, and with contact resolved."""
    if job.is_searched(stage):
        return
    policy = stage.policy if _named(job, stage) else None
    default = "wide" if job.device.startswith("cuda") else "small"
    cfg = replace(
        search_cfg(job.flags, job.robot, policy, job.space, default), seed=stage.seed, iterations=job.search_iterations
    )
    compute = Compute(job.device, job.flags.workers, job.flags.num_envs)
    search(cfg, stage.search, compute, robot=job.robot, policy=stage.policy, open_evaluator=job.open_evaluator)
    _judge(job, stage, ("fresh",))


def judged_archive(run: RunDirectory) -> Archive | None:
    """The archive of a run if it has fresh values; a damaged one, which is made again, has none."""
    try:
        archive = read_archive(run.path)
    except (OSError, ValueError):
        return None
    return None if archive.fresh is None else archive


def search_cfg(flags: Harden, robot: RobotCfg, policy: str | None, space: TerrainSpace, default: str) -> SearchCfg:
    """The searches of a hardening, with the default preset if the flags have none."""
    cfg = preset(flags.preset or default, robot, policy, space=space.name, space_sha256=space.sha256)
    sizes = {name: size for name in ("emitters", "batch_size") if (size := getattr(flags, name)) is not None}
    return replace(cfg, replicas=flags.replicas or cfg.replicas, scheduler=replace(cfg.scheduler, **sizes))


def _judge(job: Hardening, stage: Stage, stages: Sequence[Judging] = ("resolved", "others")) -> None:
    """Counts the faults of a controller among the elites of its search."""
    judge(
        stage.search, compute=Compute(job.device, job.flags.workers, job.flags.num_envs), stages=stages,
        certifiers=job.certifiers(stage.policy), robot=job.robot.spec, policy=_named(job, stage), space=job.flags.space,
        open_evaluator=job.open_evaluator,
    )  # fmt: skip


def _where(job: Hardening) -> dict[str, Any]:
    """The flags that every command about a search takes."""
    names = ("device", "workers", "num_envs", "space")
    return {"robot": job.robot.spec, **{name: getattr(job.flags, name) for name in names}}


def _named(job: Hardening, stage: Stage) -> str | None:
    """What a search calls its controller; None for the shipped one."""
    return None if job.flags.policy is None and stage.policy == job.base else stage.policy
