"""The reward of a robot's training: what a simulation's control steps pay, in training and in a crossing alike."""

from collections.abc import Collection
from dataclasses import asdict
from typing import Any

import numpy as np
import warp as wp

from kernels.episode import Outcome
from kernels.rewards import Motion, make_rewards, make_weights, reward_steps
from sim.robots.training import TrainingCfg
from sim.simulation import Simulation


def soft_joint_limits(sim: Simulation, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper soft limits of the joints [rad], float32, shape (num_joints,) each.

    They span a share of each joint's range about its middle; where there is none, they are far away.
    """
    joints = slice(6, 6 + sim.robot.num_joints)
    lower, upper = (
        np.asarray(limits.numpy(), dtype=np.float64)[joints]
        for limits in (sim.model.joint_limit_lower, sim.model.joint_limit_upper)
    )
    middle, half = 0.5 * (lower + upper), 0.5 * share * (upper - lower)
    return (middle - half).astype(np.float32), (middle + half).astype(np.float32)


def make_motion(sim: Simulation, cfg: TrainingCfg, *, command: Any, action: Any) -> Motion:
    """What rewards are computed from, as a kernel argument on the simulation's device.

    Args:
        sim: The robots; their state is referred to, not copied.
        cfg: Which joints are to keep still, how soft their limits are, and how long feet are to be in the air.
        command: Command the action answers, shape (num_envs, 3).
        action: Clipped action of the step, shape (num_envs, num_joints).
    """
    robot = sim.robot
    motion = Motion()
    for name in ("joint_q", "joint_qd", "joint_torque", "geom_force", "geom_role"):
        setattr(motion, name, getattr(sim, name))
    motion.command, motion.action = command, action
    motion.base_com = sim.sensors.base_com
    motion.default_joint_pos = sim.sensors.default_joint_pos
    motion.force_limit = robot.contact_force_limit
    motion.dt = robot.control_dt
    motion.min_air_time_s = cfg.min_air_time_s
    lower, upper = soft_joint_limits(sim, cfg.soft_joint_limit)
    motion.joint_lower = wp.array(lower, dtype=float, device=sim.device)
    motion.joint_upper = wp.array(upper, dtype=float, device=sim.device)
    steady = [int(name in cfg.steady_joints) for name in robot.joint_names]
    motion.joint_is_steady = wp.array(steady, dtype=int, device=sim.device)
    return motion


class Reward:
    """Pays every control step of every robot.

    Attributes:
        state: Rewards so far (:class:`kernels.rewards.Rewards`).
    """

    def __init__(
        self, sim: Simulation, cfg: TrainingCfg, *, command: Any, action: Any, falls: Collection[Outcome]
    ) -> None:
        """Allocate on the simulation's device; arguments as of :func:`make_motion`, and the outcomes that are falls."""
        robot = sim.robot
        self._motion = make_motion(sim, cfg, command=command, action=action)
        self._weights = make_weights(asdict(cfg.rewards), only_positive=cfg.only_positive, falls=falls)
        self.state = make_rewards(sim.num_envs, robot.num_joints, len(robot.geom_names), sim.device)

    def pay(self, outcome: Any) -> None:
        """Reward the control step just made, before the next command is written; ``outcome`` is that after it."""
        reward_steps(self._motion, self._weights, outcome, self.state)
