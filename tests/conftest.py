"""Fixtures shared by the rooms: where to run, and the few simulations all tests use (each shape is built once)."""

import os

import pytest

from sim.robot import get_robot
from sim.simulation import resolve_device


@pytest.fixture(scope="session")
def device() -> str:
    """Warp device of this run: FAULTLINE_DEVICE, or the CPU."""
    return resolve_device(os.environ.get("FAULTLINE_DEVICE", "cpu"))


@pytest.fixture(scope="session")
def anymal():
    return get_robot("anymal")
