"""Settings of trainings. This module loads neither torch nor Warp, so that a command's help is quick."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal, Self

from msgspec import Meta

from sim.files.settings import (
    Interval,
    NonNegativeFloat,
    NonNegativeInt,
    PositiveFloat,
    PositiveInt,
    Share,
    check_settings,
    select_settings,
)
from sim.robots.robot import RobotCfg
from sim.robots.training import MAX_SPREAD, Draw, NoiseCfg, PaceCfg, TrainingCfg
from sim.terrains.hand_crafted import NUM_LEVELS

_BASE_ON_CPU = {"num_envs": 32, "iterations": 20}
_TUNING_ON_CPU = {"num_envs": 24, "terrains": 12, "swap_every": 50, "iterations": 100}  # 24 s a terrain
LARGE = {"num_envs": 8192, "terrains": 2000, "iterations": 1200}
"""Sizes of each training of a hardening on a GPU, several times the paper's: robots, terrains at a time and steps."""
SPECIALIST = {**LARGE, "iterations": 1000}
"""Sizes of the training of a search's own specialist."""
_SPECIALIST_SEED = 7


@dataclass(frozen=True, kw_only=True)
class CurriculumCfg:
    """Shares of the terrain types and where robots begin.

    legged_gym's tiles have no rough ground on a level plane, which one in six hand-crafted crossings is made of:
    columns of ``noise`` tiles are added beside them.
    """

    num_columns: NonNegativeInt = 20
    """Columns of legged_gym's types; 20 and its multiples give its shares exactly."""
    noise_columns: NonNegativeInt = 2
    """Columns of noise: uniform +-(.02 + .08 d) m on patches of 0.2 m."""
    max_first_level: Annotated[int, Meta(ge=0, le=NUM_LEVELS - 1)] = 5
    """Robots begin on levels 0 to this, drawn uniformly."""


@dataclass(frozen=True, kw_only=True)
class TaskCfg(TrainingCfg):
    """The task; the defaults are legged_gym's for ANYmal, except the start's yaw, which is 0 there."""

    noise: NoiseCfg = field(default_factory=NoiseCfg)
    curriculum: CurriculumCfg = field(default_factory=CurriculumCfg)
    crosses: bool = False
    """Robots start at one side of a terrain and are told to go to the other, as in a search, instead of random
    velocities and headings from its middle."""
    start_spread: Annotated[float, Meta(ge=0, le=MAX_SPREAD)] = 0.0
    """Where robots cross, they start up to so far along the way, uniformly [m]; the goal stays where it is."""
    episode_s: PositiveFloat = 20.0
    command_interval_s: PositiveFloat = 10.0
    """Time between commands [s]."""
    lin_vel_x: Interval = (-1.0, 1.0)
    """Range of the commanded forward velocity [m/s]."""
    lin_vel_y: Interval = (-1.0, 1.0)
    """Range of the commanded sideward velocity [m/s]."""
    min_speed: NonNegativeFloat = 0.2
    """Slower commands become 0 [m/s]."""
    yaw_gain: NonNegativeFloat = 0.5
    """Commanded yaw rate per heading error [1/s]."""
    max_yaw_rate: NonNegativeFloat = 1.0
    """Largest commanded yaw rate [rad/s]."""
    push_interval_s: NonNegativeFloat = 15.0
    """Time between pushes [s]; 0 for none."""
    friction: Interval = (0.5, 1.25)
    """Range of the robots' friction coefficients."""
    start_position_range: NonNegativeFloat = 1.0
    """Starts lie within this of the tile's centre along x and y [m]."""
    start_yaw_range: NonNegativeFloat = math.pi
    """Half width of the start's heading [rad]: every heading, so that robots meet a stair or slope at every angle."""
    start_velocity_range: NonNegativeFloat = 0.5
    """Half width of the base's first linear and angular velocity [m/s, rad/s]."""
    base_force: NonNegativeFloat = 1.0
    """Contact force on the base that ends an episode [N]."""
    max_gravity_z: float = -0.1
    """An episode ends when the projected gravity's z component exceeds this (-1: upright)."""

    @classmethod
    def of(cls, robot: RobotCfg, **changes: Any) -> Self:
        """The task with a robot's own settings, but for ``changes``."""
        return cls(**{**vars(robot.training), **changes})


@dataclass(frozen=True, kw_only=True)
class PpoCfg(PaceCfg):
    """Settings of the learner; the defaults are legged_gym's, except the steps."""

    hidden_dims: tuple[PositiveInt, ...] = (512, 256, 128)
    """Hidden layers (ELU) of actor and critic."""
    steps_per_env: PositiveInt = 16
    """Control steps an iteration, per environment; legged_gym's 24 are for half as many environments."""
    epochs: PositiveInt = 5
    """Passes over the data of an iteration."""
    mini_batches: PositiveInt = 4
    """Minibatches a pass."""
    learning_rate: PositiveFloat = 1e-3
    """Learning rate at the start; adapted to the KL divergence from then on."""
    gamma: Share = 0.99
    """Discount per control step."""
    lam: Share = 0.95
    """Lambda of generalised advantage estimation."""
    clip: PositiveFloat = 0.2
    """Clip range of the probability ratio and of the value."""
    average: Share = 0.0
    """Share of all iterations, the last ones, whose actors' weights are averaged into the controller; 0: it is the last
    actor. The mean walks a little more smoothly."""

    @classmethod
    def of(cls, robot: RobotCfg) -> Self:
        """The settings that a robot's controller is learned with."""
        return cls(**vars(select_settings(PaceCfg, robot.learning)))


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
        return self._with_sizes(vars(robot.learning) if device.startswith("cuda") else _BASE_ON_CPU)

    def _with_sizes(self, sizes: Mapping[str, Any]) -> Self:
        unset = [name for name in ("num_envs", "terrains", "iterations") if getattr(self, name, None) == 0]
        return replace(self, **{name: sizes[name] for name in unset})

    def check(self, robot: RobotCfg) -> None:
        """Raises a ValueError for settings that cannot be trained with; sizes must be filled in."""
        check_settings(self)
        for name in ("episode_s", "command_interval_s"):
            if (time_s := getattr(self.task, name)) < robot.control_dt:
                raise ValueError(f"task.{name} must be at least a control step, {robot.control_dt:g} s, got {time_s:g}")
        if self.task.friction[0] < 0:
            raise ValueError(f"task.friction must be at least 0, got {self.task.friction[0]:g}")
        if not self.ppo.hidden_dims:
            raise ValueError("ppo.hidden_dims must name at least one layer, got none")
        if self.ppo.mini_batches > self.num_envs * self.ppo.steps_per_env // 2:
            transitions = f"{self.num_envs} x {self.ppo.steps_per_env} transitions of an iteration"
            got = f"{self.ppo.mini_batches}: give fewer, or more num_envs"
            raise ValueError(f"ppo.mini_batches must be at most half of the {transitions}, got {got}")


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
        weights = {"termination": tuning.termination, "tracking_lin_vel": tuning.tracking_lin_vel}
        rewards = replace(robot.training.rewards, **weights)
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
        sizes = vars(robot.paper) | on_cuda if device.startswith("cuda") else _TUNING_ON_CPU
        recipe = replace(self.recipe, swap_every=self.recipe.swap_every or sizes["swap_every"])
        return replace(self._with_sizes(sizes), recipe=recipe)

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
    """Each training, but for controller, seed, archives and space, which are the round's. On CUDA it has 8192 robots,
    2000 terrains at a time and 1200 iterations."""
    evaluation: RoundEvaluationCfg = field(default_factory=RoundEvaluationCfg)

    @classmethod
    def of(cls, robot: RobotCfg) -> Self:
        """The settings of a robot."""
        return cls(tune=FinetuneCfg.of(robot))

    def sized_tune(self, robot: RobotCfg, device: str) -> FinetuneCfg:
        """The settings of each training, with sizes of 0 replaced by those that suit the robot and the Warp device."""
        return self.tune.sized(robot, device, **LARGE)
