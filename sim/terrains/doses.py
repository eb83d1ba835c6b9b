"""Doses: one obstacle alone on flat ground, or one ground everywhere, of which one number grows.

An obstacle is an element of a course (:mod:`kernels.course`) of any size, within the ranges of its space or beyond.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

from kernels import course
from kernels.course import SPACING, Element, Kind
from kernels.ground import LEAST_FRICTION, LEAST_TIME_CONSTANT_S, MOST_TIME_CONSTANT_S
from sim.device import host_device
from sim.terrains.conditions.base import CONDITIONS, condition_column, condition_genes
from sim.terrains.ground import GROUND_KINDS, joined_name
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.spaces.on_ground import gene_of
from sim.terrains.spaces.registry import get_space
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN

FIRST_COL, NUM_PLACES = 100, 20
"""An obstacle begins at one of so many neighbouring nodes, from x = 5 m on: over 1 m, more than a stride."""
LEVEL_SPACE = joined_name(SUPER_GAUSSIAN.name, GROUND_KINDS)
"""Space of level ground whose friction or softness is the dose."""
CONDITIONS_SPACE = joined_name(SUPER_GAUSSIAN.name, tuple(CONDITIONS))
"""Space of level ground that is crossed under a condition, which is the dose."""
_CONDITIONS = {name: condition.dose for name, condition in CONDITIONS.items() if condition.dose is not None}


class Quantity(NamedTuple):
    """A parameter of an obstacle."""

    field: str
    """Of :class:`kernels.course.Element`; empty of the ground."""
    low: float
    high: float
    unit: str = "m"
    cells: int = 0
    """It is a multiple of so many cells, and the field counts cells. If 0 it is any number, and the field holds it."""
    of_gene: float = 0.0
    """Step of a condition."""

    @property
    def step(self) -> float:
        """What values are multiples of; 0 if they may be any number."""
        return 1.0 if self.unit == "steps" else self.of_gene or self.cells * SPACING

    def in_words(self, value: float) -> str:
        """A value with its unit: ``0.30 m``, ``5 steps``."""
        digits = {"steps": 0, "s": 3}.get(self.unit, 2)
        return f"{value:.{digits}f} {self.unit}".strip()


_HEIGHT = {"height": Quantity("size", 0.01, 1.0)}
_DEPTH = {"depth": Quantity("size", 0.05, 2.0)}
_SLOPE = {"slope": Quantity("size", 0.01, 2.0, "m/m")}
_STONES = {"side": Quantity("detail", 0.10, 1.0, cells=1), "gap": Quantity("turn", 0.10, 1.0, cells=1)}
_LENGTH = {"length": Quantity("length", 0.20, 4.0, cells=1)}

QUANTITIES: dict[Kind, dict[str, Quantity]] = {
    Kind.STAIRS: {
        "rise": Quantity("size", 0.01, 0.50),
        "tread": Quantity("length", 0.10, 0.60),
        "flight": Quantity("detail", 2, course.PARAMETERS[Kind.STAIRS][2].high, "steps"),
    },
    Kind.STEP: _HEIGHT,
    Kind.SILL: _HEIGHT | {"width": Quantity("length", 0.05, 0.50, cells=1)},
    Kind.RAIL: _HEIGHT,
    Kind.PALLET: _HEIGHT | _LENGTH,
    Kind.RAMP: _SLOPE | _LENGTH,
    Kind.CROSS_SLOPE: _SLOPE | {"length": Quantity("length", 0.60, 4.0, cells=1)},
    Kind.DITCH: _DEPTH | {"width": Quantity("length", 0.10, 4.0, cells=1)},
    Kind.BRIDGE: _DEPTH | _LENGTH | {"width": Quantity("detail", 0.10, 4.0, cells=2)},
    Kind.STONES: _DEPTH | _LENGTH | _STONES,
    Kind.RUBBLE: _HEIGHT | _LENGTH | {"side": Quantity("detail", 0.05, 1.0, cells=1)},
}
"""Parameters of the kinds of obstacles, and how far terrains can follow them."""
_GROUND = {
    name: Quantity("", max(0.0, gene.low), gene.high, gene.unit, of_gene=gene.step)
    for name, gene in ((name, CONDITIONS[name].genes[dose.gene]) for name, dose in _CONDITIONS.items())
} | {
    "friction": Quantity("", LEAST_FRICTION, 1.0, ""),
    "softness": Quantity("", 1.1 * LEAST_TIME_CONSTANT_S, MOST_TIME_CONSTANT_S, "s"),
}


@dataclass(frozen=True)
class Dose:
    """An obstacle, and the one of its parameters that grows."""

    title: str
    kind: Kind | None
    """None: the ground, level everywhere, whose map or condition the parameter is."""
    parameter: str
    values: tuple[float, ...]
    """Of the parameter, the easiest first."""
    up: float | None = None
    """1 up, -1 down; None of an obstacle without a direction."""
    others: Mapping[str, float] = field(default_factory=dict)
    """The other parameters."""

    @property
    def quantities(self) -> Mapping[str, Quantity]:
        """All parameters."""
        return _GROUND if self.kind is None else QUANTITIES[self.kind]

    @property
    def unit(self) -> str:
        """Of the parameter that grows; empty of a number."""
        return self.quantities[self.parameter].unit

    @property
    def space(self) -> str:
        """Terrain space of its genes; of heights any."""
        if self.kind is not None:
            return SUPER_GAUSSIAN.name
        return CONDITIONS_SPACE if self.parameter in _CONDITIONS else LEVEL_SPACE

    @property
    def harder_up(self) -> bool:
        """Whether larger values are harder."""
        return (self.parameter, self.kind) not in (("friction", None), ("motors", None), ("width", Kind.BRIDGE))

    def describe(self) -> str:
        """The obstacle and its other parameters in words: ``stairs up, tread 0.30 m, flight 5 steps``."""
        return ", ".join(
            [self.title, *(f"{name} {self.quantities[name].in_words(value)}" for name, value in self.others.items())]
        )

    def changed(self, values: Iterable[float] | None, others: Mapping[str, float]) -> "Dose":
        """The same with other values, the easiest first, and other parameters where it has them."""
        changed = {name: value for name, value in others.items() if name in self.others}
        values = self.values if values is None else sorted(values, reverse=not self.harder_up)
        if not values or len(set(values)) < len(values):
            raise ValueError(f"{self.title}: values of {self.parameter} must be some, each once, got {values}")
        for name, value in [*((self.parameter, value) for value in values), *changed.items()]:
            quantity = self.quantities[name]
            within = quantity.low <= value <= quantity.high
            if not within or (quantity.step and abs(value / quantity.step - round(value / quantity.step)) > 1e-6):
                steps = f" in steps of {quantity.step:g}" if quantity.step else ""
                limits = f"{quantity.low:g} to {quantity.high:g} {quantity.unit}".rstrip()
                raise ValueError(f"{self.title}: {name} must be {limits}{steps}, got {value:g}")
        return replace(self, values=tuple(values), others={**self.others, **changed})

    def terrains(self, count: int, rng: np.random.Generator) -> NDArray[np.float32]:
        """Terrains of all values, ``count`` each: those of the first place, value by value, then those of the next.

        An obstacle begins at ``count`` places that are spread evenly over 1 m. A cross slope leans to a side that is
        drawn for each place, rubble is another one at each. All else is the same, and equal for all values. What comes
        are heights [m], shape (count * num_values, NUM_ROWS, NUM_COLS), or genes of :attr:`space`.
        """
        if self.kind is None:
            return np.tile(self._level(), (count, 1))
        record: Any = Element  # Warp makes its dtype
        elements: Any = np.zeros((count, len(self.values)), record.numpy_dtype())
        elements["kind"] = self.kind
        elements["detail"] = 1.0  # pallets
        elements["first"] = (FIRST_COL + np.arange(count) * NUM_PLACES // count)[:, None]
        elements["turn"] = self._turns(count, rng)[:, None]
        for name, value in {**self.others, self.parameter: np.array(self.values)}.items():
            quantity = self.quantities[name]
            elements[quantity.field] = np.rint(value / SPACING) if quantity.cells else value
        with wp.ScopedDevice(host_device()):  # each alone on flat ground, before x = 12 m
            laid: Any = wp.array(elements.reshape(-1, 1), dtype=Element)
            course.place(laid)
            heights: Any = wp.empty((len(laid), NUM_ROWS, NUM_COLS), dtype=float)
            course.rasterise_elements(laid, heights)
            return np.array(heights.numpy(), np.float32)

    def _turns(self, count: int, rng: np.random.Generator) -> NDArray[np.float64]:
        if self.kind is Kind.CROSS_SLOPE:
            return rng.permutation(np.resize([-1.0, 1.0], count))
        if self.kind is Kind.RUBBLE:
            return rng.uniform(-0.5, 0.5, count)
        return np.full(count, self.up or 0.0)

    def _level(self) -> NDArray[np.float32]:
        """Genes of level ground of each value, shape (num_values, num_genes)."""
        space = get_space(self.space)
        zeros = np.zeros((len(self.values), space.num_genes), np.float32)
        genes = space.without(zeros, range(len(space.parts(zeros[0]))))
        if self.parameter in _CONDITIONS:
            dose, own = _CONDITIONS[self.parameter], CONDITIONS[self.parameter].genes
            first = space.num_genes - len(condition_genes()) + condition_column(own[0].name)
            for number, value in ((dose.gene, self.values), *dose.others):
                genes[:, first + number] = own[number].to_gene(value)
            return genes
        maps = genes[:, SUPER_GAUSSIAN.num_genes :].reshape(len(genes), len(GROUND_KINDS), -1)
        maps[:, GROUND_KINDS.index(self.parameter)] = gene_of(self.parameter, np.array(self.values))[:, None]
        return genes


_LOW = (0.05, 0.08, 0.10, 0.12, 0.15, 0.18, 0.20, 0.25, 0.30)
_RISES = (0.05, 0.10, 0.14, 0.17, 0.20, 0.22, 0.24, 0.26, 0.28, 0.30, 0.35)
_STEPS = (0.05, 0.10, 0.15, 0.20, 0.25, 0.30, 0.35, 0.40, 0.50)
_SLOPES = (0.10, 0.20, 0.30, 0.40, 0.50, 0.60, 0.70, 0.80, 1.00)
_WIDTHS = (0.10, 0.20, 0.30, 0.40, 0.50, 0.60, 0.70, 0.80, 1.00)
_GAPS = (0.10, 0.15, 0.20, 0.25, 0.30, 0.40)
_FRICTIONS = (1.0, 0.7, 0.5, 0.4, 0.35, 0.3, 0.25, 0.2, 0.15)
_FLIGHT = {"tread": 0.30, "flight": 5.0}
DOSES: dict[str, Dose] = {
    "stairs_up": Dose("stairs up", Kind.STAIRS, "rise", _RISES, up=1.0, others=_FLIGHT),
    "stairs_down": Dose("stairs down", Kind.STAIRS, "rise", _RISES, up=-1.0, others=_FLIGHT),
    "step_up": Dose("kerb or step up", Kind.STEP, "height", _STEPS, up=1.0),
    "step_down": Dose("kerb or step down", Kind.STEP, "height", _STEPS, up=-1.0),
    "sill": Dose("sill", Kind.SILL, "height", _LOW, others={"width": 0.10}),
    "rail": Dose("rail", Kind.RAIL, "height", _LOW),
    "pallet": Dose("pallet", Kind.PALLET, "height", _STEPS, others={"length": 1.0}),
    "ramp_up": Dose("ramp up", Kind.RAMP, "slope", _SLOPES, up=1.0, others={"length": 2.0}),
    "ramp_down": Dose("ramp down", Kind.RAMP, "slope", _SLOPES, up=-1.0, others={"length": 2.0}),
    "cross_slope": Dose("cross slope", Kind.CROSS_SLOPE, "slope", _SLOPES, others={"length": 3.0}),
    "ditch": Dose("ditch", Kind.DITCH, "width", _WIDTHS, others={"depth": 0.50}),
    "beam": Dose("beam over a ditch", Kind.BRIDGE, "width", _WIDTHS[::-1], others={"depth": 0.50, "length": 1.50}),
    "stones": Dose("stepping stones", Kind.STONES, "gap", _GAPS, others={"side": 0.30, "depth": 0.40, "length": 2.00}),
    "rubble": Dose("rubble", Kind.RUBBLE, "height", _LOW, others={"side": 0.20, "length": 2.00}),
    "friction": Dose("level ground", None, "friction", _FRICTIONS),
    "softness": Dose("level ground", None, "softness", (0.015, 0.02, 0.03, 0.04, 0.05, 0.06)),
} | {name: Dose(dose.title, None, name, dose.values) for name, dose in _CONDITIONS.items()}
"""Every dose by its name."""


def parse_doses(words: Sequence[str], at: Sequence[str]) -> dict[str, Dose]:
    """Some of :data:`DOSES`, in their order, as a command line names them; without ``words`` all but conditions.

    A word is ``stairs_up``, or with other values ``ditch=0.2,0.4``; a text may hold several, with spaces. ``at`` are
    other parameters of those that have them, ``tread=0.25``.
    """
    elements: dict[str, Sequence[float] | None] = {}
    for word in " ".join(words).split():
        name, equals, values = word.partition("=")
        elements[name] = [_number(value, word) for value in values.split(",")] if equals else None
    elements = elements or {name: None for name, dose in DOSES.items() if dose.parameter not in _CONDITIONS}
    pairs = (word.partition("=") for word in " ".join(at).split())
    others = {name: _number(value, f"{name}={value}") for name, _, value in pairs}
    if unknown := elements.keys() - DOSES.keys():
        raise ValueError(f"elements must be some of {', '.join(DOSES)}, got {', '.join(sorted(unknown))}")
    doses = {name: dose for name, dose in DOSES.items() if name in elements}
    known = {name for dose in doses.values() for name in dose.others}
    if wrong := others.keys() - known:
        beside = ", ".join(sorted(known)) or f"of which {', '.join(doses)} has none"
        raise ValueError(
            f"at must name parameters that the elements have beside the one that grows, {beside}, got "
            f"{', '.join(sorted(wrong))}: leave that out"
        )
    return {name: dose.changed(elements[name], others) for name, dose in doses.items()}


def _number(text: str, word: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise ValueError(f"expected NAME=NUMBER, as in tread=0.25, got {word}") from None
