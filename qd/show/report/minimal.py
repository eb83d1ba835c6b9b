"""The page's chapter about minimal terrains, and what it reads: ``minimal.json`` and the genes in ``minimal.npz``."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from qd.archive import Archive
from qd.run.minimal_file import MINIMAL_FILE, NUMBERS_FILE, read_minimal
from qd.show.minimal_figure import draw_minimal
from qd.show.report.page import Block, absent, counted, paragraph, percent, picture, table
from sim.files.atomic import read_json
from sim.files.command import plain_command

if TYPE_CHECKING:
    from qd.show.report.material import Shown

_ENTRY = ("elite", "cell", "iteration", "bumps", "words", "of", "goal_rate", "goal_interval", "cause", "margin_m")
_ROWS = 12  # of a table that is not folded


@dataclass(frozen=True, kw_only=True)
class MinimalFound:
    """Minimal terrains of elites that are in the archive."""

    numbers: dict[str, Any]
    """As ``minimal.json`` has them."""
    genes: dict[int, NDArray[np.float32]]
    """By number of the elite, each of shape (num_genes,)."""


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
            f"{folder / MINIMAL_FILE} must hold the {counted(len(entries), 'minimal terrain')} of {NUMBERS_FILE}, got "
            f"{there}: let `faultline minimise` write both again"
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


def minimal_section(shown: "Shown") -> list[Block]:
    """How little of a terrain it takes to fail, with pictures."""
    material = shown.material
    found, robot, run = material.minimal, material.robot.spec, material.run
    if found is None:
        text = f"Left out: there is no {NUMBERS_FILE} of these elites. It is made by"
        if material.archive.fresh is None:
            return [absent(f"{text} faultline minimise, after", plain_command("reevaluate", robot=robot, run=run))]
        return [absent(text, plain_command("minimise", robot=robot, run=run))]
    entries = found.numbers["elites"]
    shows = "How many parts failures take, by the kind of the cause, and minimal terrains from above"
    drawn = draw_minimal(material.archive.robot, found.numbers, found.genes, material.space)
    return [paragraph(_told(entries)), picture("minimal", drawn, shows), _listed(entries)]


def _told(entries: list[dict[str, Any]]) -> str:
    sizes = [len(entry["bumps"]) for entry in entries]
    alone = sum(size == 1 for size in sizes)
    text = (
        f"Parts of {counted(len(entries), 'failing terrain')} were taken away as long as the controller still failed, "
        "in 20 episodes each, and what was left crossed 40 times. It takes "
        f"{counted(int(np.median(sizes)), 'part')} to fail (median), in {alone:,} of them a single one."
    )
    margins = [entry["margin_m"] for entry in entries if entry["margin_m"] is not None]
    if margins:
        text += (
            " The margin says how far the ground can move toward flat ground until the robot passes: "
            f"{100 * float(np.median(margins)):.1f} cm (median)."
        )
    return f"{text} The cause is the part without which most robots arrive."


def _listed(entries: list[dict[str, Any]]) -> str:
    head = ["elite", "goal", "95 % interval", "parts", "cause", "margin [cm]", "verdict", "what is left"]
    rows = [
        [
            f"{entry['elite']}",
            "-" if entry["goal_rate"] is None else percent(entry["goal_rate"]),
            "{:.0f} to {:.0f} %".format(*(100 * limit for limit in entry["goal_interval"])),
            f"{len(entry['bumps'])} of {entry['of']}",
            entry["cause"]["kind"] if entry["cause"] else "-",
            "-" if entry["margin_m"] is None else f"{100 * entry['margin_m']:.1f}",
            str(entry.get("verdict", "")),
            "; ".join(entry["words"]),
        ]
        for entry in entries
    ]
    folded = f"Show {counted(len(rows), 'minimal terrain')}" if len(rows) > _ROWS else ""
    return table(head, rows, words=True, folded=folded)
