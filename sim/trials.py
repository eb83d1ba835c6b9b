"""Variants of one controller and its robot, side by side on level ground, and how each of them walks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import groupby
from pathlib import Path
from typing import Any

import numpy as np
import torch
import warp as wp
from numpy.typing import NDArray

from kernels.episode import Outcome
from sim.controllers.described import ControllerCfg, Described, read_row
from sim.controllers.loaders import load_described, prepare_torch
from sim.controllers.runner import is_graph_safe, reset_all
from sim.robots.robot import RobotCfg
from sim.rollout import Rollout

_SETTLING_S = 1.0  # from the start, which no measure but ``alive`` counts
MEASURES = ("alive", "speed", "velocity_error", "roll_pitch_rate", "tilt", "action_rate", "action", "power")
"""Of an episode (:func:`walk_variants`)."""


@dataclass(frozen=True, kw_only=True)
class Variant:
    """A controller's description and its robot."""

    controller: ControllerCfg
    robot: RobotCfg
    """Robots of one call differ in ``physics_dt``, ``decimation`` and ``drive_delay_steps`` alone."""
    gains: tuple[float, ...] = (1.0, 1.0, 1.0)
    """Factors of the robot's position gains, velocity gains, and armature."""


class _SideBySide(torch.nn.Module):
    """A policy of blocks of robots, with a description each, that share a network."""

    def __init__(self, blocks: list[Described], sizes: list[int], network: Any) -> None:
        super().__init__()
        self.blocks, self.sizes, self.network, self.graph_safe = blocks, sizes, network, is_graph_safe(network)
        self.output = torch.tensor(0.0)

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
    streams = np.array([int(wp.rand_init(seed, k)) for k in range(replicas)], np.uint32)
    times = [(variant.robot.physics_dt, variant.robot.decimation) for variant in variants]
    for time in dict.fromkeys(times):
        rows = [k for k, other in enumerate(times) if other == time]
        trial = _Trial([variants[k] for k in rows], weights, device, replicas, seconds)
        result[rows] = trial.walk(np.tile(streams, len(rows)), seconds).reshape(len(rows), replicas, -1)
    return result


class _Trial(Rollout):
    """Robots of variants with the same time steps, each with drives of its own; all begin at once, without a queue."""

    def __init__(self, variants: Sequence[Variant], weights: Path, device: str, replicas: int, seconds: float) -> None:
        delays = np.repeat([variant.robot.drive_delay_steps for variant in variants], replicas)
        robot = replace(variants[0].robot, drive_delay_steps=int(delays.max()), max_duration_s=seconds + 1.0)
        groups = [(cfg, len([*same])) for cfg, same in groupby(variants, key=lambda variant: variant.controller)]
        blocks = [Described(cfg, robot, str(weights)) for cfg, _ in groups]
        for block in blocks:
            block.use(None, torch.device(device))
        loaded = load_described(groups[0][0], weights, robot, device, weights.with_name("controller.toml"))
        self.side_by_side = _SideBySide(blocks, [replicas * size for _, size in groups], loaded.network)
        super().__init__(robot, self.side_by_side, num_terrains=1, replicas=len(delays), device=device)
        self._vary_drives(np.repeat([variant.gains for variant in variants], replicas, axis=0))
        self.sim.set_drive_delays(delays)
        self._step_graph = self.sim.capture(self._launch_control_step)

    def _vary_drives(self, gains: NDArray[np.float64]) -> None:
        model: Any = getattr(self.sim.dynamics, "tree", self.sim.solver.mjw_model)
        stiffness, damping, armature = gains.T
        one = np.ones_like(armature)
        factors = {"actuator_gainprm": [stiffness, *[one] * 9], "dof_armature": [armature]}
        factors["actuator_biasprm"] = [one, stiffness, damping, *[one] * 7]
        for name, columns in factors.items():
            array = getattr(model, name)
            row = array.numpy()[:1]  # all are alike
            scales = np.stack(columns, axis=1).reshape(-1, *[1] * (row.ndim - 2), len(columns))
            setattr(model, name, wp.array((row * scales).astype(np.float32), dtype=array.dtype, device=array.device))

    @torch.inference_mode()
    def walk(self, streams: NDArray[np.uint32], seconds: float) -> NDArray[np.float64]:
        """The measures of each robot's episode, which begins by its random stream, (num_envs, num_measures)."""
        robot = self.robot
        sim = self.sim
        self._episode.rng.assign(streams)
        self._queue.begins.fill_(1)
        sim.restart(self._queue.begins, self._robot_step, self._ranges, self._episode, self._rewards)
        reset_all(self.side_by_side, self.num_envs, sim.device)
        sim.launch(self._turn_graph)  # which writes what they observe
        arrays = (self._observation, self.outcome, sim.joint_qd, sim.joint_torque)
        rows, outcome, joint_qd, joint_torque = map(wp.to_torch, arrays)
        weight = -float(sim.model.gravity.numpy()[0][2]) * float(sim.model.body_mass.numpy().sum())
        records: list[torch.Tensor] = []  # a step, shape (num_measures, num_envs)
        for _ in range(round(seconds / robot.control_dt)):
            before = self.side_by_side.output.clone()
            self.control_step()
            output = self.side_by_side.output
            size = output.shape[1] ** 0.5
            sensed = read_row(rows, robot)
            values = (
                sensed.lin_vel[:, :2] - sensed.command[:, :2],
                sensed.ang_vel[:, :2],
                sensed.gravity[:, :2],
                (output - before) * 0.02 / robot.control_dt / size,
                output / size,
                (joint_torque[:, 6 : 6 + robot.num_joints] * sensed.joint_vel).sum(1, keepdim=True) / weight,
            )
            runs = (outcome == int(Outcome.RUNNING)).float()
            records.append(torch.stack([runs, joint_qd[:, 0], *(value.square().sum(1) for value in values)]))
        alive = torch.stack(records)[:, 0].mean(0)
        settled = torch.stack(records[int(_SETTLING_S / robot.control_dt) :])
        means = torch.where(settled[:, :1] > 0.0, settled, 0.0).sum(0) / settled[:, :1].sum(0)
        return torch.stack([alive, means[1], *means[2:].sqrt()], dim=1).cpu().numpy()
