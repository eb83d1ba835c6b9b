"""What crossings say of a controller on each terrain."""

import json

import numpy as np
import pytest

from qd.evaluate.measures import (
    kind_mean,
    measure,
    summarise_crossings,
    terrain_rates,
    valid_interval,
    valid_mean,
    velocity_error,
)
from sim.files.intervals import t_interval
from tests.qd.stand_in import BAD, GOAL, HIT, LATE, OUT, result_of


def test_rates_of_a_terrain():
    result = result_of([[GOAL, GOAL, HIT, LATE], [OUT, LATE, LATE, GOAL]], fallen=[[0, 0, 1, 0], [0, 0, 0, 0]])
    rates = {name: values.tolist() for name, values in terrain_rates(result).items()}
    assert rates == {"success": [0.75, 1.0], "goal": [0.5, 0.25], "fallen": [0.25, 0.0]}


def test_everything_is_a_mean_over_valid_episodes():
    # One of four is invalid: the terrain counts without it. Two of four: it does not count.
    result = result_of(
        [[GOAL, GOAL, HIT, BAD], [GOAL, GOAL, BAD, BAD]],
        reward=[[20.0, 22.0, 3.0, 99.0], [20.0] * 4],
        vel_x=[[1.0, 2.0, 6.0, 99.0], [1.0] * 4],
    )
    measured = measure(result, (1.0, 2.0))
    for name, expected in {"success": 2 / 3, "goal": 2 / 3, "fallen": 0.0, "reward": 15.0}.items():
        assert measured.values[name] == pytest.approx([expected, np.nan], nan_ok=True), name
    assert measured.penalties["vel_x"] == pytest.approx([1.5, np.nan], nan_ok=True)  # (1 + 2 + 6) / 3 by the scale of 2
    assert measured.episodes.tolist() == [3, 0] and measured.goals.tolist() == [2, 0]
    assert measured.valid.tolist() == [True, False]
    summary = summarise_crossings(result, 0)
    assert summary["success_rate"] == pytest.approx(2 / 3)
    assert (summary["terrains"], summary["invalid_terrains"], summary["outcomes"]["invalid"]) == (2, 1, 3)
    with pytest.raises(ValueError, match="reward"):
        measure(result_of([[GOAL]]), (1.0, 1.0))


def test_means_and_intervals_leave_invalid_terrains_out():
    values = np.array([1.0, 0.0, np.nan, 1.0, 1.0])
    assert valid_mean(values) == 0.75 and valid_mean(np.array([np.nan])) is None
    low, high = valid_interval(values, 0, None, None)
    assert 0.0 <= low < 0.75 < high == 1.0
    # Two families: all ones, and the single zero. A quarter of the resamples has the second alone.
    assert valid_interval(values, 0, np.array([0, 1, 2, 0, 0]), None) == [0.0, 1.0]
    assert valid_interval(values, 0, np.zeros(5, np.int64), None) is None  # one family says nothing of its spread


def test_means_of_kinds_hold_families_and_trainings():
    # Two families of two terrains: the first kind crosses all of one and half of the other, the second none.
    first, families = np.array([[1.0, 1.0, 0.5, 0.5]]), np.array([7, 7, 9, 9])
    row = kind_mean([first, np.zeros((2, 4))], families, 0)
    assert row["mean"] == pytest.approx(0.75) and row["seeds"] == [1, 2]
    # So few families could have been others: Wilson's interval of 1.5 of 2 is (.20, .97), of 0 of 2 (0, .66).
    assert row["interval"] == pytest.approx([0.75 - np.hypot(0.75 - 0.198, 0.658), 1.0], abs=2e-3)
    # A terrain that is invalid for one controller counts for none.
    first[0, 0] = np.nan
    assert kind_mean([first, np.zeros((2, 4))], families, 0)["mean"] == pytest.approx(2 / 3)
    assert kind_mean([np.full((1, 4), np.nan)], families, 0) is None
    # Families do not differ here: what is left is Student's interval over two trainings.
    alike = np.array([[0.52], [0.5]]).repeat(24, axis=1)
    assert kind_mean([alike], np.arange(24) // 2, 0)["interval"] == pytest.approx(t_interval(alike[:, 0]))


def test_intervals_of_kinds_cover_the_truth():
    """Of 19 in 20 repetitions, with trainings that differ as they do and families that differ more."""
    rng, families, covered = np.random.default_rng(0), np.arange(60) // 2, 0
    for _ in range(200):
        terrains = rng.normal(0.0, 0.2, 30)[families]
        kinds = [0.5 + terrains * weight + rng.normal(0.0, 0.03, (3, 1)) for weight in (1.0, 0.7)]
        low, high = kind_mean(kinds, families, 0)["interval"]
        covered += low <= 0.0 <= high
    assert 182 <= covered <= 199


def test_groups():
    result = result_of([[GOAL], [HIT], [GOAL], [LATE]])
    summary = summarise_crossings(result, 0, types=np.array([0, 0, 4, 4]), levels=np.array([1, 9, 9, 9]))
    assert summary["by_type"]["slope"] == {"terrains": 2, "success_rate": 0.5, "goal_rate": 0.5, "fallen_rate": 0.0}
    assert summary["by_type"]["boxes"]["success_rate"] == 1.0
    assert summary["by_level"]["9"]["goal_rate"] == pytest.approx(1 / 3)
    json.dumps(summary, allow_nan=False)


def test_velocity_error_is_a_mean_over_time():
    # .9 (m/s)^2 s over 10 s counted is (.3 m/s)^2; .24 over 6 s is .2^2; a fall before 2 s and an invalid one do not
    # count.
    outcomes, duration_s = [[GOAL, GOAL], [HIT, BAD]], [[12.0, 8.0], [1.5, 12.0]]
    error = velocity_error(result_of(outcomes, duration_s=duration_s, vel_x=[[0.9, 0.24], [0.0, 9.0]]), 0)
    assert error["vx_error_mean"] == pytest.approx((0.3 + 0.2) / 2) and error["episodes"] == 2
    assert error["goal_rate"] == pytest.approx(2 / 3)
