"""The bare physics rate: what the solver and the terrain contact alone can do, the yardstick of everything else."""

import time

import numpy as np
import warp as wp

from sim.bank import TerrainBank
from sim.robot import RobotCfg
from sim.simulation import Simulation, SolverCfg
from sim.terrain import NUM_COLS, NUM_ROWS

_CROSSING_X = (2.0, 14.0)


def measure_bare_physics(
    robot: RobotCfg,
    terrains: np.ndarray,
    num_envs: int,
    *,
    device: str,
    steps: int = 1000,
    warmup_steps: int = 400,
    solver: SolverCfg | None = None,
) -> float:
    """Physics steps a second over all environments of the captured graph of terrain contacts and solver alone.

    The robots hold their default pose, spread over each terrain from a crossing's start to its goal: contact costs
    what the ground under the robots makes it cost.

    Args:
        robot: Robot settings.
        terrains: Genes (num_terrains, 64) or heights (num_terrains, nrow, ncol); environments share them evenly.
        num_envs: Robots, a multiple of the number of terrains.
        device: Warp device name.
        steps: Physics steps timed, at least.
        warmup_steps: Physics steps made before, in which the robots settle.
        solver: Solver options.

    Raises:
        ValueError: If the environments cannot be shared out evenly.
    """
    if num_envs % len(terrains):
        raise ValueError(f"num_envs must be a multiple of the {len(terrains)} terrains, got {num_envs}")
    bank = TerrainBank(len(terrains), device=device, nrow=NUM_ROWS, ncol=NUM_COLS)
    (bank.set_heights if terrains.ndim == 3 else bank.set_genes)(terrains)
    terrain_of_env = np.repeat(np.arange(len(terrains)), num_envs // len(terrains))
    sim = Simulation(robot, bank, terrain_of_env, cfg=solver)
    x = np.linspace(*_CROSSING_X, num_envs // len(terrains))
    stand_on_terrain(sim, np.tile(x, len(terrains)))

    def control_step() -> None:
        for _ in range(robot.decimation):
            sim.physics_step()

    graph = sim.capture(control_step)
    launches = -(-steps // robot.decimation)
    for _ in range(warmup_steps // robot.decimation):
        sim.launch(graph)
    wp.synchronize_device(device)
    began = time.perf_counter()
    for _ in range(launches):
        sim.launch(graph)
    wp.synchronize_device(device)
    return num_envs * launches * robot.decimation / (time.perf_counter() - began)


def stand_on_terrain(sim: Simulation, x: np.ndarray, y: float = 4.0) -> None:
    """Put every robot in its default pose over its terrain at world-local (x, y) [m], x of shape (num_envs,); held."""
    robot, spacing = sim.robot, sim.bank.terrain.spacing
    heights = sim.bank.heights.numpy()
    length, width = (round(half / spacing) for half in robot.footprint)
    row = round(y / spacing)
    joint_q = np.zeros(sim.joint_q.shape, dtype=np.float32)
    for env, t in enumerate(np.array(sim.terrain_of_env.numpy(), dtype=np.intp)):
        col = round(float(x[env]) / spacing)
        under = heights[t, row - width : row + width + 1, max(col - length, 0) : col + length + 1]
        joint_q[env, :3] = x[env], y, under.max() + robot.default_base_height
    joint_q[:, 6] = 1.0
    joint_q[:, 7:] = robot.default_joint_pos
    sim.joint_q.assign(joint_q)
    sim.joint_qd.zero_()
    sim.targets.assign(joint_q)
    sim.refresh()
