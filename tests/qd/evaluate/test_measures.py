"""What crossings say of a controller on each terrain."""

import json

import numpy as np
import pytest
import torch

from qd.evaluate.measures import (
    base_rates,
    count_outcomes,
    invalid_lines,
    measure,
    summarise,
    terrain_rates,
    velocity_error,
)
from sim.files.intervals import bootstrap_interval
from sim.robots.robot import get_robot
from sim.rollout import CrossingCfg, Rollout
from tests.train.results import BAD, GOAL, HIT, LATE, OUT, result_of


def test_rates_of_a_terrain():
    result = result_of([[GOAL, GOAL, HIT, LATE], [OUT, LATE, LATE, GOAL]], fallen=[[0, 0, 1, 0], [0, 0, 0, 0]])
    rates = terrain_rates(result)
    assert rates["success"].tolist() == [0.75, 1.0]
    assert rates["goal"].tolist() == [0.5, 0.25]
    assert rates["fallen"].tolist() == [0.25, 0.0]
    assert count_outcomes(result) == {
        "running": 0, "goal": 3, "base_collision": 1, "time_out": 3, "out": 1, "invalid": 0,
    }  # fmt: skip


def test_everything_is_a_mean_over_valid_episodes():
    # One of four is invalid: the terrain counts without it. Two of four: it does not count.
    result = result_of(
        [[GOAL, GOAL, HIT, BAD], [GOAL, GOAL, BAD, BAD]],
        reward=[[20.0, 22.0, 3.0, 99.0], [20.0] * 4],
        vel_x=[[1.0, 2.0, 6.0, 99.0], [1.0] * 4],
    )
    measured = measure(result, (1.0, 2.0))
    for name, expected in {"success": 2 / 3, "goal": 2 / 3, "fallen": 0.0, "reward": 15.0}.items():
        assert measured.values[name][0] == pytest.approx(expected), name
        assert np.isnan(measured.values[name][1])
    assert measured.penalties["vel_x"][0] == pytest.approx(1.5)  # (1 + 2 + 6) / 3 by the scale of 2
    assert measured.penalties["yaw_rate"][0] == 0.0 and np.isnan(measured.penalties["vel_x"][1])
    assert measured.episodes.tolist() == [3, 0] and measured.goals.tolist() == [2, 0]
    assert measured.valid.tolist() == [True, False]
    assert measured.outcomes["invalid"] == 3


def test_what_does_not_belong_together_is_refused():
    with pytest.raises(ValueError, match="must come with their reward, got none"):
        measure(result_of([[GOAL]]), (1.0, 1.0))
    with pytest.raises(ValueError, match=r"one a penalty .*, got 1"):
        measure(result_of([[GOAL]], reward=[[1.0]]), (1.0,))


def test_invalid_episodes_may_be_failures():
    counts = {"goal": 880, "base_collision": 77, "time_out": 0, "invalid": 43}
    (line,) = invalid_lines({"hard_random": counts, "flat": {"goal": 5, "base_collision": 1, "invalid": 0}})
    assert line == (
        "hard_random: 43 of 1000 episodes are invalid (4.3%) and left out; counted as failures, goal would be "
        "0.880, no base collision 0.880"
    )


def test_invalid_episodes_are_left_out_and_counted():
    result = result_of([[GOAL, GOAL, HIT, BAD], [GOAL, GOAL, BAD, BAD]])
    summary = summarise(result, 0)
    assert summary["success_rate"] == pytest.approx(2 / 3)
    assert (summary["terrains"], summary["invalid_terrains"], summary["outcomes"]["invalid"]) == (2, 1, 3)
    assert summary["by_type"] is None and summary["by_level"] is None


def test_groups():
    result = result_of([[GOAL], [HIT], [GOAL], [LATE]])
    summary = summarise(result, 0, types=np.array([0, 0, 4, 4]), levels=np.array([1, 9, 9, 9]))
    assert summary["by_type"]["slope"] == {"terrains": 2, "success_rate": 0.5, "goal_rate": 0.5, "fallen_rate": 0.0}
    assert summary["by_type"]["boxes"]["success_rate"] == 1.0
    assert summary["by_level"]["9"]["goal_rate"] == pytest.approx(1 / 3)
    json.dumps(summary, allow_nan=False)


def test_interval_is_that_of_the_mean():
    rng = np.random.default_rng(0)
    values = (rng.random(400) < 0.8).astype(float)
    half = 1.96 * np.sqrt(values.mean() * (1 - values.mean()) / 400)
    assert bootstrap_interval(values, 0) == pytest.approx([values.mean() - half, values.mean() + half], abs=0.01)
    assert bootstrap_interval(np.ones(5), 0) == [1.0, 1.0]
    assert bootstrap_interval(np.empty(0), 0) is None


def test_velocity_error_is_a_mean_over_time():
    # .9 (m/s)^2 s over 10 s counted is (.3 m/s)^2; .24 over 6 s is .2^2; a fall before 2 s and an invalid one do not
    # count.
    result = result_of(
        [[GOAL, GOAL], [HIT, BAD]], duration_s=[[12.0, 8.0], [1.5, 12.0]], vel_x=[[0.9, 0.24], [0.0, 9.0]]
    )
    error = velocity_error(result, 0)
    assert error["vx_error_mean"] == pytest.approx((0.3 + 0.2) / 2)
    assert error["episodes"] == 2


def test_three_sets_are_crossed():
    def hold(observation: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(observation), 12)

    cfg = CrossingCfg(max_duration_s=2.4, penalties_from_s=2.0)
    rollout = Rollout(get_robot("anymal"), hold, num_terrains=3, num_replicas=2, device="cpu", cfg=cfg)

    def evaluate(terrains, seeds, progress):
        return rollout.evaluate(terrains, seeds, progress=progress)

    report = base_rates(evaluate, 3, seed=0)
    assert report["hand_crafted"]["success_rate"] == 1.0 and report["hand_crafted"]["goal_rate"] == 0.0
    assert set(report["hand_crafted"]["by_type"]) == {"slope", "rough_slope", "stairs_up_down"}
    assert report["hard_random"]["episodes"] == 6 and report["hard_random"]["by_level"] is None
    assert report["flat"]["vx_error_mean"] == pytest.approx(0.75, abs=0.05)  # it stands still
