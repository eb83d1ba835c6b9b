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


class Reward:
    """Pays every control step of every robot.

    Attributes:
        motion: What rewards are computed from, a kernel argument on the simulation's device, whose state is not copied.
        state: Rewards so far (:class:`kernels.rewards.Rewards`).
    """

    def __init__(
        self, sim: Simulation, cfg: TrainingCfg, *, command: Any, action: Any, falls: Collection[Outcome]
    ) -> None:
        """Allocate on the simulation's device; ``falls`` are the outcomes that count as such.

        ``command``, of shape (num_envs, 3), is what the step's clipped ``action``, (num_envs, num_joints), answers.
        """
        robot = sim.robot
        motion = self.motion = Motion()
        for name in ("joint_q", "joint_qd", "joint_torque", "geom_force", "geom_role"):
            setattr(motion, name, getattr(sim, name))
        motion.command, motion.action = command, action
        motion.base_com = sim.sensors.base_com
        motion.default_joint_pos = sim.sensors.default_joint_pos
        motion.force_limit = robot.contact_force_limit
        motion.dt = robot.control_dt
        motion.min_air_time_s = cfg.min_air_time_s
        limits = (sim.model.joint_limit_lower, sim.model.joint_limit_upper)
        lower, upper = (np.asarray(limit.numpy(), dtype=np.float64)[6 : 6 + robot.num_joints] for limit in limits)
        # Soft limits span a share of each joint's range about its middle; where there is none, they are far away.
        middle, half = 0.5 * (lower + upper), 0.5 * cfg.soft_joint_limit * (upper - lower)
        motion.joint_lower = wp.array(middle - half, dtype=float, device=sim.device)
        motion.joint_upper = wp.array(middle + half, dtype=float, device=sim.device)
        steady = [int(name in cfg.steady_joints) for name in robot.joint_names]
        motion.joint_is_steady = wp.array(steady, dtype=int, device=sim.device)
        self._weights = make_weights(asdict(cfg.rewards), only_positive=cfg.only_positive, falls=falls)
        self.state = make_rewards(sim.num_envs, robot.num_joints, len(robot.geom_names), sim.device)

    def pay(self, outcome: Any) -> None:
        """Reward the control step just made, before the next command is written; ``outcome`` is that after it."""
        reward_steps(self.motion, self._weights, outcome, self.state)
