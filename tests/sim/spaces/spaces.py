"""A terrain space of a user's own, as a file."""

import shutil
from pathlib import Path

from tests.docs import code_of

MORE = """
    sigma0 = 0.4

    def parts(self, genes):
        return ["ridges"]

    def without(self, genes, parts):
        genes[:, 0] = -1
        return genes
"""


def write_ridges(folder: Path, name: str = "space.py") -> str:
    """Writes the space of docs/terrains.md, with parts; returns what a command line calls it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(code_of("docs/terrains.md", "python")[1] + MORE)
    return f"{folder / name}:Ridges"


def move(spec: str, folder: Path) -> str:
    """Moves the file of a space into another folder; returns what a command line calls it there."""
    file, _, name = spec.rpartition(":")
    folder.mkdir(parents=True, exist_ok=True)
    return f"{shutil.move(file, folder)}:{name}"
