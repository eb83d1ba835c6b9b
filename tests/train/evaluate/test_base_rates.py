"""The numbers of the base evaluation, from hand-made crossings."""

import json

import numpy as np
import pytest
import torch

from sim.files.intervals import bootstrap_interval
from sim.robots.robot import get_robot
from sim.rollout import CrossingCfg, Rollout
from tests.train.results import BAD, GOAL, HIT, LATE, result_of
from train.evaluate.base_rates import evaluate_sets, summarise, velocity_error


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
    assert bootstrap_interval(values, rng) == pytest.approx([values.mean() - half, values.mean() + half], abs=0.01)
    assert bootstrap_interval(np.ones(5), rng) == [1.0, 1.0]
    assert bootstrap_interval(np.empty(0), rng) is None


def test_velocity_error_is_a_mean_over_time():
    # 1.2 m over 10 s counted is .12 m/s; .3 m over 6 s is .05; a fall before 2 s and an invalid one do not count.
    result = result_of(
        [[GOAL, GOAL], [HIT, BAD]], duration_s=[[12.0, 8.0], [1.5, 12.0]], vel_x=[[1.2, 0.3], [0.0, 9.0]]
    )
    error = velocity_error(result, 0)
    assert error["vx_error_mean"] == pytest.approx((0.12 + 0.05) / 2)
    assert error["episodes"] == 2


def test_three_sets_are_crossed():
    def hold(observation: torch.Tensor) -> torch.Tensor:
        return torch.zeros(len(observation), 12)

    cfg = CrossingCfg(max_duration_s=2.4, penalties_from_s=2.0)
    rollout = Rollout(get_robot("anymal"), hold, num_terrains=3, num_replicas=2, device="cpu", cfg=cfg)

    def evaluate(terrains, seeds, progress):
        return rollout.evaluate(terrains, seeds, progress=progress)

    report = evaluate_sets(evaluate, 3, seed=0)
    assert report["hand_crafted"]["success_rate"] == 1.0 and report["hand_crafted"]["goal_rate"] == 0.0
    assert set(report["hand_crafted"]["by_type"]) == {"slope", "rough_slope", "stairs_up_down"}
    assert report["hard_random"]["episodes"] == 6 and report["hard_random"]["by_level"] is None
    assert report["flat"]["vx_error_mean"] == pytest.approx(0.75, abs=0.05)  # it stands still
