"""What a condition is, and all conditions by name.

A condition has genes in [-1, 1], each of which becomes one number. The numbers of all conditions, in the order in which
they are registered, are the row of conditions of a terrain.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from sim.terrains.quantities import Quantity, Sweep

Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class Gene(Quantity):
    """How a gene in [-1, 1] becomes a number of a condition: ``middle`` at 0, and linear on both sides."""

    middle: float
    absent: float = 0.0
    """The gene that changes nothing."""
    limits: tuple[float, float] = (-100.0, 100.0)
    """Values that can be simulated."""
    mirrored: bool = False
    """Whether the value changes its sign on a terrain that is mirrored at the way."""
    hard_at_limits: bool = True
    """Whether hard-random terrains have it at a limit; else uniform."""

    def to_value(self, genes: Any) -> NDArray[np.float64]:
        """Values of genes, any shape."""
        values = np.interp(genes, (-1.0, 0.0, 1.0), (self.low, self.middle, self.high))
        return np.floor(values / self.step + 0.5) * self.step if self.step else values

    def to_gene(self, values: Any) -> NDArray[np.float64]:
        """Genes of values, any shape; outside of the range those at its ends."""
        return np.interp(values, (self.low, self.middle, self.high), (-1.0, 0.0, 1.0))


class Condition:
    """A condition under which robots cross. A class and its instance in :data:`CONDITIONS` add one."""

    name: ClassVar[str]
    """What a space is called by it: ``course+payload``."""
    cause: ClassVar[str]
    """What a fault is called that it causes."""
    genes: ClassVar[tuple[Gene, ...]]
    form: ClassVar[str]
    """Its values as text."""
    least: ClassVar[float]
    """What its first value differs by from the nominal one, or nothing is said of it."""
    dose: ClassVar[Sweep | None] = None
    """One of its genes as a dose on level ground."""
    varied: ClassVar[tuple[float, float] | None] = None
    """Limits between which its first value is drawn for varied conditions; None if it stays nominal."""
    begin: ClassVar[Any] = None
    """Warp function that varies a robot where its episode begins (:mod:`kernels.conditions`)."""
    disturb: ClassVar[Any] = None
    """Warp function that disturbs a control step."""
    disturbs_last: ClassVar[bool] = False
    """Whether it disturbs what others have disturbed."""

    def text(self, values: Array) -> str:
        """Its values in a few words; empty where it changes nothing to speak of."""
        nominal = self.genes[0].to_value(self.genes[0].absent)
        return self.form.format(*values) if abs(values[0] - nominal) >= self.least else ""

    def to_genes(self, values: Mapping[str, Any]) -> NDArray[np.float64]:
        """Genes of some values by name, each of shape (...), as (..., number of genes); the others change nothing."""
        genes = (gene.to_gene(values[gene.name]) if gene.name in values else gene.absent for gene in self.genes)
        return np.stack(np.broadcast_arrays(*genes), axis=-1)

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Varies the model, ``strength`` or ``delay_steps`` of a :class:`sim.mujoco_c.crossing.Episodes`."""

    def disturb_plain(self, episodes: Any, values: Array, rows: Array, running: Any, step: int) -> Array:
        """Observations (num_episodes, observation_size) as shown to the controller; may push the episodes ``running``.

        ``step`` counts physics steps since the episodes began.
        """
        return rows


CONDITIONS: dict[str, Condition] = {}
"""All conditions by name, in the order of their numbers in a row of conditions."""


def condition_genes(names: Sequence[str] | None = None) -> tuple[Gene, ...]:
    """Genes of some conditions in their order, or of all."""
    return tuple(gene for name in (CONDITIONS if names is None else names) for gene in CONDITIONS[name].genes)


def condition_column(name: str) -> int:
    """Column of a gene's value in a row of conditions."""
    return [gene.name for gene in condition_genes()].index(name)


def nominal_row() -> NDArray[np.float32]:
    """A row of conditions that change nothing."""
    return np.array([gene.to_value(gene.absent) for gene in condition_genes()], np.float32)


def split_row(row: Array) -> list[tuple[Condition, Array]]:
    """Each condition with its numbers in a row."""
    ends = np.cumsum([len(condition.genes) for condition in CONDITIONS.values()])
    return list(zip(CONDITIONS.values(), np.split(row, ends[:-1]), strict=True))


def condition_texts(row: NDArray[np.floating], names: Sequence[str]) -> list[str]:
    """Some conditions of a row as text; empty where one changes nothing to speak of."""
    texts = {condition.name: condition.text(values) for condition, values in split_row(row)}
    return [texts[name] for name in names]


def begin_effects() -> tuple[tuple[Any, int], ...]:
    """Warp functions that vary robots, each with its first column in a row."""
    columns = split_row(np.arange(len(condition_genes())))
    return tuple((condition.begin, int(first)) for condition, (first, *_) in columns if condition.begin is not None)


def disturb_effects() -> tuple[tuple[Any, int], ...]:
    """Warp functions that disturb control steps, in the order in which they do, each with its first column in a row."""
    columns = sorted(split_row(np.arange(len(condition_genes()))), key=lambda pair: pair[0].disturbs_last)
    return tuple((condition.disturb, int(first)) for condition, (first, *_) in columns if condition.disturb is not None)
