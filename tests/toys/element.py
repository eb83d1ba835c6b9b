"""An element of courses in one file: a hump, and the space of courses that have it."""

from dataclasses import dataclass
from typing import ClassVar

import warp as wp

from kernels.course import Element, Range
from sim.terrains.elements.kinds import ELEMENTS, LENGTH, CourseElement
from sim.terrains.quantities import Quantity, Sweep
from sim.terrains.spaces.course import Course
from sim.terrains.spaces.registry import SPACES


@wp.func
def _hump_relief(element: Element, s: int, row: int) -> float:
    share = float(s) / float(element.cells)
    return 4.0 * element.size * share * (1.0 - share)


HUMP = CourseElement(
    name="hump",
    size=Range(0.05, 0.5, hard="high"),
    length=Range(10, 40, whole=True),
    relief=_hump_relief,
    text=lambda e: f"hump of {e['size']:.2f} m",
    quantities={"height": Quantity(name="size", low=0.01, high=1.0, unit="m"), "length": LENGTH},
    doses={"hump": Sweep("height", (0.1, 0.2, 0.4), {"length": 1.0})},
)
ELEMENTS["hump"] = HUMP


@dataclass(frozen=True, kw_only=True)
class Humps(Course):
    base_name: ClassVar[str] = "humps"
    kinds: ClassVar[tuple[str, ...]] = ("flat", "hump")


SPACES["humps"] = Humps()
