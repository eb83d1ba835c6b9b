"""Fixtures of the commands that work on a run."""

import shutil
from pathlib import Path

import pytest

from tests.qd.searches import found_and_fresh


@pytest.fixture(scope="session")
def made(tmp_path_factory):
    """A run, once with fresh episodes and once without."""
    return found_and_fresh(tmp_path_factory.mktemp("made"))


@pytest.fixture
def path(made, tmp_path):
    """A run with fresh episodes."""
    return Path(shutil.copytree(made / "fresh", tmp_path / "run"))
