"""A robot or a definition of the penalties that is another now: readers refuse what was made with it before."""

import dataclasses
import json

import pytest

from sim.controllers.loaders import load_policy
from sim.controllers.spec import controller_identity
from sim.robots.find import get_robot, resolve_robot
from sim.robots.robot import robot_digest, robot_identity
from sim.robots.shipped import ROBOTS
from tests.builders import rsl_rl_actor, save_checkpoint
from tests.sim.dogs import write_dog


def test_a_changed_robot_is_warned_of_by_its_controller_and_refused_by_its_records(tmp_path, capsys):
    dog = write_dog(tmp_path)
    robot = get_robot(str(dog))
    record = {"robot": "dog", **robot_identity(robot)}
    assert resolve_robot(record, str(dog), tmp_path) == robot
    policy = save_checkpoint(dog.parent / "a1.pt", rsl_rl_actor(12 + 24 + 15, 8).state_dict())
    policy.with_suffix(".train.json").write_text(json.dumps({"settings": {"robot_sha256": robot_digest(robot)}}))
    load_policy(policy, dataclasses.replace(robot, physics_dt=0.001, decimation=20), "cpu")  # finer, not another
    assert "warning" not in capsys.readouterr().err
    dog.write_text(dog.read_text().replace("contact_force_limit=150.0", "contact_force_limit=15.0"))
    changed = get_robot(str(dog))
    with pytest.raises(ValueError, match=record["robot_sha256"][:12]):
        resolve_robot(record, str(dog), tmp_path)
    load_policy(policy, changed, "cpu")
    load_policy(policy, changed, "cpu")
    assert capsys.readouterr().err.count("warning") == 1


@pytest.mark.parametrize("name", ROBOTS)
def test_the_shipped_scales_are_of_the_shipped_robot_and_controller(name):
    """If this fails, a shipped file has changed: its scales must be measured again."""
    robot = ROBOTS[name]
    content = json.loads(robot.scales_file.read_text())
    assert controller_identity(robot, robot.policy_file).items() <= content.items()
