"""Settings of a robot for the training of its controllers: rewards, learning, fine-tuning."""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from sim.files.settings import Interval, NonNegativeFloat, PositiveFloat, PositiveInt, Share


@dataclass(frozen=True, kw_only=True)
class NoiseCfg:
    """Half widths of the uniform observation noise, in the units of the measured quantity: those of legged_gym."""

    lin_vel: NonNegativeFloat = 0.1
    ang_vel: NonNegativeFloat = 0.2
    gravity: NonNegativeFloat = 0.05
    joint_pos: NonNegativeFloat = 0.01
    joint_vel: NonNegativeFloat = 1.5
    scan: NonNegativeFloat = 0.1

    def column_widths(self, sizes: Sequence[int]) -> NDArray[np.float64]:
        """Half width of each column of an observation whose quantities have the sizes of ``robot.column_sizes``."""
        widths = [2.0 * self.lin_vel, 0.25 * self.ang_vel, self.gravity, 0.0, 0.0]
        widths += [self.joint_pos, 0.05 * self.joint_vel, 0.0, 5.0 * self.scan, 0.0, 0.5 * self.gravity, 0.0, 0.0]
        return np.repeat(widths, sizes)  # a small turn by a is half of a in a quaternion


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
    dof_pos_limits: float = 0.0  # On the radians beyond the soft joint limits.
    no_fly: float = 0.0  # On control steps with exactly one foot on the ground.
    orientation: float = 0.0
    """On the tilt of the base; Isaac Lab gives -2.5 to Cassie on flat ground, nothing on rough."""
    joint_deviation: float = 0.0
    """On the steady joints' distance from the default pose; Isaac Lab gives -.2 to Cassie's hips."""
    termination: float = 0.0  # On a fall, in the control step that ends the episode.


@dataclass(frozen=True, kw_only=True)
class TrainingCfg:
    """The settings of the training task that belong to the robot; the defaults are legged_gym's."""

    rewards: RewardCfg = field(default_factory=RewardCfg)
    only_positive: bool = True  # Clip the reward of a step at 0, so that ending early never pays.
    min_air_time_s: NonNegativeFloat = 0.5  # Time in the air of a foot beyond which its steps are rewarded [s].
    soft_joint_limit: Annotated[float, Meta(gt=0, le=1)] = 1.0
    """Soft joint limits span this share of the range between the hard ones, about its middle."""
    steady_joints: tuple[str, ...] = ()  # Joints whose distance from the default angle is penalised.
    added_base_mass: Interval = (0.0, 0.0)  # Range of the mass added to the bases [kg]; ANYmal's is -5 to 5.
    push_speed: NonNegativeFloat = 1.0
    """A push sets the horizontal velocity to a random one of up to this along x and y [m/s]."""
    start_joint_range: NonNegativeFloat = 0.5  # Joints start at the default pose times 1 +- this.


@dataclass(frozen=True, kw_only=True)
class PaceCfg:
    """The settings of the learner that belong to the robot; the defaults are legged_gym's."""

    init_noise_std: PositiveFloat = 1.0  # Standard deviation of the actions before the first update.
    desired_kl: PositiveFloat = 0.01  # KL divergence an update aims at.
    entropy: NonNegativeFloat = 0.01  # Weight of the entropy bonus.


@dataclass(frozen=True, kw_only=True)
class LearningCfg(PaceCfg):
    """How the robot's controller is learned from scratch on a GPU; the defaults are ANYmal's."""

    num_envs: PositiveInt = 8192
    iterations: PositiveInt = 2240


Draw = Literal["uniform", "failing", "learnable"]  # how a fine-tuning draws elites (:class:`train.cfg.RecipeCfg`)
MAX_SPREAD = 10.0  # how far along the way robots may start [m]; farther ones would start within 2 m of the goal


@dataclass(frozen=True, kw_only=True)
class TuningCfg:
    """How the robot's controller is fine-tuned on terrains that break it; the defaults suit a user's robot."""

    termination: float = -200.0  # Weight of :attr:`RewardCfg.termination` in place of the robot's own.
    tracking_lin_vel: float = 2.0  # Weight of :attr:`RewardCfg.tracking_lin_vel` in place of the robot's own.
    draw: Draw = "learnable"
    start_spread: Annotated[float, Meta(ge=0, le=MAX_SPREAD)] = 8.0  # Robots start up to so far along the way [m].
    entropy: NonNegativeFloat = 0.005
    """Weight of the entropy bonus. It widens the noise of the actions, which a further training begins with."""
    average: Share = 0.2  # Share of all iterations, the last ones, whose actors are averaged into the controller.


@dataclass(frozen=True, kw_only=True)
class PaperCfg:
    """Sizes of the paper's fine-tunings and tables (arXiv 2506.01362); the defaults are its ANYmal's."""

    num_envs: int = 1500
    terrains: int = 500  # Terrains at a time.
    swap_every: int = 400  # Iterations after which the terrains are exchanged.
    iterations: int = 1200
    test_terrains: int = 300  # Terrains of each set of its tables.
