"""What the training of a controller takes of its robot: the rewards, and how its starts and its body are varied."""

import math
from dataclasses import asdict, dataclass, field
from typing import Any

_SIZES = ("num_envs", "iterations")


@dataclass(frozen=True, kw_only=True)
class RewardCfg:
    """Weight of each reward term per second: legged_gym's for ANYmal, and the paper's two."""

    tracking_lin_vel: float = 1.0
    tracking_ang_vel: float = 0.5
    lin_vel_z: float = -2.0
    ang_vel_xy: float = -0.05
    torques: float = -1e-5
    dof_acc: float = -2.5e-7
    feet_air_time: float = 1.0
    collision: float = -1.0
    action_rate: float = -0.01
    stumble: float = -0.1
    feet_contact_forces: float = -2e-4
    """Contacts are stiff and their peaks high: five times this drowns the tracking for half of a training."""
    dof_pos_limits: float = 0.0
    """On the radians beyond the soft joint limits."""
    no_fly: float = 0.0
    """On one foot alone being on the ground."""
    orientation: float = 0.0
    """On the tilt of the base; Isaac Lab gives -2.5 to Cassie on flat ground, nothing on rough."""
    joint_deviation: float = 0.0
    """On the steady joints' distance from the default pose; Isaac Lab gives -.2 to Cassie's hips."""
    termination: float = 0.0
    """On a fall, in the control step that it ends the episode with."""


@dataclass(frozen=True, kw_only=True)
class TrainingCfg:
    """The settings of the training task that belong to the robot; the defaults are legged_gym's."""

    rewards: RewardCfg = field(default_factory=RewardCfg)
    only_positive: bool = True
    """Clip the reward of a step at 0, so that ending early never pays."""
    min_air_time_s: float = 0.5
    """Feet are to be in the air for longer than this in each step [s]."""
    soft_joint_limit: float = 1.0
    """Soft joint limits span this share of the range between the hard ones, about its middle."""
    steady_joints: tuple[str, ...] = ()
    """Joints that are to keep near their default angle."""
    added_base_mass: tuple[float, float] = (0.0, 0.0)
    """Range of the mass added to the bases [kg]; ANYmal's is -5 to 5."""
    push_speed: float = 1.0
    """A push sets the horizontal velocity to a random one of up to this along x and y [m/s]."""
    start_joint_range: float = 0.5
    """Joints start at the default pose times 1 +- this."""


@dataclass(frozen=True, kw_only=True)
class PaceCfg:
    """The settings of the learner that belong to the robot; the defaults are legged_gym's."""

    init_noise_std: float = 1.0
    """Standard deviation of the actions before the first update."""
    desired_kl: float = 0.01
    """KL divergence an update aims at."""
    entropy: float = 0.01
    """Weight of the entropy bonus."""
    final_share: float = 0.0
    """Share of the iterations, the last ones, with final_kl and final_entropy in place of desired_kl and entropy:
    smaller steps and less noise."""
    final_kl: float = 0.008
    final_entropy: float = 0.002


@dataclass(frozen=True, kw_only=True)
class LearningCfg(PaceCfg):
    """How the robot's controller is learned from scratch on a GPU; the defaults are ANYmal's."""

    num_envs: int = 8192
    iterations: int = 2240


def learning_problems(cfg: LearningCfg) -> list[str]:
    """What is wrong with the sizes and the types of settings, one line each; ranges are for PPO to say."""
    values = asdict(cfg)
    problems = [f"learning.{name} must be a whole number from 1 on, got {values[name]!r}" for name in _SIZES
                if not isinstance(values[name], int) or values[name] < 1]  # fmt: skip
    return problems + [f"learning.{name} must be a number, got {value!r}" for name, value in values.items()
                       if name not in _SIZES and not _is_number(value)]  # fmt: skip


def training_problems(cfg: TrainingCfg) -> list[str]:
    """What is wrong with the settings of a training by themselves, one line each."""
    weights: dict[str, Any] = asdict(cfg.rewards) if isinstance(cfg.rewards, RewardCfg) else {}
    problems = [f"training.rewards.{name} must be a number, got {weight!r}" for name, weight in weights.items()
                if not _is_number(weight)]  # fmt: skip
    if not weights:
        problems.append(f"training.rewards must be a RewardCfg, got {type(cfg.rewards).__name__}")
    for name in ("min_air_time_s", "push_speed", "start_joint_range"):
        value = getattr(cfg, name)
        if not _is_number(value) or value < 0.0:
            problems.append(f"training.{name} must be a number from 0 on, got {value!r}")
    if not _is_number(cfg.soft_joint_limit) or not 0.0 < cfg.soft_joint_limit <= 1.0:
        problems.append(f"training.soft_joint_limit must be a share in 0..1, got {cfg.soft_joint_limit!r}")
    mass: Any = cfg.added_base_mass
    if not isinstance(mass, tuple) or len(mass) != 2 or not all(map(_is_number, mass)) or mass[0] > mass[1]:
        problems.append(f"training.added_base_mass must be a least and a largest mass [kg], got {mass!r}")
    return problems


def _is_number(value: Any) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value)
