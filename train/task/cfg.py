"""Settings of the command-following task. Nothing here loads Warp or Newton: the help of a command shows them."""

import math
from dataclasses import dataclass, field, fields
from typing import TYPE_CHECKING, Any

from sim.files.settings import problems, setting
from sim.robots.training import MOST_SPREAD, TrainingCfg
from sim.terrain import NUM_LEVELS

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg


@dataclass(frozen=True, kw_only=True)
class NoiseCfg:
    """Half widths of the uniform observation noise, in the units of the measured quantity."""

    lin_vel: float = setting(0.1, least=0)
    ang_vel: float = setting(0.2, least=0)
    gravity: float = setting(0.05, least=0)
    joint_pos: float = setting(0.01, least=0)
    joint_vel: float = setting(1.5, least=0)
    scan: float = setting(0.1, least=0)


@dataclass(frozen=True, kw_only=True)
class CurriculumCfg:
    """Shares of the terrain types and where robots begin.

    legged_gym's tiles have no rough ground on a level plane, which one in six hand-crafted crossings is made of:
    columns of ``noise`` tiles are added beside them.
    """

    num_columns: int = setting(20, least=0)
    """Columns of legged_gym's types; 20 and its multiples give its shares exactly."""
    noise_columns: int = setting(2, least=0)
    """Columns of noise: uniform +-(.02 + .08 d) m on patches of 0.2 m."""
    max_first_level: int = setting(5, least=0, most=NUM_LEVELS - 1)
    """Robots begin on levels 0 to this, drawn uniformly."""


@dataclass(frozen=True, kw_only=True)
class TaskCfg(TrainingCfg):
    """The task; the defaults are legged_gym's for ANYmal, except the start's yaw, which is 0 there."""

    noise: NoiseCfg = field(default_factory=NoiseCfg)
    curriculum: CurriculumCfg = field(default_factory=CurriculumCfg)
    crosses: bool = False
    """Robots start at one side of a terrain and are told to go to the other, as in a search, instead of random
    velocities and headings from its middle."""
    start_spread: float = setting(0.0, least=0.0, most=MOST_SPREAD)
    """Where robots cross, they start up to so far along the way, uniformly [m]; the goal stays where it is."""
    episode_s: float = setting(20.0, above=0)
    command_interval_s: float = setting(10.0, above=0)
    """Time between commands [s]."""
    lin_vel_x: tuple[float, float] = setting((-1.0, 1.0), rising=True)
    """Range of the commanded forward velocity [m/s]."""
    lin_vel_y: tuple[float, float] = setting((-1.0, 1.0), rising=True)
    """Range of the commanded sideward velocity [m/s]."""
    min_speed: float = setting(0.2, least=0)
    """Slower commands become 0 [m/s]."""
    yaw_gain: float = setting(0.5, least=0)
    """Commanded yaw rate per heading error [1/s]."""
    max_yaw_rate: float = setting(1.0, least=0)
    """Largest commanded yaw rate [rad/s]."""
    push_interval_s: float = setting(15.0, least=0)
    """Time between pushes [s]; 0 for none."""
    friction: tuple[float, float] = setting((0.5, 1.25), least=0, rising=True)
    """Range of the robots' friction coefficients."""
    start_position_range: float = setting(1.0, least=0)
    """Starts lie within this of the tile's centre along x and y [m]."""
    start_yaw_range: float = setting(math.pi, least=0)
    """Half width of the start's heading [rad]: every heading, so that robots meet a stair or slope at every angle."""
    start_velocity_range: float = setting(0.5, least=0)
    """Half width of the base's first linear and angular velocity [m/s, rad/s]."""
    base_force: float = setting(1.0, least=0)
    """Contact force on the base that ends an episode [N]."""
    max_gravity_z: float = setting(-0.1)
    """An episode ends when the projected gravity's z component exceeds this (-1: upright)."""

    @classmethod
    def of(cls, robot: "RobotCfg", **changes: Any) -> "TaskCfg":
        """The task with a robot's own settings.

        Args:
            robot: Robot settings.
            changes: Fields to set otherwise.
        """
        own = {own.name: getattr(robot.training, own.name) for own in fields(TrainingCfg)}
        return cls(**{**own, **changes})


def task_problems(cfg: TaskCfg, control_dt: float) -> list[str]:
    """What is wrong with the settings of a task, one line each.

    Args:
        cfg: The settings.
        control_dt: Control step of the robot [s].
    """
    return problems(cfg, "task.") + [
        f"task.{name} must be at least a control step, {control_dt:g} s, got {getattr(cfg, name):g}"
        for name in ("episode_s", "command_interval_s")
        if 0 < getattr(cfg, name) < control_dt
    ]
