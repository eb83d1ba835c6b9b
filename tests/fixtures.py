"""Fixtures shared by the rooms: where to run, and the few simulations all tests use (each shape is built once)."""

import tests.imports

# isort: split
import tests.toys  # noqa: F401  before anything reads the registries

# isort: split
import multiprocessing
import os
import shutil
from collections.abc import Iterator
from multiprocessing import forkserver
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
import warp as wp

from qd.search import loop
from qd.workers import crosser, process
from sim.device import resolve_device
from sim.recording.renderer import open_context
from sim.robots.find import get_robot
from sim.robots.robot import ROBOTS
from sim.simulation import Simulation
from sim.terrains.bank import TerrainBank

DEVICE = os.environ.get("FAULTLINE_DEVICE", "cpu")
WORKERS = ("sim.simulation", "sim.rollout", "qd.workers.crosser")
"""What worker processes load."""


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call() -> Iterator[None]:
    """Skips what also needs Warp on the CPU where Warp has no compiler for it, as on a host with a GPU's part alone."""
    try:
        return (yield)
    except AttributeError as error:
        if wp.is_cpu_available() or "wp_compile_cpp" not in str(error):
            raise
        pytest.skip("Warp has no compiler for the CPU here")


@pytest.fixture(scope="session", autouse=True)
def one_thread():
    """One core for torch, as the search's workers have it: its threads spin for each other on a busy machine."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session", autouse=True)
def forked_workers():
    """On the CPU worker processes are forks of one that has loaded Newton, which takes most of their start."""
    with pytest.MonkeyPatch.context() as patch:
        if DEVICE == "cpu":
            patch.setattr(process, "CONTEXT", fork_from(*WORKERS))
        yield


@pytest.fixture(scope="module")
def nursery(forked_workers):
    """Processes are forks of one that has searched before (tests.kills.nursery)."""
    fork_from("tests.kills.nursery")
    yield
    fork_from(*WORKERS)


def fork_from(*modules: str) -> Any:
    """A context whose processes are forks of a new server, which loads some modules first."""
    context = multiprocessing.get_context("forkserver")
    forkserver._forkserver._stop()
    context.set_forkserver_preload(["tests.imports", *modules])
    return context


@pytest.fixture(scope="session", autouse=True)
def stand_ins():
    """Pipelines of a compute that has an opener of its own (tests.qd.stand_in.compute_by) are opened by it."""
    real = crosser.open_pipeline

    def open_pipeline(cfg, **kwargs):
        opener = getattr(cfg.compute, "opener", None)
        return opener(cfg) if opener else real(cfg, **kwargs)

    with pytest.MonkeyPatch.context() as patch:
        for module in (crosser, loop):
            patch.setattr(module, "open_pipeline", open_pipeline)
        yield


@pytest.fixture(scope="session")
def device() -> str:
    """Warp device of this run: FAULTLINE_DEVICE, or the CPU."""
    return resolve_device(DEVICE)


@pytest.fixture(scope="session")
def opengl() -> None:
    """Skips what needs pictures where there is no OpenGL."""
    try:
        open_context(16, 16).free()
    except ValueError as error:
        pytest.skip(str(error))


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
def published(tmp_path_factory) -> Path:
    """A results/ folder with the published archives."""
    results = tmp_path_factory.mktemp("published") / "results"
    shipped = Path(__file__).resolve().parents[1] / "results"
    for name in ROBOTS:
        shutil.copytree(shipped / name / "archive", results / name / "archive")
    return results


@pytest.fixture(scope="session")
def eight(robot, device):
    """Eight robots, each on a grid of its own; a test puts ground and robots where it wants them."""
    return Simulation(robot, TerrainBank(8, device=device), np.arange(8))
