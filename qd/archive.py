"""The archive of a search as data: terrains that break the controller, one a cell, and the file that holds them.

Training and figures read archives without the search's libraries.
"""

import os
from collections.abc import Collection
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.descriptors import Cells
from qd.fitness import FAILING_GOAL_RATE, FITNESS_FLOOR, Evaluation
from sim.files.atomic import write_atomically
from sim.files.intervals import wilson_interval
from sim.files.npz import array_names, npz_bytes, read_arrays
from sim.files.records import PENALTY_DEFINITION
from sim.rates import MAX_INVALID_SHARE

ARCHIVE_FILE = "archive.npz"
"""Name of the archive in a run directory."""


@dataclass(frozen=True, kw_only=True)
class FreshValues(Evaluation):
    """What fresh episodes say of N elites, free of the luck that made them elites; a collision bit as searched."""

    collision_low: NDArray[np.float64]
    """Lower limit of the 95 % interval of the collision rate, shape (N,); 0 of an invalid elite."""
    collision_high: NDArray[np.float64]
    """Upper limit, shape (N,); 1 of an invalid elite."""
    reproduced: NDArray[np.bool_]
    """Whether an elite lands in its cell or a neighbour of it again, shape (N,)."""

    @property
    def failing(self) -> NDArray[np.bool_]:
        """Whether an elite is valid and under half of the robots reach the goal, shape (N,)."""
        return self.not_crossed

    def std(self) -> NDArray[np.float64]:
        """Sum over penalties of the standard deviation over the episodes, of the valid elites, shape (num_valid,)."""
        return self.penalty_std[self.valid].sum(axis=1)

    def corrected_elites(self) -> NDArray[np.int64]:
        """The archive that fresh episodes alone would make: of each cell that an elite lands in, its fittest.

        Returns:
            Indices into the elites, one a filled cell (the "corrected archive" of Flageat and Cully 2023).
        """
        valid = np.flatnonzero(self.valid & (self.fitness > FITNESS_FLOOR))
        order = valid[np.lexsort((-self.fitness[valid], self.cell[valid]))]
        return order[np.unique(self.cell[order], return_index=True)[1]]

    def rows(self, chosen: NDArray[np.int64]) -> "FreshValues":
        """Those of some of the elites alone, in the order given."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in FRESH})


FRESH = tuple(field.name for field in fields(FreshValues))
"""Names of the arrays of fresh values; in the file ``fresh_`` goes before them."""

OUTCOMES = ("goal", "base_collision", "other", "invalid")
"""How episodes are counted: ``other`` are those out of time or off the terrain."""


@dataclass(frozen=True, kw_only=True)
class FaultCounts:
    """How further episodes on N elites ended, by :data:`OUTCOMES`; an elite that was not crossed has none."""

    resolved_outcomes: NDArray[np.int64]
    """By the controller that was searched, with contact resolved, shape (N, 4)."""
    mujoco_c_outcomes: NDArray[np.int64]
    """The same in plain MuJoCo C, shape (N, 4)."""
    certifiers: tuple[str, ...] = ()
    """Names of C other controllers."""
    certifier_sha256: tuple[str, ...] = ()
    """Their hashes."""
    certifier_outcomes: NDArray[np.int64]
    """By them at the search's settings, shape (N, C, 4)."""
    certifier_resolved_outcomes: NDArray[np.int64]
    """By them with contact resolved, shape (N, C, 4)."""

    @classmethod
    def none_of(cls, num_elites: int) -> "FaultCounts":
        """Of elites that nobody has crossed yet."""
        none, nobody = np.zeros((num_elites, 4), np.int64), np.zeros((num_elites, 0, 4), np.int64)
        return cls(
            resolved_outcomes=none,
            mujoco_c_outcomes=none,
            certifier_outcomes=nobody,
            certifier_resolved_outcomes=nobody,
        )

    def rows(self, chosen: NDArray[np.int64]) -> "FaultCounts":
        """Those of some of the elites alone, in the order given."""
        return replace(self, **{name: getattr(self, name)[chosen] for name in COUNTS})

    def of_certifiers(self, sha256: Collection[str]) -> "FaultCounts":
        """Those of some of the certifiers alone, by their hashes."""
        places = [place for place, digest in enumerate(self.certifier_sha256) if digest in sha256]
        return replace(
            self,
            certifiers=tuple(self.certifiers[place] for place in places),
            certifier_sha256=tuple(self.certifier_sha256[place] for place in places),
            certifier_outcomes=self.certifier_outcomes[:, places],
            certifier_resolved_outcomes=self.certifier_resolved_outcomes[:, places],
        )

    def certificates(self) -> NDArray[np.bool_]:
        """Whether a controller reaches the goal in at least half of both kinds of episodes, shape (N, C)."""
        both = (self.certifier_outcomes, self.certifier_resolved_outcomes)
        return np.all([goal_rates(counts) >= FAILING_GOAL_RATE for counts in both], axis=0)


COUNTS = tuple(field.name for field in fields(FaultCounts) if field.name.endswith("_outcomes"))
"""Names of the arrays of counts, which have one row an elite."""


def goal_rates(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """Share of valid episodes that reached the goal, of counts of shape (..., 4).

    Returns:
        Shape (...); NaN where nothing was crossed, or too many episodes are invalid.
    """
    episodes, invalid = counts.sum(axis=-1), counts[..., OUTCOMES.index("invalid")]
    known = (episodes > 0) & (invalid <= MAX_INVALID_SHARE * episodes)
    return np.where(known, counts[..., 0] / np.maximum(episodes - invalid, 1), np.nan)


def _goal_intervals(counts: NDArray[np.int64]) -> NDArray[np.float64]:
    """95 % intervals of the rates (Wilson), shape (..., 2); 0 to 1 without an episode."""
    valid = counts.sum(axis=-1) - counts[..., OUTCOMES.index("invalid")]
    pairs = zip(counts[..., 0].ravel().tolist(), valid.ravel().tolist(), strict=True)
    limits = [wilson_interval(*pair) for pair in pairs]
    return np.array(limits, np.float64).reshape(*counts.shape[:-1], 2)


@dataclass(frozen=True, kw_only=True)
class Archive(Evaluation):
    """Elites as they were found, by descending fitness, the corrected one if there are fresh values."""

    robot: str
    space: str
    """Name of the terrain space of the genes (:func:`sim.spaces.registry.get_space`)."""
    penalties: tuple[str, ...]
    """Names of the P penalties, in the order of the ratios."""
    scales: tuple[float, ...]
    """What raw penalty sums were divided by."""
    intervals: int
    """Intervals of each ratio."""
    collision_bit: bool
    """Whether base collision is a descriptor too."""
    iterations: int
    """Iterations the search had done."""
    genes: NDArray[np.float32]
    """Clipped genes, shape (N, num_genes)."""
    iteration: NDArray[np.int64]
    """Iteration that found the elite, from 1, shape (N,)."""
    robot_sha256: str | None = None
    """Hash of the robot that was searched; None in a file of a version before there was one."""
    policy_sha256: str | None = None
    """Hash of its controller; None where it has no file."""
    space_sha256: str | None = None
    """Hash of the code of the terrain space; None of a shipped one."""
    penalty_definition: str = PENALTY_DEFINITION
    """How its penalties are defined (:data:`sim.files.records.PENALTY_DEFINITION`)."""
    fresh: FreshValues | None = None
    """What fresh episodes say of the elites; None if there were none."""
    faults: FaultCounts | None = None
    """What became of those that fail under other conditions; only beside fresh values."""

    def named(self) -> dict[str, Any]:
        """Robot, controller and definition of the penalties, as :func:`sim.files.records.identity` names them."""
        return {name: getattr(self, name) for name in ("robot", *_OF_IDENTITY)}

    def __len__(self) -> int:
        """Number of elites."""
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

    def scores(self) -> dict[str, Any]:
        """How good the archive is, as metrics have it."""
        names = ("reachable_coverage", "qd_score", "mean_fitness")
        return {"elites": len(self), **{name: getattr(self, name) for name in names}}

    @property
    def collided(self) -> NDArray[np.bool_]:
        """Whether any of the episodes that found an elite had a base collision, as the paper counts, shape (N,)."""
        return self.collision_rate > 0.0

    @property
    def failing(self) -> NDArray[np.bool_]:
        """Whether fresh episodes say that the controller fails an elite, shape (N,)."""
        return np.zeros(len(self), bool) if self.fresh is None else self.fresh.failing

    @property
    def confirmed(self) -> NDArray[np.bool_]:
        """Whether it fails an elite with contact resolved too, shape (N,)."""
        if self.faults is None:
            return np.zeros(len(self), bool)
        return self.failing & (goal_rates(self.faults.resolved_outcomes) < FAILING_GOAL_RATE)

    @property
    def certified(self) -> NDArray[np.bool_]:
        """Whether it fails an elite that another controller crosses, shape (N,)."""
        return np.zeros(len(self), bool) if self.faults is None else self.failing & self.faults.certificates().any(1)

    def has_elites_of(self, other: "Archive") -> bool:
        """Whether the elites and all that was found of them are another's too, in whatever order."""
        if len(self) != len(other):
            return False
        own, others = np.argsort(self.cell), np.argsort(other.cell)
        return all(np.array_equal(getattr(self, name)[own], getattr(other, name)[others]) for name in PER_ELITE)

    def rows(self, chosen: NDArray[np.int64]) -> "Archive":
        """The archive with some of its elites alone, in the order given."""
        fresh = None if self.fresh is None else self.fresh.rows(chosen)
        faults = None if self.faults is None else self.faults.rows(chosen)
        own = {name: getattr(self, name)[chosen] for name in PER_ELITE}
        return replace(self, fresh=fresh, faults=faults, **own)

    def corrected_by(self, fresh: FreshValues) -> "Archive":
        """The archive with what fresh episodes say, by descending corrected fitness, the invalid elites last."""
        return replace(self, fresh=fresh).rows(np.lexsort((-fresh.fitness, ~fresh.valid)))

    def with_faults_of(self, other: "Archive") -> "Archive":
        """The archive with the fault counts of another that has its elites, in whatever order; else as it is."""
        if other.faults is None or not self.has_elites_of(other):
            return self
        place = np.argsort(other.cell)[np.searchsorted(np.sort(other.cell), self.cell)]
        return replace(self, faults=other.faults.rows(place))


_OF_IDENTITY = ("robot_sha256", "policy_sha256", "penalty_definition")
_HASHES = (*_OF_IDENTITY, "space_sha256")  # which a file may lack
_SETTINGS = ("robot", "space", "penalties", "scales", "intervals", "collision_bit", "iterations", *_HASHES)
_PREFIX = "fresh_"
_CERTIFIERS = ("certifiers", "certifier_sha256")
_KINDS = {
    **dict.fromkeys(("robot", "space", "penalties", *_HASHES), "U"),
    **dict.fromkeys(_CERTIFIERS, "U"),
    **dict.fromkeys(("collision_bit", "reproduced", "confirmed", "certified"), "b"),
    **dict.fromkeys(COUNTS, "i"),
    **dict.fromkeys(("intervals", "iterations", "cell", "invalid_episodes", "episodes", "iteration"), "i"),
}
_BESIDE = ("fresh", "faults")
_MAX_ITEM_BYTES = 4096  # a name's; a damaged header may claim any
PER_ELITE = tuple(field.name for field in fields(Archive) if field.name not in (*_SETTINGS, *_BESIDE))
"""Names of the arrays that have one row an elite."""


def write_archive(path: Path, archive: Archive) -> None:
    """Writes an archive as a compressed npz; equal archives give equal bytes.

    Args:
        path: File to write, atomically.
        archive: What to write.
    """
    settings = {name: getattr(archive, name) for name in _SETTINGS}
    content: dict[str, Any] = {name: np.asarray(value) for name, value in settings.items() if value is not None}
    content |= _arrays(archive) | _fault_arrays(archive)
    write_atomically(path, npz_bytes(content))


def _arrays(archive: Archive) -> dict[str, NDArray[Any]]:
    """All that has one row an elite, by its name in the file."""
    arrays = {name: np.asarray(getattr(archive, name)) for name in PER_ELITE}
    if archive.fresh is None:
        return arrays
    return arrays | {_PREFIX + name: np.asarray(getattr(archive.fresh, name)) for name in FRESH}


_RATES = tuple(name.replace("_outcomes", ending) for name in COUNTS for ending in ("_goal_rate", "_goal_interval"))
_FAULT_NAMES = (*_CERTIFIERS, *COUNTS, *_RATES, "confirmed", "certified")
_KNOWN = {*_SETTINGS, *PER_ELITE, *(_PREFIX + name for name in FRESH), *_FAULT_NAMES}


def _fault_arrays(archive: Archive) -> dict[str, NDArray[Any]]:
    """Fault counts by their names in the file, and what follows from them; nothing where there are none."""
    faults = archive.faults
    if faults is None:
        return {}
    arrays: dict[str, NDArray[Any]] = {name: np.array(getattr(faults, name), dtype=np.str_) for name in _CERTIFIERS}
    for name in COUNTS:
        counts, what = getattr(faults, name), name.removesuffix("_outcomes")
        arrays |= {name: counts, f"{what}_goal_rate": goal_rates(counts)}
        arrays[f"{what}_goal_interval"] = _goal_intervals(counts)
    return arrays | {"confirmed": archive.confirmed, "certified": archive.certified}


def read_archive(path: str | Path) -> Archive:
    """Reads an archive; data only, nothing in the file can run.

    Args:
        path: ``archive.npz``, or the run directory that holds it.

    Returns:
        The archive.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If the file is damaged or no archive.
    """
    path = Path(path)
    file = path / ARCHIVE_FILE if os.path.isdir(path) else path
    if not os.path.isfile(file):  # False too for a name that no file can have
        raise FileNotFoundError(f"no archive at {file}: give a run directory or the {ARCHIVE_FILE} of one")
    try:
        there = set(array_names(file))
        if unknown := there - _KNOWN:  # a damaged name of an array that older archives lack
            raise ValueError(f"no archive has an array {', '.join(sorted(unknown))}")
        names = [name for name in (*_SETTINGS, *PER_ELITE) if name not in _HASHES or name in there]
        if any(name.startswith(_PREFIX) for name in there):  # then all of them, or it is damage
            names += [_PREFIX + name for name in FRESH]
        if not there.isdisjoint(_FAULT_NAMES):  # likewise
            names += _FAULT_NAMES
        content = read_arrays(file, names)
        _check_kinds(content)
        judged = {name: content.pop(name) for name in _FAULT_NAMES if name in content}
        fresh = {name.removeprefix(_PREFIX): content.pop(name) for name in list(content) if name.startswith(_PREFIX)}
        found = {name: _from_array(name, value) for name, value in content.items()}
        archive = Archive(**found, fresh=FreshValues(**fresh) if fresh else None)
        _check_shapes(archive)
        _check_values(archive)
        if judged:
            archive = _with_faults(archive, judged)
    except Exception as error:  # zip, zlib and npy headers answer damage with a dozen types
        raise ValueError(
            f"{file} must be the archive of a search, but it is damaged or another file: {error}: going on with its "
            "run (--resume) writes it again"
        ) from None
    return archive


def _from_array(name: str, value: NDArray) -> Any:
    """A field as the dataclass wants it: settings as Python values, arrays as they are."""
    if name not in _SETTINGS:
        return value
    return tuple(value.tolist()) if value.ndim else value.item()


def _check_kinds(content: dict[str, NDArray[Any]]) -> None:
    """That every field holds numbers, strings or flags as it should, and every setting one or a row of them."""
    for name, value in content.items():
        expected = _KINDS.get(name.removeprefix(_PREFIX), "f")
        if value.dtype.kind != expected or value.dtype.itemsize > _MAX_ITEM_BYTES:
            raise ValueError(f"{name} must be of kind '{expected}', got {value.dtype}")
        if name in _SETTINGS and value.ndim != int(name in ("penalties", "scales")):
            raise ValueError(f"{name} has shape {value.shape}")


def _check_shapes(archive: Archive) -> None:
    from sim.spaces.registry import get_space, is_own  # which imports Warp: not for `--help`

    num_elites, num_penalties = archive.fitness.size, len(archive.penalties)
    # How many genes a space of one's own has only its code says, and reading an archive runs none.
    num_genes = archive.genes.shape[-1] if is_own(archive.space) else get_space(archive.space).num_genes
    columns = {"genes": num_genes, "ratios": num_penalties}
    columns |= {"penalty_mean": num_penalties, "penalty_std": num_penalties}
    for name, array in _arrays(archive).items():
        column = columns.get(name.removeprefix(_PREFIX))
        expected = (num_elites,) if column is None else (num_elites, column)
        if array.shape != expected:
            raise ValueError(f"{name} must have shape {expected}, got {array.shape}")


def _check_values(archive: Archive) -> None:
    finite = all(np.isfinite(array).all() for array in _arrays(archive).values())
    if not finite or not (np.abs(archive.genes) <= 1.0).all():
        raise ValueError("it must hold finite numbers, and genes in [-1, 1]")
    if len(archive.scales) != len(archive.penalties) or not all(0.0 < scale < np.inf for scale in archive.scales):
        raise ValueError(f"scales must be one positive number a penalty, got {archive.scales}")
    num_cells = archive.cells.num_cells
    cells = [archive.cell] if archive.fresh is None else [archive.cell, archive.fresh.cell]
    if not all(((cell >= 0) & (cell < num_cells)).all() for cell in cells):
        raise ValueError(f"cell must lie in 0 to {num_cells - 1}")


def _with_faults(archive: Archive, judged: dict[str, NDArray[Any]]) -> Archive:
    """The archive with the fault counts of its file, whose other arrays must follow from them."""
    names = [tuple(judged[name].tolist()) for name in _CERTIFIERS]
    num_elites, num_certifiers = len(archive), len(names[0])
    if archive.fresh is None or len(names[1]) != num_certifiers:
        raise ValueError("faults need fresh episodes, and every certifier a hash")
    for name in COUNTS:
        expected = (num_elites, num_certifiers, 4) if name.startswith("certifier") else (num_elites, 4)
        if judged[name].shape != expected or (judged[name] < 0).any():
            raise ValueError(f"{name} must be counts of shape {expected}, got {judged[name].shape}")
    counts = {name: judged[name].astype(np.int64) for name in COUNTS}
    archive = replace(archive, faults=FaultCounts(certifiers=names[0], certifier_sha256=names[1], **counts))
    for name, value in _fault_arrays(archive).items():
        if not np.array_equal(judged[name], value, equal_nan=value.dtype.kind == "f"):
            raise ValueError(f"{name} must follow from the outcomes")
    return archive
