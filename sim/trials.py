"""Variants of one controller and its robot, side by side on level ground, and how each of them walks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from kernels.episode import Outcome, command_goal, latch_outcomes, make_episodes, park_ended
from kernels.observation import Noise, apply_action
from kernels.rewards import Rewards
from sim.controllers.described import ControllerCfg, Described, read_row
from sim.controllers.loaders import load_described, prepare_torch
from sim.controllers.runner import PolicyRunner, is_graph_safe
from sim.crossing import CrossingCfg, make_start_ranges, make_task
from sim.robots.robot import RobotCfg
from sim.simulation import Simulation
from sim.terrains.bank import TerrainBank

_SETTLING_S = 1.0  # from the start, which no measure but ``alive`` counts
MEASURES = ("alive", "speed", "velocity_error", "roll_pitch_rate", "tilt", "action_rate", "action", "power")
"""Of an episode (:func:`walk_variants`)."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A controller's description and its robot."""

    controller: ControllerCfg
    robot: RobotCfg
    """Robots of one call differ in ``physics_dt``, ``decimation`` and ``drive_delay_steps`` alone."""
    gains: tuple[float, ...] = (1.0, 1.0, 1.0, 1.0)
    """Factors of the robot's position gains, velocity gains, torque limits, and armature."""


class _SideBySide(torch.nn.Module):
    """A policy of blocks of robots, with a description each, that share a network."""

    def __init__(self, blocks: Sequence[Described], sizes: list[int], network: Any) -> None:
        super().__init__()
        self.blocks, self.sizes, self.network, self.graph_safe = list(blocks), sizes, network, is_graph_safe(network)
        self.output = torch.zeros(0)

    def reset(self, rows: torch.Tensor) -> None:
        for block, block_rows in zip(self.blocks, rows.split(self.sizes), strict=True):
            block.reset(block_rows)
        if hasattr(self.network, "reset"):
            self.network.reset(rows)

    def forward(self, rows: torch.Tensor) -> torch.Tensor:
        observed = zip(self.blocks, rows.split(self.sizes), strict=True)
        self.output = self.network(torch.cat([block.observe(block_rows) for block, block_rows in observed]))
        outputs = zip(self.blocks, self.output.split(self.sizes), strict=True)
        return torch.cat([block.act(output) for block, output in outputs])


def walk_variants(
    variants: Sequence[Variant], weights: Path, *, device: str, seconds: float, replicas: int, seed: int = 0
) -> NDArray[np.float64]:
    """Lets each variant walk toward the goal on level ground; returns shape (num_variants, replicas, num_measures).

    Episodes of a number have the same start. ``alive`` is the share of the time before a fall or an invalid state;
    ``speed`` the mean toward the goal [m/s]. All else are root mean squares while the robot is alive: error of the
    commanded velocity [m/s], rates of roll and pitch [rad/s], horizontal part of gravity's direction, change of the
    network's output in 20 ms, that output, and power over the robot's weight [m/s]; NaN of a fall in the first second.
    """
    prepare_torch(device)
    result = np.zeros((len(variants), replicas, len(MEASURES)))
    steps = [(variant.robot.physics_dt, variant.robot.decimation) for variant in variants]
    for step in dict.fromkeys(steps):
        rows = [k for k, other in enumerate(steps) if other == step]
        result[rows] = _walk_alike([variants[k] for k in rows], weights, device, seconds, replicas, seed)
    return result


def _scale_rows(model: Any, name: str, *factors: Any) -> None:
    """Gives each world its row of a model's array, in which all are alike, times factors (num_envs,) of its columns."""
    array = getattr(model, name)
    row = array.numpy()[:1]
    scales = np.stack(factors, axis=1).reshape(-1, *[1] * (row.ndim - 2), len(factors))
    setattr(model, name, wp.array((row * scales).astype(np.float32), dtype=array.dtype, device=array.device))


def _vary_drives(sim: Simulation, gains: NDArray[np.float64], delays: NDArray[np.int32]) -> None:
    """Gives each robot its own drives, by factors of shape (num_envs, 4), and their delay in physics steps."""
    model: Any = getattr(sim.dynamics, "tree", sim.solver.mjw_model)
    stiffness, damping, effort, armature = gains.T
    one = np.ones_like(stiffness)
    _scale_rows(model, "actuator_gainprm", stiffness, *[one] * 9)
    _scale_rows(model, "actuator_biasprm", one, stiffness, damping, *[one] * 7)
    _scale_rows(model, "jnt_actfrcrange", effort)
    _scale_rows(model, "dof_armature", armature)
    if sim.motors is None:  # these write the range in every step
        _scale_rows(model, "actuator_forcerange", effort)
    sim.set_drive_delays(delays)


@torch.inference_mode()
def _walk_alike(
    variants: Sequence[Variant], weights: Path, device: str, seconds: float, replicas: int, seed: int
) -> NDArray[np.float64]:
    """The measures of variants with the same time steps."""
    descriptions: list[ControllerCfg] = []
    for variant in variants:
        if variant.controller not in descriptions:
            descriptions.append(variant.controller)
    block_numbers = [descriptions.index(variant.controller) for variant in variants]
    order = np.argsort(block_numbers, kind="stable")  # variants of a description stand together
    delays = np.repeat([variants[k].robot.drive_delay_steps for k in order], replicas).astype(np.int32)
    robot = replace(variants[0].robot, drive_delay_steps=int(delays.max()), max_duration_s=seconds + 1.0)
    count = len(delays)
    sim = Simulation(robot, TerrainBank(1, device=device), np.zeros(count, dtype=int))
    _vary_drives(sim, np.repeat([variants[k].gains for k in order], replicas, axis=0), delays)
    blocks = [Described(cfg, robot, str(weights)) for cfg in descriptions]
    loaded = load_described(descriptions[0], weights, robot, device, weights.with_name("controller.toml"))
    for block in blocks:
        block.use(None, torch.device(device))
    policy = _SideBySide(blocks, (replicas * np.bincount(block_numbers)).tolist(), loaded.network)
    cfg, task = CrossingCfg(), make_task(CrossingCfg(), robot)
    with wp.ScopedDevice(device):
        command, counter, begins = wp.zeros((count, 3), dtype=float), wp.zeros(1, dtype=int), wp.ones(count, dtype=int)
        action = wp.zeros((count, robot.num_joints), dtype=float)
        last_action = wp.zeros_like(action)
        observation = wp.zeros((count, robot.observation_size), dtype=float)
        episodes = make_episodes(count)
        starts = [int(wp.rand_init(seed, k)) for k in range(replicas)] * len(variants)
        episodes.rng.assign(np.array(starts, np.uint32))
        step = sim.make_step(command, last_action)
        act = PolicyRunner(policy, observation, action, begins)

    def observe() -> None:
        command_goal(sim.joint_q, episodes.outcome, task, command)
        sim.observe(step, episodes, robot.physics_dt, Noise(), counter, observation)

    def move() -> None:
        apply_action(action, sim.sensors, robot.action_scale, last_action, sim.targets)
        at_rest = (sim.sensors.default_joint_pos, sim.joint_q, sim.joint_qd, sim.targets, sim.parked)
        park_ended(episodes.outcome, *at_rest)
        for _ in range(robot.decimation):
            sim.physics_step()
            sim.read_geom_forces()
            latch_outcomes(step, task, episodes)
        observe()

    graph = sim.capture(move)
    sim.restart(begins, step, make_start_ranges(cfg, robot), episodes, Rewards())
    observe()
    rows, outcome, joint_qd, joint_torque = map(
        wp.to_torch, (observation, episodes.outcome, sim.joint_qd, sim.joint_torque)
    )
    weight = -float(sim.model.gravity.numpy()[0][2]) * float(sim.model.body_mass.numpy().sum()) / count
    sums = torch.zeros((count, len(MEASURES)), device=rows.device)
    counted = torch.zeros((count, 1), device=rows.device)
    num_steps = round(seconds / robot.control_dt)
    for number in range(num_steps):
        before = policy.output.clone()
        act()
        begins.zero_()
        sim.launch(graph)
        runs = (outcome == int(Outcome.RUNNING)).float()[:, None]
        sums[:, :1] += runs
        if (number + 1) * robot.control_dt > _SETTLING_S:
            sensed = read_row(rows, robot)
            values = (
                sensed.lin_vel[:, :2] - sensed.command[:, :2],
                sensed.ang_vel[:, :2],
                sensed.gravity[:, :2],
                (policy.output - before) * 0.02 / robot.control_dt / policy.output.shape[1] ** 0.5,
                policy.output / policy.output.shape[1] ** 0.5,
                (joint_torque[:, 6 : 6 + robot.num_joints] * sensed.joint_vel).sum(1, keepdim=True) / weight,
            )
            squares = torch.stack([joint_qd[:, 0], *(value.square().sum(1) for value in values)], dim=1)
            sums[:, 1:] += torch.where(runs > 0.0, squares, 0.0)
            counted += runs
    sums[:, :1] /= num_steps
    sums[:, 1:] /= counted
    sums[:, 2:] = sums[:, 2:].sqrt()
    result = np.zeros((len(variants), replicas, len(MEASURES)))
    result[order] = sums.cpu().numpy().reshape(len(variants), replicas, -1)
    return result
