"""Numbers of elements, grounds and conditions: how far each can go, and how one grows in a dose."""

from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True, kw_only=True)
class Quantity:
    """A number that can be set: how far it can go, and its unit."""

    name: str
    """Of a parameter of an element, a map of the ground or a number of a condition."""
    low: float
    high: float
    unit: str = ""
    step: float = 0.0
    """What values are multiples of; 0 if they may be any number."""


@dataclass(frozen=True)
class Sweep:
    """One quantity that grows, and those that stay beside it."""

    parameter: str
    """The quantity that grows."""
    values: tuple[float, ...]
    """The easiest first."""
    others: Mapping[str, float] = field(default_factory=dict)
    """The other quantities."""
    title: str = ""
    """Empty of an element, which has a name."""
    turn: float = 0.0
    """Of an element: 1 up, -1 down."""
