"""Settings of the command-following task. Nothing here loads Warp or Newton: the help of a command shows them."""

import math
from dataclasses import dataclass, field, fields
from typing import Annotated, Any, Self

from msgspec import Meta

from sim.files.settings import Interval, NonNegativeFloat, NonNegativeInt, PositiveFloat, problems
from sim.robots.robot import RobotCfg
from sim.robots.training import MAX_SPREAD, NoiseCfg, TrainingCfg
from sim.terrains.hand_crafted import NUM_LEVELS


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
        training = {setting.name: getattr(robot.training, setting.name) for setting in fields(TrainingCfg)}
        return cls(**{**training, **changes})


def task_problems(cfg: TaskCfg, control_dt: float) -> list[str]:
    """What is wrong with the settings of a task, one line each; ``control_dt`` is the robot's control step [s]."""
    lines = problems(cfg, "task.")
    for name in ("episode_s", "command_interval_s"):
        if 0 < getattr(cfg, name) < control_dt:
            lines.append(f"task.{name} must be at least a control step, {control_dt:g} s, got {getattr(cfg, name):g}")
    if not lines and cfg.friction[0] < 0:
        lines.append(f"task.friction must be at least 0, got {cfg.friction[0]:g}")
    return lines
