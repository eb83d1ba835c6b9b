"""Minimal terrains as they are shown: ``minimal.json`` of a run, and the genes in ``minimal.npz``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.run.minimal_file import MINIMAL_FILE, NUMBERS_FILE, read_minimal
from sim.files.atomic import read_json
from sim.files.command import split_words
from sim.files.intervals import value_words

_ENTRY = ("elite", "cell", "iteration", "bumps", "words", "of", "goal_rate", "goal_interval", "cause", "margin_m")


@dataclass(frozen=True, kw_only=True)
class MinimalFound:
    """Minimal terrains of elites that are in the archive."""

    numbers: dict[str, Any]
    """As ``minimal.json`` has them."""
    genes: dict[int, NDArray[np.float32]]
    """By number of the elite, each of shape (num_genes,)."""

    def chosen(self, text: str, whose: object) -> list[int]:
        """Numbers of elites that have a minimal terrain, as a command line names them.

        Args:
            text: Numbers apart by spaces or commas, or ``all``.
            whose: Their run, for the message.

        Raises:
            ValueError: If it is something else, or one has none.
        """
        words = split_words([text])
        known = list(map(str, self.genes))
        words = known if words == ["all"] else words
        unknown = [word for word in words if word not in known]
        if unknown or not words:
            raise ValueError(
                f"{whose} has no minimal terrain of elite {', '.join(unknown) or repr(text)}: expected all, or some of "
                f"{', '.join(known)}"
            )
        return [int(word) for word in dict.fromkeys(words)]

    def entry(self, number: int) -> dict[str, Any]:
        """What ``minimal.json`` says of the minimal terrain of an elite."""
        return next(entry for entry in self.numbers["elites"] if entry["elite"] == number)

    def words(self, number: int) -> str:
        """What is known of the minimal terrain of an elite, in a sentence."""
        entry = self.entry(number)
        rate = value_words(entry["goal_rate"], entry["goal_interval"], ".0%")
        told = f"{len(entry['bumps'])} of {entry['of']} parts; goal reached {rate} when they were found"
        if entry["cause"]:
            told += f"; the cause is a {entry['cause']['kind']}"
        return told + (f"; margin {100 * entry['margin_m']:.1f} cm" if entry["margin_m"] is not None else "")


def read_minimal_numbers(folder: Path, archive: Archive) -> MinimalFound | None:
    """The minimal terrains of a run; None where nobody looked for them, or of none of the archive's elites.

    Args:
        folder: Of the run.
        archive: Its archive.

    Raises:
        ValueError: If a file is damaged, or the two are not of one another.
    """
    file = folder / NUMBERS_FILE
    if not file.exists():
        return None
    numbers, genes = read_json(file), read_minimal(folder, archive).genes
    entries = numbers.get("elites")
    if not isinstance(entries, list) or not all(set(_ENTRY) <= set(entry) for entry in entries):
        raise ValueError(f"{file} must hold minimal terrains, but it is damaged or another file: move it away")
    if len(entries) != (0 if genes is None else len(genes)):
        there = "no file" if genes is None else f"one of {len(genes)}"
        raise ValueError(
            f"{folder / MINIMAL_FILE} must hold the {len(entries)} minimal terrain{'s' * (len(entries) != 1)} of "
            f"{NUMBERS_FILE}, got {there}: let `faultline minimise` write both again"
        )
    own = [place for place, entry in enumerate(entries) if _is_in(archive, entry)]
    if not own or genes is None:
        return None
    kept = [entries[place] for place in own]
    return MinimalFound(
        numbers=numbers | {"elites": kept}, genes={entries[place]["elite"]: genes[place] for place in own}
    )


def _is_in(archive: Archive, entry: dict[str, Any]) -> bool:
    """Whether an elite is still the one of that number; a search that went on may have found others."""
    number = entry["elite"]
    there = 0 <= number < len(archive)
    return there and (archive.cell[number], archive.iteration[number]) == (entry["cell"], entry["iteration"])
