"""Settings of the command-following task, and what the kernels take of them."""

from dataclasses import asdict, dataclass, field, fields
from typing import Any

import numpy as np

from kernels.episode import Task
from kernels.restart import StartRanges
from kernels.training import Rules
from sim import crossing
from sim.files.settings import problems as problems_of
from sim.robots.robot import RobotCfg
from sim.robots.training import TrainingCfg
from sim.simulation import CAPACITY_OVERFLOWS
from train.task.curriculum import CurriculumCfg

_TILE_SIDE = 8.0
_TILE_CENTRE = (8.0, 4.0)


@dataclass(frozen=True, kw_only=True)
class NoiseCfg:
    """Half widths of the uniform observation noise, in the units of the measured quantity."""

    lin_vel: float = 0.1
    ang_vel: float = 0.2
    gravity: float = 0.05
    joint_pos: float = 0.01
    joint_vel: float = 1.5
    scan: float = 0.1


@dataclass(frozen=True, kw_only=True)
class TaskCfg(TrainingCfg):
    """The task; the defaults are legged_gym's for ANYmal but for the start's yaw, which it leaves at 0."""

    noise: NoiseCfg = field(default_factory=NoiseCfg)
    curriculum: CurriculumCfg = field(default_factory=CurriculumCfg)
    crosses: bool = False
    """Robots start at one side of a terrain and are told to go to the other, as in a search, instead of random
    velocities and headings from its middle."""
    episode_s: float = 20.0
    command_interval_s: float = 10.0
    """A new command every so often."""
    lin_vel_x: tuple[float, float] = (-1.0, 1.0)
    """Range of the commanded forward velocity [m/s]."""
    lin_vel_y: tuple[float, float] = (-1.0, 1.0)
    """Range of the commanded sideward velocity [m/s]."""
    min_speed: float = 0.2
    """Slower commands become 0 [m/s]."""
    yaw_gain: float = 0.5
    """Commanded yaw rate per heading error [1/s]."""
    max_yaw_rate: float = 1.0
    """Largest commanded yaw rate [rad/s]."""
    push_interval_s: float = 15.0
    """A push every so often; 0 for none."""
    friction: tuple[float, float] = (0.5, 1.25)
    """Range of the robots' friction coefficients."""
    start_position_range: float = 1.0
    """Starts lie within this of the tile's centre along x and y [m]."""
    start_yaw_range: float = np.pi
    """Half width of the start's heading [rad]: every heading, so that robots meet a stair or slope at every angle."""
    start_velocity_range: float = 0.5
    """Half width of the base's first linear and angular velocity [m/s, rad/s]."""
    base_force: float = 1.0
    """Contact force on the base that ends an episode [N]."""
    max_gravity_z: float = -0.1
    """An episode ends when the projected gravity's z component exceeds this (-1: upright)."""

    @classmethod
    def of(cls, robot: RobotCfg, **changes: Any) -> "TaskCfg":
        """The task with a robot's own settings.

        Args:
            robot: Robot settings.
            changes: Fields to set otherwise.
        """
        own = {setting.name: getattr(robot.training, setting.name) for setting in fields(TrainingCfg)}
        return cls(**{**own, **changes})


_RANGES = ("friction", "lin_vel_x", "lin_vel_y")
_FROM_0 = (
    "episode_s", "command_interval_s", "min_speed", "yaw_gain", "max_yaw_rate", "push_interval_s",
    "start_position_range", "start_yaw_range", "start_velocity_range", "base_force",
)  # fmt: skip


def task_problems(cfg: TaskCfg, control_dt: float) -> list[str]:
    """What is wrong with the settings of a task, one line each.

    Args:
        cfg: The settings.
        control_dt: Control step of the robot [s].
    """
    problems = problems_of(cfg, "training.")
    for name in _RANGES:
        low, high = getattr(cfg, name)
        if not -np.inf < low <= high < np.inf or (name == "friction" and low < 0.0):
            problems.append(f"task.{name} must be a least and a largest number, got {low:g} and {high:g}")
    for name in _FROM_0:
        least = control_dt if name in ("episode_s", "command_interval_s") else 0.0
        if not least <= getattr(cfg, name) < np.inf:
            problems.append(f"task.{name} must be a number from {least:g} on, got {getattr(cfg, name):g}")
    noise = {name: value for name, value in asdict(cfg.noise).items() if not 0.0 <= value < np.inf}
    problems += [f"task.noise.{name} must be a number from 0 on, got {value:g}" for name, value in noise.items()]
    return problems


def fill(struct: Any, **values: Any) -> Any:
    """Set the fields of a kernel argument; returns it."""
    for name, value in values.items():
        setattr(struct, name, value)
    return struct


def make_task(cfg: TaskCfg, robot: RobotCfg) -> Task:
    """Goal, command and limits of an episode as a kernel argument; its steps are control steps."""
    task = crossing.make_task(crossing.CrossingCfg(), robot, to_goal=cfg.crosses)
    if not cfg.crosses:
        endless = {"lower": (-np.inf, -np.inf), "upper": (np.inf, np.inf)}
        fill(task, yaw_gain=cfg.yaw_gain, max_yaw_rate=cfg.max_yaw_rate, **endless)
    return fill(
        task,
        max_steps=round(cfg.episode_s / robot.control_dt),
        base_force=cfg.base_force,
        max_gravity_z=cfg.max_gravity_z,
        overflow_mask=0,  # counted, and no reason to end an episode
    )


def make_rules(cfg: TaskCfg, robot: RobotCfg, num_levels: int, num_columns: int) -> Any:
    """Commands, pushes and levels of the task as a kernel argument."""
    control_dt = robot.control_dt
    return fill(
        Rules(),
        crosses=int(cfg.crosses),
        overflow_mask=CAPACITY_OVERFLOWS,
        num_levels=num_levels,
        num_columns=num_columns,
        promotion_distance=0.5 * _TILE_SIDE,
        demotion_time_s=0.5 * cfg.episode_s,
        command_steps=round(cfg.command_interval_s / control_dt),
        lin_vel_x=cfg.lin_vel_x,
        lin_vel_y=cfg.lin_vel_y,
        min_speed=cfg.min_speed,
        push_steps=round(cfg.push_interval_s / control_dt),
        push_speed=cfg.push_speed,
    )


def make_start_ranges(cfg: TaskCfg, robot: RobotCfg) -> Any:
    """The randomised start of an episode as a kernel argument."""
    if cfg.crosses:
        return crossing.make_start_ranges(crossing.CrossingCfg(), robot)
    return fill(
        StartRanges(),
        position=_TILE_CENTRE,
        position_range=cfg.start_position_range,
        yaw_range=cfg.start_yaw_range,
        joint_scale_range=cfg.start_joint_range,
        velocity_range=cfg.start_velocity_range,
        base_height=robot.default_base_height,
        footprint=(max(robot.footprint), max(robot.footprint)),  # whatever the heading
    )
