"""What the kernels are timed on: robots that the shipped controller has walked into the middle of gene terrains."""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from kernels.episode import command_goal
from sim.crossing import CrossingCfg, make_task
from sim.robots.robot import RobotCfg
from sim.rollout import Rollout
from sim.space import SUPER_GAUSSIAN


@dataclass(frozen=True, kw_only=True)
class Scene:
    """Walking robots, and what the benchmarked kernels read beside their state, all on the device."""

    rollout: Rollout
    num_terrains: int
    """Terrains that environments stand on, the first of the rollout's bank."""
    genes: np.ndarray
    """Genes of every grid of the rollout's bank."""
    seeds: np.ndarray
    """Seed of the episodes on each of them."""
    seed: int
    """What all is drawn with."""
    command: Any
    """Shape (num_envs, 3)."""
    last_action: Any
    """Random actions, shape (num_envs, num_joints)."""

    @property
    def robot(self) -> RobotCfg:
        """The robot's settings."""
        return self.rollout.robot

    @property
    def num_envs(self) -> int:
        """Number of robots."""
        return self.rollout.sim.num_envs


def build_scene(
    robot: RobotCfg,
    device: str,
    *,
    num_envs: int,
    num_terrains: int,
    walk_s: float = 8.0,
    duration_s: float = 20.0,
    seed: int = 0,
) -> Scene:
    """Builds the simulation and lets the robots walk, by their shipped controller.

    Args:
        robot: Robot settings.
        device: Warp device name.
        num_envs: Number of robots.
        num_terrains: Terrains they stand on.
        walk_s: Simulated time they walk [s]: at 0.75 m/s, 6 m are where the bumps are.
        duration_s: Length of the crossings by which the whole step is timed [s].
        seed: Draws terrains, starts and actions.

    Raises:
        ValueError: If a terrain has no robot, the walk is longer than a crossing, or fewer than half of the robots
            still stand on something: nothing would be worth timing.
    """
    if not 1 <= num_terrains <= num_envs:
        raise ValueError(
            f"num_terrains must lie in 1..num_envs, got {num_terrains} terrains for {num_envs} envs: "
            "each terrain needs a robot"
        )
    if not 0 < walk_s <= duration_s < math.inf:
        raise ValueError(f"walk_s must lie in 0..{duration_s} s, got {walk_s}")
    rollout = Rollout(
        robot,
        robot.policy_file,
        num_terrains=num_terrains,
        num_replicas=-(-num_envs // num_terrains),
        num_envs=num_envs,
        device=device,
        cfg=CrossingCfg(max_duration_s=duration_s),
    )
    sim = rollout.sim
    genes = SUPER_GAUSSIAN.hard_random(num_terrains, seed)
    seeds = np.random.SeedSequence(seed).generate_state(num_terrains, np.uint32)
    rollout.put(genes, seeds)
    for _ in range(round(walk_s / robot.control_dt)):
        rollout.control_step()
    if sim.contact_count.numpy()[0] < num_envs // 2:
        raise ValueError(f"only {sim.contact_count.numpy()[0]} contacts in {num_envs} environments: no robot walks")
    actions = np.random.default_rng(seed).normal(size=(num_envs, robot.num_joints)).astype(np.float32)
    with wp.ScopedDevice(device):
        sim.refresh()
        sim.collide()  # of the poses the last step ended in; before, the records are those it began with
        command = wp.zeros((num_envs, 3), dtype=float)
        command_goal(sim.joint_q, wp.zeros(num_envs, dtype=int), make_task(rollout.cfg, robot), command)
        return Scene(
            rollout=rollout,
            num_terrains=num_terrains,
            genes=genes,
            seeds=seeds,
            seed=seed,
            command=command,
            last_action=wp.array(actions),
        )
