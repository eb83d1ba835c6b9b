"""Conditions of a crossing on the host: what there is, as genes and in words (:mod:`kernels.conditions`)."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from kernels.conditions import Condition

NOMINAL = np.array([condition in (Condition.STRENGTH, Condition.FRICTION) for condition in Condition], np.float32)
"""A row of conditions that change nothing, shape (12,)."""
MOST_DELAY_S = MOST_LAG_S = 0.06
"""Longest delay of actions, beside the robot's own, and largest age of observations [s]."""
DELAY_STEP_S, LAG_STEP_S = 0.005, 0.02
"""What these are multiples of: physics and control steps of the shipped robots, which are late by whole steps alone."""


@dataclass(frozen=True)
class Gene:
    """How a gene in [-1, 1] becomes a condition: ``middle`` at 0, and linear on both sides."""

    condition: Condition
    least: float
    middle: float
    most: float
    absent: float = 0.0
    """The gene that changes nothing."""
    step: float = 0.0
    """What conditions are multiples of; 0 if they may be any number."""

    def value(self, genes: NDArray[np.floating]) -> NDArray[np.float64]:
        """Conditions of genes, any shape."""
        values = np.interp(genes, (-1.0, 0.0, 1.0), (self.least, self.middle, self.most))
        return np.floor(values / self.step + 0.5) * self.step if self.step else values

    def gene(self, values: NDArray[np.floating]) -> NDArray[np.float64]:
        """Genes of conditions, any shape; outside of the limits those at the limit."""
        return np.interp(values, (self.least, self.middle, self.most), (-1.0, 0.0, 1.0))


KINDS: dict[str, tuple[Gene, ...]] = {
    "payload": (
        Gene(Condition.PAYLOAD, -0.05, 0.0, 0.4),
        Gene(Condition.PAYLOAD_X, -0.2, 0.0, 0.2),
        Gene(Condition.PAYLOAD_Y, -0.2, 0.0, 0.2),
    ),
    "motors": (Gene(Condition.STRENGTH, 0.4, 1.0, 1.2),),
    "delay": (Gene(Condition.DELAY, 0.0, MOST_DELAY_S / 2, MOST_DELAY_S, absent=-1.0, step=DELAY_STEP_S),),
    "lag": (Gene(Condition.LAG, 0.0, MOST_LAG_S / 2, MOST_LAG_S, absent=-1.0, step=LAG_STEP_S),),
    "noise": (Gene(Condition.NOISE, 0.0, 2.0, 4.0, absent=-1.0),),
    "push": (
        Gene(Condition.PUSH_X, -2.0, 0.0, 2.0),
        Gene(Condition.PUSH_Y, -2.0, 0.0, 2.0),
        Gene(Condition.PUSH_TIME, 0.0, 6.0, 12.0),
    ),
    "grip": (Gene(Condition.FRICTION, 0.2, 1.0, 1.2),),
}
"""Conditions that a space may have, each of one to three genes."""


def check_conditions(rows: NDArray[np.floating], count: int) -> None:
    """That rows are conditions of so many terrains that can be simulated."""
    if rows.shape != (count, len(Condition)):
        raise ValueError(f"conditions must have shape ({count}, {len(Condition)}), got {rows.shape}")
    limits = {Condition.DELAY: (0.0, MOST_DELAY_S), Condition.LAG: (0.0, MOST_LAG_S)}
    limits |= {Condition.PAYLOAD: (-0.1, 10.0), Condition.STRENGTH: (1e-3, 10.0)}
    limits |= {Condition.FRICTION: (1e-3, 10.0), Condition.NOISE: (0.0, 100.0)}
    for condition in Condition:
        least, most = limits.get(condition, (-100.0, 100.0))
        wrong = ~((rows[:, condition] >= least - 1e-6) & (rows[:, condition] <= most + 1e-6))
        if wrong.any():
            raise ValueError(
                f"the condition {condition.name} must lie in {least:g} to {most:g}, got {rows[wrong][0, condition]:g}"
            )


def genes_of(kinds: Sequence[str]) -> tuple[Gene, ...]:
    """Genes of some kinds, in their order."""
    return tuple(gene for kind in kinds for gene in KINDS[kind])


def rows_of(genes: NDArray[np.floating], kinds: Sequence[str]) -> NDArray[np.float32]:
    """Rows of conditions, shape (N, 12), of genes of some kinds, (N, number of them)."""
    rows = np.tile(NOMINAL, (len(genes), 1))
    for column, gene in enumerate(genes_of(kinds)):
        rows[:, gene.condition] = gene.value(genes[:, column])
    return rows


def _directions(values: NDArray[np.floating], form: str, least: float, ways: Sequence[str]) -> str:
    """Two numbers along the axes in words, each with one of the four ``ways``: ahead, back, left, right."""
    said = [f"{abs(value):{form}} {ways[2 * axis + (value < 0)]}"
            for axis, value in enumerate(values) if abs(value) >= least]  # fmt: skip
    return " and ".join(said)


def words_of(kind: str, row: NDArray[np.float32]) -> str:
    """One kind of a row of conditions in words; empty where it changes nothing to speak of."""
    payload, strength, push = row[Condition.PAYLOAD], row[Condition.STRENGTH], row[[Condition.PUSH_X, Condition.PUSH_Y]]
    if kind == "payload" and abs(payload) >= 0.0005:
        if payload < 0:
            return f"base lighter by {-payload:.1%} of the robot's mass"
        ways = ("m ahead of", "m behind", "m left of", "m right of")
        place = _directions(row[[Condition.PAYLOAD_X, Condition.PAYLOAD_Y]], ".2f", 0.005, ways)
        return f"payload of {payload:.1%} of the robot's mass{place and f', {place} the centre of the base'}"
    if kind == "motors" and abs(strength - 1.0) >= 0.005:
        return f"motors at {strength:.0%}"
    if kind == "delay" and row[Condition.DELAY] >= 0.0005:
        return f"actions {1000 * row[Condition.DELAY]:.0f} ms late"
    if kind == "lag" and row[Condition.LAG] >= 0.0005:
        return f"observations {1000 * row[Condition.LAG]:.0f} ms old"
    if kind == "noise" and row[Condition.NOISE] >= 0.05:
        return f"noise {row[Condition.NOISE]:.1f} times legged_gym's"
    if kind == "push" and np.abs(push).max() >= 0.05:
        ways = ("m/s ahead", "m/s back", "m/s to the left", "m/s to the right")
        return f"pushed by {_directions(push, '.1f', 0.05, ways)} after {row[Condition.PUSH_TIME]:.0f} s"
    if kind == "grip" and abs(row[Condition.FRICTION] - 1.0) >= 0.005:
        return f"friction times {row[Condition.FRICTION]:.2f}"
    return ""
