"""The archive of a search as data: terrains that break the controller, one a cell, and the file that holds them.

Training and figures read archives without the search's libraries.
"""

import os
from collections.abc import Iterable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.search.descriptors import Cells
from qd.search.fitness import FAILING_GOAL_RATE, FITNESS_FLOOR, Evaluation
from sim.files.atomic import write_atomically
from sim.files.npz import array_names, check_shapes, npz_bytes, read_arrays
from sim.rates import MAX_INVALID_SHARE

ARCHIVE_FILE = "archive.npz"


@dataclass(frozen=True, kw_only=True)
class FreshValues(Evaluation):
    """What fresh episodes say of N elites, free of the luck that made them elites; a collision bit as searched."""

    reproduced: NDArray[np.bool_]
    """Whether an elite lands in its cell or a neighbour of it again, shape (N,)."""

    def corrected_elites(self) -> NDArray[np.int64]:
        """Rows of the archive that fresh episodes alone would make: the fittest elite of each cell that one lands in.

        It is the "corrected archive" of Flageat and Cully 2023.
        """
        valid = np.flatnonzero(self.valid & (self.fitness > FITNESS_FLOOR))
        order = valid[np.lexsort((-self.fitness[valid], self.cell[valid]))]
        return order[np.unique(self.cell[order], return_index=True)[1]]


FRESH = tuple(field.name for field in fields(FreshValues))
"""Names of the arrays of fresh values; in the file ``fresh_`` goes before them."""

OUTCOMES = ("goal", "base_collision", "other", "invalid")
"""How episodes are counted: ``other`` are those out of time or off the terrain."""


@dataclass(frozen=True, kw_only=True)
class FaultCounts:
    """How further episodes on N elites ended, by :data:`OUTCOMES`; an elite that was not crossed has none."""

    resolved_outcomes: NDArray[np.int64]
    """By the controller that was searched, with contact resolved, shape (N, 4)."""
    certifiers: tuple[str, ...] = ()
    """Names of C other controllers."""
    certifier_sha256: tuple[str, ...] = ()
    certifier_outcomes: NDArray[np.int64]
    """By them at the search's settings, shape (N, C, 4)."""
    certifier_resolved_outcomes: NDArray[np.int64]
    """By them with contact resolved, shape (N, C, 4)."""
    varied_outcomes: NDArray[np.int64] | None = None
    """By the controller that was searched under varied conditions
    (:func:`sim.terrains.spaces.under_conditions.varied_genes`), shape (N, 4); None where nobody has crossed so."""
    certifier_varied_outcomes: NDArray[np.int64] | None = None
    """By the others under the same ones, shape (N, C, 4); None likewise."""

    def certificates(self) -> NDArray[np.bool_]:
        """Whether a controller reaches the goal in at least half of both kinds of episodes, shape (N, C)."""
        both = (self.certifier_outcomes, self.certifier_resolved_outcomes)
        return np.all([goal_rates(counts) >= FAILING_GOAL_RATE for counts in both], axis=0)


COUNTS = tuple(field.name for field in fields(FaultCounts) if field.name.endswith("_outcomes"))
"""Names of the arrays of counts, which have one row an elite."""
_VARIED = tuple(name for name in COUNTS if "varied" in name)  # they may be None


def goal_rates(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Share of valid episodes that reached the goal, shape (...), of counts of shape (..., 4).

    NaN where nothing was crossed, or too many episodes are invalid.
    """
    episodes, invalid = counts.sum(axis=-1), counts[..., OUTCOMES.index("invalid")]
    known = (episodes > 0) & (invalid <= MAX_INVALID_SHARE * episodes)
    return np.where(known, counts[..., 0] / np.maximum(episodes - invalid, 1), np.nan)


@dataclass(frozen=True, kw_only=True)
class Archive(Evaluation):
    """Elites as they were found, by descending fitness, the corrected one if there are fresh values."""

    robot: str
    robot_sha256: str
    penalty_definition: str
    """How its penalties are defined (:data:`sim.robots.identity.PENALTY_DEFINITION`)."""
    space: str
    """Name of the terrain space of the genes (:func:`sim.terrains.spaces.registry.get_space`)."""
    penalties: tuple[str, ...]
    """Names of the P penalties, in the order of the ratios."""
    scales: tuple[float, ...]
    """What raw penalty sums were divided by."""
    intervals: int
    """Intervals of each ratio."""
    collision_bit: bool
    """Whether base collision is a descriptor too."""
    iterations: int
    genes: NDArray[np.float32]
    """Clipped genes, shape (N, num_genes)."""
    iteration: NDArray[np.int64]
    """Iteration that found the elite, from 1, shape (N,)."""
    policy_sha256: str | None = None
    """Hash of its controller; None where it has no file."""
    space_sha256: str | None = None
    """Hash of the code of the terrain space; None of a shipped one."""
    fresh: FreshValues | None = None
    """What fresh episodes say of the elites; None if there were none."""
    faults: FaultCounts | None = None
    """What became of those that fail under other conditions; only beside fresh values."""
    family: NDArray[np.int64] | None = None
    """Family of each elite (:func:`qd.faults.families.families_of`), shape (N,); None where nobody has judged them."""
    cause: NDArray[np.str_] | None = None
    """What stops the robot where its typical episode ends (:func:`qd.faults.causes.causes_at`), shape (N,); empty of an
    elite that does not fail; None likewise."""

    def named(self) -> dict[str, Any]:
        """Robot, controller and penalties: keys of :func:`sim.controllers.spec.controller_identity`."""
        return {name: getattr(self, name) for name in ("robot", "robot_sha256", "policy_sha256", "penalty_definition")}

    def __len__(self) -> int:
        return len(self.fitness)

    @property
    def cells(self) -> Cells:
        """The cells that ``cell`` counts in."""
        return Cells(len(self.penalties), self.intervals, collision_bit=self.collision_bit)

    @property
    def reachable_coverage(self) -> float:
        """Filled share of the reachable cells."""
        return len(self) / self.cells.num_cells

    @property
    def qd_score(self) -> float:
        """Sum over the elites of their fitness above the floor of -20."""
        return float((self.fitness - FITNESS_FLOOR).sum())

    @property
    def mean_fitness(self) -> float:
        """Mean fitness of the elites; 0 without any."""
        return float(self.fitness.mean()) if len(self) else 0.0

    @property
    def counts(self) -> FaultCounts:
        """``faults``, or counts of 0 where nobody has crossed the elites under other conditions."""
        none, nobody = np.zeros((len(self), 4), np.int64), np.zeros((len(self), 0, 4), np.int64)
        return self.faults or FaultCounts(
            resolved_outcomes=none, certifier_outcomes=nobody, certifier_resolved_outcomes=nobody
        )

    @property
    def failing(self) -> NDArray[np.bool_]:
        """Whether fresh episodes say that the controller fails an elite, shape (N,)."""
        fresh = self.fresh
        return np.zeros(len(self), bool) if fresh is None else fresh.valid & (fresh.goal_rate < FAILING_GOAL_RATE)

    @property
    def confirmed(self) -> NDArray[np.bool_]:
        """Whether it fails an elite with contact resolved too, shape (N,)."""
        return self.failing & (goal_rates(self.counts.resolved_outcomes) < FAILING_GOAL_RATE)

    @property
    def certified(self) -> NDArray[np.bool_]:
        """Whether it fails an elite that another controller crosses, shape (N,)."""
        return self.failing & self.counts.certificates().any(axis=1)

    @property
    def is_fault(self) -> NDArray[np.bool_]:
        """Whether it is a fault: confirmed and certified, shape (N,)."""
        return self.confirmed & self.certified

    @property
    def robust(self) -> NDArray[np.bool_]:
        """Whether a fault is one under varied conditions too, shape (N,).

        The controller crosses in under half of them, and one with a certificate in at least half.
        """
        faults = self.counts
        if faults.varied_outcomes is None or faults.certifier_varied_outcomes is None:
            return np.zeros(len(self), bool)
        fails = goal_rates(faults.varied_outcomes) < FAILING_GOAL_RATE
        crosses = faults.certificates() & (goal_rates(faults.certifier_varied_outcomes) >= FAILING_GOAL_RATE)
        return self.is_fault & fails & crosses.any(axis=1)

    def has_elites_of(self, other: "Archive") -> bool:
        """Whether the elites and all that was found of them are another's too, in whatever order."""
        if len(self) != len(other):
            return False
        order, other_order = np.argsort(self.cell), np.argsort(other.cell)
        return all(np.array_equal(getattr(self, name)[order], getattr(other, name)[other_order]) for name in PER_ELITE)

    def rows(self, chosen: NDArray[np.int64]) -> "Archive":
        """The archive with some of its elites alone, in the order given."""

        def of(values: Any, names: Iterable[str]) -> Any:
            return replace(values, **{name: getattr(values, name)[chosen] for name in names})

        known = [name for name in _JUDGED if getattr(self, name) is not None]
        fresh = None if self.fresh is None else of(self.fresh, FRESH)
        faults = self.faults
        if faults is not None:
            faults = of(faults, [name for name in COUNTS if getattr(faults, name) is not None])
        return replace(of(self, (*PER_ELITE, *known)), fresh=fresh, faults=faults)

    def corrected_by(self, fresh: FreshValues) -> "Archive":
        """The archive with what fresh episodes say, by descending corrected fitness, the invalid elites last."""
        return replace(self, fresh=fresh).rows(np.lexsort((-fresh.fitness, ~fresh.valid)))


_JUDGED = ("family", "cause")  # of elites that were judged
_BESIDE = ("fresh", "faults", *_JUDGED)
_OPTIONAL = ("policy_sha256", "space_sha256", *_JUDGED)
_TEXTS = ("robot", "robot_sha256", "penalty_definition", "space", "policy_sha256", "space_sha256")
_SETTINGS = (*_TEXTS, "penalties", "scales", "intervals", "collision_bit", "iterations")
_PREFIX = "fresh_"
_CERTIFIERS = ("certifiers", "certifier_sha256")
_SHAPES = {
    **dict.fromkeys((*_TEXTS, "intervals", "collision_bit", "iterations"), ""),
    **dict.fromkeys(("penalties", "scales"), "P"),
    **dict.fromkeys(_CERTIFIERS, "C"),
    "genes": "NG", "end_position": "N2", **dict.fromkeys(("ratios", "penalty_mean", "penalty_std"), "NP"),
    **{name: "NC4" if name.startswith("certifier") else "N4" for name in COUNTS},
}  # fmt: skip
"""Dimensions of arrays in N elites, G genes, P penalties and C certifiers; N alone of all others."""
PER_ELITE = tuple(field.name for field in fields(Archive) if field.name not in (*_SETTINGS, *_BESIDE))
"""Names of the arrays that have one row an elite."""


def write_archive(path: Path, archive: Archive) -> None:
    """Writes an archive as a compressed npz, atomically; equal archives give equal bytes."""
    known = {name: getattr(archive, name) for name in (*_SETTINGS, *PER_ELITE, *_JUDGED)}
    content = {name: np.asarray(value) for name, value in known.items() if value is not None}
    if archive.fresh is not None:
        content |= {_PREFIX + name: np.asarray(getattr(archive.fresh, name)) for name in FRESH}
    if archive.faults is not None:
        content |= {name: np.array(getattr(archive.faults, name), dtype=np.str_) for name in _CERTIFIERS}
        counts = {name: getattr(archive.faults, name) for name in COUNTS}
        content |= {name: values for name, values in counts.items() if values is not None}
        content |= {"confirmed": archive.confirmed, "certified": archive.certified}
    write_atomically(path, npz_bytes(content))


def read_archive(path: str | Path) -> Archive:
    """Reads an archive, ``archive.npz`` or that of a run directory; data only, nothing in the file can run."""
    path = Path(path)
    file = path / ARCHIVE_FILE if os.path.isdir(path) else path
    if not os.path.isfile(file):  # False too for a name that no file can have
        raise FileNotFoundError(f"no archive at {file}: give a run directory or the {ARCHIVE_FILE} of one")
    try:
        stored = set(array_names(file))
        names = [name for name in (*_SETTINGS, *PER_ELITE, *_JUDGED) if name not in _OPTIONAL or name in stored]
        fresh_names = [_PREFIX + name for name in FRESH] if any(name.startswith(_PREFIX) for name in stored) else []
        fault_names = [*_CERTIFIERS, *COUNTS] if not stored.isdisjoint((*_CERTIFIERS, *COUNTS)) else []
        fault_names = [name for name in fault_names if name not in _VARIED or name in stored]
        arrays = read_arrays(file, [*names, *fresh_names, *fault_names])
        _check_shapes(arrays)
        fresh = {name.removeprefix(_PREFIX): arrays[name] for name in fresh_names}
        faults = {name: _as_field(name, arrays[name]) for name in fault_names}
        return Archive(
            **{name: _as_field(name, arrays[name]) for name in names},
            fresh=FreshValues(**fresh) if fresh else None,
            faults=FaultCounts(**faults) if faults else None,
        )
    except Exception as error:  # zip, zlib and npy headers answer damage with a dozen types
        raise ValueError(
            f"{file} must be the archive of a search, but it is damaged or another file: {error}"
        ) from None


def _as_field(name: str, array: NDArray[Any]) -> Any:
    """A field as the dataclass has it: settings and names as Python values, arrays as they are."""
    if name not in (*_SETTINGS, *_CERTIFIERS):
        return array
    return tuple(array.tolist()) if array.ndim else array.item()


def _check_shapes(arrays: dict[str, NDArray[Any]]) -> None:
    """Refuses arrays of other shapes, texts in place of numbers, and numbers in place of texts."""
    sizes = {"2": 2, "4": len(OUTCOMES)}
    dimensions = {name: _SHAPES.get(name.removeprefix(_PREFIX), "N") for name in arrays}
    check_shapes(arrays, {name: [sizes.get(size, size) for size in shape] for name, shape in dimensions.items()})
    for name, array in arrays.items():
        is_text = name in (*_TEXTS, *_CERTIFIERS, "penalties", "cause")
        if array.dtype.kind not in ("U" if is_text else "bif"):
            raise ValueError(f"{name} must hold {'texts' if is_text else 'numbers'}, got {array.dtype}")
        if name in ("genes", "fitness", "scales") and not np.isfinite(array).all():
            raise ValueError(f"{name} must be finite")
