"""What the kernels are timed on: robots that the shipped controller has walked into the middle of gene terrains."""

import math
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp

from kernels.episode import command_goal
from kernels.penalties import PENALTIES
from sim.bank import TerrainBank
from sim.crossing import CrossingCfg, make_task
from sim.robots.robot import RobotCfg
from sim.rollout import Rollout
from sim.space import SUPER_GAUSSIAN


@dataclass(frozen=True, kw_only=True)
class SceneCfg:
    """Sizes of a benchmark."""

    num_envs: int
    num_terrains: int
    walk_s: float = 8.0
    """Simulated time the robots walk before anything is timed: at 0.75 m/s, 6 m, where the bumps are."""
    duration_s: float = 20.0
    """Length of the crossings by which the whole step is timed."""
    seed: int = 0

    def __post_init__(self) -> None:
        if not 1 <= self.num_terrains <= self.num_envs:
            raise ValueError(
                f"num_terrains must lie in 1..num_envs, got {self.num_terrains} terrains for {self.num_envs} envs: "
                "each terrain needs a robot"
            )
        if not 0 < self.walk_s <= self.duration_s < math.inf:
            raise ValueError(f"walk_s must lie in 0..{self.duration_s} s, got {self.walk_s}")


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Walking robots and the buffers the benchmarked kernels write, all on the device."""

    cfg: SceneCfg
    rollout: Rollout
    genes: np.ndarray
    """Genes of every grid of the rollout's bank; environments stand on the first ``cfg.num_terrains``."""
    seeds: np.ndarray
    fresh: TerrainBank
    """A bank to rasterise into, so that the ground under the robots stays as it is."""
    genes_on_device: Any
    """Genes of ``fresh``, shape (num_terrains, 64)."""
    command: Any
    last_action: Any
    counted: Any
    buffers: dict[str, Any] = field(default_factory=dict)
    """What the kernels write: ``scan``, ``observation`` and ``penalties``."""

    @property
    def robot(self) -> RobotCfg:
        """The robot's settings."""
        return self.rollout.robot


def build_scene(robot: RobotCfg, cfg: SceneCfg, device: str) -> Scene:
    """Builds the simulation and lets the robots walk, by their shipped controller.

    Raises:
        ValueError: If fewer than half of the robots still stand on something: nothing would be worth timing.
    """
    rollout = Rollout(
        robot,
        robot.policy_file,
        num_terrains=cfg.num_terrains,
        num_replicas=-(-cfg.num_envs // cfg.num_terrains),
        num_envs=cfg.num_envs,
        device=device,
        cfg=CrossingCfg(max_duration_s=cfg.duration_s),
    )
    sim = rollout.sim
    genes = SUPER_GAUSSIAN.hard_random(rollout.num_terrains, cfg.seed)
    seeds = np.random.SeedSequence(cfg.seed).generate_state(rollout.num_terrains, np.uint32)
    rollout.put(genes, seeds)
    for _ in range(round(cfg.walk_s / robot.control_dt)):
        rollout.control_step()
    if sim.contact_count.numpy()[0] < cfg.num_envs // 2:
        raise ValueError(f"only {sim.contact_count.numpy()[0]} contacts in {cfg.num_envs} environments: no robot walks")
    rng = np.random.default_rng(cfg.seed)
    with wp.ScopedDevice(device):
        sim.collide()  # of the poses the last step ended in; before, the records are those it began with
        command = wp.zeros((cfg.num_envs, 3), dtype=float)
        command_goal(sim.joint_q, wp.zeros(cfg.num_envs, dtype=int), make_task(rollout.cfg, robot), command)
        return Scene(
            cfg=cfg,
            rollout=rollout,
            genes=genes,
            seeds=seeds,
            fresh=TerrainBank(cfg.num_terrains, device=device),
            genes_on_device=wp.array(genes, dtype=float),
            command=command,
            last_action=wp.array(rng.normal(size=(cfg.num_envs, robot.num_joints)).astype(np.float32)),
            counted=wp.ones(cfg.num_envs, dtype=int),
            buffers={
                "scan": wp.zeros((cfg.num_envs, robot.num_scan_points), dtype=float),
                "observation": wp.zeros((cfg.num_envs, robot.observation_size), dtype=float),
                "penalties": wp.zeros((cfg.num_envs, len(PENALTIES)), dtype=float),
            },
        )
