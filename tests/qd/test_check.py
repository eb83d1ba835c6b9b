"""What `faultline check` says of robots and controllers."""

import json

import pytest

from qd.check import check_robot, ensure_ready
from qd.commands import CheckCommand
from qd.workers.compute import Compute
from sim.files.command import run_command
from sim.robots.find import get_robot, read_penalty_scales
from sim.terrains.spaces.registry import get_space, space_at
from tests.qd.robots import Robots
from tests.qd.stand_in import compute_by
from tests.sim.dogs import CONTROLLER, write_dog, write_toml


def test_the_command_prints_what_is_read_and_fails_where_something_must_be_mended(tmp_path, capsys):
    file = write_dog(tmp_path)
    file.write_text(file.read_text().replace("default_base_height=0.29", "default_base_height=0.2, nconmax=2"))
    assert run_command(CheckCommand, ["--robot", str(file), "--device", "cpu"], name="check") == 1
    text = capsys.readouterr().out
    assert "FL_hip" in text and "default_base_height" in text and "It stands" in text
    assert "nconmax = " in text and "Without a controller" in text


def test_a_controller_is_tried_before_anything_is_simulated(tmp_path, capsys):
    file = write_toml(tmp_path / "dog", "default_joint_pos = {'.*hip' = 0.6, '.*knee' = -1.2}\n")
    file.with_name("controller.toml").write_text('observation = [{term = "height"}]\n')
    assert run_command(CheckCommand, ["--robot", str(file), "--device", "cpu"], name="check") == 2
    text = capsys.readouterr()
    assert "height" in text.err and "stands" not in text.out


@pytest.mark.slow
def test_the_shipped_controller_walks_alike_in_both_simulators_and_gets_over_kerbs(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    assert check_robot(get_robot("anymal"), compute=Compute.resolve("cpu", "1", None))
    text = capsys.readouterr().out
    assert text.count("8 of 8 reach the goal") == 2 and "get over a kerb of " in text


@pytest.mark.slow
def test_a_controller_that_stands_still_does_not_walk(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    compute = Compute.resolve("cpu", "1", None)
    assert not check_robot(get_robot("anymal"), "tests.sim.policies:stand", compute=compute)
    text = capsys.readouterr().out
    assert text.count("0 of 8 reach the goal") == 2 and "It does not walk" in text and "kerb" not in text


def test_a_robot_toml_gets_scales_when_it_is_first_used_and_when_it_changes(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    pose = "default_joint_pos = {'.*hip' = 0.6, '.*knee' = -1.2}\n"
    file, policy = write_toml(tmp_path / "dog", f"{pose}nconmax = 2\n"), f"{tmp_path / 'trot.py'}:Trot"
    (tmp_path / "trot.py").write_text(CONTROLLER)
    robot = ensure_ready(get_robot(str(file)), policy, compute_by(Robots()))
    assert robot == get_robot(str(file)) and robot.nconmax > 2
    assert len(read_penalty_scales(robot)) == len(robot.penalties)
    assert ensure_ready(robot, policy, compute_by(Robots(stop_after=0))) is robot
    file.write_text(f"speed = 0.5\n{file.read_text()}")
    changed = ensure_ready(get_robot(str(file)), policy, compute_by(Robots()))
    assert len(read_penalty_scales(changed)) == len(robot.penalties) and changed.speed == 0.5
    assert capsys.readouterr().out.count("measured first") == 2
    scales = json.loads(robot.scales_file.read_text()) | {"space": "super_gaussian@0.06"}
    robot.scales_file.write_text(json.dumps(scales))
    asked = {"course@0.06": ("course", None), "course@0.1": ("course@0.1", None), "course@0.2": ("course", 0.2)}
    for expected, (name, height) in asked.items():
        assert space_at(get_space(name), height, robot).name == expected
