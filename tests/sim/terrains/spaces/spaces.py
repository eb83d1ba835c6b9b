"""A terrain space of a user's own, as a file."""

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
