"""Settings of the crossing task and of its physics, and the kernel arguments made of them."""

import math
from dataclasses import dataclass, replace

import warp as wp

from kernels.episode import Task
from kernels.launch import make_struct, make_zeros
from kernels.queue import StartRanges
from kernels.route import WINDOW_S, Trail
from sim.robots.robot import RobotCfg
from sim.terrains.conditions.kinds import CONDITIONS, condition_column

CAPACITY_OVERFLOWS = 0xFFFF & ~(512 | 1024)
"""mujoco_warp's overflow bits, less those of its two iteration caps: to reach a cap is no fault."""
GROUND_FRICTION = 0.3
"""Below every robot's own: MuJoCo takes the larger of the two, so the robot's friction decides."""
_RESOLVED_DT = 0.001
_RESOLVED_TIME_CONSTANT_S = 0.003


@dataclass(frozen=True, kw_only=True)
class CrossingCfg:
    """A crossing: start, goal, command and ends (the paper's task; the rest in the terms of the field).

    Speed and longest duration are the robot's.
    """

    start: tuple[float, float] = (2.0, 4.0)
    start_position_range: float = 0.1
    start_yaw_range: float = 0.2
    start_joint_range: float = 0.2
    start_velocity_range: float = 0.2
    goal: tuple[float, float] = (14.0, 4.0)
    goal_radius: float = 0.5
    yaw_gain: float = 0.5
    max_yaw_rate: float = 1.0
    lowest_command: tuple[float, float, float] = (0.0, -0.5, -1.0)
    """Least command of a steered episode: v_x, v_y [m/s], yaw rate [rad/s]."""
    highest_command: tuple[float, float, float] = (1.0, 0.5, 1.0)
    """Ahead a robot may go as fast as it is commanded elsewhere, if that is faster (:func:`find_highest_command`)."""
    lower: tuple[float, float] = (-2.0, -2.0)
    upper: tuple[float, float] = (18.0, 10.0)
    penalties_from_s: float = 0.0
    """Penalties are summed from this time on."""
    base_force: float = 1.0
    """Contact force on the base that counts as a collision [N]."""
    poll_every_s: float = 1.0
    """How often the host asks whether any episode still runs, in simulated time."""
    stray_s: float = 1.0
    """Time off its commanded motion after which a route has failed."""
    stray_m: float | None = None
    """Displacement over two seconds that misses the commanded one by this is off it [m]; the robot's if None."""
    reward: bool = False
    """Sum the robot's training reward too. A robot that reached the goal is then told to stand, and goes on until its
    time is over or it ends otherwise; without it, robots stop at the goal."""


def find_highest_command(cfg: CrossingCfg, robot: RobotCfg) -> tuple[float, float, float]:
    """Largest command of a steered episode of a robot: v_x, v_y [m/s], yaw rate [rad/s]."""
    ahead, aside, turn = cfg.highest_command
    return max(ahead, robot.speed), aside, turn


def make_task(cfg: CrossingCfg, robot: RobotCfg, *, to_goal: bool = True) -> Task:
    """The goal, command and ends of a crossing as a kernel argument; without ``to_goal`` the goal ends none."""
    return make_struct(
        Task,
        cfg,
        speed=robot.speed,
        highest_command=find_highest_command(cfg, robot),
        goal_radius=cfg.goal_radius if to_goal else 0.0,  # no distance is smaller
        max_steps=round(robot.max_duration_s / robot.physics_dt),
        first_counted_step=round(cfg.penalties_from_s / robot.physics_dt) + 1,
        max_speed=robot.max_speed,
        max_gravity_z=2.0,  # no tilt ends a crossing
        stray_m=math.inf if cfg.stray_m is None else cfg.stray_m,
        max_strayed=round(cfg.stray_s / robot.control_dt),
        overflow_mask=CAPACITY_OVERFLOWS,
    )


def make_trail(num_envs: int, robot: RobotCfg, device: str) -> Trail:
    """What routes of conditions need."""
    steps = (num_envs, 1 + round(WINDOW_S / robot.control_dt))
    trail = make_zeros(Trail, device, walked=steps, commanded=steps, age=num_envs, here=num_envs, error=num_envs)
    trail.first = condition_column("segment_1_x")
    pushes = [condition_column(condition.genes[0].name) for condition in CONDITIONS.values() if condition.moment]
    trail.pushes = wp.array(pushes, dtype=int, device=device)
    return trail


def make_start_ranges(cfg: CrossingCfg, robot: RobotCfg) -> StartRanges:
    """The randomised start of a crossing as a kernel argument."""
    return make_struct(
        StartRanges,
        position=cfg.start,
        position_range=cfg.start_position_range,
        yaw_range=cfg.start_yaw_range,
        joint_scale_range=cfg.start_joint_range,
        velocity_range=cfg.start_velocity_range,
        base_height=robot.default_base_height,
        footprint=robot.footprint,
    )


@dataclass(frozen=True, kw_only=True)
class SolverCfg:
    """Options of the physics solver, chosen by measurement.

    The contact time constant stands in the robot's file: 0.01 s at critical damping, the stiffest that the integrator
    ``implicitfast`` takes with steps of 0.005 s. At MuJoCo's default of 0.02 s feet that land hard sink in by more than
    their radius. Friction cones are elliptic: a pyramid gives way at 0.7 of the friction across its axes, and robots
    fail on slopes that would hold them (docs/results.md).
    """

    iterations: int = 5
    """Newton iterations a step at most. Caps of 3 to 50 give the same rates (results/bench/options-*.json), but with 4
    the forces of a hard landing are off by up to 2 % of its impulse (tests/sim/robots/test_drops.py notices)."""
    ls_iterations: int = 10
    """Line-search iterations at most."""
    time_constant_s: float | None = None
    """Contact time constant [s] at critical damping; that of the robot's file if None."""


def resolved(robot: RobotCfg) -> tuple[RobotCfg, SolverCfg]:
    """Robot and solver with contact resolved: steps of 1 ms and contacts of 3 ms, against which a search's are judged.

    Four times the steps: about five times the time. Steps are shorter where a control step does not last whole ones.
    """
    control_s = robot.physics_dt * robot.decimation
    decimation = max(robot.decimation, math.ceil(control_s / _RESOLVED_DT - 1e-6))
    step = round(control_s / decimation, 12)
    delay = round(robot.drive_delay_steps * robot.physics_dt / step)
    net = robot.actuator_net  # it goes on at its own rate
    net = net and replace(net, decimation=round(net.decimation * robot.physics_dt / step))
    finer = replace(robot, physics_dt=step, decimation=decimation, drive_delay_steps=delay, actuator_net=net)
    return finer, SolverCfg(time_constant_s=_RESOLVED_TIME_CONSTANT_S)
