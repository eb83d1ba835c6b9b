"""A terrain space of a user's own, as a file."""

import shutil
from pathlib import Path

RIDGES = '''
import torch


class Ridges:
    """Ridges across the way: their height, how far apart they are, and how they are turned."""

    num_genes = 3
    sigma0 = 0.4

    def rasterise(self, genes, x, y):
        height, distance, turn = (genes[:, k, None, None] for k in range(3))
        along = (x - 8) * torch.cos(0.5 * turn) + (y - 4) * torch.sin(0.5 * turn)
        ridges = torch.cos(2 * torch.pi * along / (0.9 + 0.5 * distance)).clamp(min=0) ** 2
        return (0.15 + 0.15 * height) * ridges * ((x > 4) & (x < 12))

    def hard_random(self, count, rng):
        genes = rng.uniform(-1, 1, (count, 3))
        genes[:, 0] = 1
        return genes

    def describe(self, genes):
        return f"ridges of {0.15 + 0.15 * genes[0]:.2f} m"

    def parts(self, genes):
        return ["ridges"]

    def without(self, genes, parts):
        genes[:, 0] = -1
        return genes
'''


def write_ridges(folder: Path, name: str = "space.py") -> str:
    """Writes the space; returns what a command line calls it."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / name).write_text(RIDGES)
    return f"{folder / name}:Ridges"


def move(spec: str, folder: Path) -> str:
    """Moves the file of a space into another folder; returns what a command line calls it there."""
    file, _, name = spec.rpartition(":")
    folder.mkdir(parents=True, exist_ok=True)
    return f"{shutil.move(file, folder)}:{name}"
