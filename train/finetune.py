"""Fine-tune a controller on the terrains that broke it."""

import time
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal

from sim.files.command import OnGround
from sim.files.settings import setting
from sim.robots.training import MOST_SPREAD, Draw, RewardCfg
from train.ppo.cfg import PpoCfg, TrainingFlags

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg

_PPO = PpoCfg(steps_per_env=24, desired_kl=0.005)  # beside it the robot's recipe


def shipped_space(settings: dict[str, Any]) -> str | None:
    """The terrain space that a training's settings name; None for one of a user's own, which its command line names."""
    return None if settings.get("space_sha256") else settings.get("space")


def archive_paths(settings: dict[str, Any]) -> list[str]:
    """Where the archives lie that a training's settings name; a single one stands there by itself."""
    paths = (settings.get("archive") or {"path": []})["path"]
    return [paths] if isinstance(paths, str) else paths


@dataclass(frozen=True, kw_only=True)
class Finetune(OnGround, TrainingFlags):
    """Fine-tune a controller by PPO on hand-crafted terrains and on those of an archive (the paper's C-G).

    On CUDA the sizes are the paper's, on the CPU small ones, enough to see that it runs. Ctrl-C or --max-seconds saves
    and stops; --resume RUN_DIR goes on with the settings of that run.
    """

    command: ClassVar[str] = "finetune"
    policy: Path | None = None
    """Controller to begin with: an rsl_rl checkpoint with layers of any size; the shipped one. The checkpoint.pt of a
    training is its last actor, with its critic; its policy.pt is the mean of the last actors."""
    noise_of: Path | None = None
    """Controller with whose noise of the actions to begin, if its file says it; that of --policy. Noise grows in a
    training, and a hardening lets each begin with the base's."""
    mix: Literal["generated", "hard-random", "hand-crafted"] = "generated"
    """Terrains: hand-crafted ones, and as many elites (generated, the paper's C-G) or hard-random ones (C-HR), or
    nothing else (C-HC)."""
    archive: tuple[Path, ...] = ()
    """Runs of searches, or their archive.npz, for mix generated; results/<robot>/archive, or of a robot without one
    its newest run under runs/."""
    shares: Literal["equal", "size"] = "equal"
    """How often elites of several archives are drawn. equal: as often from each archive, so that a small one counts as
    much as a large one. size: every elite equally often."""
    space: str | None = None
    """Terrain space of mix hard-random: super_gaussian, course, or file.py:CLASS; super_gaussian if left out. Name a
    space of your own here too, for its elites and for a resumed training on it."""
    split_seed: int = setting(0, least=0)
    """Which elites are held out for the evaluation."""
    only: Literal["all", "failing", "certified", "uncertified"] = "all"
    """Which elites to train on. failing: those that fail by their fresh episodes. certified: those of them that a
    certifier crosses. uncertified: those of them that none is known to cross."""
    held_out: bool = True
    """Whether elites are held out for the evaluation. A specialist, which is to certify, may train on all."""
    draw: Draw | None = None
    """How elites are drawn at each exchange. uniform: all alike. failing: rather those that were seldom crossed.
    learnable: rather those that were crossed about half of the time, so that harder ones come later; so if
    left out."""
    task: Literal["crossing", "commands"] = "crossing"
    """What robots are told. crossing: to cross the terrain, as in a search. commands: random velocities, as in the
    base's training."""
    start_spread: float | None = setting(None, least=0.0, most=MOST_SPREAD)
    """Robots start up to so far along the way, drawn uniformly [m]. The goal stays where it is. Only for task crossing.
    So robots also learn what lies behind a hard beginning. If left out: 8."""
    rewards: RewardCfg
    """Weights of the reward terms in this training: the robot's own, but -200 for a fall and 6 for tracking_lin_vel
    (Cassie: 4, a robot of your own: 2). The rewards of an evaluation keep the robot's own."""
    terrains: int | None = setting(None, least=1)
    """Terrains at a time; on CUDA 500 (Cassie: 100), on the CPU 12."""
    swap_every: int | None = setting(None, least=1)
    """Iterations after which they are exchanged; on CUDA 400 (Cassie: 200), on the CPU 50."""
    critic_iterations: int | None = setting(None, least=0)
    """How many iterations the critic learns alone at first, if the controller comes without one. 50, or half of all if
    there are fewer than 100."""
    ppo: PpoCfg = field(default_factory=lambda: _PPO)
    """The learner; its layers are those of the controller."""

    @classmethod
    def begun(cls, robot: "RobotCfg", settings: dict[str, Any] | None) -> dict[str, Any]:
        """The flags that follow from a robot, or that a run was begun with."""
        if settings is None:
            own = robot.tuning
            weights = {"termination": own.termination, "tracking_lin_vel": own.tracking_lin_vel}
            ppo = replace(_PPO, entropy=own.entropy, average=own.average)
            return {"rewards": replace(robot.training.rewards, **weights), "ppo": ppo}
        same = ("seed", "num_envs", "iterations", "critic_iterations", "split_seed", "ppo")
        policy, task = settings["policy"], settings["task"]
        return {
            **{name: settings[name] for name in same},
            **settings["mix"],
            "policy": None if policy == "shipped" else Path(policy),
            "noise_of": Path(settings["noise_of"]) if settings.get("noise_of") else None,
            "archive": tuple(map(Path, archive_paths(settings))),
            "shares": settings.get("shares", "equal"),
            "space": shipped_space(settings),
            "task": "crossing" if task["crosses"] else "commands",
            "start_spread": task.get("start_spread", 0.0),
            "only": (settings["archive"] or {}).get("only", "all"),
            "held_out": (settings["archive"] or {}).get("held_out", True),
            "rewards": task["rewards"],
        }

    def execute(self) -> int:
        """Fine-tunes; returns the exit status: 0, or 130 after Ctrl-C.

        Raises:
            ValueError: If a flag's value cannot be used; raised before any long work.
            FloatingPointError: If the training leaves the finite numbers; the last checkpoint is kept.
        """
        from train.ppo.run import run_training
        from train.tuning import FineTuning, job_of, other_weights

        job = job_of(self, time.monotonic())
        print(
            f"Fine-tuning '{job.robot.name}' on {job.mix.cfg.terrains} terrains at a time ({self.mix}): "
            f"{job.num_envs} robots on {job.device}, {job.iterations} iterations, in {job.run_dir}",
            flush=True,
        )
        print(other_weights(job.task.rewards, job.robot.training.rewards))
        if job.critic_iterations >= job.iterations:
            print(
                f"The critic learns alone for the first {job.critic_iterations} iterations: the controller stays as it "
                "is. To change it, give more --iterations or fewer --critic-iterations."
            )
        return run_training(job, lambda: FineTuning(job))
