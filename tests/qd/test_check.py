"""What `faultline check` says of robots and controllers; penalty scales from episodes by hand."""

import json
from dataclasses import replace

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.check import calibrate, check_robot, ensure_ready, find_fitting_height, measure_scales
from qd.commands import CheckCommand
from qd.workers.compute import Compute
from sim.controllers.spec import controller_identity
from sim.files.command import run_command
from sim.robots.find import get_robot, read_penalty_scales
from sim.robots.robot import RobotCfg
from sim.terrains.spaces.registry import get_space, space_at
from sim.terrains.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.qd import stand_in
from tests.qd.robots import Robots
from tests.qd.stand_in import compute_by, make_result
from tests.sim.dogs import CONTROLLER, write_dog, write_toml

ROBOT = get_robot("anymal")


@pytest.mark.slow
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
@pytest.mark.parametrize(
    ("policy", "goals", "text"), [(None, 20, "kerb of "), ("tests.sim.policies:stand", 0, "not walk")]
)
def test_both_simulators_agree_whether_a_controller_walks(tmp_path, monkeypatch, capsys, policy, goals, text):
    monkeypatch.chdir(tmp_path)
    walks = check_robot(get_robot("anymal"), policy, compute=Compute.resolve("cpu", "1", None))
    output = capsys.readouterr().out
    assert output.count(f"{goals} of 20 reach the goal") == 2 and text in output
    assert walks == ("kerb" in output) == (goals == 20)


@pytest.mark.slow
def test_a_robot_toml_gets_scales_when_it_is_first_used_and_when_it_changes(monkeypatch, tmp_path, capsys):
    monkeypatch.chdir(tmp_path)
    pose = "default_joint_pos = {'.*hip' = 0.6, '.*knee' = -1.2}\n"
    file, policy = write_toml(tmp_path / "dog", f"{pose}nconmax = 2\n"), f"{tmp_path / 'trot.py'}:Trot"
    (tmp_path / "trot.py").write_text(CONTROLLER)
    robot = ensure_ready(get_robot(str(file)), policy, compute_by(Robots()))
    assert robot == get_robot(str(file)) and robot.nconmax > 2
    assert robot.max_duration_s == 21.5  # 12 m at 0.7 m/s are 17.14 s, times 1.25, rounded up
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


def test_scales_are_means_over_failing_episodes_or_over_all_if_under_200_fail():
    # 100 episodes fail with 1, 4 and 100 with 3, 0: means 2 and 2. That 300 reach the goal with 9, 8 changes nothing.
    rows = [[1, 4]] * 100 + [[3, 0]] * 100 + [[9, 8]] * 300
    numbers = measure_scales(make_result([rows], late=[[True] * 200 + [False] * 300]))
    assert numbers["scales"] == {"yaw_rate": 2.0, "vel_x": 2.0} and numbers["scaled_by"] == "failing"
    assert numbers["share_of_episodes_with"] == {"yaw_rate": 1.0, "vel_x": 0.5}
    # One of the 200 is invalid: 199 of 1, 4 fail, 199 reach the goal with 3, 8. Means (1 + 3) / 2 and (4 + 8) / 2.
    rows = [[1, 4]] * 199 + [[np.nan, np.nan]] + [[3, 8]] * 199
    invalid = [False] * 199 + [True] + [False] * 199
    numbers = measure_scales(make_result([rows], late=[[True] * 200 + [False] * 199], invalid=[invalid]))
    assert numbers["scales"] == {"yaw_rate": 2.0, "vel_x": 6.0} and numbers["scaled_by"] == "all"
    assert (numbers["episodes"], numbers["invalid_episodes"], numbers["failing_episodes"]) == (399, 1, 199)


def robots(change=lambda result: result, **kwargs):
    """The stand-in, whose result is changed."""
    return Robots(lambda cfg, genes, seeds: change(stand_in.evaluate(genes, seeds, cfg.replicas)), **kwargs)


def failing(share):
    """Changes a result so that a share of each terrain's episodes misses the goal."""

    def change(result):
        late = np.arange(result.invalid.shape[1]) < share * result.invalid.shape[1]
        outcome = np.where(late, Outcome.TIME_OUT, Outcome.GOAL).astype(np.uint8)
        return replace(result, outcome=np.broadcast_to(outcome, result.invalid.shape).copy())

    return change


@pytest.fixture
def scales(tmp_path, monkeypatch):
    """File of the robot's scales."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(RobotCfg, "scales_file", tmp_path / "scales.json")
    return tmp_path / "scales.json"


def calibrated(opened, terrains, replicas=20):
    return calibrate(ROBOT, str(ROBOT.policy_file), compute=compute_by(opened), terrains=terrains, replicas=replicas)


def test_the_file_is_what_the_robot_reads(scales):
    calibrated(robots(), 12, replicas=4)
    content = json.loads(scales.read_text())
    assert read_penalty_scales(ROBOT) == tuple(content["scales"].values())
    assert (content["terrains"], content["episodes"], content["invalid_episodes"], content["seed"]) == (60, 240, 0, 0)
    assert controller_identity(ROBOT, ROBOT.policy_file).items() <= content.items()
    assert (content["space"], content["crossing"]["speed"]) == ("super_gaussian", 0.75)


def test_terrains_are_added_until_200_episodes_failed_and_a_stop_loses_nothing(scales):
    # 8 terrains x 20 episodes, of which a quarter fails: 40 after 8 terrains, 200 after 40.
    stopped, rest = (robots(failing(0.25), stop_after=count) for count in (20, None))
    with pytest.raises(KeyboardInterrupt):
        calibrated(stopped, 8)
    content = calibrated(rest, 8)
    assert len(stopped.seeds) + len(rest.seeds) == content["terrains"] == 40 and rest.seeds
    assert (content["failing_episodes"], content["scaled_by"]) == (200, "failing")
    genes = SUPER_GAUSSIAN.hard_random(40, 0)
    whole = failing(0.25)(stand_in.evaluate(genes, np.random.SeedSequence(0).generate_state(40, np.uint32), 20))
    np.testing.assert_array_equal(list(content["scales"].values()), whole.penalties[~whole.reached_goal].mean(axis=0))


def test_a_penalty_that_never_occurs_is_refused_once_all_scales_are_written(scales):
    without = robots(lambda result: replace(result, penalties=result.penalties * (np.arange(6) > 0)))
    with pytest.raises(ValueError, match="yaw_rate"):
        calibrated(without, 20)
    assert list(json.loads(scales.read_text())["scales"]) == list(stand_in.PENALTIES[1:])


@pytest.mark.parametrize(("crossed_up_to", "expected"), [(0.30, 0.25), (0.11, 0.1), (0.04, 0.04), (0.001, 0.02)])
def test_terrain_is_as_high_as_the_controller_crosses_it_mostly(crossed_up_to, expected):
    heights = []

    class Crosses:
        def cross(self, policy, terrains, *, replicas, label, room):
            heights.append(0.25 * np.abs(terrains.genes[:, 7]).max())  # of the first bump
            result = stand_in.evaluate(terrains.genes, terrains.seeds, replicas)
            return failing(0.0 if heights[-1] <= crossed_up_to + 1e-6 else 0.5)(result)

    height, share = find_fitting_height(Crosses(), "policy.pt")
    assert height == expected and (share >= 0.8) == (height <= crossed_up_to)
    assert heights[0] == 0.25 and len(heights) <= 5
