"""Options and markers of all tests; :mod:`tests.fixtures` has what they share.

A test that takes the ``device`` fixture, by itself or through another fixture, has the marker ``gpu``: it runs on the
CPU, and on a GPU where FAULTLINE_DEVICE names one.
"""

import gc
import os
from pathlib import Path

import pytest

from sim.files.command import publish
from sim.files.provenance import provenance


def pytest_configure(config: pytest.Config) -> None:
    """Loads the fixtures, which takes seconds, where tests run or are listed: not in a process that hands them out."""
    if hasattr(config, "workerinput") or config.option.collectonly or not config.getoption("numprocesses", None):
        config.pluginmanager.import_plugin("tests.fixtures")


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--record", type=Path, metavar="FILE", help="write the numbers of tests and the device to FILE")


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Marks what runs on the device; in time for -m, which deselects afterwards."""
    for item in items:
        if "device" in getattr(item, "fixturenames", ()):
            item.add_marker(pytest.mark.gpu)


def pytest_collection_finish() -> None:
    """Collects garbage again, but for what tests are made of."""
    gc.freeze()
    gc.enable()


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    """Writes the numbers of tests and where they ran (--record)."""
    out = config.getoption("--record")
    if out is None:
        return
    outcomes = ("passed", "failed", "error", "skipped")
    counts = {name: len(terminalreporter.getreports(name)) for name in outcomes}
    counts["failed"] += counts.pop("error")
    device = os.environ.get("FAULTLINE_DEVICE", "cpu")
    publish(out, lambda: counts | provenance(device, 0), lambda report: None)
