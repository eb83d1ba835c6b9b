"""The bare physics rate: what the solver and the terrain contact alone can do, the yardstick of everything else."""

import time

import numpy as np
import warp as wp

from sim.bank import TerrainBank
from sim.robot import RobotCfg
from sim.simulation import Simulation, SolverCfg
from sim.terrain import NUM_COLS, NUM_ROWS


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

    The robots start where a crossing does and hold their default pose (definitions: bare physics rate).

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
    stand_on_terrain(sim)

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


def stand_on_terrain(sim: Simulation, x: float = 2.0, y: float = 4.0) -> None:
    """Put every robot in its default pose at world-local (x, y) [m] over its terrain, and hold that pose."""
    robot, spacing = sim.robot, sim.bank.terrain.spacing
    heights = sim.bank.heights.numpy()[np.array(sim.terrain_of_env.numpy(), dtype=np.intp)]
    row, col = round(y / spacing), round(x / spacing)
    length, width = (round(half / spacing) for half in robot.footprint)
    ground = heights[:, row - width : row + width + 1, col - length : col + length + 1].max(axis=(1, 2))
    joint_q = np.zeros(sim.joint_q.shape, dtype=np.float32)
    joint_q[:, 0], joint_q[:, 1], joint_q[:, 2] = x, y, ground + robot.default_base_height
    joint_q[:, 6] = 1.0
    joint_q[:, 7:] = robot.default_joint_pos
    sim.joint_q.assign(joint_q)
    sim.joint_qd.zero_()
    sim.targets.assign(joint_q)
    sim.refresh()
