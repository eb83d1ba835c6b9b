"""Fixtures of the report's tests."""

import pytest

from tests.qd.show.report.pages import DOT, make_run, reporter


@pytest.fixture
def run(tmp_path):
    return make_run(tmp_path)


@pytest.fixture
def reported(run, monkeypatch):
    """Makes reports whose figures are a dot, without rendered pictures: drawing takes most of the time."""
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    monkeypatch.setattr("sim.files.figures._png_of", lambda figure: DOT)
    return reporter(run, monkeypatch)
