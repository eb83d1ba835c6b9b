"""Fixtures shared by the rooms: where to run, and the few simulations all tests use (each shape is built once)."""

import os

import numpy as np
import pytest
import torch

from sim.bank import TerrainBank
from sim.robots.robot import ROBOTS, get_robot
from sim.simulation import Simulation, resolve_device
from tests.sim.scenes import Stepper


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """One core for torch, as the search's workers have it: its threads spin for each other on a busy machine."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def device() -> str:
    """Warp device of this run: FAULTLINE_DEVICE, or the CPU."""
    return resolve_device(os.environ.get("FAULTLINE_DEVICE", "cpu"))


@pytest.fixture(scope="session")
def anymal():
    return get_robot("anymal")


@pytest.fixture(scope="session")
def cassie():
    return get_robot("cassie")


@pytest.fixture(scope="session", params=sorted(ROBOTS))
def robot(request):
    """Every robot in turn; ``tests.sim.scenes.ONLY_ANYMAL`` marks what is of one alone."""
    return get_robot(request.param)


@pytest.fixture(scope="session")
def eight(robot, device):
    """Eight robots, each on a grid of its own; a test puts ground and robots where it wants them."""
    bank = TerrainBank(8, device=device)
    return Simulation(robot, bank, np.arange(8))


@pytest.fixture(scope="session")
def eight_stepper(eight):
    """Steps the eight robots by four physics steps at a time."""
    return Stepper(eight)
