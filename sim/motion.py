"""What the rewards of a control step are computed from: a simulation's state, with what it is compared with."""

from typing import Any

import numpy as np
import warp as wp

from kernels.reward_terms import Motion
from sim.robots.training import TrainingCfg
from sim.simulation import Simulation


def soft_joint_limits(sim: Simulation, share: float) -> tuple[np.ndarray, np.ndarray]:
    """Lower and upper soft limits of the joints [rad], float32, shape (num_joints,) each.

    Args:
        sim: The robots.
        share: Part of each joint's range that they span, about its middle; where there is none, they are far away.
    """
    joints = slice(6, 6 + sim.robot.num_joints)
    lower, upper = (
        np.asarray(limits.numpy(), dtype=np.float64)[joints]
        for limits in (sim.model.joint_limit_lower, sim.model.joint_limit_upper)
    )
    middle, half = 0.5 * (lower + upper), 0.5 * share * (upper - lower)
    return (middle - half).astype(np.float32), (middle + half).astype(np.float32)


def make_motion(
    sim: Simulation,
    cfg: TrainingCfg,
    *,
    command: Any,
    action: Any,
    previous_action: Any,
    previous_joint_vel: Any,
    fallen: Any,
) -> Motion:
    """The kernel argument of :func:`kernels.rewards.reward_steps`, on the simulation's device.

    Args:
        sim: The robots; their state is referred to, not copied.
        cfg: Which joints are to keep still, and how soft their limits are.
        command: Command the action answers, shape (num_envs, 3).
        action: Clipped action of the step, shape (num_envs, num_joints).
        previous_action: That of the step before, shape (num_envs, num_joints).
        previous_joint_vel: Joint rates at the end of the step before [rad/s], shape (num_envs, num_joints).
        fallen: 1 where the step ended the episode by a fall, shape (num_envs,).

    Raises:
        ValueError: If a steady joint is none of the robot's.
    """
    robot = sim.robot
    unknown = [name for name in cfg.steady_joints if name not in robot.joint_names]
    if unknown:
        raise ValueError(
            f"steady_joints: robot '{robot.name}' has no joint named {', '.join(unknown)}: expected some of "
            f"{', '.join(robot.joint_names)}"
        )
    motion = Motion()
    for name in ("joint_q", "joint_qd", "joint_torque", "geom_force", "geom_role"):
        setattr(motion, name, getattr(sim, name))
    motion.command = command
    motion.action = action
    motion.previous_action = previous_action
    motion.previous_joint_vel = previous_joint_vel
    motion.fallen = fallen
    motion.base_com = sim.sensors.base_com
    motion.default_joint_pos = sim.sensors.default_joint_pos
    motion.force_limit = robot.contact_force_limit
    motion.dt = robot.control_dt
    lower, upper = soft_joint_limits(sim, cfg.soft_joint_limit)
    motion.joint_lower = wp.array(lower, dtype=float, device=sim.device)
    motion.joint_upper = wp.array(upper, dtype=float, device=sim.device)
    steady = [int(name in cfg.steady_joints) for name in robot.joint_names]
    motion.joint_is_steady = wp.array(steady, dtype=int, device=sim.device)
    return motion
