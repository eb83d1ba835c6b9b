"""Settings of a search: what is searched, with what, and how; and how a run remembers them."""

import json
import shlex
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from qd.search.archive import Subject
from qd.search.descriptors import Cells
from qd.search.fitness import FitnessCfg
from qd.search.presets import SchedulerCfg, read_preset
from sim.controllers.spec import SHIPPED, ControllerSpec, controller_hash, resolve_policy
from sim.files.settings import NonNegativeInt, PositiveInt, check_settings
from sim.robots.find import read_penalty_scales
from sim.robots.robot import RobotCfg, robot_identity
from sim.terrains.conditions.likely import choose_likely
from sim.terrains.spaces.registry import get_space

_MAX_EPISODES = 10_000_000  # of an iteration


@dataclass(frozen=True, kw_only=True)
class SearchCfg(Subject):
    """What is searched, with what, and how; runs that agree in all but ``iterations`` are the same run."""

    preset: str
    policy: str
    """Controller: ``shipped``, or as :func:`sim.controllers.loaders.load_policy` takes it."""
    seed: NonNegativeInt = 0
    iterations: PositiveInt
    """Iterations to reach; may be raised later."""
    replicas: PositiveInt
    """Episodes a terrain."""
    fitness: FitnessCfg
    scheduler: SchedulerCfg

    def __post_init__(self) -> None:
        check_settings(self)
        if self.episodes_per_iteration > _MAX_EPISODES:
            limit = f"at most {_MAX_EPISODES:,} episodes, got {self.episodes_per_iteration:,}"
            raise ValueError(f"an iteration must have {limit}: give fewer replicas or terrains")
        Cells(len(self.fitness.penalties), self.intervals)  # refuses too many
        self.scheduler.check_iterations(self.iterations)
        self.scheduler.check_worth(crossed=self.fitness.crossed, likely=self.fitness.likely)

    @property
    def cells(self) -> Cells:
        """The archive's cells."""
        return Cells(len(self.fitness.penalties), self.intervals, collision_bit=self.collision_bit)

    @property
    def episodes_per_iteration(self) -> int:
        """Episodes of one iteration."""
        return self.scheduler.num_terrains * self.replicas


def preset(
    name: str,
    robot: RobotCfg,
    policy: str | None = None,
    *,
    space: str = "super_gaussian",
    space_sha256: str | None = None,
    likely: Path | None = None,
) -> SearchCfg:
    """Settings of a search by the name of a preset; ``policy`` and ``likely`` are shipped ones if None."""
    known = choose_likely(get_space(space, space_sha256), likely)
    scales, named = read_penalty_scales(robot, policy), policy or SHIPPED
    return SearchCfg(
        robot=robot.name, **robot_identity(robot), preset=name, policy=named,
        policy_sha256=controller_hash(resolve_policy(named, robot)), space=space, space_sha256=space_sha256,
        collision_bit=robot.collision_bit, **read_preset(name),
        fitness=FitnessCfg(penalties=robot.penalties, scales=scales, disturbances=known),
    )  # fmt: skip


def as_settings(cfg: SearchCfg) -> dict[str, Any]:
    """What makes a run what it is: all fields but ``iterations``, as JSON values."""
    settings = json.loads(json.dumps(asdict(cfg)))
    del settings["iterations"]
    return settings


def differences(stored: dict[str, Any], settings: dict[str, Any], prefix: str = "") -> list[str]:
    """Settings that differ, each as ``scheduler.sigma0 (0.5 there, 0.2 wanted)``."""
    lines = []
    for name in sorted(stored.keys() | settings.keys()):
        before, after = stored.get(name), settings.get(name)
        if isinstance(before, dict) and isinstance(after, dict):
            lines += differences(before, after, f"{prefix}{name}.")
        elif before != after:
            texts = (json.dumps(value) for value in (before, after))
            shown, asked = (text if len(text) <= 40 else f"{text[:37]}..." for text in texts)
            lines.append(f"{prefix}{name} ({shown} there, {asked} wanted)")
    return lines


def is_searched(cfg: SearchCfg, policy: str, robot: RobotCfg) -> bool:
    """Whether a controller is that of a search: by its hash, or by its name where it has none."""
    if cfg.policy_sha256 is None:
        return policy == resolve_policy(cfg.policy, robot)
    return controller_hash(policy) == cfg.policy_sha256


def find_policy(path: Path, cfg: SearchCfg, robot: RobotCfg) -> str:
    """The controller that a run was searched with, which must be what it was, and no code."""
    if ControllerSpec.parse(cfg.policy).runs_code:
        remedy = f"name it again (--policy {shlex.quote(cfg.policy)})"
        reason = "since no code runs that the command line does not name"
        raise ValueError(f"{path} was searched with the controller {cfg.policy}, which is code: {remedy}, {reason}")
    policy = resolve_policy(cfg.policy, robot)
    if not is_searched(cfg, policy, robot):
        digest = controller_hash(policy)
        state = f"{'another one now' if digest else 'lost'} (expected SHA-256 {cfg.policy_sha256}, got {digest})"
        remedy = "put it back, or say with --policy where it is"
        raise ValueError(f"{path} was searched with the controller in {policy}, which is {state}: {remedy}")
    return policy
