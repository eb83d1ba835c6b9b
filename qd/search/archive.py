"""The archive of a search: a table of terrains that break the controller, one a cell, and the file that holds it.

Its columns come in groups. The search fills the first; each stage of judging (:mod:`qd.faults.judge`) adds one.
"""

import os
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from kernels.episode import SEGMENTS, STEERING
from qd.search.descriptors import Cells
from qd.search.fitness import FAILING_GOAL_RATE, FITNESS_FLOOR, ColumnTable, Evaluation
from sim.files.atomic import write_atomically
from sim.files.npz import array_names, check_shapes, npz_bytes, read_arrays
from sim.files.settings import PositiveInt
from sim.rates import MAX_INVALID_SHARE
from sim.terrains.spaces.base import TerrainSpace
from sim.terrains.spaces.registry import get_space

ARCHIVE_FILE = "archive.npz"


@dataclass(frozen=True, kw_only=True)
class FreshValues(Evaluation):
    """N elites by fresh episodes, free of the luck that made them elites; the collision bit is of 20 episodes."""

    reproduced: NDArray[np.bool_]
    """Whether an elite lands in its cell or in a neighbour again, shape (N,)."""

    def corrected_elites(self) -> NDArray[np.int64]:
        """Rows of the "corrected archive" of Flageat and Cully 2023: by fresh episodes the fittest of each cell."""
        valid = np.flatnonzero(self.valid & (self.fitness > FITNESS_FLOOR))
        order = valid[np.lexsort((-self.fitness[valid], self.cell[valid]))]
        return order[np.unique(self.cell[order], return_index=True)[1]]


WITNESSES = ("", "around", "beside", "line")
"""Kinds of witnesses, the strictest last: by how far from the straight line the ways lead (:mod:`qd.faults.steer`)."""


@dataclass(frozen=True, kw_only=True)
class Witnesses(ColumnTable):
    """Ways by which a controller crosses some of N elites, if it does (:mod:`qd.faults.steer`)."""

    walker: NDArray[np.str_]
    """Name of the controller whose way it is, ``searched`` for that of the search; empty where none was tried, (N,)."""
    kind: NDArray[np.int64]
    """Index in :data:`WITNESSES`, shape (N,)."""
    way: NDArray[np.float32]
    """:data:`kernels.episode.STEERING` by segment, shape (N, SEGMENTS, 3)."""
    counts: NDArray[np.int64]
    """Episodes that reach the goal on the line, beside it, and at all, and valid ones; shape (N, 2, 2, 4), at the
    search's settings and with contact resolved, under the plain command and steered."""
    limit_m: float
    """Largest distance from the straight line of a way on the line [m]."""

    @property
    def on_line(self) -> NDArray[np.bool_]:
        """Whether a witness on the line certifies that an elite can be crossed, shape (N,)."""
        return self.kind == WITNESSES.index("line")

    def updated(self, rows: NDArray[np.int64], others: "Witnesses") -> "Witnesses":
        """The ways with those on some of the elites replaced by as many others."""
        updated = self.rows(np.arange(len(self.kind)))
        for name in ("walker", "kind", "way", "counts"):
            getattr(updated, name)[rows] = getattr(others, name)
        return updated


def no_witnesses(count: int, limit_m: float) -> Witnesses:
    """Witnesses of elites that nobody has tried."""
    way = np.zeros((count, SEGMENTS, len(STEERING)), np.float32)
    kind, counts = np.zeros(count, np.int64), np.zeros((count, 2, 2, 4), np.int64)
    return Witnesses(walker=np.full(count, "", "<U255"), kind=kind, way=way, counts=counts, limit_m=limit_m)


OUTCOMES = ("goal", "base_collision", "other", "invalid")
"""How an episode counts: ``other`` is out of time or off the terrain."""


def goal_rates(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Share of valid episodes that reached the goal, of counts (..., 4); NaN where too few, or none, are valid."""
    episodes, invalid = counts.sum(axis=-1), counts[..., OUTCOMES.index("invalid")]
    is_known = (episodes > 0) & (invalid <= MAX_INVALID_SHARE * episodes)
    return np.where(is_known, counts[..., 0] / np.maximum(episodes - invalid, 1), np.nan)


@dataclass(frozen=True, kw_only=True)
class CrossedAgain(ColumnTable):
    """Outcomes of N elites, as of an :class:`Archive`, some of which were crossed under other conditions."""

    searched: NDArray[np.int64]
    certifiers: NDArray[np.int64]
    steered: NDArray[np.int64] | None = None
    """Of witnesses on the line, shape (N, 4); what leaves it does not count as the goal."""


@dataclass(frozen=True, kw_only=True)
class Subject:
    """What is searched: robot, controller and terrain space, and the intervals of the cells."""

    robot: str
    robot_sha256: str
    """Hash of its settings, model and meshes."""
    penalty_definition: str
    """How the penalties are defined (:data:`sim.robots.robot.PENALTY_DEFINITION`)."""
    policy_sha256: str | None = None
    """Hash of the controller's files; None where there are none."""
    space: str = "super_gaussian"
    """Terrain space of the genes, as :func:`sim.terrains.spaces.registry.load_space` takes it."""
    space_sha256: str | None = None
    """Hash of its code if it is a user's own."""
    intervals: PositiveInt = 10
    collision_bit: bool
    """Whether base collision is a descriptor of its own."""

    @property
    def terrain_space(self) -> TerrainSpace:
        """What the genes mean."""
        return get_space(self.space, self.space_sha256)

    def named(self) -> dict[str, Any]:
        """Robot, controller and penalties: keys of :func:`sim.controllers.spec.controller_identity`."""
        return {name: getattr(self, name) for name in ("robot", "robot_sha256", "policy_sha256", "penalty_definition")}


@dataclass(frozen=True, kw_only=True)
class Archive(Evaluation, Subject):
    """N elites by descending fitness: by the corrected one if there are fresh episodes, else as they were found.

    Outcomes count episodes by :data:`OUTCOMES`: those of the controller that was searched in arrays of shape (N, 4),
    those of C others, the certifiers, in (N, C, 4). They are 0 for an elite that was not crossed.
    """

    penalties: tuple[str, ...]
    """Names of the P penalties, in the order of the ratios."""
    scales: tuple[float, ...]
    """What raw penalty sums were divided by."""
    iterations: int

    genes: NDArray[np.float32]
    """Clipped genes, shape (N, num_genes)."""
    iteration: NDArray[np.int64]
    """Iteration that found the elite, from 1, shape (N,)."""

    # By fresh episodes; None before.
    fresh: FreshValues | None = None
    family: NDArray[np.int64] | None = None
    """Family of each elite (:func:`qd.faults.families.find_families`), shape (N,)."""
    cause: NDArray[np.str_] | None = None
    """What stops the robot where its typical episode ends (:func:`qd.faults.causes.find_causes`); else empty, (N,)."""

    resolved_outcomes: NDArray[np.int64]
    """With contact resolved."""
    certifiers: tuple[str, ...] = ()
    certifier_sha256: tuple[str, ...] = ()
    certifier_outcomes: NDArray[np.int64]
    """At the search's settings."""
    certifier_resolved_outcomes: NDArray[np.int64]

    witnesses: Witnesses | None = None
    """None before the stage ``steered``."""

    varied: CrossedAgain | None = None
    """Faults under varied conditions (:func:`sim.terrains.spaces.wider.varied_genes`); None before."""
    mujoco_c: CrossedAgain | None = None
    """Some faults and what certifies each in MuJoCo C with contact resolved, until decided; None before."""

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
    def failing(self) -> NDArray[np.bool_]:
        """Whether the controller fails an elite by its fresh episodes, shape (N,)."""
        fresh = self.fresh
        return np.zeros(len(self), bool) if fresh is None else fresh.valid & (fresh.goal_rate < FAILING_GOAL_RATE)

    @property
    def confirmed(self) -> NDArray[np.bool_]:
        """Whether it fails an elite with contact resolved too, shape (N,)."""
        return self.failing & (goal_rates(self.resolved_outcomes) < FAILING_GOAL_RATE)

    @property
    def certificates(self) -> NDArray[np.bool_]:
        """Whether a certifier reaches the goal in at least half of both kinds of episodes, shape (N, C)."""
        both = (self.certifier_outcomes, self.certifier_resolved_outcomes)
        return np.all([goal_rates(counts) >= FAILING_GOAL_RATE for counts in both], axis=0)

    @property
    def certified_by_controllers(self) -> NDArray[np.bool_]:
        """Whether it fails an elite that another controller crosses, shape (N,)."""
        return self.failing & self.certificates.any(axis=1)

    @property
    def certified(self) -> NDArray[np.bool_]:
        """Whether it fails an elite that another controller crosses, or some controller on the line, shape (N,)."""
        by_witness = False if self.witnesses is None else self.failing & self.witnesses.on_line
        return self.certified_by_controllers | by_witness

    @property
    def is_fault(self) -> NDArray[np.bool_]:
        """Whether an elite is a fault: confirmed and certified, shape (N,)."""
        return self.confirmed & self.certified

    @property
    def strong(self) -> NDArray[np.bool_]:
        """Whether the controller crosses a fault under a fifth of the time, and a certifier over four fifths, (N,)."""
        if self.fresh is None:
            return np.zeros(len(self), bool)
        searched = np.maximum(self.fresh.goal_rate, goal_rates(self.resolved_outcomes))
        others = np.minimum(*map(goal_rates, (self.certifier_outcomes, self.certifier_resolved_outcomes)))
        return self.is_fault & (searched < 0.2) & (others > 0.8).any(axis=1)

    @property
    def robust(self) -> NDArray[np.bool_]:
        """Whether a fault is one under varied conditions too, shape (N,)."""
        return self._is_fault_by(self.varied)

    @property
    def holds_in_mujoco_c(self) -> NDArray[np.bool_]:
        """Whether a fault is one in MuJoCo C too, shape (N,)."""
        return self._is_fault_by(self.mujoco_c)

    def _is_fault_by(self, again: CrossedAgain | None) -> NDArray[np.bool_]:
        """Whether a fault is one by other outcomes too."""
        if again is None:
            return np.zeros(len(self), bool)
        crosses = self.certificates & (goal_rates(again.certifiers) >= FAILING_GOAL_RATE)
        by_witness = False if again.steered is None else goal_rates(again.steered) >= FAILING_GOAL_RATE
        fails = goal_rates(again.searched) < FAILING_GOAL_RATE
        return self.is_fault & fails & (crosses.any(axis=1) | by_witness)

    @property
    def is_judged(self) -> bool:
        """Whether anything was crossed with contact resolved, by other controllers, or steered."""
        return bool(self.certifiers) or bool(self.resolved_outcomes.any()) or self.witnesses is not None

    def corrected_by(self, fresh: FreshValues) -> "Archive":
        """The archive with fresh values, by descending corrected fitness, the invalid elites last."""
        return replace(self, fresh=fresh).rows(np.lexsort((-fresh.fitness, ~fresh.valid)))


def no_outcomes(num_elites: int) -> dict[str, Any]:
    """Columns of an :class:`Archive` whose elites nobody has crossed under other conditions."""
    shapes = {"resolved_outcomes": (4,), "certifier_outcomes": (0, 4), "certifier_resolved_outcomes": (0, 4)}
    return {name: np.zeros((num_elites, *shape), np.int64) for name, shape in shapes.items()}


# Arrays of the file by group, with their dimensions: N elites, G genes, P penalties, C certifiers, or a size.
_OPTIONAL = ("policy_sha256", "space_sha256")
_SETTINGS = {field.name: "" for field in fields(Subject)} | {"iterations": "", "penalties": "P", "scales": "P"}
_VALUES = {field.name: "N" for field in fields(Evaluation)} | {"end_position": "N2"}
_VALUES |= dict.fromkeys(("ratios", "penalty_mean", "penalty_std"), "NP")
_FOUND = {**_VALUES, "genes": "NG", "iteration": "N"}
_GROUPED = {"family": "N", "cause": "N"}
_CERTIFIERS = {"certifiers": "C", "certifier_sha256": "C"}
_CROSSED = {**_CERTIFIERS, "resolved_outcomes": "N4", "certifier_outcomes": "NC4", "certifier_resolved_outcomes": "NC4"}
_WITNESS = {"walker": "N", "kind": "N", "way": "NS3", "counts": "N224", "limit_m": ""}
_VARIED = {"searched": ("varied_outcomes", "N4"), "certifiers": ("certifier_varied_outcomes", "NC4")}
_MUJOCO_C = {name: (key.replace("varied", "mujoco_c"), shape) for name, (key, shape) in _VARIED.items()}
_TABLES: dict[str, tuple[type[ColumnTable], dict[str, tuple[str, str]]]] = {
    "varied": (CrossedAgain, _VARIED),
    "mujoco_c": (CrossedAgain, _MUJOCO_C | {"steered": ("steered_mujoco_c_outcomes", "N4")}),
    "fresh": (FreshValues, {name: (f"fresh_{name}", shape) for name, shape in {**_VALUES, "reproduced": "N"}.items()}),
    "witnesses": (Witnesses, {name: (f"witness_{name}", shape) for name, shape in _WITNESS.items()}),
}  # by field of the archive: what it is, and the name and dimensions of each column in the file
_BY_JUDGING = (_GROUPED, _CROSSED, *(dict(columns.values()) for _, columns in _TABLES.values()))  # whole, or not at all
_TEXTS = {*_SETTINGS, *_CERTIFIERS, "cause", "witness_walker"} - {"intervals", "collision_bit", "iterations", "scales"}
_SHAPES = {name: shape for group in (_SETTINGS, _FOUND, *_BY_JUDGING) for name, shape in group.items()}
_WHOLE_ENDS = ("outcomes", "counts", "kind", "cell", "family", "iteration", "iterations", "episodes", "intervals")
_WHOLE = {name for name in _SHAPES if name.endswith(_WHOLE_ENDS)}
_CONTENTS = {"U": "texts", "i": "whole numbers", "bif": "numbers"}  # by kinds of NumPy types
_FINITE = ("genes", "fitness", "scales", "witness_way", "witness_limit_m")


def write_archive(path: Path, archive: Archive) -> None:
    """Writes an archive, a file or that of a run directory, as an npz, atomically; equal archives give equal bytes."""
    groups = (_SETTINGS, _FOUND, _GROUPED, _CROSSED if archive.is_judged else {})
    values = {name: getattr(archive, name) for group in groups for name in group}
    for field, (_, columns) in _TABLES.items():
        if (table := getattr(archive, field)) is not None:
            values |= {key: getattr(table, name) for name, (key, _) in columns.items()}
    values |= {name: np.array(values[name], np.str_) for name in _CERTIFIERS if name in values}  # of none, too
    arrays = {name: np.asarray(value) for name, value in values.items() if value is not None}
    if archive.is_judged:
        arrays |= {"confirmed": archive.confirmed, "certified": archive.certified}
    write_atomically(path / ARCHIVE_FILE if os.path.isdir(path) else path, npz_bytes(arrays))


def read_archive(path: str | Path) -> Archive:
    """Reads an archive, ``archive.npz`` or that of a run directory; data only, nothing in the file can run."""
    path = Path(path)
    file = path / ARCHIVE_FILE if os.path.isdir(path) else path
    if not os.path.isfile(file):  # False too for a name that no file can have
        raise FileNotFoundError(f"no archive at {file}: give a run directory or the {ARCHIVE_FILE} of one")
    try:
        stored = set(array_names(file))
        names = [name for name in (*_SETTINGS, *_FOUND) if name not in _OPTIONAL or name in stored]
        names += [name for group in _BY_JUDGING if not stored.isdisjoint(group) for name in group]
        arrays = read_arrays(file, names)
        sizes = {"2": 2, "3": len(STEERING), "4": len(OUTCOMES), "S": SEGMENTS}
        check_shapes(arrays, {name: [sizes.get(size, size) for size in _SHAPES[name]] for name in arrays})
        for name, array in arrays.items():
            kinds = "U" if name in _TEXTS else "i" if name in _WHOLE else "bif"
            if array.dtype.kind not in kinds:
                raise ValueError(f"{name} must hold {_CONTENTS[kinds]}, got {array.dtype}")
            if name in _FINITE and not np.isfinite(array).all():
                raise ValueError(f"{name} must be finite")
        values: dict[str, Any] = no_outcomes(len(arrays["fitness"])) | arrays
        if not np.isin(values.get("witness_kind", 0), np.arange(len(WITNESSES))).all():
            raise ValueError(f"witness_kind must be from 0 to {len(WITNESSES) - 1}")
        for name in arrays.keys() & {*_SETTINGS, *_CERTIFIERS, "witness_limit_m"}:  # as the dataclasses have them
            values[name] = tuple(array.tolist()) if (array := arrays[name]).ndim else array.item()
        for field, (kind, columns) in _TABLES.items():
            table = {name: values.pop(key) for name, (key, _) in columns.items() if key in values}
            values[field] = kind(**table) if table else None
        return Archive(**values)
    except Exception as error:  # zip, zlib and npy headers answer damage with a dozen types
        message = f"{file} must be the archive of a search, but it is damaged or another file: {error}"
        raise ValueError(message) from None
