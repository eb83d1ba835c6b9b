"""What tests of the page share; those of its widgets need viser."""

import dataclasses
from importlib.util import find_spec

import numpy as np
import pytest

from qd.show.view.listing import listing_of
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import small_archive

_NEED_VISER = ("test_app.py", "test_listing.py", "test_address.py", "test_browser.py", "test_show.py")
collect_ignore = [] if find_spec("viser") else list(_NEED_VISER)


@pytest.fixture(scope="session")
def run(published):
    """The published archive of ANYmal."""
    return published / "anymal" / "archive"


@pytest.fixture
def listing():
    """Twenty elites whose goal rate is their number / 20, and collision rate 1 where the number is odd."""
    numbers = np.arange(20)
    archive = dataclasses.replace(
        small_archive(20),
        goal_rate=numbers / 20,
        collision_rate=(numbers % 2).astype(float),
        fitness=10.0 - numbers,
        episodes=np.full(20, 20),
    )
    return listing_of(archive, SUPER_GAUSSIAN)
