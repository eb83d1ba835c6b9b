"""How likely conditions are, by a plain model of how far from nominal each is: ``likely.toml``, or a user's file.

The likelihood of a terrain is the probability of conditions at least as far from nominal as its own, each kind by
itself. It says nothing of the terrain's shape.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray
from scipy.special import log_ndtr

from sim.files.settings import PositiveFloat, check_settings, from_builtins, read_toml
from sim.terrains.conditions.kinds import CONDITIONS, condition_column, nominal_row

SHIPPED = Path(__file__).with_name("likely.toml")
"""The model that is taken where no other file is named."""


def _log_uniform_tail(distance: NDArray[np.float64]) -> NDArray[np.float64]:
    with np.errstate(divide="ignore"):  # minus infinity from 1 on
        return np.log1p(-np.minimum(distance, 1.0))


TAILS: dict[str, Callable[[NDArray[np.float64]], NDArray[np.float64]]] = {
    "half_normal": lambda distance: log_ndtr(-distance) - log_ndtr(0.0),
    "exponential": lambda distance: 0.0 - distance,
    "uniform": _log_uniform_tail,
}
"""Log-probabilities of distances at least as large, by the names of distributions."""


@dataclass(frozen=True, kw_only=True)
class Disturbance:
    """How far a condition is from nominal."""

    numbers: dict[str, PositiveFloat]
    """Scales of the numbers that count. The distance is Euclidean, of their differences over these."""
    distribution: str
    """Of the distance, one of :data:`TAILS`."""
    source: Annotated[str, Meta(min_length=1)]
    """Who says so; ``assumed`` where nobody does."""

    def __post_init__(self) -> None:
        check_settings(self)
        if self.distribution not in TAILS:
            raise ValueError(f"distribution must be one of {', '.join(TAILS)}, got {self.distribution}")


def read_likely(file: Path = SHIPPED) -> dict[str, Disturbance]:
    """The entries of a file by their conditions."""
    entries = {}
    for name, entry in read_toml(file).items():
        label = f"{file}: [{name}]"
        if name not in CONDITIONS:
            raise ValueError(f"{label} must be one of {', '.join(CONDITIONS)}: leave it out, or correct its name")
        try:
            entries[name] = from_builtins(Disturbance, entry, label)
        except ValueError as error:
            raise ValueError(f"{error}, got {entry}: write it as {SHIPPED} does") from None
        known = [gene.name for gene in CONDITIONS[name].genes]
        if not entries[name].numbers or not entries[name].numbers.keys() <= {*known}:
            got = ", ".join(entries[name].numbers) or "none"
            raise ValueError(f"{label} numbers must be some of {', '.join(known)}, got {got}: correct them")
    return entries


def choose_likely(space: Any, file: Path | None = None, *, needed: bool = False) -> dict[str, Disturbance]:
    """The entries of a file, or of the shipped one, for the conditions of a space.

    There are none where one is lacking, or no condition; that is refused if they are ``needed``, or a file is named.
    """
    entries = read_likely(file or SHIPPED)
    lacking = [name for name in space.conditions if name not in entries]
    if space.conditions and not lacking:
        return {name: entries[name] for name in space.conditions}
    if needed or file is not None:
        rule = f"{file or SHIPPED} must have an entry for each of the conditions of {space.name}"
        remedy = "name a file that has, with --likely, and a space with conditions, such as +push"
        raise ValueError(f"{rule}, got none for {', '.join(lacking) or 'it'}: {remedy}")
    return {}


def find_log_likelihood(rows: NDArray[np.floating], entries: Mapping[str, Disturbance]) -> NDArray[np.float64]:
    """Natural logarithms of the probabilities of conditions at least as far from nominal, shape (num_terrains,).

    ``rows`` are those of conditions, shape (num_terrains, number of values). Kinds are independent, what is nominal
    adds 0, and what an entry rules out is minus infinity.
    """
    total = np.zeros(len(rows))
    for entry in entries.values():
        columns = [condition_column(name) for name in entry.numbers]
        apart = np.subtract(rows[:, columns], nominal_row()[columns], dtype=np.float64)
        total += TAILS[entry.distribution](np.sqrt(((apart / [*entry.numbers.values()]) ** 2).sum(axis=1)))
    return total
