"""Settings of a search: presets, what the command line changes of them, and what a run directory remembers.

Nothing here imports pyribs, which takes seconds: `--help` and the worker processes do without.
"""

import json
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qd.descriptors import Cells
from qd.fitness import FitnessCfg
from qd.scheduler_cfg import SchedulerCfg
from sim.files.command import split_words
from sim.files.settings import built
from sim.policy.spec import SHIPPED, ControllerSpec, spec_of

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg

Settings = dict[str, Any]
"""The settings that make a run what it is, as JSON values."""


@dataclass(frozen=True, kw_only=True)
class SearchCfg:
    """What is searched, with what, and how; runs that agree in all but ``iterations`` are the same run."""

    robot: str
    """Name of the robot."""
    preset: str
    policy: str
    """Controller: ``shipped``, or as :func:`sim.policy.loaders.load_policy` takes it."""
    policy_sha256: str | None
    """Hash of the controller's files, None for the code of a module."""
    seed: int
    iterations: int
    """Iterations to reach; may be raised later."""
    replicas: int
    """Episodes a terrain."""
    intervals: int
    """Intervals of each ratio."""
    collision_bit: bool
    """Whether base collision is a descriptor of its own."""
    fitness: FitnessCfg
    scheduler: SchedulerCfg
    robot_sha256: str | None = None
    """Hash of the settings, model and meshes of a robot that is not shipped."""
    reevaluate_every: int = 50
    """Every so many iterations, up to 200 elites are looked at again in 40 fresh episodes each; 0: never."""

    def __post_init__(self) -> None:
        for name in ("iterations", "replicas", "intervals"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, got {getattr(self, name)}")
        Cells(len(self.fitness.penalties), self.intervals)  # refuses too many
        if self.reevaluate_every < 0:
            raise ValueError(f"reevaluate_every must not be negative, got {self.reevaluate_every}")
        if self.seed < 0:
            raise ValueError(f"seed must not be negative, got {self.seed}")

    @property
    def cells(self) -> Cells:
        """The archive's cells."""
        return Cells(len(self.fitness.penalties), self.intervals, collision_bit=self.collision_bit)

    @property
    def episodes_per_iteration(self) -> int:
        """Episodes of one iteration."""
        return self.scheduler.num_terrains * self.replicas


def paper(robot: "RobotCfg") -> SearchCfg:
    """The paper's search: 10 emitters x 20 terrains x 20 episodes, 1,000 iterations; for a GPU."""
    return SearchCfg(
        robot=robot.name,
        preset="paper",
        policy=SHIPPED,
        policy_sha256=None,
        seed=0,
        iterations=1000,
        replicas=20,
        intervals=10,
        collision_bit=robot.collision_bit,
        fitness=FitnessCfg(penalties=robot.penalties, scales=robot.read_penalty_scales()),
        scheduler=SchedulerCfg(),
    )


def small(robot: "RobotCfg") -> SearchCfg:
    """A search that a laptop finishes while one waits: 4 emitters x 8 terrains x 4 episodes, 20 iterations."""
    return replace(
        paper(robot), preset="small", iterations=20, replicas=4, scheduler=SchedulerCfg(emitters=4, batch_size=8)
    )


PRESETS = {"paper": paper, "small": small}


def preset(name: str, robot: "RobotCfg") -> SearchCfg:
    """Settings by the name of a preset.

    Raises:
        ValueError: If there is no such preset, or the robot's penalty scales were never measured.
    """
    if name not in PRESETS:
        raise ValueError(f"unknown preset '{name}': expected one of {', '.join(sorted(PRESETS))}")
    return PRESETS[name](robot)


def changed(cfg: SearchCfg, changes: dict[str, Any]) -> SearchCfg:
    """Settings with some of them changed, wherever they stand.

    Args:
        cfg: Settings.
        changes: New values by the names of fields of this class, its fitness or its scheduler; None changes nothing.

    Raises:
        ValueError: If a value is out of range.
    """
    given = {name: value for name, value in changes.items() if value is not None}
    for part in ("fitness", "scheduler"):
        current = getattr(cfg, part)
        names = {field.name for field in fields(current)} & given.keys()
        cfg = replace(cfg, **{part: replace(current, **{name: given.pop(name) for name in names})})
    return replace(cfg, **given)


def as_settings(cfg: SearchCfg) -> Settings:
    """What makes a run what it is: all fields but ``iterations``, as JSON values."""
    values = {name: value for name, value in asdict(cfg).items() if name != "iterations"}
    return json.loads(json.dumps(values))


def from_settings(settings: Settings, iterations: int) -> SearchCfg:
    """Settings as a run directory remembers them.

    Args:
        settings: All fields but ``iterations``, as JSON values.
        iterations: Iterations to reach.

    Raises:
        ValueError: If they are not the settings of a search.
    """
    try:
        return built(SearchCfg, {**settings, "iterations": iterations}, "a search")
    except (TypeError, ValueError) as error:
        raise ValueError(f"settings must be those of a search of this version, but: {error}") from None


def policy_spec(cfg: SearchCfg, robot: "RobotCfg") -> str:
    """What to load the controller from, as :func:`sim.policy.loaders.load_policy` takes it."""
    return spec_of(cfg.policy, robot)


def file_hash(policy: str | Path) -> str | None:
    """SHA-256 of a controller's file or files; None where there are none, as of ``module:callable``."""
    return ControllerSpec.parse(policy).digest()


def kept_penalties(robot: "RobotCfg", without: Sequence[str]) -> tuple[str, ...]:
    """The robot's penalties but for some.

    Args:
        robot: The robot.
        without: Names to leave out; several may stand in one, apart by spaces or commas, as make hands them over.

    Raises:
        ValueError: If a name is unknown, or fewer than 2 penalties are left.
    """
    names = split_words(without)
    _check_known(names, robot)
    kept = tuple(name for name in robot.penalties if name not in names)
    if len(kept) < 2:
        raise ValueError(
            f"without must leave at least 2 of {', '.join(robot.penalties)}, got {', '.join(names)}: a single ratio is "
            "always 1"
        )
    return kept


def _check_known(names: Sequence[str], robot: "RobotCfg") -> None:
    unknown = [name for name in names if name not in robot.penalties]
    if unknown:
        raise ValueError(f"no penalty named {', '.join(unknown)}: {robot.name} has {', '.join(robot.penalties)}")


def measured_now(cfg: SearchCfg, robot: "RobotCfg") -> SearchCfg:
    """Settings with the present scales of their penalties and the present hashes of controller and robot.

    Raises:
        ValueError: If the robot lacks one of the penalties, or their scales were never measured.
    """
    digest = file_hash(policy_spec(cfg, robot))
    penalties = cfg.fitness.penalties
    _check_known(penalties, robot)
    scales = dict(zip(robot.penalties, robot.read_penalty_scales(), strict=True))
    fitness = replace(cfg.fitness, scales=tuple(scales[name] for name in penalties))
    return replace(
        cfg,
        robot=robot.name,
        robot_sha256=_robot_hash(robot),
        policy_sha256=digest,
        fitness=fitness,
        collision_bit=robot.collision_bit,
    )


def _robot_hash(robot: "RobotCfg") -> str | None:
    if robot.settings_file is None:
        return None
    from sim.robots.own import robot_digest

    return robot_digest(robot)
