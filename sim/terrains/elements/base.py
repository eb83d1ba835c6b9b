"""What an element of a course is, and all of them by name."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

from kernels import course
from kernels.course import SPACING, ElementKind
from sim.device import host_device
from sim.terrains.hand_crafted import NUM_COLS, NUM_ROWS
from sim.terrains.quantities import Quantity, Sweep

FIRST_COL = 100
"""An element alone on flat ground begins at x = 5 m, or at one of the next nodes."""
NUM_STARTS = 20
"""Nodes at which it may begin: over 1 m, more than a stride."""


def cells(name: str, low: float, high: float, every: int = 1) -> Quantity:
    """A length [m] that is a multiple of ``every`` cells."""
    return Quantity(name=name, low=low, high=high, unit="m", step=every * SPACING)


LENGTH = cells("length", 0.20, 4.0)


@dataclass(frozen=True, kw_only=True, eq=False)
class CourseElement(ElementKind):
    """A kind of element with its text and its doses."""

    text: Callable[[Any], str]
    """Of a record of :class:`kernels.course.Element`."""
    quantities: Mapping[str, Quantity] = field(default_factory=dict)
    """What doses can set."""
    doses: Mapping[str, Sweep] = field(default_factory=dict)
    """Doses by name."""
    draw_turns: Callable[[int, np.random.Generator], NDArray[Any]] | None = None
    """Draws the turns of an element of a dose, one for each node where it begins."""

    def lay_alone(
        self, turn: float, quantities: Mapping[str, Any], count: int, rng: np.random.Generator
    ) -> NDArray[np.float32]:
        """Elements alone on flat ground before x = 12 m, of quantities of which one has several values.

        They begin at ``count`` nodes that are spread evenly over 1 m. Returns heights [m], shape (count * num_values,
        NUM_ROWS, NUM_COLS): first one of each value, then the next of each.
        """
        record: Any = course.Element  # Warp makes its dtype
        laid: Any = np.zeros((count, max(map(np.size, quantities.values()))), record.numpy_dtype())
        laid["kind"] = all_elements().index(self)
        laid["detail"] = 1.0  # pallets
        laid["first"] = (FIRST_COL + np.arange(count) * NUM_STARTS // count)[:, None]
        laid["turn"] = turn if self.draw_turns is None else self.draw_turns(count, rng)[:, None]
        for name, values in quantities.items():
            quantity = self.quantities[name]
            in_cells = quantity.step and quantity.unit == "m"
            laid[quantity.name] = np.rint(np.asarray(values) / SPACING) if in_cells else values
        with wp.ScopedDevice(host_device()):
            elements: Any = wp.array(laid.reshape(-1, 1), dtype=course.Element)
            course.lay_elements(elements, all_elements())
            heights: Any = wp.empty((len(elements), NUM_ROWS, NUM_COLS), dtype=float)
            course.rasterise_elements(elements, all_elements(), heights)
            return np.array(heights.numpy(), np.float32)


ELEMENTS: dict[str, CourseElement] = {}
"""All elements by name; flat ground is the first, and what is left where another is taken away.

Courses of the shipped space have those that spaces/course.py names.
"""


def all_elements() -> tuple[CourseElement, ...]:
    """All elements, in the order of their numbers in kernels."""
    return tuple(ELEMENTS.values())
