"""What a condition is, and all conditions by name.

A condition has genes in [-1, 1], each of which becomes one number. The numbers of all conditions, in the order in which
they are registered, are the row of conditions of a terrain.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[Any]


@dataclass(frozen=True, kw_only=True)
class Gene:
    """How a gene in [-1, 1] becomes a number of a condition: ``middle`` at 0, and linear on both sides."""

    name: str
    low: float
    middle: float
    high: float
    absent: float = 0.0
    """The gene that changes nothing."""
    step: float = 0.0
    """What values are multiples of; 0 if they may be any number."""
    unit: str = ""
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


@dataclass(frozen=True, kw_only=True)
class ConditionDose:
    """A condition as a dose on level ground: one of its genes grows."""

    title: str
    values: tuple[float, ...]
    """The easiest first."""
    gene: int = 0
    others: tuple[tuple[int, float], ...] = ()
    """Values of other genes."""


class Condition:
    """A condition under which robots cross. A class of one in a file, and its instance in ``__init__``, add one."""

    name: ClassVar[str]
    """What a space is called by it: ``course+payload``."""
    genes: ClassVar[tuple[Gene, ...]]
    cause: ClassVar[str]
    """What a fault is called that it causes."""
    dose: ClassVar[ConditionDose | None] = None
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
        raise NotImplementedError

    def begin_plain(self, episodes: Any, values: Array) -> None:
        """Varies the model, ``strength`` or ``delay_steps`` of a :class:`sim.mujoco_c.crossing.Episodes`."""

    def disturb_plain(self, episodes: Any, values: Array, rows: Array, running: Any, step: int) -> Array:
        """Observations (num_episodes, observation_size) as shown to the controller; may push the episodes ``running``.

        ``step`` counts physics steps since the episodes began.
        """
        return rows


CONDITIONS: dict[str, Condition] = {}
"""All conditions by name, in the order of their numbers in a row of conditions."""


def register(condition: Condition) -> None:
    """Adds a condition behind the others."""
    CONDITIONS[condition.name] = condition


def condition_genes(names: Sequence[str] | None = None) -> tuple[Gene, ...]:
    """Genes of some conditions in their order, or of all."""
    return tuple(gene for name in (CONDITIONS if names is None else names) for gene in CONDITIONS[name].genes)


def condition_column(name: str) -> int:
    """Column of a gene's value in a row of conditions."""
    return [gene.name for gene in condition_genes()].index(name)


def nominal_row() -> NDArray[np.float32]:
    """A row of conditions that change nothing."""
    return np.array([gene.to_value(gene.absent) for gene in condition_genes()], np.float32)


def condition_rows(genes: NDArray[np.floating], names: Sequence[str]) -> NDArray[np.float32]:
    """Rows of conditions of genes of some conditions, shape (num_terrains, number of their genes)."""
    rows = np.tile(nominal_row(), (len(genes), 1))
    for column, gene in enumerate(condition_genes(names)):
        rows[:, condition_column(gene.name)] = gene.to_value(genes[:, column])
    return rows


def split_row(row: NDArray[Any]) -> Iterator[tuple[Condition, NDArray[Any]]]:
    """Each condition with its numbers in a row."""
    for condition, first in _first_columns():
        yield condition, row[first : first + len(condition.genes)]


def condition_texts(row: NDArray[np.floating], names: Sequence[str]) -> list[str]:
    """Some conditions of a row as text; empty where one changes nothing to speak of."""
    texts = {condition.name: condition.text(values) for condition, values in split_row(row) if condition.name in names}
    return [texts[name] for name in names]


def begin_effects() -> tuple[tuple[Any, int], ...]:
    """Warp functions that vary robots, each with its first column in a row."""
    return tuple((condition.begin, first) for condition, first in _first_columns() if condition.begin is not None)


def disturb_effects() -> tuple[tuple[Any, int], ...]:
    """Warp functions that disturb control steps, likewise, in the order in which they do."""
    ordered = sorted(_first_columns(), key=lambda pair: pair[0].disturbs_last)
    return tuple((condition.disturb, first) for condition, first in ordered if condition.disturb is not None)


def _first_columns() -> Iterator[tuple[Condition, int]]:
    first = 0
    for condition in CONDITIONS.values():
        yield condition, first
        first += len(condition.genes)


def check_conditions(rows: NDArray[np.floating], count: int) -> None:
    """Checks that ``rows`` are conditions of ``count`` terrains that can be simulated."""
    genes = condition_genes()
    if rows.shape != (count, len(genes)):
        raise ValueError(f"conditions must have shape ({count}, {len(genes)}), got {rows.shape}")
    for gene, values in zip(genes, rows.T, strict=True):
        low, high = gene.limits
        wrong = ~((values >= low - 1e-6) & (values <= high + 1e-6))
        if wrong.any():
            raise ValueError(f"the condition {gene.name} must lie in {low:g} to {high:g}, got {values[wrong][0]:g}")


def round_steps(seconds: float, dt: float) -> int:
    """Steps of a time, rounded as the parallel simulation does."""
    return int(np.float32(seconds) / np.float32(dt) + np.float32(0.5))


def direction_text(values: NDArray[np.floating], form: str, least: float, directions: Sequence[str]) -> str:
    """Two numbers along the axes, each with one of four ``directions``: ahead, back, left, right."""
    return " and ".join(
        f"{abs(value):{form}} {directions[2 * axis + (value < 0)]}"
        for axis, value in enumerate(values)
        if abs(value) >= least
    )
