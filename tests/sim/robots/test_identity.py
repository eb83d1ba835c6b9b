"""Records name the robot and the controller that they are of."""

import dataclasses
import hashlib
from pathlib import Path

import pytest

from sim.controllers.spec import controller_identity
from sim.robots.robot import check_robot_identity, robot_digest
from sim.robots.training import TrainingCfg


def test_records_name_robot_and_controller_by_hash(anymal, tmp_path):
    record = controller_identity(anymal, anymal.policy_file)
    assert record["robot"] == "anymal" and record["policy"] == "anymal.pt"
    assert record["robot_sha256"] == robot_digest(anymal)
    assert record["policy_sha256"] == hashlib.sha256(anymal.policy_file.read_bytes()).hexdigest()
    check_robot_identity(record, anymal, Path("a.json"), "make it anew")
    for key in ("robot_sha256", "penalty_definition"):
        for changed in (record | {key: "other"}, {name: value for name, value in record.items() if name != key}):
            with pytest.raises(ValueError, match=r"a\.json"):
                check_robot_identity(changed, anymal, Path("a.json"), "make it anew")


def test_a_robots_hash_follows_its_settings_but_those_of_training(anymal):
    digest = robot_digest(anymal)
    assert robot_digest(dataclasses.replace(anymal, max_speed=99.0)) != digest
    assert robot_digest(dataclasses.replace(anymal, training=TrainingCfg(push_speed=9.0))) == digest
