"""Settings of a search: how terrains are asked for, what is searched, and the presets.

Nothing here imports pyribs, which takes seconds: `--help` and the worker processes do without.
"""

import json
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

from msgspec import Meta

from qd.descriptors import Cells
from qd.fitness import FitnessCfg
from sim.files.records import robot_identity
from sim.files.settings import NonNegativeInt, PositiveInt, Share, check, from_builtins
from sim.policy.spec import SHIPPED, ControllerSpec, controller_hash, label_suffix, spec_of
from sim.robots.robot import RobotCfg

Settings = dict[str, Any]
"""The settings that make a run what it is, as JSON values."""

METHODS = ("cma_mae", "cma_me", "map_elites", "surrogate", "hard_random", "uniform_random")
Step = Annotated[float, Meta(ge=1e-6, le=1e3)]
"""A first step size that evolution strategies can reckon with; genes are float32 in [-1, 1]."""
Sigma = Annotated[float, Meta(ge=0, le=1e3)]
"""A standard deviation of changes of genes."""


@dataclass(frozen=True, kw_only=True)
class SchedulerCfg:
    """How terrains are asked for."""

    method: str = "surrogate"
    """Where new terrains come from: `surrogate`, elites varied by iso+line for some generations that networks judge
    (after DSAGE, Bhatt et al. 2022); `cma_mae` (Fontaine and Nikolaidis 2023); `cma_me` (Fontaine et al. 2020);
    `map_elites`, elites varied by iso+line (Vassiliades and Mouret 2018); `hard_random`, the paper's, every height at
    its limit; `uniform_random`. The last two learn nothing. Several are joined by a plus: emitters take them in turn,
    and where there are fewer emitters, the first methods count. docs/comparison.md compares them."""
    emitters: PositiveInt = 10
    """Emitters that ask, each with an evolution strategy or a stream of its own."""
    batch_size: Annotated[int, Meta(ge=2)] = 20
    """Terrains an emitter asks for in an iteration."""
    groups: Annotated[int, Meta(ge=1, le=32)] = 1
    """Groups of emitters that ask and are told in turn, in a fixed order, at most one an emitter: robots have the
    terrains of the others to cross while the last robots of a group's terrains still walk."""
    learning_rate: Share = 0.09
    """Step of a cell's acceptance threshold toward the fitness found there; 1 is elitist, 0 pure optimisation."""
    sigma0: Step | None = None
    """First step size of an evolution strategy; genes live in [-1, 1]. The terrain space's own if None."""
    restart_rule: PositiveInt = 50
    """Iterations after which an evolution strategy restarts at an elite."""
    iso_sigma: Sigma = 0.02
    """Iso+line: standard deviation of each gene's own change (published: .01 of the genes' range)."""
    line_sigma: Sigma = 0.2
    """Iso+line: standard deviation of the step along the line to another elite, in its length (published: .2)."""
    crossover_share: Share = 0.3
    """Surrogate: share of the varied elites that take each of their parts, such as bumps, from a further elite with a
    chance of a half; of no effect where a space has no parts."""
    candidates: Annotated[int, Meta(ge=1, le=10_000)] = 20
    """Surrogate: terrains that the networks judge in each generation for one that robots cross."""
    generations: Annotated[int, Meta(ge=1, le=1_000)] = 10
    """Surrogate: generations that the networks judge before robots cross the best."""
    explore_share: Share = 0.25
    """Surrogate: share of its terrains that are elites varied once, whatever the networks say."""
    disagree_share: Share = 0.1
    """Surrogate: share of its terrains that the networks disagree most about."""
    training_steps: Annotated[int, Meta(ge=1, le=100_000)] = 100
    """Surrogate: steps of training an iteration, each on 64 terrains a network."""

    def __post_init__(self) -> None:
        check(self)
        if not set(self.methods) <= set(METHODS) or len(set(self.methods)) < len(self.methods):
            raise ValueError(
                f"method must be one of {', '.join(METHODS)}, or several joined by a plus, each once, got {self.method}"
            )
        if self.explore_share + self.disagree_share > 1.0:
            raise ValueError(
                f"explore_share and disagree_share must be at most 1 together, got {self.explore_share} and "
                f"{self.disagree_share}"
            )

    @property
    def methods(self) -> tuple[str, ...]:
        """The methods joined in ``method``."""
        return tuple(self.method.split("+"))

    @property
    def num_groups(self) -> int:
        """Groups that there are."""
        return min(self.groups, self.emitters)

    @property
    def num_terrains(self) -> int:
        """Terrains of one iteration."""
        return self.emitters * self.batch_size


@dataclass(frozen=True, kw_only=True)
class SearchCfg:
    """What is searched, with what, and how; runs that agree in all but ``iterations`` are the same run."""

    robot: str
    """Name of the robot."""
    robot_sha256: str
    """Hash of its settings, model and meshes."""
    penalty_definition: str
    """How the penalties are defined (:data:`sim.files.records.PENALTY_DEFINITION`)."""
    preset: str
    policy: str
    """Controller: ``shipped``, or as :func:`sim.policy.loaders.load_policy` takes it."""
    policy_sha256: str | None
    """Hash of the controller's files, None where there are none."""
    space: str = "super_gaussian"
    """Terrain space, as :func:`sim.spaces.registry.load_space` takes it."""
    space_sha256: str | None = None
    """Hash of its code if it is a user's own."""
    seed: NonNegativeInt = 0
    iterations: PositiveInt
    """Iterations to reach; may be raised later."""
    replicas: PositiveInt
    """Episodes a terrain."""
    intervals: PositiveInt = 10
    """Intervals of each ratio."""
    collision_bit: bool
    """Whether base collision is a descriptor of its own."""
    fitness: FitnessCfg
    scheduler: SchedulerCfg
    reevaluate_every: NonNegativeInt = 50
    """Every so many iterations, up to 200 elites cross 40 fresh episodes each; 0: never."""

    def __post_init__(self) -> None:
        check(self)
        Cells(len(self.fitness.penalties), self.intervals)  # refuses too many

    @property
    def cells(self) -> Cells:
        """The archive's cells."""
        return Cells(len(self.fitness.penalties), self.intervals, collision_bit=self.collision_bit)

    @property
    def episodes_per_iteration(self) -> int:
        """Episodes of one iteration."""
        return self.scheduler.num_terrains * self.replicas


PRESETS: dict[str, dict[str, Any]] = {
    "wide": {"iterations": 125, "replicas": 20, "scheduler": SchedulerCfg(emitters=80, groups=8, training_steps=400)},
    "paper": {"iterations": 1000, "replicas": 20, "scheduler": SchedulerCfg()},
    "small": {
        "iterations": 20, "replicas": 4,
        "scheduler": SchedulerCfg(emitters=4, batch_size=8, groups=2, generations=3),  # judging takes time on a CPU
    },
}  # fmt: skip
"""Sizes of a search by name.

``paper`` is the paper's search: 10 emitters x 20 terrains x 20 episodes, 1,000 iterations. ``wide`` has as many
episodes, and eight times as many emitters and an eighth of the iterations, which fills a GPU. ``small`` is one that a
laptop finishes while one waits: 4 emitters x 8 terrains x 4 episodes, 20 iterations.
"""


def preset_of(name: str) -> dict[str, Any]:
    """Iterations, replicas and scheduler of a preset; an unknown name is a ValueError."""
    if name not in PRESETS:
        raise ValueError(f"unknown preset '{name}': expected one of {', '.join(PRESETS)}")
    return PRESETS[name]


def preset(
    name: str,
    robot: RobotCfg,
    policy: str | None = None,
    *,
    space: str = "super_gaussian",
    space_sha256: str | None = None,
) -> SearchCfg:
    """Settings of a search by the name of a preset.

    Args:
        name: Of the preset.
        robot: Robot to search.
        policy: Controller to search; the robot's own if None.
        space: Name of the terrain space.
        space_sha256: Hash of its code if it is a user's own.
    """
    return SearchCfg(
        robot=robot.name,
        **robot_identity(robot),
        preset=name,
        policy=policy or SHIPPED,
        policy_sha256=controller_hash(spec_of(policy or SHIPPED, robot)),
        space=space,
        space_sha256=space_sha256,
        collision_bit=robot.collision_bit,
        fitness=FitnessCfg(penalties=robot.penalties, scales=robot.read_penalty_scales(policy)),
        **preset_of(name),
    )


def as_settings(cfg: SearchCfg) -> Settings:
    """What makes a run what it is: all fields but ``iterations``, as JSON values."""
    settings = json.loads(json.dumps(asdict(cfg)))
    del settings["iterations"]
    return settings


def from_settings(settings: Settings, iterations: int) -> SearchCfg:
    """The search that :func:`as_settings` was of; other settings are a ValueError."""
    return from_builtins(SearchCfg, {**settings, "iterations": iterations}, "a search")


def differences(stored: Settings, settings: Settings, prefix: str = "") -> list[str]:
    """Settings that differ, each as ``scheduler.sigma0 (0.5 there, 0.2 wanted)``."""
    lines = []
    for name in sorted(stored.keys() | settings.keys()):
        pair = stored.get(name), settings.get(name)
        if isinstance(pair[0], dict) and isinstance(pair[1], dict):
            lines += differences(*pair, f"{prefix}{name}.")
        elif pair[0] != pair[1]:
            before, after = (text if len(text := json.dumps(value)) <= 40 else f"{text[:37]}..." for value in pair)
            lines.append(f"{prefix}{name} ({before} there, {after} wanted)")
    return lines


def is_searched(cfg: SearchCfg, policy: str, robot: RobotCfg) -> bool:
    """Whether a controller is that of a search: by its hash, or by its name where it has none."""
    if cfg.policy_sha256 is None:
        return policy == spec_of(cfg.policy, robot)
    return controller_hash(policy) == cfg.policy_sha256


def suffix_of(cfg: SearchCfg, policy: str, robot: RobotCfg) -> str:
    """The ending of the names of what is made of a run with a controller: empty for the search's, else ``-C-G``."""
    return "" if is_searched(cfg, policy, robot) else label_suffix(policy)


def own_policy(path: Path, cfg: SearchCfg, robot: RobotCfg) -> str:
    """The controller that a run was searched with, which must be what it was.

    Code runs only if the command line names it, so a controller that is code is refused here.
    """
    if ControllerSpec.parse(cfg.policy).runs_code:
        raise ValueError(
            f"{path} was searched with the controller {cfg.policy}, which is code: name it again "
            f"(--policy {shlex.quote(cfg.policy)}), since no code runs that the command line does not name"
        )
    policy = spec_of(cfg.policy, robot)
    if not is_searched(cfg, policy, robot):
        digest = controller_hash(policy)
        state = "lost" if digest is None else "another one now"
        raise ValueError(
            f"{path} was searched with the controller in {policy}, which is {state} (expected SHA-256 "
            f"{cfg.policy_sha256}, got {digest}): put it back, or say with --policy where it is"
        )
    return policy
