"""The observation row split into physical quantities, for controllers that expect another row."""

from dataclasses import dataclass
from functools import lru_cache

import torch

from kernels.observation import ANG_VEL_SCALE, JOINT_VEL_SCALE, LIN_VEL_SCALE, SCAN_OFFSET, SCAN_SCALE
from sim.robots.robot import RobotCfg


@dataclass(frozen=True, kw_only=True)
class Sensed:
    """What robots sense; tensors lead with num_envs, on the observation's device."""

    lin_vel: torch.Tensor
    """Velocity of the base link's origin, base frame [m/s], shape (num_envs, 3)."""
    ang_vel: torch.Tensor
    """Angular velocity of the base, base frame [rad/s], shape (num_envs, 3)."""
    gravity: torch.Tensor
    """Direction of gravity, base frame, a unit vector: (0, 0, -1) upright; shape (num_envs, 3)."""
    command: torch.Tensor
    """Commanded v_x, v_y [m/s] in the base's yaw frame, and yaw rate [rad/s], shape (num_envs, 3)."""
    joint_pos: torch.Tensor
    """Joint angles [rad] in the order of ``robot.joint_names``, shape (num_envs, num_joints)."""
    joint_vel: torch.Tensor
    """Joint rates [rad/s], shape (num_envs, num_joints)."""
    last_action: torch.Tensor
    """What the controller last returned, clipped to +-100; 0 at the start; shape (num_envs, num_joints)."""
    scan: torch.Tensor
    """Height of the base over the ground at the scan points [m], clipped to -0.5..1.5; shape
    (num_envs, len(scan_x), len(scan_y)): ``robot.scan_x`` ahead and ``robot.scan_y`` left of the base, yaw frame."""


@lru_cache(maxsize=16)
def _on_device(values: tuple[float, ...], device: torch.device) -> torch.Tensor:
    """Copied once: every control step would wait for it."""
    return torch.tensor(values, dtype=torch.float32, device=device)


def read_row(row: torch.Tensor, robot: RobotCfg) -> Sensed:
    """Splits a robot's observation rows, shape (num_envs, observation_size), into physical quantities."""
    if row.ndim != 2 or row.shape[1] != robot.observation_size:
        raise ValueError(f"row must have shape (num_envs, {robot.observation_size}), got {tuple(row.shape)}")
    sizes = (3, 3, 3, 2, 1, *[robot.num_joints] * 3, robot.num_scan_points)
    lin_vel, ang_vel, gravity, speed, yaw_rate, joint_pos, joint_vel, last_action, scan = row.split(sizes, dim=1)
    return Sensed(
        lin_vel=lin_vel / LIN_VEL_SCALE,
        ang_vel=ang_vel / ANG_VEL_SCALE,
        gravity=gravity,
        command=torch.cat([speed / LIN_VEL_SCALE, yaw_rate / ANG_VEL_SCALE], dim=1),
        joint_pos=joint_pos + _on_device(robot.default_joint_pos, row.device),
        joint_vel=joint_vel / JOINT_VEL_SCALE,
        last_action=last_action,
        scan=(scan / SCAN_SCALE + SCAN_OFFSET).reshape(len(row), len(robot.scan_x), len(robot.scan_y)),
    )
