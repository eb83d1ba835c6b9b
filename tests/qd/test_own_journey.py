"""A robot, a controller, a terrain space and a penalty of a user's own, by the documented commands alone."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from qd.search.archive import read_archive
from sim.terrains.maps.heightmap import read_heightmap
from tests.docs import ROOT
from tests.sim.dogs import write_dog
from tests.sim.terrains.spaces.spaces import write_ridges

RUN_COMMANDS = """
import contextlib, io, json, sys
import faultline

from sim.robots.identity import robot_identity
from sim.robots.find import get_robot

if __name__ == "__main__":
    robot = get_robot("mine/dog.py")
    scales = {**robot_identity(robot), "scales": dict.fromkeys(robot.penalties, 1.0)}
    robot.scales_file.write_text(json.dumps(scales))
    for words in json.loads(sys.argv[1]):
        with contextlib.redirect_stderr(io.StringIO()) as errors:
            status = faultline.main([*words, "--device", "cpu"] if words[0] != "export" else words)
        print("ended " + json.dumps([status, errors.getvalue()]), flush=True)
"""
ROBOT, SPACE = ["--robot", "mine/dog.py"], ["--space", "mine/space.py:Ridges"]
POLICY = ["--policy", "mine/dog_trot.py:Trot"]
SIZE = ["--scheduler.emitters", "1", "--scheduler.batch-size", "2", "--replicas", "2", "--iterations", "2"]


@pytest.fixture
def project(tmp_path):
    """The project with the penalty of docs/robots.md in its kernels, and a folder of the user's; its name."""
    page = (ROOT / "docs" / "robots.md").read_text()
    function, name = re.findall(r"```python\n(@penalty\(\s+\"(\w+)\".*?)```", page, re.DOTALL)[0]
    (tmp_path / "kernels").mkdir()
    for source in (ROOT / "kernels").glob("*.*"):
        (tmp_path / "kernels" / source.name).write_text(source.read_text())
    for source in ("sim", "qd", "train", "faultline.py"):
        (tmp_path / source).symlink_to(ROOT / source)
    penalties = tmp_path / "kernels" / "penalties.py"
    penalties.write_text(penalties.read_text().replace("\n@cache\n", f"\n{function}\n\n@cache\n"))
    dog = write_dog(tmp_path / "mine")
    dog.write_text(dog.read_text().replace('"vel_y", "collision"', f'"vel_y", "{name}"'))
    write_ridges(tmp_path / "mine")
    return tmp_path, name


def run_commands(folder: Path, *commands: list[str]) -> list[tuple[int, str]]:
    """Status of each command and what it wrote to stderr; all in one process, since Python alone takes seconds."""
    environment = os.environ | {"PYTHONPATH": str(folder), "MPLBACKEND": "agg"}
    done = subprocess.run(
        [sys.executable, "-c", RUN_COMMANDS, json.dumps(commands)],
        cwd=folder, env=environment, capture_output=True, text=True, timeout=500,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return [tuple(json.loads(line[6:])) for line in done.stdout.splitlines() if line.startswith("ended ")]


@pytest.mark.slow  # the kernels are compiled anew
def test_what_is_a_users_own_is_searched_replayed_evaluated_and_exported(project):
    folder, penalty = project
    ended = run_commands(
        folder,
        ["archive", *ROBOT, *POLICY, *SPACE, *SIZE, "--run-dir", "run", "--workers", "1"],
        ["replay", *ROBOT, *POLICY, *SPACE, "--run", "run", "--replicas", "1"],
        ["evaluate", *ROBOT, *SPACE, "--policies", "mine=mine/dog_trot.py:Trot", "--sets", "hard_random",
         "--terrains", "1", "--episodes", "1", "--workers", "1", "--out", "tables.json"],
        ["export", *ROBOT, *SPACE, "--run", "run", "--elite", "0", "--formats", "npz"],
    )  # fmt: skip
    assert [(status, errors[-300:]) for status, errors in ended if status] == []
    archive = read_archive(folder / "run")
    assert (archive.robot, archive.penalties, archive.iterations) == ("dog", ("yaw_rate", "vel_x", "vel_y", penalty), 2)
    assert archive.space == SPACE[1] and archive.genes.shape == (len(archive), 3) and len(archive) >= 1
    assert np.isfinite(archive.fitness).all()
    assert len([*(folder / "run").glob("elite-*.png")]) == 1  # the worst
    tables = json.loads((folder / "tables.json").read_text())
    assert (tables["robot"], [*tables["controllers"]]) == ("dog", ["mine"])
    heights = read_heightmap(folder / "run/terrains/elite-0.npz").heights
    assert 0.0 < np.ptp(heights) < 0.301  # ridges of at most 0.3 m
