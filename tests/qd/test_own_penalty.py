"""The penalty of docs/own-robot.md, put where that page says: calibrated and searched by, with nothing else changed."""

import json
import os
import re
import subprocess
import sys

import pytest

from tests.docs import ROOT
from tests.sim.dogs import write_dog

ADDED = re.compile(r"```python\n(@_penalty\ndef (\w+)\(.*?)```", re.DOTALL)
LINKED = ("sim", "qd", "train", "faultline.py")


@pytest.fixture
def project(tmp_path):
    """The project with that function in its kernels; what else it is made of is the checkout's."""
    page = (ROOT / "docs" / "own-robot.md").read_text()
    (function, name), file = ADDED.findall(page)[0], tmp_path / "kernels" / "penalties.py"
    file.parent.mkdir()
    for there in (ROOT / "kernels").glob("*.*"):
        (file.parent / there.name).write_text(there.read_text())
    text = file.read_text()
    assert text.count("\nPENALTIES = ") == 1
    file.write_text(text.replace("\nPENALTIES = ", f"\n{function}\n\nPENALTIES = "))
    for there in LINKED:
        (tmp_path / there).symlink_to(ROOT / there)
    return tmp_path, name


@pytest.mark.slow  # the kernels are compiled anew
def test_an_added_penalty_is_one_function(project):
    folder, name = project
    dog = write_dog(folder / "mine")
    settings = dog.read_text()
    assert '"vel_y", "collision"' in settings
    dog.write_text(settings.replace('"vel_y", "collision"', f'"vel_y", "{name}"'))

    def run(*words):
        flags = ("--robot", str(dog), "--policy", f"{dog.parent}/dog_trot.py:Trot", "--device", "cpu", "--workers", "1")
        done = subprocess.run(
            [sys.executable, "-m", "faultline", *words, *flags],
            cwd=folder, env=os.environ | {"PYTHONPATH": str(folder)}, capture_output=True, text=True, timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr
        return done.stdout

    assert name in run("calibrate", "--terrains", "2", "--most-terrains", "2")
    assert list(json.loads(dog.with_suffix(".scales.json").read_text())["scales"]) == [
        "yaw_rate",
        "vel_x",
        "vel_y",
        name,
    ]
    size = ("--scheduler.emitters", "1", "--scheduler.batch-size", "4", "--replicas", "2", "--iterations", "1")
    run("archive", *size, "--run-dir", "run")
    config = json.loads((folder / "run" / "config.json").read_text())
    assert config["settings"]["fitness"]["penalties"][-1] == name
