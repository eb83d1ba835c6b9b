"""A robot or a definition of the penalties that is another now: readers refuse what was made with it before."""

import dataclasses
import json

import pytest

from sim.files.records import identity, robot_digest, robot_identity
from sim.policy.loaders import load_policy
from sim.robots.find import get_robot, read_penalty_scales, robot_of
from sim.robots.shipped import ROBOTS
from tests.builders import rsl_rl_actor, save_checkpoint
from tests.sim.dogs import write_dog


@pytest.fixture
def dog(tmp_path):
    """The dog's settings, and beside them its scales."""
    file = write_dog(tmp_path)
    robot = get_robot(str(file))
    robot.scales_file.write_text(json.dumps({**robot_identity(robot), "scales": dict.fromkeys(robot.penalties, 1.0)}))
    return file


def readers(file):
    """What reads a record of the robot."""
    robot = get_robot(str(file))
    record = {"robot": "dog"} | json.loads(robot.scales_file.read_text())
    return lambda: read_penalty_scales(robot), lambda: robot_of(record, str(file), file.parent)


def test_what_was_made_with_the_robot_before_it_changed_is_refused(dog):
    for read in readers(dog):
        read()
    was = robot_digest(get_robot(str(dog)))
    dog.write_text(dog.read_text().replace("contact_force_limit=150.0", "contact_force_limit=15.0"))
    assert robot_digest(get_robot(str(dog))) != was
    for read in readers(dog):
        with pytest.raises(ValueError, match=was[:12]):
            read()


def test_a_controller_trained_with_the_robot_before_is_told_so(dog, capsys):
    robot = get_robot(str(dog))
    policy = save_checkpoint(dog.parent / "a1.pt", rsl_rl_actor(12 + 24 + 15, 8).state_dict())
    policy.with_suffix(".train.json").write_text(json.dumps({"settings": {"robot_sha256": robot_digest(robot)}}))
    load_policy(policy, dataclasses.replace(robot, physics_dt=0.001, decimation=20), "cpu")  # finer, not another
    assert "warning" not in capsys.readouterr().err
    dog.write_text(dog.read_text().replace("contact_force_limit=150.0", "contact_force_limit=15.0"))
    changed = get_robot(str(dog))
    load_policy(policy, changed, "cpu")
    load_policy(policy, changed, "cpu")
    assert capsys.readouterr().err.count("warning") == 1


@pytest.mark.parametrize("name", ROBOTS)
def test_the_shipped_scales_are_of_the_shipped_robot_and_controller(name):
    """If this fails, a shipped file has changed: its scales must be measured again."""
    robot = ROBOTS[name]
    content = json.loads(robot.scales_file.read_text())
    assert identity(robot, robot.policy_file).items() <= content.items()
