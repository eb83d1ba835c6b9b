"""Doses: one obstacle alone on flat ground, or one ground or condition everywhere, of which one number grows.

An obstacle is an element of a course (:mod:`sim.terrains.elements`) of any size, within the ranges of its space or
beyond.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from kernels import course
from kernels.ground import MAX_TIME_CONSTANT_S, MIN_FRICTION, MIN_TIME_CONSTANT_S, NUM_PATCHES
from sim.device import host_device
from sim.terrains.conditions.base import CONDITIONS, Condition, ConditionDose
from sim.terrains.elements.base import CourseElement, ElementDose, Quantity, all_elements
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.spaces.names import join_name
from sim.terrains.spaces.on_ground import ground_genes
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN

FIRST_COL = 100
"""An obstacle begins at x = 5 m, or at one of the next nodes."""
NUM_STARTS = 20
"""Nodes at which it may begin: over 1 m, more than a stride."""


@dataclass(frozen=True, kw_only=True)
class Dose:
    """An obstacle, a ground or a condition, and the one of its quantities that grows."""

    title: str
    parameter: str
    """The quantity that grows."""
    values: tuple[float, ...]
    """The easiest first."""
    quantities: Mapping[str, Quantity]
    make: Callable[[Mapping[str, Any], int, np.random.Generator], NDArray[np.float32]] = field(compare=False)
    """Makes the terrains of quantities, of which one has several values (:meth:`terrains`)."""
    others: Mapping[str, float] = field(default_factory=dict)
    """The other quantities."""
    space: str = SUPER_GAUSSIAN.name
    """Terrain space of its genes; of heights any."""

    @property
    def unit(self) -> str:
        """Of the quantity that grows; empty of a number."""
        return self.quantities[self.parameter].unit

    @property
    def harder_up(self) -> bool:
        """Whether larger values are harder."""
        return self.values[-1] >= self.values[0]

    def describe(self) -> str:
        """The obstacle and its other quantities: ``stairs up, tread 0.30 m, flight 5 steps``."""
        others = (f"{name} {self.quantities[name].format(value)}" for name, value in self.others.items())
        return ", ".join([self.title, *others])

    def changed(self, values: Iterable[float] | None, others: Mapping[str, float]) -> "Dose":
        """The same with other values, the easiest first, and other quantities where it has them."""
        changed = {name: value for name, value in others.items() if name in self.others}
        values = self.values if values is None else sorted(values, reverse=not self.harder_up)
        if not values or len(set(values)) < len(values):
            raise ValueError(f"{self.title}: values of {self.parameter} must be some, each once, got {values}")
        for name, value in [*((self.parameter, value) for value in values), *changed.items()]:
            quantity = self.quantities[name]
            steps = value / quantity.step if quantity.step else 0.0
            if not quantity.low <= value <= quantity.high or abs(steps - round(steps)) > 1e-6:
                every = f" in steps of {quantity.step:g}" if quantity.step else ""
                limits = f"{quantity.low:g} to {quantity.high:g} {quantity.unit}".rstrip()
                raise ValueError(f"{self.title}: {name} must be {limits}{every}, got {value:g}")
        return replace(self, values=tuple(values), others={**self.others, **changed})

    def terrains(self, count: int, rng: np.random.Generator) -> NDArray[np.float32]:
        """Terrains of all values, ``count`` each: first one of each value, then the next of each.

        An obstacle begins at ``count`` nodes that are spread evenly over 1 m. A cross slope leans to a side that is
        drawn for each node, rubble is another one at each. All else is the same for all values. Returns heights [m],
        shape (count * num_values, NUM_ROWS, NUM_COLS), or genes of :attr:`space`.
        """
        return self.make({**self.others, self.parameter: np.array(self.values)}, count, rng)


def _dose_element(name: str, element: CourseElement, dose: ElementDose) -> Dose:
    def make(quantities: Mapping[str, Any], count: int, rng: np.random.Generator) -> NDArray[np.float32]:
        record: Any = course.Element  # Warp makes its dtype
        laid: Any = np.zeros((count, len(quantities[dose.quantity])), record.numpy_dtype())
        laid["kind"] = all_elements().index(element)
        laid["detail"] = 1.0  # pallets
        laid["first"] = (FIRST_COL + np.arange(count) * NUM_STARTS // count)[:, None]
        laid["turn"] = dose.turn if element.draw_turns is None else element.draw_turns(count, rng)[:, None]
        for name, value in quantities.items():
            laid[element.quantities[name].parameter] = element.quantities[name].to_parameter(value)
        with wp.ScopedDevice(host_device()):  # each alone on flat ground, before x = 12 m
            elements: Any = wp.array(laid.reshape(-1, 1), dtype=course.Element)
            course.lay_elements(elements, all_elements())
            heights: Any = wp.empty((len(elements), NUM_ROWS, NUM_COLS), dtype=float)
            course.rasterise_elements(elements, all_elements(), heights)
            return np.array(heights.numpy(), np.float32)

    return Dose(
        title=name.replace("_", " "), parameter=dose.quantity, values=dose.values, others=dose.others, make=make,
        quantities=element.quantities,
    )  # fmt: skip


def _dose_level(title: str, name: str, quantity: Quantity, values: tuple[float, ...], to_genes: Any) -> Dose:
    """Level ground, whose map or condition of a name is by ``to_genes`` of the values, shape (num_values, ...)."""

    def make(quantities: Mapping[str, Any], count: int, rng: np.random.Generator) -> NDArray[np.float32]:
        genes = to_genes(quantities[name])
        flat = np.zeros((len(genes), SUPER_GAUSSIAN.num_genes))  # bumps of no height
        return np.tile(np.concatenate([flat, genes], axis=1).astype(np.float32), (count, 1))

    space = join_name(SUPER_GAUSSIAN.name, (name,))
    return Dose(title=title, parameter=name, values=values, quantities={name: quantity}, make=make, space=space)


def _dose_condition(condition: Condition, dose: ConditionDose) -> Dose:
    dosed = condition.genes[dose.gene]

    def to_genes(values: NDArray[Any]) -> NDArray[Any]:
        genes = np.tile([gene.absent for gene in condition.genes], (len(values), 1)).astype(np.float64)
        for number, value in ((dose.gene, values), *dose.others):
            genes[:, number] = condition.genes[number].to_gene(value)
        return genes

    quantity = Quantity(low=max(0.0, dosed.low), high=dosed.high, unit=dosed.unit, step=dosed.step)
    return _dose_level(dose.title, condition.name, quantity, dose.values, to_genes)


_GROUND = {
    "friction": (Quantity(low=MIN_FRICTION, high=1.0, unit=""), (1.0, 0.7, 0.5, 0.4, 0.35, 0.3, 0.25, 0.2, 0.15)),
    "softness": (
        Quantity(low=1.1 * MIN_TIME_CONSTANT_S, high=MAX_TIME_CONSTANT_S, unit="s"),
        (0.015, 0.02, 0.03, 0.04, 0.05, 0.06),
    ),
}


def _dose_ground(kind: str) -> Dose:
    quantity, values = _GROUND[kind]
    return _dose_level(
        "level ground", kind, quantity, values,
        lambda dosed: np.repeat(ground_genes(kind, dosed)[:, None], NUM_PATCHES, axis=1),
    )  # fmt: skip


def all_doses() -> dict[str, Dose]:
    """Every dose by its name: obstacles, then grounds, then conditions."""
    elements = {name: _dose_element(name, kind, dose) for kind in all_elements() for name, dose in kind.doses.items()}
    conditions = {
        name: _dose_condition(condition, condition.dose)
        for name, condition in CONDITIONS.items()
        if condition.dose is not None
    }
    return elements | {kind: _dose_ground(kind) for kind in _GROUND} | conditions


def parse_doses(texts: Sequence[str], at: Sequence[str]) -> dict[str, Dose]:
    """Some of :func:`all_doses`, in their order, as a command line names them; without ``texts`` all but conditions.

    A word is ``stairs_up``, or with other values ``ditch=0.2,0.4``; a text may hold several, with spaces. ``at`` are
    other quantities of those that have them, ``tread=0.25``.
    """
    doses, chosen = all_doses(), dict[str, Sequence[float] | None]()
    for word in " ".join(texts).split():
        name, equals, values = word.partition("=")
        chosen[name] = [_parse_number(value, word) for value in values.split(",")] if equals else None
    chosen = chosen or {name: None for name in doses if name not in CONDITIONS}
    if unknown := chosen.keys() - doses.keys():
        raise ValueError(f"elements must be some of {', '.join(doses)}, got {', '.join(sorted(unknown))}")
    pairs = (word.partition("=") for word in " ".join(at).split())
    others = {name: _parse_number(value, f"{name}={value}") for name, _, value in pairs}
    doses = {name: dose for name, dose in doses.items() if name in chosen}
    allowed = sorted({name for dose in doses.values() for name in dose.others})
    if wrong := others.keys() - set(allowed):
        raise ValueError(
            f"at must name quantities that the elements have beside the one that grows ({', '.join(allowed) or 'none'}"
            f"), got {', '.join(sorted(wrong))}: leave that out"
        )
    return {name: dose.changed(chosen[name], others) for name, dose in doses.items()}


def _parse_number(text: str, word: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"expected NAME=NUMBER, as in tread=0.25, got {word}") from None
