"""A condition in one file: wind along the way."""

import warp as wp

from kernels.conditions import DisturbedStep
from sim.terrains.conditions.kinds import CONDITIONS, Condition, Gene
from sim.terrains.quantities import Sweep


@wp.func
def _blow(step: DisturbedStep, row: wp.array[float], first: int, env: int):
    if row[first] != 0.0:
        step.joint_qd[env, 0] += row[first] * float(step.every) * step.dt


class Wind(Condition):
    name, cause = "wind", "headwind"
    genes = (Gene(name="wind", low=-5.0, middle=0.0, high=5.0, unit="m/s^2"),)
    form, least = "wind of {:.1f} m/s^2", 0.05
    dose = Sweep("wind", (0.0, 1.0, 2.0), title="wind from behind")
    meet = _blow

    def disturb_plain(self, episodes, values, rows, running, step):
        for k in running:
            episodes.data[k].qvel[0] += values[0] * episodes.robot.control_dt
            episodes.qvel[k] = episodes.data[k].qvel
        return rows


CONDITIONS["wind"] = Wind()
