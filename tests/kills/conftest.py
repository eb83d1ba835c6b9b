"""A folder for runs that are begun by the hundred."""

import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest


@pytest.fixture
def folder(tmp_path) -> Iterator[Path]:
    """An empty folder in memory where the system has one: every write waits for the disk, and here there are many."""
    if not Path("/dev/shm").is_dir():
        yield tmp_path
        return
    with tempfile.TemporaryDirectory(dir="/dev/shm", prefix="faultline-") as path:
        yield Path(path)
