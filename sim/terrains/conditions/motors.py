"""Weak or strong motors."""

from typing import Any

import warp as wp

from kernels.conditions import VariedRobots
from sim.terrains.conditions.base import Array, Condition, ConditionDose, Gene


@wp.func
def _begin_motors(robots: VariedRobots, row: wp.array[float], first: int, terrain: int, env: int):
    robots.strength[env] = row[first]


class MotorStrength(Condition):
    """Factor of the torques of all motors, and of their limits."""

    name, cause = "motors", "weak motors"
    genes = (Gene(name="strength", low=0.4, middle=1.0, high=1.2, limits=(1e-3, 10.0)),)
    dose = ConditionDose(title="strength of motors", values=(1.0, 0.9, 0.8, 0.7, 0.6, 0.5, 0.4))
    varied = (0.9, 1.1)
    begin = _begin_motors

    def text(self, values: Array) -> str:
        """Strength in percent."""
        return f"motors at {values[0]:.0%}" if abs(values[0] - 1.0) >= 0.005 else ""

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Scales gains and limits of the model's actuators."""
        episodes.strength, model = float(values[0]), episodes.model
        model.actuator_gainprm[:, 0] *= values[0]
        model.actuator_biasprm[:, :3] *= values[0]
        model.actuator_forcerange[:] *= values[0]
        model.jnt_actfrcrange[:] *= values[0]
