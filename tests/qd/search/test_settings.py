import dataclasses
import json
from pathlib import Path

import pytest

from qd.search import settings as module
from qd.search.fitness import FitnessCfg
from qd.search.presets import SchedulerCfg
from qd.search.settings import as_settings, differences, find_policy, from_settings, is_searched, preset
from sim.controllers.spec import controller_hash
from sim.robots.robot import RobotCfg, robot_digest
from sim.robots.shipped import ROBOTS
from tests.qd import stand_in


@pytest.fixture(autouse=True)
def of_made_up_scales(monkeypatch):
    monkeypatch.setattr(module, "read_penalty_scales", lambda robot, policy=None: stand_in.SCALES)


def robot(policy_file: Path = ROBOTS["anymal"].policy_file):
    """ANYmal with another controller."""
    kind = type("Robot", (RobotCfg,), {"policy_file": policy_file})
    return kind(**{field.name: getattr(ROBOTS["anymal"], field.name) for field in dataclasses.fields(RobotCfg)})


def test_paper_has_the_papers_numbers():
    cfg = preset("paper", robot())
    assert (cfg.scheduler.emitters, cfg.scheduler.batch_size, cfg.replicas, cfg.iterations) == (10, 20, 20, 1000)
    wide = preset("wide", robot())  # as many episodes
    assert cfg.episodes_per_iteration == 4000
    assert wide.episodes_per_iteration * wide.iterations == 4000 * 1000
    assert (cfg.fitness.alpha, cfg.fitness.lam, cfg.intervals) == (1.0, 2.0, 10)


@pytest.mark.parametrize(
    ("name", "value"), [("method", "ppo"), ("method", "cma_me+cma_me"), ("disagree_share", 0.9), ("sigma0", 1e30)]
)
def test_values_of_the_scheduler_out_of_range_are_named(name, value):  # the square of 1e30 is no float32
    with pytest.raises(ValueError, match=name):
        SchedulerCfg(**{name: value})


def test_iterations_that_settle_need_terrains_to_cross_again_and_others_before_them():
    with pytest.raises(ValueError, match="again"):
        SchedulerCfg(settling=2)
    cfg = dataclasses.replace(preset("small", robot()), scheduler=SchedulerCfg(again=2, settling=2))
    with pytest.raises(ValueError, match="settling"):
        dataclasses.replace(cfg, iterations=2)
    with pytest.raises(ValueError, match="replicas"):
        dataclasses.replace(cfg, replicas=10**9)


def test_settings_survive_json_and_those_of_something_else_are_refused_by_name():
    cfg = preset("small", robot())
    cfg = dataclasses.replace(cfg, scheduler=dataclasses.replace(cfg.scheduler, learning_rate=0.01, sigma0=0.5))
    assert from_settings(json.loads(json.dumps(as_settings(cfg))), 7) == dataclasses.replace(cfg, iterations=7)
    assert "iterations" not in as_settings(cfg)
    with pytest.raises(ValueError, match="certified_by"):
        from_settings(as_settings(cfg) | {"certified_by": []}, 1)


def test_differences_name_every_key():
    stored = {"seed": 0, "scheduler": {"sigma0": 0.5, "method": "cma_mae"}, "old": 1, "same": [1, 2]}
    settings = {"seed": 0, "scheduler": {"sigma0": 0.2, "method": "cma_mae"}, "new": "x", "same": [1, 2]}
    assert [line.split(" ")[0] for line in differences(stored, settings)] == ["new", "old", "scheduler.sigma0"]
    assert differences(stored, stored) == []


def test_robot_and_controller_are_part_of_the_settings(tmp_path):
    shipped, other = tmp_path / "anymal.pt", tmp_path / "other.pt"
    shipped.write_bytes(b"a")
    other.write_bytes(b"b")
    body = robot(shipped)
    cfg, same, changed, code = (preset("paper", body, p) for p in (None, "shipped", str(other), "module:callable"))
    assert cfg == same and cfg.policy_sha256 == controller_hash(shipped) and cfg.robot_sha256 == robot_digest(body)
    assert changed.policy_sha256 == controller_hash(other) and code.policy_sha256 is None
    assert is_searched(cfg, str(shipped), body) and not is_searched(cfg, str(other), body)
    assert is_searched(code, "module:callable", body) and not is_searched(code, "module:other", body)
    assert find_policy(tmp_path, cfg, body) == str(shipped)
    shipped.write_bytes(b"c")
    with pytest.raises(ValueError, match="policy"):
        find_policy(tmp_path, cfg, body)


@pytest.mark.parametrize("names", [("vel_x", "torque"), ("vel_x",)])  # unknown; a single ratio is always 1
def test_penalties_that_cannot_count_are_refused(names):
    with pytest.raises(ValueError, match="penalties"):
        FitnessCfg(penalties=stand_in.PENALTIES, scales=stand_in.SCALES).with_penalties(names)
