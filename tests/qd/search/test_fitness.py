import dataclasses

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.search.descriptors import Cells
from qd.search.fitness import FitnessCfg, evaluate_rollout, merge_evaluations
from tests.qd.stand_in import make_result

CFG = FitnessCfg(penalties=("yaw_rate", "vel_x"), scales=(1.0, 10.0), alpha=0.5, lam=4.0)
CELLS = Cells(2)


def test_fitness_by_hand():
    # scaled penalties of four episodes: (1, 2), (3, 2), (1, 6), (3, 2); the second episode collides
    # means 2 and 3; standard deviations (ddof 0): 1, and sqrt(((-1)^2 + (-1)^2 + 3^2 + (-1)^2) / 4) = sqrt(3)
    # u = 3 of 4 without collision: f = (2 + 3) - .5 * (1 + sqrt(3)) - 4 * .75
    result = make_result([[[1, 20], [3, 20], [1, 60], [3, 20]]], base_collision=[[False, True, False, False]])
    evaluation = evaluate_rollout(result, CELLS, CFG)
    assert evaluation.fitness[0] == pytest.approx(5.0 - 0.5 * (1.0 + 3.0**0.5) - 3.0)
    assert evaluation.penalty_mean.tolist() == [[2.0, 3.0]]
    assert evaluation.penalty_std[0] == pytest.approx([1.0, 3.0**0.5])
    assert evaluation.collision_rate.tolist() == [0.25]
    # ratios (1/3, 2/3), (3/5, 2/5), (1/7, 6/7), (3/5, 2/5)
    assert evaluation.ratios[0, 0] == pytest.approx((1 / 3 + 3 / 5 + 1 / 7 + 3 / 5) / 4)
    assert CELLS.tuples[evaluation.cell[0]].tolist() == [4, 5]


@pytest.mark.parametrize(("collided", "inconsistency"), [(0, 0.0), (1, 0.75), (3, 0.25), (4, 0.0)])
def test_consistent_terrains_are_not_punished(collided, inconsistency):
    # identical episodes: no spread, so the fitness is 1 + 1 - 4 u; u is 0 if none collides and if all do
    collides = [[k < collided for k in range(4)]]
    result = make_result([[[1, 10]] * 4], base_collision=collides)
    assert evaluate_rollout(result, CELLS, CFG).fitness[0] == pytest.approx(2.0 - 4.0 * inconsistency)


@pytest.mark.parametrize(("num_invalid", "valid"), [(5, True), (6, False), (19, False)])
def test_more_than_a_quarter_of_invalid_episodes_make_a_terrain_invalid(num_invalid, valid):
    invalid = np.arange(20)[None] < num_invalid
    penalties = np.where(invalid[..., None], np.nan, 1.0) * [1.0, 30.0]
    evaluation = evaluate_rollout(make_result(penalties, base_collision=~invalid, invalid=invalid), CELLS, CFG)
    assert evaluation.valid.tolist() == [valid]
    assert evaluation.fitness[0] == pytest.approx(4.0 if valid else -20.0)
    # Statistics are those of the valid episodes, all alike, whether there are enough of them or not.
    assert evaluation.ratios[0] == pytest.approx([0.25, 0.75])
    assert evaluation.collision_rate.tolist() == [1.0]
    assert (evaluation.invalid_episodes.tolist(), evaluation.episodes.tolist()) == ([num_invalid], [20])
    assert all(np.isfinite(value).all() for value in vars(evaluation).values())


def test_without_a_valid_episode_there_are_no_statistics():
    penalties = np.full((1, 20, 2), np.nan)
    evaluation = evaluate_rollout(make_result(penalties, invalid=np.ones((1, 20), bool)), CELLS, CFG)
    assert evaluation.fitness.tolist() == [-20.0] and evaluation.ratios.tolist() == [[0.5, 0.5]]
    assert np.isnan(evaluation.end_position).all()
    for name in ("penalty_mean", "penalty_std", "collision_rate", "goal_rate", "fallen_rate"):
        assert not getattr(evaluation, name).any()


def test_the_typical_episode_ends_where_the_commonest_ending_of_a_failed_terrain_does():
    outcomes = np.array([
        [Outcome.GOAL] * 2 + [Outcome.TIME_OUT] * 2 + [Outcome.BASE_COLLISION] * 1,  # 2 of 5 arrive: it is failed
        [Outcome.GOAL] * 3 + [Outcome.TIME_OUT] * 2,
        [Outcome.TIME_OUT] * 2 + [Outcome.BASE_COLLISION] * 2 + [Outcome.INVALID],  # of two as common a collision
        [Outcome.INVALID] * 5,
    ])  # fmt: skip
    x = np.array([[14, 14.2, 6, 7, 9], [14, 14.2, 14.4, 7, 9], [6, 6, 8, 9, 50], [1, 1, 1, 1, 1]])
    result = make_result(np.ones((4, 5, 2)), invalid=outcomes == Outcome.INVALID)
    places = np.stack([x, 4 - x / 10, x], axis=2).astype(np.float32)
    result = dataclasses.replace(result, outcome=outcomes.astype(np.uint8), final_position=places)
    ends = evaluate_rollout(result, CELLS, CFG).end_position
    np.testing.assert_allclose(ends, [[6.5, 3.35], [14.2, 2.58], [8.5, 3.15], [np.nan, np.nan]], rtol=1e-6)


def test_collision_bit_needs_one_collision_in_a_valid_episode():
    cells = Cells(2, collision_bit=True)
    invalid = [[True, False, False, False]] * 2
    collides = [[True, False, False, False], [False, False, True, False]]
    result = make_result([[[1, 10]] * 4] * 2, base_collision=collides, invalid=invalid)
    assert (evaluate_rollout(result, cells, CFG).cell >= len(cells.tuples)).tolist() == [False, True]


@pytest.mark.parametrize("part", [2, 4])
def test_counts_and_statistics_agree_when_a_terrain_is_invalid_for_a_while(part):
    """Parts of 12 episodes, of which one or several are invalid, one after the other."""
    rng, cells = np.random.default_rng(0), Cells(2, collision_bit=True)
    penalties, collides = rng.lognormal(0.0, 1.0, (2, 12, 2)), rng.random((2, 12)) < 0.3
    invalid = np.zeros((2, 12), bool)
    invalid[0, [0, 1]] = invalid[1, [0, 4, 5]] = True

    def of(first: int, last: int):
        some = (values[:, first:last] for values in (penalties, collides, invalid))
        return evaluate_rollout(make_result(next(some), base_collision=next(some), invalid=next(some)), cells, CFG)

    joined = of(0, part)
    assert not joined.valid[0]
    for first in range(part, 12, part):
        joined = merge_evaluations(joined, of(first, first + part), cells, CFG)
        assert joined.counted.tolist() == (~invalid[:, : first + part]).sum(axis=1).tolist()
        for name, values in vars(of(0, first + part)).items():
            np.testing.assert_allclose(getattr(joined, name), values, rtol=1e-12, atol=1e-12, err_msg=name)
    assert joined.valid.all()


def test_few_episodes_show_too_little_spread():
    rng = np.random.default_rng(0)
    penalties = rng.normal([5.0, 50.0], [2.0, 20.0], (4000, 20, 2)).clip(0.0)
    few, many = (evaluate_rollout(make_result(penalties[:, :count]), CELLS, CFG) for count in (3, 20))
    assert few.penalty_std.mean() == pytest.approx(0.72 * 2.0, rel=0.05)
    assert few.spread.mean() == pytest.approx(2.0, rel=0.1)
    assert many.spread.mean() == pytest.approx(2.0, rel=0.03)


def test_a_collision_is_expected_above_one_episode_in_thirty():
    rates = [0, 1, 2]
    collides = [np.arange(40) < count for count in rates]
    result = make_result(np.ones((3, 40, 2)), base_collision=collides)
    assert evaluate_rollout(result, CELLS, CFG).collides.tolist() == [False, False, True]
    short = make_result(np.ones((1, 29, 2)), base_collision=[np.arange(29) < 1])
    assert evaluate_rollout(short, CELLS, CFG).collides.tolist() == [True]


def test_penalties_are_found_by_name():
    result = make_result([[[7, 10, 1]] * 4], names=("stumble", "vel_x", "yaw_rate"))
    assert evaluate_rollout(result, CELLS, CFG).penalty_mean.tolist() == [[1.0, 1.0]]


@pytest.mark.parametrize("scales", [(1.0,), (1.0, 0.0), (1.0, float("nan"))])
def test_scales_must_be_positive_one_a_penalty(scales):
    with pytest.raises(ValueError, match="scales"):
        FitnessCfg(penalties=CFG.penalties, scales=scales)
