import dataclasses
import json
from pathlib import Path

import pytest

from qd.run import settings
from qd.run.settings import (
    as_settings,
    changed,
    differences,
    from_settings,
    kept_penalties,
    measured_now,
    policy_spec,
    preset,
)
from sim.robots.robot import RobotCfg
from sim.robots.shipped import ROBOTS
from tests.qd import stand_in


def robot(policy_file: Path = Path("missing.pt"), scales=stand_in.SCALES):
    """ANYmal with another controller and other scales."""
    changed = {"policy_file": policy_file, "read_penalty_scales": lambda self, policy=None: scales}
    kind = type("Robot", (RobotCfg,), changed)
    return kind(**{field.name: getattr(ROBOTS["anymal"], field.name) for field in dataclasses.fields(RobotCfg)})


def test_paper_has_the_papers_numbers():
    cfg = preset("paper", robot())
    assert (cfg.scheduler.emitters, cfg.scheduler.batch_size, cfg.replicas, cfg.iterations) == (10, 20, 20, 1000)
    assert cfg.episodes_per_iteration == 4000
    assert (cfg.fitness.alpha, cfg.fitness.lam, cfg.intervals) == (1.0, 2.0, 10)


def test_small_crosses_every_terrain_at_least_four_times():
    cfg = preset("small", robot())
    assert cfg.replicas >= 4
    assert cfg.episodes_per_iteration == 128


def test_unknown_preset():
    with pytest.raises(ValueError, match="unknown preset 'huge': expected one of wide, paper, small"):
        preset("huge", robot())


def test_changes_land_where_the_setting_stands():
    changes = {"sigma0": 0.25, "alpha": 0.0, "replicas": 8, "seed": None, "iterations": 5}
    cfg = changed(preset("paper", robot()), changes)
    assert (cfg.scheduler.sigma0, cfg.fitness.alpha, cfg.replicas, cfg.iterations, cfg.seed) == (0.25, 0.0, 8, 5, 0)
    assert cfg.scheduler.emitters == 10


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("iterations", 0, "iterations must be at least 1, got 0"),
        ("replicas", -1, "replicas must be at least 1, got -1"),
        ("intervals", 0, "intervals must be at least 1, got 0"),
        ("intervals", 100, "intervals must leave fewer than 500,000 cells for 6 penalties, got 100"),
        ("seed", -1, "seed must be at least 0, got -1"),
        ("emitters", 0, "emitters must be at least 1"),
        ("sigma0", 1e30, r"sigma0 must be at least 1e-06 and at most 1000, got 1e\+30"),  # its square is no float32
        ("sigma0", float("nan"), "sigma0 must be a finite number, got nan"),
        ("line_sigma", float("inf"), "line_sigma must be a finite number, got inf"),
        ("method", "cma_mae+", "several joined by a plus, each once, got cma_mae\\+"),
        ("method", "cma_mae+cma_mae", "each once, got cma_mae"),
    ],
)
def test_values_out_of_range(name, value, message):
    with pytest.raises(ValueError, match=message):
        changed(preset("paper", robot()), {name: value})


def test_settings_survive_json():
    cfg = changed(preset("small", robot()), {"learning_rate": 0.01, "restart_rule": "basic"})
    back = from_settings(json.loads(json.dumps(as_settings(cfg))), 7)
    assert back == dataclasses.replace(cfg, iterations=7)
    assert "iterations" not in as_settings(cfg)


def test_differences_name_every_key():
    there = {"seed": 0, "scheduler": {"sigma0": 0.5, "es": "cma_es"}, "old": 1, "same": [1, 2]}
    wanted = {"seed": 0, "scheduler": {"sigma0": 0.2, "es": "cma_es"}, "new": "x", "same": [1, 2]}
    assert differences(there, wanted) == [
        'new (null there, "x" wanted)',
        "old (1 there, null wanted)",
        "scheduler.sigma0 (0.5 there, 0.2 wanted)",
    ]
    assert differences(there, there) == []


def test_settings_of_a_surrogate_make_no_difference_to_other_methods():
    former = {"scheduler": {"method": "cma_mae+map_elites", "generations": 3, "crossover_share": 0.0, "sigma0": 2.0}}
    now = {"scheduler": {"method": "cma_mae+map_elites", "generations": 10, "crossover_share": 0.3, "sigma0": 2.0}}
    assert differences(former, now) == []
    for run in (former, now):
        run["scheduler"]["method"] = "surrogate+cma_mae"
    assert len(differences(former, now)) == 2


def test_long_values_are_shortened():
    (line,) = differences({"sha": "a" * 64}, {"sha": "b" * 64})
    assert line == f'sha ("{"a" * 36}... there, "{"b" * 36}... wanted)'


@pytest.mark.parametrize(
    ("bad", "what"),
    [
        ({}, "scheduler"),
        ({"scheduler": "wide"}, "scheduler"),
        ({"fitness": {}, "scheduler": {}}, "penalties"),
        ({"fitness": {"penalties": [], "scales": []}, "scheduler": {}}, ""),
    ],
)
def test_settings_of_something_else(bad, what):
    with pytest.raises(ValueError, match=f"settings must be those of a search of this version, but: .*{what}"):
        from_settings(bad, 1)


def test_settings_that_are_gone_are_read_where_they_changed_nothing():
    settings = as_settings(preset("wide", robot()))
    gone = {"mirror_share": 0.0, "shares": "fixed"}
    former = {**settings, "scheduler": {**settings["scheduler"], **gone}}
    assert as_settings(from_settings(former, 7)) == settings
    for name, value in (("mirror_share", 0.3), ("shares", "adaptive")):
        former["scheduler"] = {**settings["scheduler"], **gone, name: value}
        with pytest.raises(ValueError, match=f"has no setting {name}$"):
            from_settings(former, 7)


def test_the_controllers_file_is_part_of_the_settings(tmp_path):
    shipped, own = tmp_path / "anymal.pt", tmp_path / "own.pt"
    shipped.write_bytes(b"a")
    own.write_bytes(b"b")
    cfg = preset("paper", robot(shipped))
    digests = [
        measured_now(changed(cfg, {"policy": policy}), robot(shipped)).policy_sha256
        for policy in (None, "shipped", str(own), "module:callable")
    ]
    assert digests[0] == digests[1] != digests[2]
    assert digests[3] is None
    assert policy_spec(cfg, robot(shipped)) == str(shipped)
    assert measured_now(cfg, robot(shipped, scales=(9.0,) * 6)).fitness.scales == (9.0,) * 6


@pytest.mark.parametrize("names", [("stumble", "vel_x"), ("stumble vel_x",), ("vel_x,stumble",), ("vel_x, stumble",)])
def test_penalties_left_out_by_name_in_any_way_of_listing_them(names):
    assert kept_penalties(robot(), names) == ("yaw_rate", "vel_y", "contact_force", "collision")


def test_nothing_left_out_leaves_all():
    assert kept_penalties(robot(), ()) == stand_in.PENALTIES


def test_scales_follow_the_penalties_that_are_kept():
    cfg = measured_now(changed(preset("paper", robot()), {"penalties": ("vel_x", "stumble", "contact_force")}), robot())
    assert cfg.fitness.penalties == ("vel_x", "stumble", "contact_force")
    assert cfg.fitness.scales == (2.0, 1.0, 4.0)
    assert cfg.cells.num_ratios == 3


def test_a_penalty_that_the_robot_has_no_more_is_named():
    cfg = changed(preset("paper", robot()), {"penalties": ("vel_x", "torque")})
    with pytest.raises(ValueError, match="no penalty named torque: anymal has yaw_rate, vel_x, vel_y, contact_force"):
        measured_now(cfg, robot())


def test_nothing_slow_is_imported():
    assert "ribs" not in vars(settings)
