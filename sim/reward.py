"""The reward of a robot's training for the control steps of a simulation, in training and in crossings."""

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
        motion: The state that rewards are computed from, a kernel argument; it shares the simulation's arrays.
        state: Rewards so far (:class:`kernels.rewards.Rewards`).
    """

    def __init__(
        self, sim: Simulation, cfg: TrainingCfg, *, command: Any, action: Any, falls: Collection[Outcome]
    ) -> None:
        """Allocate on the simulation's device; ``falls`` are the outcomes that count as such.

        ``command``, of shape (num_envs, 3), is what the step's clipped ``action``, (num_envs, num_joints), answers.
        """
        robot = sim.robot
        limits = (sim.model.joint_limit_lower, sim.model.joint_limit_upper)
        lower, upper = (np.asarray(limit.numpy(), dtype=np.float64)[6 : 6 + robot.num_joints] for limit in limits)
        # Soft limits span a share of each joint's range about its middle; a joint without limits has them far away.
        middle = 0.5 * (lower + upper)
        half = 0.5 * cfg.soft_joint_limit * (upper - lower)
        steady = [int(name in cfg.steady_joints) for name in robot.joint_names]
        self.motion = sim.fill(
            Motion,
            command=command,
            action=action,
            default_joint_pos=sim.sensors.default_joint_pos,
            force_limit=robot.contact_force_limit,
            dt=robot.control_dt,
            min_air_time_s=cfg.min_air_time_s,
            joint_lower=wp.array(middle - half, dtype=float, device=sim.device),
            joint_upper=wp.array(middle + half, dtype=float, device=sim.device),
            joint_is_steady=wp.array(steady, dtype=int, device=sim.device),
        )
        self._weights = make_weights(asdict(cfg.rewards), only_positive=cfg.only_positive, falls=falls)
        self.state = make_rewards(sim.num_envs, robot.num_joints, len(robot.geom_names), sim.device)

    def pay(self, outcome: Any) -> None:
        """Reward the control step just made, before the next command is written; ``outcome`` is that after it."""
        reward_steps(self.motion, self._weights, outcome, self.state)
