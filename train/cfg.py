"""Settings of trainings. This module loads neither torch nor Warp, so that a command's help is quick."""

from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Literal, Self, TypeVar

from msgspec import Meta

from sim.files.settings import NonNegativeInt, PositiveInt, check_settings
from sim.robots.robot import RobotCfg
from sim.robots.training import Draw
from train.ppo.cfg import PpoCfg, ppo_problems
from train.task.cfg import TaskCfg, task_problems

_Cfg = TypeVar("_Cfg", bound="TrainCfg")
Sizes = dict[str, int]
"""Sizes of a training by the names of their settings."""
_BASE_ON_CPU: Sizes = {"num_envs": 32, "iterations": 20}
_TUNING_ON_CPU: Sizes = {"num_envs": 24, "terrains": 12, "swap_every": 50, "iterations": 100}  # 24 s a terrain
LARGE: Sizes = {"num_envs": 8192, "terrains": 2000}
"""Sizes that left ANYmal a third of the faults that the paper's left."""
SPECIALIST: Sizes = {**LARGE, "iterations": 1000}
"""Sizes of the training of a search's own specialist."""
_SPECIALIST_SEED = 7


@dataclass(frozen=True, kw_only=True)
class RunCfg:
    """Device and export of a training. They do not change what it learns."""

    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    export: Path | None = None
    """Also write the controller to this file and its training record beside it: sim/robots/<robot>.pt ships it,
    <name>.pt beside the settings file of another robot makes it that robot's own, unless a controller.toml stands
    beside its robot.toml."""


RUN = RunCfg()


@dataclass(frozen=True, kw_only=True)
class TrainCfg:
    """The training of a base controller. Its result depends on these settings and the robot alone."""

    seed: NonNegativeInt = 0
    """Seed of everything drawn."""
    num_envs: NonNegativeInt = 0
    """Robots trained at once, per process; 0: as many as suit robot and device."""
    iterations: NonNegativeInt = 0
    """Iterations in all, with those before a resume; 0: as many as suit robot and device."""
    task: TaskCfg = field(default_factory=TaskCfg)
    ppo: PpoCfg = field(default_factory=PpoCfg)

    @classmethod
    def of(cls, robot: RobotCfg) -> Self:
        """The settings of a robot."""
        return cls(task=TaskCfg.of(robot), ppo=PpoCfg.of(robot))

    def sized(self, robot: RobotCfg, device: str) -> Self:
        """Replaces sizes of 0 by those that suit the robot and the Warp device."""
        on_cuda = {"num_envs": robot.learning.num_envs, "iterations": robot.learning.iterations}
        return _with_sizes(self, on_cuda if device.startswith("cuda") else _BASE_ON_CPU)

    def check(self, robot: RobotCfg) -> None:
        """Raises a ValueError for settings that cannot be trained with; sizes must be filled in."""
        check_settings(self)
        lines = [*task_problems(self.task, robot.control_dt), *ppo_problems(self.ppo, self.num_envs)]
        if lines:
            raise ValueError("; ".join(lines))


@dataclass(frozen=True, kw_only=True)
class RecipeCfg:
    """Settings that seldom differ between fine-tunings."""

    swap_every: NonNegativeInt = 0
    """Iterations after which the terrains are exchanged; 0: on CUDA 400 (Cassie: 200), on the CPU 50."""
    draw: Draw = "learnable"
    """How elites are drawn at each exchange. uniform: all with equal chance. failing: with a chance that falls with
    the rate at which they were crossed last. learnable: with a chance that is largest for a rate of a half (rate times
    one minus rate: Rutherford et al. 2024). The rate is over robots that start all along the way. If there are at
    least as many terrains as elites, each elite is taken, and the draw fills the rest."""
    critic_iterations: NonNegativeInt | None = None
    """First iterations, in which the critic alone learns, if the controller has no critic; 50, or half of all if there
    are fewer than 100."""
    noise_of: str | None = None
    """Controller whose action noise the training begins with, if its file has it; that of --policy. Noise grows in a
    training, and each training of a hardening begins with the noise of the base controller."""
    only: Literal["all", "failing"] = "all"
    """Which elites to train on. failing: those that fail in fresh episodes."""
    held_out: bool = True
    """Hold elites out for the evaluation. A specialist, a certifier, trains on all."""


@dataclass(frozen=True, kw_only=True)
class FinetuneCfg(TrainCfg):
    """A fine-tuning. Its result depends on these settings, the files they name and the robot alone."""

    policy: str | None = None
    """Controller to begin with: an rsl_rl checkpoint with layers of any size, or a controller.toml of such or of
    TorchScript with plain layers; the robot's own. The checkpoint.pt of a training is its last actor, with its critic;
    its policy.pt is the mean of the last actors."""
    mix: Literal["generated", "hard-random", "hand-crafted"] = "generated"
    """Terrains: half hand-crafted ones, and half elites (generated, the paper's C-G) or hard-random ones (C-HR); or
    hand-crafted ones alone (C-HC)."""
    terrains: NonNegativeInt = 0
    """Terrains at a time; 0: on CUDA 500 (Cassie: 100), on the CPU 12."""
    archive: tuple[str, ...] = ()
    """Runs of searches, or their archive.npz, for mix generated, which share the places that not all elites fill. Left
    out, results/<robot>/archive, or of a robot without one its newest run under runs/."""
    space: str | None = None
    """Terrain space of mix hard-random: super_gaussian, course, or file.py:CLASS; super_gaussian if left out. Name a
    space of your own here too, for its elites and for a resumed training on it."""
    recipe: RecipeCfg = field(default_factory=RecipeCfg)

    @classmethod
    def of(cls, robot: RobotCfg) -> Self:
        """The settings of a robot: robots cross, and falls cost more than in the training of its base controller."""
        tuning = robot.tuning
        rewards = replace(
            robot.training.rewards, termination=tuning.termination, tracking_lin_vel=tuning.tracking_lin_vel
        )
        return cls(
            task=TaskCfg.of(robot, crosses=True, rewards=rewards, start_spread=tuning.start_spread),
            ppo=PpoCfg(steps_per_env=24, desired_kl=0.005, entropy=tuning.entropy, average=tuning.average),
            recipe=RecipeCfg(draw=tuning.draw),
        )

    @classmethod
    def specialist(cls, robot: RobotCfg) -> Self:
        """The settings that a search's own specialist is trained with."""
        cfg = cls.of(robot)
        return replace(cfg, seed=_SPECIALIST_SEED, recipe=replace(cfg.recipe, only="failing", held_out=False))

    def sized(self, robot: RobotCfg, device: str, **on_cuda: int) -> Self:
        """Replaces sizes of 0 by ``on_cuda`` and the paper's on a GPU, or by small ones on the CPU."""
        sizes = asdict(robot.paper) | on_cuda if device.startswith("cuda") else _TUNING_ON_CPU
        recipe = replace(self.recipe, swap_every=self.recipe.swap_every or sizes["swap_every"])
        return replace(_with_sizes(self, sizes), recipe=recipe)

    def check(self, robot: RobotCfg) -> None:
        """Raises a ValueError for settings that cannot be trained with; sizes must be filled in."""
        super().check(robot)
        if self.terrains < 2 and self.mix != "hand-crafted":
            raise ValueError(f"terrains must be at least 2 for mix {self.mix}, half of each kind, got {self.terrains}")
        if self.num_envs < self.terrains:
            raise ValueError(f"num_envs must be at least as many as terrains, {self.terrains}, got {self.num_envs}")
        if not self.task.crosses:
            raise ValueError("task.crosses must be True in a fine-tuning, whose terrains are to be crossed, got False")
        if self.mix != "generated" and self.archive:
            raise ValueError(f"mix {self.mix} takes no terrains from an archive, got --archive: leave it out")


@dataclass(frozen=True, kw_only=True)
class RoundSearchCfg:
    """Each search of a hardening."""

    preset: str | None = None
    """Size of an iteration: wide (the default on a GPU), paper, or small (the default on the CPU)."""
    episodes: NonNegativeInt = 0
    """Budget in episodes, rounded up to whole iterations; 0: 400,000 on CUDA (5 minutes on one H200), 2,560 on the CPU.
    With fewer, less is found: compare numbers of faults only between searches of the same budget."""


@dataclass(frozen=True, kw_only=True)
class RoundEvaluationCfg:
    """The evaluation and the validation of every controller of a hardening."""

    terrains: NonNegativeInt = 0
    """A set; 0: on CUDA 300 (Cassie: 180), on the CPU 24."""
    episodes: NonNegativeInt = 0
    """On each terrain; 0: on CUDA 20, on the CPU 4."""


@dataclass(frozen=True, kw_only=True)
class HardenCfg:
    """A hardening. Its result depends on these settings, the files they name and the robot alone."""

    policy: str | None = None
    """Controller to begin with: an rsl_rl checkpoint with layers of any size, or a controller.toml; the robot's own."""
    rounds: PositiveInt = 3
    """Rounds of training; there is one search more. A larger number later continues a finished run."""
    seed: Annotated[int, Meta(ge=0, le=10_000_000)] = 0
    """Seed of everything drawn in searches and trainings."""
    space: str | None = None
    """Terrain space: super_gaussian, course, or one of your own, file.py:CLASS; super_gaussian if left out."""
    specialists: bool = False
    """Train a specialist for each search too, whose certificates count beside those of the panel."""
    search: RoundSearchCfg = field(default_factory=RoundSearchCfg)
    tune: FinetuneCfg = field(default_factory=FinetuneCfg)
    """Each training, but for controller, seed, archives and space, which are the round's. On CUDA it has 8192 robots
    and 2000 terrains at a time (Cassie: the paper's sizes)."""
    evaluation: RoundEvaluationCfg = field(default_factory=RoundEvaluationCfg)

    @classmethod
    def of(cls, robot: RobotCfg) -> Self:
        """The settings of a robot."""
        return cls(tune=FinetuneCfg.of(robot))

    def sized_tune(self, robot: RobotCfg, device: str) -> FinetuneCfg:
        """The settings of each training, with sizes of 0 replaced by those that suit the robot and the Warp device."""
        return self.tune.sized(robot, device, **(LARGE if robot.tuning.large_rounds else {}))


def _with_sizes(cfg: _Cfg, sizes: Sizes) -> _Cfg:
    return replace(cfg, **{name: getattr(cfg, name) or size for name, size in sizes.items() if hasattr(cfg, name)})
