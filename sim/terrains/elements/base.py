"""What an element of a course is, and all of them by name."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kernels.course import SPACING, ElementKind, Range


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A number that a dose sets: how far it can go, and its unit."""

    low: float
    high: float
    unit: str = "m"
    step: float = 0.0
    """What values are multiples of; 0 if they may be any number."""
    parameter: str = ""
    """Of an element: which of its parameters it is."""

    def format(self, value: float) -> str:
        """A value with its unit: ``0.30 m``, ``5 steps``."""
        digits = {"steps": 0, "s": 3}.get(self.unit, 2)
        return f"{value:.{digits}f} {self.unit}".strip()

    def to_parameter(self, values: Any) -> Any:
        """Values as the element's parameter, which counts cells if they are multiples of cells."""
        return np.rint(np.asarray(values) / SPACING) if self.step and self.unit == "m" else values


def cells(parameter: str, low: float, high: float, every: int = 1) -> Quantity:
    """A length [m] that is a multiple of ``every`` cells."""
    return Quantity(parameter=parameter, low=low, high=high, step=every * SPACING)


LENGTH = cells("length", 0.20, 4.0)


@dataclass(frozen=True)
class ElementDose:
    """An element alone on flat ground, of which one quantity grows."""

    quantity: str
    values: tuple[float, ...]
    """The easiest first."""
    turn: float = 0.0
    """1 up, -1 down."""
    others: Mapping[str, float] = field(default_factory=dict)
    """The other quantities."""


def both_ways(name: str, *dose: Any, **others: float) -> dict[str, ElementDose]:
    """Doses of an element that leads up and down."""
    return {f"{name}_{way}": ElementDose(*dose, turn, others) for way, turn in (("up", 1.0), ("down", -1.0))}


@dataclass(frozen=True, kw_only=True, eq=False)
class CourseElement(ElementKind):
    """A kind of element with its text and its doses."""

    text: Callable[[Any], str]
    """Of a record of :class:`kernels.course.Element`."""
    quantities: Mapping[str, Quantity] = field(default_factory=dict)
    """What doses can set."""
    doses: Mapping[str, ElementDose] = field(default_factory=dict)
    """Doses by name."""
    draw_turns: Callable[[int, np.random.Generator], NDArray[Any]] | None = None
    """Draws the turns of an element of a dose, one for each place where it begins."""


ELEMENTS: dict[str, CourseElement] = {}
"""All elements by name; flat ground is the first, and what is left where another is taken away."""


def register_element(element: CourseElement) -> None:
    """Adds an element behind the others. Courses of the shipped space do not have it (spaces/course.py)."""
    ELEMENTS[element.name] = element


def all_elements() -> tuple[CourseElement, ...]:
    """All elements, in the order of their numbers in kernels."""
    return tuple(ELEMENTS.values())


def hard(low: float, high: float) -> Range:
    """Any number, of which larger ones are harder."""
    return Range(low, high, hard="high")


def whole(low: int, high: int, hard_end: str = "") -> Range:
    """Whole numbers."""
    return Range(low, high, whole=True, hard=hard_end)


def metres(num_cells: float) -> str:
    """A length in metres."""
    return f"{num_cells * SPACING:.2f} m"


def up_or_down(element: Any) -> str:
    """Its direction."""
    return "up" if element["turn"] >= 0.0 else "down"
