"""What crossings say of a controller on each terrain."""

import numpy as np
import pytest

from tests.train.results import BAD, GOAL, HIT, LATE, OUT, result_of
from train.evaluate.measures import count_outcomes, invalid_lines, measure, terrain_rates


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
        "hard_random: 43 of 1000 episodes are invalid (4.3%) and left out; counted as failures, success would be "
        "0.880, goal 0.880"
    )
