"""The file of minimal terrains: their genes, and every crossing by which they were found, from which work goes on."""

from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.archive import COUNTS, OUTCOMES, Archive, FaultCounts
from qd.minimal import Case, How, Minimal, Trial
from sim.files.atomic import write_atomically
from sim.files.npz import array_names, npz_bytes, read_arrays

MINIMAL_FILE = "minimal.npz"
NUMBERS_FILE = "minimal.json"

_HOWS: dict[str, How] = {"exhaustive": "exhaustive", "greedy": "greedy"}
_FAULTS = tuple(one.name for one in fields(FaultCounts))
_TRIALS = ("trial_of", "trial_parts", "trial_scale", "trial_fresh", "trial_outcomes")
_ASKED = ("asked", "asked_cell", "asked_iteration", "asked_how", "asked_genes")


@dataclass(frozen=True, kw_only=True)
class Known:
    """What the file of a run holds about elites that are still in its archive."""

    hows: dict[int, How] = field(default_factory=dict)
    """How elites were taken apart, by their number."""
    counts: dict[int, dict[Trial, NDArray[np.int64]]] = field(default_factory=dict)
    """What was crossed of them."""
    genes: NDArray[np.float32] | None = None
    """Of the minimal terrains, shape (K, num_genes)."""
    faults: FaultCounts | None = None
    """How episodes of theirs ended under other conditions; None if there were none."""

    def faults_of(self, genes: NDArray[np.float32]) -> FaultCounts | None:
        """The counts of terrains that are among those of the file, zeros of others.

        Args:
            genes: Shape (N, num_genes).
        """
        if self.faults is None or self.genes is None:
            return None
        places = {row.tobytes(): place for place, row in enumerate(self.genes)}
        there = np.array([places.get(row.tobytes(), -1) for row in genes], dtype=np.int64)
        counts = {name: getattr(self.faults, name) for name in COUNTS}
        rows = {name: np.zeros((len(genes), *old.shape[1:]), np.int64) for name, old in counts.items()}
        for name, old in counts.items():
            rows[name][there >= 0] = old[there[there >= 0]]
        return replace(self.faults, **rows)


def write_minimal(
    path: Path,
    archive: Archive,
    cases: Mapping[int, Case],
    minima: Mapping[int, Minimal],
    judged: Archive,
    scaled: Mapping[int, NDArray[np.float32]],
) -> None:
    """Writes the file, atomically; equal content gives equal bytes.

    Args:
        path: The run directory.
        archive: Its elites.
        cases: Elites that are taken apart, by number.
        minima: Minimal terrains that are known, by number of the elite.
        judged: These as elites, in the order of their numbers.
        scaled: Their genes with the heights at the least scale that fails.
    """
    numbers = np.array(sorted(cases), dtype=np.int64)
    count = max((max((*case.parts, 0)) + 1 for case in cases.values()), default=0)
    trials = [
        (place, trial, case_counts)
        for place, number in enumerate(numbers.tolist())
        for trial, case_counts in sorted(cases[number].counts.items(), key=lambda one: one[0])
        if trial != Trial(cases[number].whole, fresh=True)  # the archive has it
    ]
    chosen = np.array([*minima], dtype=np.int64)
    content: dict[str, Any] = {
        "space": np.array(archive.space),
        "asked": numbers,
        "asked_cell": archive.cell[numbers],
        "asked_iteration": archive.iteration[numbers],
        "asked_how": np.array([cases[number].how for number in numbers.tolist()], dtype=np.str_),
        "asked_genes": archive.genes[numbers],
        "trial_of": np.array([place for place, _, _ in trials], np.int64),
        "trial_parts": _flags([trial.parts for _, trial, _ in trials], count),
        "trial_scale": np.array([trial.scale for _, trial, _ in trials], np.float64),
        "trial_fresh": np.array([trial.fresh for _, trial, _ in trials], bool),
        "trial_outcomes": np.array([row for _, _, row in trials], np.int64).reshape(len(trials), len(OUTCOMES)),
        "elite": chosen,
        "genes": judged.genes,
        "scaled_genes": np.array([scaled[number] for number in minima], np.float32).reshape(judged.genes.shape),
        "parts": _flags([one.parts for one in minima.values()], count),
        "scale": np.array([np.nan if one.scale is None else one.scale for one in minima.values()], np.float64),
    }
    if archive.space_sha256 is not None:
        content["space_sha256"] = np.array(archive.space_sha256)
    if judged.faults is not None:
        values = {name: getattr(judged.faults, name) for name in _FAULTS}
        content |= {name: np.array(v, np.str_) if isinstance(v, tuple) else v for name, v in values.items()}
    write_atomically(path / MINIMAL_FILE, npz_bytes(content))


def _flags(parts: list[tuple[int, ...]], count: int) -> NDArray[np.bool_]:
    """Which parts there are, shape (len(parts), count)."""
    return np.array([[part in some for part in range(count)] for some in parts], bool).reshape(len(parts), count)


def read_minimal(path: Path, archive: Archive) -> Known:
    """Reads the file of a run; data only, nothing in it can run.

    Args:
        path: The run directory.
        archive: Its elites; what the file holds of other elites, or of ones that do not fail, is left out.

    Raises:
        ValueError: If it is damaged.
    """
    file = path / MINIMAL_FILE
    if not file.exists():
        return Known()
    try:
        names = set(array_names(file))
        there = read_arrays(file, (*_ASKED, *_TRIALS, "genes"))
        faults = read_arrays(file, [name for name in _FAULTS if name in names])
        return _known(archive, there, faults)
    except Exception as error:  # a damaged zip archive can fail with anything
        raise ValueError(
            f"{file} must be minimal terrains, but it is damaged or another file: {error}: move it away, "
            "and it is made again"
        ) from None


def _known(archive: Archive, there: dict[str, NDArray[Any]], faults: dict[str, NDArray[Any]]) -> Known:
    names = zip(archive.iteration.tolist(), archive.cell.tolist(), strict=True)
    numbers = {name: number for number, name in enumerate(names)}
    hows: dict[int, How] = {}
    places: dict[int, int] = {}
    asked = zip(there["asked_iteration"].tolist(), there["asked_cell"].tolist(), strict=True)
    for place, (name, how) in enumerate(zip(asked, there["asked_how"].tolist(), strict=True)):
        number = numbers.get(name, -1)
        same = number >= 0 and np.array_equal(archive.genes[number], there["asked_genes"][place])
        if same and archive.failing[number]:
            hows[number], places[place] = _HOWS[how], number
    counts: dict[int, dict[Trial, NDArray[np.int64]]] = {number: {} for number in hows}
    for place, parts, scale, fresh, outcomes in zip(*(there[name] for name in _TRIALS), strict=True):
        if (number := places.get(int(place))) is not None:
            trial = Trial(tuple(np.flatnonzero(parts).tolist()), float(scale), bool(fresh))
            counts[number][trial] = outcomes.astype(np.int64)
    judged: dict[str, Any] = {n: tuple(v.tolist()) if v.dtype.kind == "U" else v for n, v in faults.items()}
    return Known(hows=hows, counts=counts, genes=there["genes"], faults=FaultCounts(**judged) if judged else None)
