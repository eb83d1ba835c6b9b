"""A fine-tuning: what it begins with, checked, and how it exchanges terrains under the learner."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from qd.archive import Archive
from qd.evaluate.marks import TRAINED_ON, marks_of, recorded_marks
from qd.evaluate.sets import EliteSplit, elites_sha256, read_elites, space_of, split_elites
from qd.run.directory import directory_of, published_or_newest
from sim.files.command import command_line
from sim.policy.loaders import MlpPolicy, load_policy
from sim.policy.spec import SHIPPED, name_of
from sim.robots.find import get_robot
from sim.robots.robot import RobotCfg
from sim.robots.training import RewardCfg
from sim.spaces.base import TerrainSpace
from sim.spaces.registry import get_space, identity, is_own, load_space
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from train.finetune import Finetune, archive_paths
from train.ppo.learner import Start, read_start
from train.ppo.run import (
    POLICY,
    Job,
    Training,
    check_resumed,
    device_of,
    prepare_run_dir,
    read_saved,
    settings_of,
    sizes_of,
)
from train.task.cfg import TaskCfg
from train.task.mix import Mix, MixCfg

_PAPER = {"cassie": {"num_envs": 600, "terrains": 100, "swap_every": 200, "iterations": 3000}}
_PAPER_OTHERS = {"num_envs": 1500, "terrains": 500, "swap_every": 400, "iterations": 1200}  # the paper's ANYmal
_HARDENING_OTHERS = {"num_envs": 8192, "terrains": 2000}  # left ANYmal a third of the faults that the paper's left
_SMALL = {"num_envs": 24, "terrains": 12, "swap_every": 50, "iterations": 100}  # 24 s a terrain: episodes end
_CRITIC_ITERATIONS = 50
_VALIDATION = "validation"  # key of the settings with the number of elites that are for validation


@dataclass(frozen=True, kw_only=True)
class TuningJob(Job):
    """A fine-tuning that can begin."""

    start: Start | None
    """Networks it begins with; none where it goes on from a checkpoint."""
    mix: Mix

    @property
    def critic_iterations(self) -> int:
        """Iterations at first in which the critic learns alone."""
        return self.settings["critic_iterations"]

    @property
    def trained_on(self) -> list[str]:
        """Marks of all elites that the controller has been trained on in the end (:func:`marks_of`)."""
        return sorted({*chain(*map(marks_of, self.mix.genes)), *self.settings.get("trained_before", [])})


class FineTuning(Training):
    """A fine-tuning at work: the terrains are exchanged under the learner."""

    def __init__(self, job: TuningJob) -> None:
        """Begin, or go on from the checkpoint of the job."""
        self.mix, self._alone = job.mix, job.critic_iterations
        tiles = self.mix.restore(job.saved["extra"]["mix"]) if job.saved else self.mix.next()
        # Every episode is whole, at the beginning as after an exchange: who crossed which terrain is counted.
        super().__init__(job, tiles=tiles, random_ages=False)
        self.extra = {TRAINED_ON: job.trained_on}
        if job.start is not None:
            self.learner.start_from(job.start.actor, job.start.critic)

    def before_iteration(self) -> None:
        """Exchanges the terrains where that is due, and lets the actor learn once its critic has had its time."""
        iteration = self.learner.iteration
        if iteration // self.mix.cfg.swap_every > self.mix.swap:
            self.task.exchange(self.mix.next(self.task.counts()))
            self.learner.begin_again()
        self.learner.alg.let_actor_learn(iteration >= self._alone)
        if iteration == self._alone:
            self.learner.alg.begin_actor()

    @property
    def averaged_from(self) -> int:
        """Likewise; while the critic learns alone, the actor is what it was."""
        return max(super().averaged_from, self._alone)

    def state(self) -> dict[str, Any]:
        """What a checkpoint keeps beside the learner, the terrains among it."""
        return {**super().state(), "mix": self.mix.state(self.task.counts())}

    def finish(self) -> None:
        """Writes the controller as ONNX too, where the packages for it are."""
        super().finish()
        path = self.job.run_dir / POLICY
        try:
            from sim.policy.export import export_onnx
        except ImportError as error:
            command = command_line("export-policy", robot=self.job.robot.spec, policy=path)
            print(f"No ONNX file was written ({error}); where onnx is installed:  {command}")
            return
        policy = load_policy(path, self.job.robot, "cpu")
        assert isinstance(policy, MlpPolicy)
        export_onnx(policy, path.with_suffix(".onnx"))
        print(f"The same as ONNX: {path.with_suffix('.onnx')}")

    def next_command(self) -> str:
        """The command that holds the controller against the shipped one, on elites held out of its training too.

        Of one that was trained on all elites, none held out: the command that lets it certify.
        """
        settings = self.job.settings
        newest, space = (archive_paths(settings) or [None])[-1], self.mix.spaces[-1].name
        space = space if is_own(space) else None
        if newest is not None and not settings["archive"].get("held_out", True):
            by, run = f"S={self.job.run_dir / POLICY}", directory_of(Path(newest))
            return command_line("certify", robot=self.job.robot.spec, run=run, space=space, by=[by])
        return command_line(
            "evaluate",
            robot=self.job.robot.spec,
            policies=[f"base={settings['policy']}", f"tuned={self.job.run_dir / POLICY}"],
            archive=newest,
            space=space,
            split_seed=(settings["split_seed"] or None) if newest else None,
        )


def job_of(flags: Finetune, began: float) -> TuningJob:
    """What a command line asks for, checked; the command ``began`` then on the clock of :func:`time.monotonic` [s].

    Raises:
        ValueError: If controller, archive, mix, a size or the directory is not as it must be.
    """
    robot, device = get_robot(flags.robot), device_of(flags)
    saved = read_saved(flags.resume, robot, flags.command) if flags.resume else None
    size = tuning_sizes(flags, robot, device)
    alone = flags.critic_iterations
    alone = min(_CRITIC_ITERATIONS, size["iterations"] // 2) if alone is None else alone
    if saved is None:
        path = flags.policy or robot.policy_file
        start, before = read_start(path, robot), sorted(recorded_marks(str(path)))
        start = start if flags.noise_of is None else start.with_noise_of(read_start(flags.noise_of, robot))
        ppo = replace(flags.ppo, hidden_dims=start.hidden_dims)
        alone = 0 if start.critic is not None else alone
    else:  # all of it is in the checkpoint: the file it began with may be gone
        start, ppo, before = None, flags.ppo, saved["extra"]["settings"].get("trained_before", [])
    crosses = flags.task == "crossing"
    draw = flags.draw or (robot.tuning.draw if flags.mix == "generated" else "uniform")
    spread = (robot.tuning.start_spread if crosses else 0.0) if flags.start_spread is None else flags.start_spread
    if spread and not crosses:
        raise ValueError(f"start_spread needs task crossing, got task {flags.task} with {spread:g} m")
    task = TaskCfg.of(robot, crosses=crosses, rewards=flags.rewards, start_spread=spread)
    common = settings_of(flags, robot, size, task, ppo)
    mix_cfg = MixCfg(mix=flags.mix, terrains=size["terrains"], swap_every=size["swap_every"], draw=draw)
    check_sizes(size)
    if saved is not None:
        _check_space(flags, saved["extra"]["settings"])
    elites = _elites(flags, robot, keep_validation=_keeps_validation(saved))
    settings = {
        **common,
        "policy": str(flags.policy or SHIPPED),
        **({} if flags.noise_of is None else {"noise_of": name_of(flags.noise_of, robot)}),
        "mix": asdict(mix_cfg),
        "archive": elites.about,
        **({"shares": flags.shares} if len(flags.archive) > 1 else {}),
        "split_seed": flags.split_seed,
        "critic_iterations": alone,
        **({"trained_before": before} if before else {}),
        **_named(elites.spaces, saved),
    }
    if saved is not None:
        _refuse_changes(flags, saved, settings)
    return TuningJob(
        flags=flags, robot=robot, device=device, num_envs=size["num_envs"], iterations=size["iterations"], task=task,
        ppo=ppo, settings=settings, saved=saved, began=began,
        run_dir=prepare_run_dir(flags, f"{robot.name}-{flags.mix}"),
        start=start,
        mix=Mix(
            cfg=mix_cfg, genes=elites.genes, spaces=elites.spaces, equal=flags.shares == "equal", crosses=crosses,
            seed=flags.seed, device=device, goal_rate=elites.goal_rate if draw == "learnable" else None,
        ),
    )  # fmt: skip


def other_weights(rewards: RewardCfg, own: RewardCfg) -> str:
    """Which reward terms weigh otherwise than the robot's own, in words."""
    usual = asdict(own)
    other = {name: weight for name, weight in asdict(rewards).items() if weight != usual[name]}
    if not other:
        return "Rewards: the robot's own"
    given = ", ".join(f"{name}={weight:g}" for name, weight in other.items())
    return f"Rewards: {given} (the robot's own: {', '.join(f'{usual[name]:g}' for name in other)})"


def tuning_sizes(flags: Finetune, robot: RobotCfg, device: str) -> dict[str, int]:
    """Robots, terrains, iterations and how often terrains are exchanged: what flags say, else what suits the device."""
    return sizes_of(flags, paper_sizes(robot.name), _SMALL, device=device)


def hardening_sizes(flags: Finetune, robot: RobotCfg, device: str) -> dict[str, int]:
    """As :func:`tuning_sizes`, of a training of a hardening: on CUDA of more robots, but for Cassie."""
    on_gpu = _PAPER.get(robot.name, _PAPER_OTHERS | _HARDENING_OTHERS)
    return sizes_of(flags, on_gpu, _SMALL, device=device)


def check_sizes(sizes: dict[str, int], prefix: str = "") -> None:
    """Refuses fewer robots than terrains; ``prefix`` is of the flags that say them.

    Raises:
        ValueError: If a terrain would have no robot.
    """
    robots, terrains = sizes["num_envs"], sizes["terrains"]
    if robots < terrains:
        raise ValueError(f"{prefix}num_envs must be at least as many as {prefix}terrains, {terrains}, got {robots}")


def paper_sizes(robot: str) -> dict[str, int]:
    """Sizes of the paper's fine-tuning; of a robot that it does not have, those of its ANYmal."""
    return _PAPER.get(robot, _PAPER_OTHERS)


class _Elites(NamedTuple):
    """Elites to train on."""

    genes: tuple[np.ndarray, ...]
    """A part of each archive, shape (E, genes of its space); E sums up over the parts."""
    spaces: tuple[TerrainSpace, ...]
    """Of each part; without elites one, that of hard-random terrains."""
    goal_rate: np.ndarray | None = None
    """Of each, as its archive has it, shape (E,)."""
    about: dict[str, Any] | None = None
    """Where they are from, as settings have it: of several archives each value is a list."""


def _keeps_validation(saved: dict[str, Any] | None) -> bool:
    """Whether no validation elites are trained on; a run begun before there were such goes on with what it has."""
    return saved is None or _VALIDATION in (saved["extra"]["settings"]["archive"] or {})


def _elites(flags: Finetune, robot: RobotCfg, *, keep_validation: bool) -> _Elites:
    """The elites that a command line asks to train on.

    Raises:
        ValueError: If there are none, or the ground of two archives cannot be in one training.
    """
    if flags.mix != "generated":
        if flags.archive:
            raise ValueError(f"mix {flags.mix} takes no terrains from an archive: leave --archive out")
        if flags.only != "all" or not flags.held_out:
            raise ValueError(f"mix {flags.mix} has no elites: leave --only and --no-held-out out, or use mix generated")
        space = load_space(flags.space, flags.ground)
        return _Elites((np.zeros((0, space.num_genes), np.float32),), (space,))
    if flags.ground is not None:
        raise ValueError("mix generated takes the ground of its archives, got --ground: leave it out")
    paths = flags.archive or (_usual_archive(flags, robot),)
    archives = [_read_archive(flags, robot, path) for path in paths]
    spaces = tuple(map(space_of, archives))
    splits = list(map(split_elites, archives))
    rows = _rows_to_train_on(flags, paths, archives, splits)
    parts = [one.genes[chosen] for one, chosen in zip(archives, rows, strict=True)]
    rates = [(one.fresh or one).goal_rate[chosen] for one, chosen in zip(archives, rows, strict=True)]
    about = [
        {
            "path": str(path), "archive_iterations": one.iterations, "elites": len(one), "trained_on": len(part),
            "elites_sha256": elites_sha256(one),
            **({_VALIDATION: len(split.validation)} if flags.held_out and keep_validation else {}),
        }
        for path, one, part, split in zip(paths, archives, parts, splits, strict=True)
    ]  # fmt: skip
    # The defaults are not named, so that a run of before there were others goes on.
    chosen = {"only": flags.only} if flags.only != "all" else {}
    chosen |= {} if flags.held_out else {"held_out": False}
    identities = _identities(spaces)
    chosen |= {"space": identities} if len(set(identities)) > 1 else {}
    return _Elites(
        genes=tuple(parts),
        spaces=spaces,
        goal_rate=np.concatenate(rates),
        about=(about[0] if len(about) == 1 else {key: [one[key] for one in about] for key in about[0]}) | chosen,
    )


def _rows_to_train_on(
    flags: Finetune, paths: Sequence[Path], archives: Sequence[Archive], splits: Sequence[EliteSplit]
) -> list[np.ndarray]:
    """Which elites of each archive: those asked for, without what any archive holds out for test or validation.

    Raises:
        ValueError: If there are none.
    """
    held_out = set[str]()
    if flags.held_out:  # searches that begin alike may share an elite
        for one, split in zip(archives, splits, strict=True):
            held_out.update(marks_of(one.genes[np.concatenate([split.test, split.validation])]))
    found = []
    for path, one, split in zip(paths, archives, splits, strict=True):
        # All of them are more than the parts of a split, which has no more than the paper's numbers; in an order that
        # does not depend on that of the file.
        rows = split.train if flags.held_out else np.lexsort(one.genes.T[::-1])
        rows = rows[chosen_elites(one, flags.only, path)[rows]]
        found.append(rows[[mark not in held_out for mark in marks_of(one.genes[rows])]] if len(rows) else rows)
    if not any(map(len, found)):
        told = ", ".join(map(str, paths))
        raise ValueError(
            f"{told} must have elites to train on that are {flags.only}, got none: choose others by --only"
        )
    return found


def _usual_archive(flags: Finetune, robot: RobotCfg) -> Path:
    named = None if flags.policy is None else str(flags.policy)
    return published_or_newest(robot, named, flag="archive")


def _read_archive(flags: Finetune, robot: RobotCfg, path: Path) -> Archive:
    try:
        return read_elites(path, robot, flags.space)
    except FileNotFoundError as error:
        make = command_line("archive", robot=robot.spec, policy=None if flags.policy is None else str(flags.policy))
        raise ValueError(f"{error}; make one with `{make}` and name it with --archive") from error


def chosen_elites(archive: Archive, only: str, path: Path) -> np.ndarray:
    """Which elites of an archive are of a kind: ``all``, ``failing``, ``certified`` or ``uncertified``.

    Args:
        archive: The N elites.
        only: The kind.
        path: Where the archive lies, for errors.

    Returns:
        Bool, shape (N,).

    Raises:
        ValueError: If nobody has looked: there are no fresh episodes, or no certifier was asked about them all.
    """
    if only == "all":
        return np.ones(len(archive), bool)
    if archive.fresh is None:
        raise ValueError(
            f"{path} must have fresh episodes of its elites, which say what fails, got none: run `faultline "
            "reevaluate` first, or use --only all"
        )
    if only == "failing":
        return archive.failing
    asked = (
        np.zeros(len(archive), bool) if archive.faults is None else archive.faults.certifier_outcomes.any(axis=(1, 2))
    )
    missing = int((archive.failing & ~asked).sum())
    if missing:
        raise ValueError(
            f"{path} must have all its failing elites crossed by certifiers, got {missing} of "
            f"{int(archive.failing.sum())} that were not: run `faultline certify` first, or use --only failing"
        )
    return archive.certified if only == "certified" else archive.failing & ~archive.certified


def _identities(spaces: Sequence[TerrainSpace]) -> list[str]:
    """What the terrains of each space depend on, wherever its code lies."""
    return [identity(space.name, space.sha256) for space in spaces]


def _named(spaces: Sequence[TerrainSpace], saved: dict[str, Any] | None) -> dict[str, Any]:
    """What settings say of a terrain space; a run of a user's own goes on with the name that it began with.

    Several spaces are named beside their archives.
    """
    space, *others = dict(zip(_identities(spaces), spaces, strict=True)).values()
    if others or space is SUPER_GAUSSIAN:  # the only one at first, which no settings name
        return {}
    there = {} if saved is None else saved["extra"]["settings"]
    moved = space.sha256 is not None and there.get("space_sha256") == space.sha256
    return {"space": there["space"] if moved else space.name, "space_sha256": space.sha256}


def _check_space(flags: Finetune, there: dict[str, Any]) -> None:
    """Refuses to go on without the terrain space that a run was begun in, or with one that has changed.

    Raises:
        ValueError: If it is a user's own that the command line does not name, or another now.
    """
    if there.get("space") is not None:
        if flags.space is not None:
            load_space(flags.space)
        get_space(there["space"], there.get("space_sha256"))


def _refuse_changes(flags: Finetune, saved: dict[str, Any], settings: dict[str, Any]) -> None:
    """Nothing but the iterations may change, and where the archive lies: its hash says whether it is the same.

    The robot was compared when the checkpoint was read; an older one names no hash of it.
    """
    free = ("iterations ", "archive.path ", "robot_sha256 ")
    different = [line for line in check_resumed(flags, saved, settings) if not line.startswith(free)]
    if different:
        raise ValueError(
            f"{flags.resume} was begun with other settings ({'; '.join(different)}): leave out what is given "
            "otherwise, put an archive that has changed back, or begin a new run"
        )
