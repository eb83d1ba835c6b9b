"""Folders for runs that are begun by the hundred."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

_MEMORY = Path("/dev/shm")


@pytest.fixture
def folder(tmp_path) -> Iterator[Path]:
    """An empty folder in memory where the system has one: every write waits for the disk, and here there are many."""
    if not _MEMORY.is_dir():
        yield tmp_path
        return
    with tempfile.TemporaryDirectory(dir=_MEMORY, prefix="faultline-") as path:
        yield Path(path)
