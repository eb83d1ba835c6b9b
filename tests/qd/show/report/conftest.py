"""Fixtures of the report's tests."""

import pytest
from PIL import Image

from tests.qd.show.report.pages import make_run, reporter


@pytest.fixture
def run(tmp_path):
    return make_run(tmp_path)


@pytest.fixture
def reported(run, monkeypatch):
    """Makes reports whose figures are a dot, without close pictures: drawing takes most of the time."""
    monkeypatch.setenv("MUJOCO_GL", "nothing")
    monkeypatch.setattr("qd.show.report.page.as_image", lambda figure: Image.new("RGB", (1, 1)))
    return reporter(run, monkeypatch)
