"""No figures of searches, and fixtures of the commands that work on a run."""

import tests.imports

# isort: split
import tests.toys  # noqa: F401  before anything reads the registries

# isort: split
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qd.faults.judge import judge
from qd.search.archive import read_archive, write_archive
from tests.qd.searches import run, without_figures
from tests.qd.stand_in import compute_by, open_stand_in


@pytest.fixture(autouse=True)
def undrawn(monkeypatch):
    without_figures(monkeypatch)


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """A run: ``found`` as its search ended, ``fresh`` with fresh episodes."""
    folder = tmp_path_factory.mktemp("made")
    with pytest.MonkeyPatch.context() as patch:
        without_figures(patch)
        run(folder / "found", iterations=6)
        shutil.copytree(folder / "found", folder / "fresh")
        judge(folder / "fresh", compute=compute_by(open_stand_in), stages=("fresh",))
    return folder


@pytest.fixture
def path(made, tmp_path):
    """A run with fresh episodes."""
    return Path(shutil.copytree(made / "fresh", tmp_path / "run"))


@pytest.fixture
def elites(path):
    """Numbers of two elites that fail for bump 4, which is .24 m high."""
    archive = read_archive(path)
    numbers = np.flatnonzero(archive.failing)[:2]
    genes = archive.genes.copy()
    genes[numbers, 4 * 8 : 5 * 8] = (0.0, 0.0, -0.5, 1.0, 1.0, 1.0, 0.0, 0.96)  # in the middle of the way, across it
    write_archive(path / "archive.npz", replace(archive, genes=genes))
    return numbers.tolist()
