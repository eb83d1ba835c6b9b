"""What a command line of the fine-tuning means: controller, terrains and sizes, looked at before any long work."""

from dataclasses import asdict, dataclass, field, replace
from datetime import datetime
from pathlib import Path
from typing import Any, Literal

import numpy as np

from qd.archive import read_archive
from sim.files.command import split_words
from sim.robots.own import own_hash
from sim.robots.robot import RobotCfg, get_robot
from sim.robots.training import RewardCfg
from sim.simulation import resolve_device
from train.evaluate.held_out import marks_of, recorded_marks
from train.evaluate.sets import elites_sha256, split_elites
from train.ppo.ppo import PpoCfg, check_ppo
from train.ppo.resumed import check_resumed, saved_ppo, settings_of
from train.ppo.run import check_least, check_limits, check_more, plain, prepare_run_dir, read_saved
from train.ppo.start import Start, read_start
from train.task.cfg import TaskCfg
from train.task.mix import Mix, MixCfg

_PAPER = {"cassie": {"num_envs": 600, "terrains": 100, "swap_every": 200, "iterations": 3000}}
_PAPER_OTHERS = {"num_envs": 1500, "terrains": 500, "swap_every": 400, "iterations": 1200}
_SMALL = {"num_envs": 24, "terrains": 12, "swap_every": 50, "iterations": 100}  # 24 s a terrain: episodes end
_REWARDS = ("termination=-200", "tracking_lin_vel=2")  # of six weightings the best (README, Training on what broke it)
_DEFAULTS = {
    "mix": "generated", "split_seed": 0, "draw": "uniform", "task": "crossing", "seed": 0, "rewards": _REWARDS
}  # fmt: skip
_CRITIC_ITERATIONS = 50
_NUMBERS = (*_PAPER_OTHERS, "critic_iterations")
_KINDS = {name: type(value) for name, value in _DEFAULTS.items()} | dict.fromkeys(_NUMBERS, int)
_TASKS = ("crossing", "commands")
_PPO = PpoCfg(steps_per_env=24, entropy=0.005, desired_kl=0.005, final_kl=0.002)


@dataclass(frozen=True, kw_only=True)
class FinetuneCfg:
    """Fine-tune a controller by PPO on hand-crafted terrains and on those of an archive (the paper's C-G).

    Sizes are the paper's on a GPU, and small ones on the CPU, enough to see that it runs.
    """

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py)."""
    policy: Path | None = None
    """Controller to begin with: an rsl_rl checkpoint with layers of any size; the shipped one. A checkpoint.pt of
    train.base brings its critic too."""
    mix: Literal["generated", "hard-random", "hand-crafted"] | None = None
    """Terrains: hand-crafted ones, and as many elites (generated, the paper's C-G, the default) or hard-random ones
    (C-HR), or nothing else (C-HC)."""
    archive: Path | None = None
    """Run of a search, or its archive.npz, for mix generated; results/<robot>/archive."""
    split_seed: int | None = None
    """Which elites are held out for the evaluation; 0."""
    draw: Literal["uniform", "failing"] | None = None
    """How elites are drawn at each exchange: uniform; or failing, the likelier the less often they were crossed."""
    task: Literal["crossing", "commands"] | None = None
    """What robots are told: to cross, as in a search, the default; or random velocities, as in the base's training."""
    rewards: tuple[str, ...] | None = None
    """Weights that reward terms have in this training, each NAME=WEIGHT; termination=-200 (a fall) and
    tracking_lin_vel=2. Giving any replaces these two: terms left out keep the robot's own weight, also these two, as
    all do in the rewards of an evaluation."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    num_envs: int | None = None
    """Robots trained at once; on CUDA 1500 (Cassie: 600), on the CPU 24."""
    terrains: int | None = None
    """Terrains at a time; 500 (Cassie: 100), 12."""
    swap_every: int | None = None
    """Iterations after which they are exchanged; 400 (Cassie: 200), 50."""
    iterations: int | None = None
    """Iterations in all, those before a resume included; 1200 (Cassie: 3000), 100."""
    critic_iterations: int | None = None
    """Iterations at first in which the critic learns alone, where the controller comes without one; 50, or half."""
    max_seconds: float | None = None
    """Save and stop in time to be done this many seconds after the start."""
    run_dir: Path | None = None
    """Where to write; runs/<robot>-<mix>-<date>, or the resumed run."""
    resume: Path | None = None
    """Run directory to go on from, as it was begun."""
    export: Path | None = None
    """Also write the controller to this file and its training record beside it."""
    seed: int | None = None
    """Seed of everything drawn; 0."""
    save_every_s: float = 60.0
    """A checkpoint every so often [s]."""
    rows: int = 100
    """Progress rows over the whole training."""
    ppo: PpoCfg = field(default_factory=lambda: _PPO)
    """The layers are those of the controller."""


@dataclass(frozen=True, kw_only=True)
class Job:
    """A fine-tuning that can begin: everything a user may have got wrong has been looked at."""

    cfg: FinetuneCfg
    """Sizes, layers and seed filled in."""
    robot: RobotCfg
    device: str
    iterations: int
    num_envs: int
    seed: int
    start: Start | None
    """Networks it begins with; none where it goes on from a checkpoint."""
    mix: Mix
    task: TaskCfg
    settings: dict[str, Any]
    """What makes it what it is, as JSON values."""
    saved: dict[str, Any] | None
    """The checkpoint it goes on from."""
    run_dir: Path

    @property
    def trained_on(self) -> list[str]:
        """Marks of all elites that the controller has been trained on in the end (:mod:`train.evaluate.held_out`)."""
        return sorted({*marks_of(self.mix.genes), *self.settings.get("trained_before", [])})


def job_of(cfg: FinetuneCfg) -> Job:
    """What a command line asks for.

    Raises:
        ValueError: If controller, archive, mix, a size or the directory is not as it must be.
    """
    robot, device = get_robot(cfg.robot), resolve_device(cfg.device)
    saved = read_saved(cfg.resume, robot.name, finetuning=True) if cfg.resume else None
    cfg = _filled(cfg, robot.name, device)
    if saved is None:
        path = cfg.policy or robot.policy_file
        start = read_start(path, robot)
        hidden, before = start.hidden_dims, sorted(recorded_marks(str(path)))
        cfg = cfg if start.critic is None else replace(cfg, critic_iterations=0)
    else:  # all of it is in the checkpoint: the file it began with may be gone
        start, hidden = None, saved_ppo(cfg.resume, saved).hidden_dims
        before = saved["extra"]["settings"].get("trained_before", [])
    cfg = replace(cfg, ppo=replace(_ppo(cfg, saved), hidden_dims=hidden))
    values: Any = cfg  # whose numbers and names are all there now
    mix_cfg = MixCfg(mix=values.mix, terrains=values.terrains, swap_every=values.swap_every, draw=values.draw)
    check_ppo(cfg.ppo, values.num_envs)
    check_limits(rows=cfg.rows, save_every_s=cfg.save_every_s, max_seconds=cfg.max_seconds)
    check_more(cfg.resume, saved, values.iterations)
    if values.num_envs < mix_cfg.terrains:
        raise ValueError(f"num_envs must be at least as many as terrains, {mix_cfg.terrains}, got {values.num_envs}")
    if values.task not in _TASKS:
        raise ValueError(f"task must be one of {', '.join(_TASKS)}, got '{values.task}'")
    genes, about = _elites(cfg, robot)
    mix = Mix(cfg=mix_cfg, genes=genes, crosses=values.task == "crossing", seed=values.seed, device=device)
    task = TaskCfg.of(robot, crosses=mix.crosses, rewards=_rewards(values.rewards, robot))
    settings = plain(
        {
            "seed": values.seed,
            "num_envs": values.num_envs,
            "policy": str(cfg.policy or "shipped"),
            "mix": asdict(mix_cfg),
            "archive": about,
            "critic_iterations": cfg.critic_iterations,
            "task": asdict(task),
            "ppo": asdict(cfg.ppo),
            **own_hash(robot),
            **({"trained_before": before} if before else {}),
        }
    )
    if saved is not None and cfg.resume is not None:
        check_resumed(cfg.resume, saved, settings)
    return Job(
        cfg=cfg,
        robot=robot,
        device=device,
        iterations=values.iterations,
        num_envs=values.num_envs,
        seed=values.seed,
        start=start,
        mix=mix,
        task=task,
        settings=settings,
        saved=saved,
        run_dir=prepare_run_dir(_run_dir(cfg, robot.name), resume=cfg.resume, export=cfg.export),
    )


def _filled(cfg: FinetuneCfg, robot: str, device: str) -> FinetuneCfg:
    """Settings with all that was left out: as the resumed run has it, else as the device can do.

    Raises:
        ValueError: If a number is out of range, or the resumed run's settings cannot be read.
    """
    on_gpu = device.startswith("cuda")
    sizes = _PAPER.get(robot, _PAPER_OTHERS) if on_gpu else _SMALL
    before = settings_of(cfg.resume, {**_KINDS, "policy": Path, "archive": Path}) if cfg.resume else {}
    if not on_gpu and not before and cfg.num_envs is None and cfg.iterations is None:
        print(
            f"No GPU: a small fine-tuning of {sizes['num_envs']} robots and {sizes['iterations']} iterations, enough "
            "to see that it runs. The paper's takes minutes on one GPU."
        )
    defaults = {**_DEFAULTS, **sizes, **before}
    cfg = replace(cfg, **{name: value for name, value in defaults.items() if getattr(cfg, name) is None})
    if cfg.critic_iterations is None and cfg.iterations is not None:
        cfg = replace(cfg, critic_iterations=min(_CRITIC_ITERATIONS, cfg.iterations // 2))
    check_least(num_envs=(cfg.num_envs, 1), iterations=(cfg.iterations, 1), seed=(cfg.seed, 0))
    check_least(critic_iterations=(cfg.critic_iterations, 0))
    return cfg


def _rewards(given: tuple[str, ...], robot: RobotCfg) -> RewardCfg:
    """The robot's weights of reward terms but for those given, each NAME=WEIGHT."""
    weights = asdict(robot.training.rewards)
    for one in split_words(given):
        name, _, weight = one.partition("=")
        if name not in weights:
            raise ValueError(f"rewards has no term '{name}': expected NAME=WEIGHT with one of {', '.join(weights)}")
        try:
            weights[name] = float(weight)
        except ValueError:
            weights[name] = np.nan
        if not np.isfinite(weights[name]):
            raise ValueError(f"rewards must be NAME=WEIGHT with a number, such as {name}=-1, got '{one}'")
    return RewardCfg(**weights)


def _elites(cfg: FinetuneCfg, robot: RobotCfg) -> tuple[np.ndarray, dict[str, Any] | None]:
    """Genes of the elites to train on, shape (E, 64), and where they are from."""
    if cfg.mix != "generated":
        if cfg.archive is not None:
            raise ValueError(f"mix {cfg.mix} takes no terrains from an archive: leave --archive out")
        return np.zeros((0, 64), np.float32), None
    path = cfg.archive or Path("results") / robot.name / "archive"
    try:
        archive = read_archive(path)
    except FileNotFoundError as error:
        raise ValueError(f"{error}; make one (make archive ROBOT={robot.name}) and name it with --archive") from error
    split_seed = cfg.split_seed or 0
    rows = split_elites(archive, robot.name, split_seed).train
    about = {"archive_iterations": archive.iterations, "elites": len(archive), "trained_on": len(rows)}
    return archive.genes[rows], {
        "path": str(path), **about, "split_seed": split_seed, "elites_sha256": elites_sha256(archive)
    }  # fmt: skip


def _ppo(cfg: FinetuneCfg, saved: dict[str, Any] | None) -> PpoCfg:
    """Settings of the learner: the resumed run's, unless others are asked for."""
    if not cfg.ppo.captured:
        raise ValueError("rsl_rl's own PPO cannot let the critic learn alone at first: leave --ppo.captured on")
    return cfg.ppo if saved is None or cfg.ppo != _PPO else saved_ppo(cfg.resume, saved)


def _run_dir(cfg: FinetuneCfg, robot: str) -> Path:
    stamp = datetime.now().strftime("%Y%m%d-%H%M%S")
    return cfg.run_dir or cfg.resume or Path("runs") / f"{robot}-{cfg.mix}-{stamp}"
