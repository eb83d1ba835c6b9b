"""A penalty in one file, registered before any robot is simulated, so that all tests share one compilation."""

from kernels.penalties import penalty
from kernels.state import RobotStep, base_ang_vel_b


@penalty(
    "roll_rate",
    plain=lambda step: step.ang_vel[:, 0] ** 2,
    label="roll rate of the trunk",
    unit="(rad/s)^2 s",
    color="#009e73",
    default=False,
)
def _roll_rate(step: RobotStep, env: int) -> float:
    """Squared roll rate [(rad/s)^2], base frame."""
    rate = base_ang_vel_b(step.joint_q, step.joint_qd, env)[0]
    return rate * rate
