"""A robot, a controller and a terrain space of a user's own, by the documented commands alone."""

import json

import numpy as np
import pytest

import faultline
from qd.search.archive import read_archive
from sim.files.atomic import to_json
from sim.robots.find import get_robot
from sim.robots.robot import robot_identity
from sim.terrains.maps.heightmap import read_heightmap
from tests.sim.dogs import write_dog
from tests.sim.terrains.spaces.spaces import write_ridges

ROBOT, SPACE = ["--robot", "mine/dog.py"], ["--space", "mine/space.py:Ridges"]
POLICY = ["--policy", "mine/dog_trot.py:Trot"]
SIZE = ["--scheduler.emitters", "1", "--scheduler.batch-size", "2", "--replicas", "2", "--iterations", "2"]
SIZE += ["--skip-level-ground"]
TABLES = ["--policies", "mine=mine/dog_trot.py:Trot", "--sets", "hard_random", "--terrains", "1", "--episodes", "1"]
COMMANDS = [
    ["archive", *ROBOT, *POLICY, *SPACE, *SIZE, "--run-dir", "run", "--workers", "1", "--device", "cpu"],
    ["replay", *ROBOT, *POLICY, *SPACE, "--run", "run", "--replicas", "1", "--device", "cpu"],
    ["evaluate", *ROBOT, *SPACE, *TABLES, "--workers", "1", "--out", "tables.json", "--device", "cpu"],
    ["export", *ROBOT, *SPACE, "--run", "run", "--elite", "0", "--formats", "npz"],
]


@pytest.mark.slow  # the kernels are compiled for the robot
def test_what_is_a_users_own_is_searched_replayed_evaluated_and_exported(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    robot = get_robot(str(write_dog(tmp_path / "mine")))
    write_ridges(tmp_path / "mine")
    scales = dict.fromkeys(robot.penalties, 1.0)
    robot.scales_file.write_bytes(to_json({**robot_identity(robot), "scales": scales}))
    for words in COMMANDS:
        assert faultline.main(words) == 0, words[0]
    archive = read_archive(tmp_path / "run")
    assert (archive.robot, archive.penalties, archive.iterations) == ("dog", robot.penalties, 2)
    assert archive.space == SPACE[1] and archive.genes.shape == (len(archive), 3) and len(archive) >= 1
    assert np.isfinite(archive.fitness).all()
    assert len([*(tmp_path / "run").glob("elite-*.png")]) == 1  # the worst
    tables = json.loads((tmp_path / "tables.json").read_text())
    assert (tables["robot"], [*tables["controllers"]]) == ("dog", ["mine"])
    heights = read_heightmap(tmp_path / "run/terrains/elite-0.npz").heights
    assert 0.0 < np.ptp(heights) < 0.301  # ridges of at most 0.3 m
