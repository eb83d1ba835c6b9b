"""What tests of the page share."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from qd.show.view.viewed import ViewedRun
from tests.builders import small_archive


@pytest.fixture(scope="session")
def run(published):
    """The published archive of ANYmal."""
    return published / "anymal" / "archive"


@pytest.fixture
def show(anymal):
    """Twenty elites whose goal rate is their number / 20, and collision rate 1 where the number is odd."""
    numbers = np.arange(20)
    archive = dataclasses.replace(
        small_archive(20),
        goal_rate=numbers / 20,
        collision_rate=(numbers % 2).astype(float),
        fitness=10.0 - numbers,
        episodes=np.full(20, 20),
    )
    return ViewedRun(path=Path(), archive=archive, robot=anymal, controllers={})
