"""Routes: a robot is asked to follow a sequence of commands, which are genes, in place of reaching the goal."""

import math

from kernels.episode import Kind
from kernels.route import LEAST_SPEED, SEGMENTS
from sim.terrains.conditions.kinds import CONDITIONS, GROUPS, Array, Condition, Gene
from sim.terrains.quantities import Sweep


class Segment(Condition):
    """The command of a part of a route: v_x and v_y over the robot's speed, and the yaw rate [rad/s].

    Nominal is straight on at the robot's speed. No command goes beyond the robot's limits, and slow ones are stops.
    """

    cause = "command"
    asks = Kind.ROUTE

    def __init__(self, number: int) -> None:
        """The segment of a number, from 1."""
        self.name = f"segment_{number}"
        self.genes = (
            Gene(name=f"{self.name}_x", low=0.0, middle=1.0, high=1.3),
            Gene(name=f"{self.name}_y", low=-0.6, middle=0.0, high=0.6, mirrored=True),
            Gene(name=f"{self.name}_turn", low=-1.0, middle=0.0, high=1.0, unit="rad/s", mirrored=True),
        )
        self.dose = None
        if number == 2:
            title = f"route: yaw rate in the second of {SEGMENTS} parts of the time"
            self.dose = Sweep(f"{self.name}_turn", (0.0, 0.2, 0.4, 0.6, 0.8, 1.0), title=title)
        self._number = number

    def span(self, values: Array, duration_s: float) -> tuple[float, float]:
        """Its share of the time."""
        return duration_s * (self._number - 1) / SEGMENTS, duration_s * self._number / SEGMENTS

    def text(self, values: Array) -> str:
        """The command, over the robot's speed; empty of straight on."""
        x, y, turn = map(float, values)
        if max(abs(x - 1.0), abs(y), abs(turn)) < 0.005:
            return ""
        if math.hypot(x, y) < float(LEAST_SPEED):
            x = y = 0.0
        turn *= abs(turn) >= float(LEAST_SPEED)
        words = [f"{x:.0%} of its speed ahead"] * (x >= 0.005)
        words += [f"{abs(y):.0%} to the {'left' if y > 0 else 'right'}"] * (abs(y) >= 0.005)
        words += [f"turning {'left' if turn > 0 else 'right'} by {abs(turn):.1f} rad/s"] * (turn != 0.0)
        return f"part {self._number} of {SEGMENTS} of the route: {', '.join(words) or 'stop'}"


_SEGMENTS = {segment.name: segment for segment in map(Segment, range(1, SEGMENTS + 1))}
CONDITIONS.update(_SEGMENTS)
GROUPS["command"] = tuple(_SEGMENTS)
