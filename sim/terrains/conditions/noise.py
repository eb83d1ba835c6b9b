"""Noise of observations."""

from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from kernels.conditions import DisturbedStep
from kernels.observation import noise_width
from sim.robots.training import NoiseCfg
from sim.terrains.conditions.base import Array, Condition, ConditionDose, Gene


@wp.func
def _disturb_noise(step: DisturbedStep, row: wp.array[float], first: int, env: int, column: int):
    if row[first] > 0.0:
        # Drawn by the episode's own stream: neither robot nor slot changes an episode.
        number = step.memory.age[env, column] * step.observation.shape[1] + column
        state = wp.rand_init(int(step.episodes.rng[env]), number)
        width = noise_width(step.memory.noise, column, step.num_joints)
        step.observation[env, column] += row[first] * width * wp.randf(state, -1.0, 1.0)


def noise_widths(robot: Any) -> NDArray[np.float64]:
    """Half widths of legged_gym's noise of each column of an observation, shape (observation_size,)."""
    noise, joints = NoiseCfg(), robot.num_joints
    groups = [
        (3, 2.0 * noise.lin_vel), (3, 0.25 * noise.ang_vel), (3, noise.gravity), (3, 0.0), (joints, noise.joint_pos),
        (joints, 0.05 * noise.joint_vel), (joints, 0.0), (len(robot.scan_points()[0]), 5.0 * noise.scan),
    ]  # fmt: skip
    return np.concatenate([np.full(count, width) for count, width in groups])


class ObservationNoise(Condition):
    """Factor of legged_gym's uniform noise of observations."""

    name, cause = "noise", "noise"
    genes = (Gene(name="noise", low=0.0, middle=2.0, high=4.0, absent=-1.0, limits=(0.0, 100.0)),)
    dose = ConditionDose(title="noise over legged_gym's", values=(0.0, 0.5, 1.0, 1.5, 2.0, 3.0, 4.0))
    varied = (1.0, 1.0)
    disturb = _disturb_noise

    def text(self, values: Array) -> str:
        """The factor."""
        return f"noise {values[0]:.1f} times legged_gym's" if values[0] >= 0.05 else ""

    def disturb_plain(self, episodes: Any, values: Array, rows: Array, running: Any, step: int) -> Array:
        """Adds noise, drawn otherwise than in the parallel simulation."""
        widths = values[0] * noise_widths(episodes.robot)
        return rows + widths * episodes.rng.uniform(-1.0, 1.0, rows.shape)
