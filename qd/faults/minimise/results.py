"""Minimal terrains of a run, as its files hold them."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.faults.numbers import TEMPLATES
from qd.search.archive import Archive
from sim.files.atomic import read_json
from sim.files.command import choose_elites
from sim.files.intervals import format_value
from sim.files.npz import read_arrays

MINIMAL_FILE = "minimal.npz"
NUMBERS_FILE = "minimal.json"

_ENTRY = ("elite", "cell", "iteration", "bumps", "words", "of", "goal_rate", "goal_interval", "cause", "margin_m")


@dataclass(frozen=True, kw_only=True)
class MinimalTerrains:
    """Minimal terrains of elites of an archive."""

    numbers: dict[str, Any]
    """The content of ``minimal.json``."""
    genes: dict[int, NDArray[np.float32]]
    """By number of the elite, each of shape (num_genes,)."""

    def choose(self, text: str, run: object) -> list[int]:
        """Numbers of elites of a run that have a minimal terrain, as a command line names them: some, or ``all``."""
        return choose_elites(text, [*self.genes], f"{run} has no minimal terrain of elite")

    def entry(self, number: int) -> dict[str, Any]:
        """The entry of an elite in ``minimal.json``."""
        return next(entry for entry in self.numbers["elites"] if entry["elite"] == number)

    def describe(self, number: int) -> str:
        """What is known of the minimal terrain of an elite, in a sentence."""
        entry = self.entry(number)
        rate = format_value(entry["goal_rate"], entry["goal_interval"], ".0%")
        return TEMPLATES.get_template("minimal.txt").render(entry=entry, rate=rate)


def read_minimal(folder: Path, archive: Archive) -> MinimalTerrains | None:
    """The minimal terrains in a run's folder that are of elites of the archive; None if there are none."""
    file = folder / NUMBERS_FILE
    if not file.exists():
        return None
    try:
        numbers = read_json(file)
        arrays = read_arrays(folder / MINIMAL_FILE, ("elite", "genes"))
        entries = numbers["elites"]
        genes = arrays["genes"]
        shape = (len(entries), archive.genes.shape[1])
        if [entry["elite"] for entry in entries] != arrays["elite"].tolist() or genes.shape != shape:
            raise ValueError(f"{NUMBERS_FILE} and {MINIMAL_FILE} are not of one another")
        if not all(set(_ENTRY) <= set(entry) for entry in entries):
            raise ValueError(f"expected {', '.join(_ENTRY)} of each")
    except Exception as error:  # a damaged zip archive can fail with anything
        files = f"{folder / NUMBERS_FILE} and {MINIMAL_FILE}"
        what = f"it lacks {error}" if isinstance(error, KeyError) else error
        raise ValueError(
            f"{files} must be minimal terrains of the archive beside them: {what}: remove both, or run `faultline "
            "minimise` again"
        ) from None
    # A search that went on may have found others of these numbers.
    names = list(zip(range(len(archive)), archive.cell.tolist(), archive.iteration.tolist(), strict=True))
    rows = [row for row, entry in enumerate(entries) if (entry["elite"], entry["cell"], entry["iteration"]) in names]
    if not rows:
        return None
    return MinimalTerrains(
        numbers=numbers | {"elites": [entries[row] for row in rows]},
        genes={entries[row]["elite"]: genes[row] for row in rows},
    )
