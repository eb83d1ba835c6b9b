import dataclasses
from fractions import Fraction
from itertools import product

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.search.descriptors import Cells, terrain_ratios
from qd.search.fitness import FitnessCfg, evaluate_rollout, find_worth, merge_evaluations
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


def test_consistent_terrains_are_not_punished():
    # identical episodes: no spread, so the fitness is 1 + 1 - 4 u; u is 0 if none collides and if all do
    collides = [np.arange(4) < collided for collided in (0, 1, 3, 4)]
    fitness = evaluate_rollout(make_result([[[1, 10]] * 4] * 4, base_collision=collides), CELLS, CFG).fitness
    assert fitness == pytest.approx([2.0, 2.0 - 4.0 * 0.75, 2.0 - 4.0 * 0.25, 2.0])


def test_worth_is_a_share_of_what_lies_above_the_floor():
    worth = find_worth(np.array([10.0, 10.0, -12.0]), np.array([1.0, 0.4, 0.2]))  # 30, 30 and 8 above -20
    assert worth == pytest.approx([10.0, -20.0 + 0.4 * 30.0, -20.0 + 0.2 * 8.0])
    fitness = np.array([0.1, 0.2]) / 3.0
    assert find_worth(fitness, None).tolist() == fitness.tolist()


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
    penalties = np.random.default_rng(0).normal([5.0, 50.0], [2.0, 20.0], (4000, 20, 2)).clip(0.0)
    few, many = (evaluate_rollout(make_result(penalties[:, :count]), CELLS, CFG) for count in (3, 20))
    assert few.penalty_std.mean() == pytest.approx(0.72 * 2.0, rel=0.05)
    assert few.spread.mean() == pytest.approx(2.0, rel=0.1)
    assert many.spread.mean() == pytest.approx(2.0, rel=0.03)


@pytest.mark.parametrize(("episodes", "expected"), [(40, [False, False, True]), (29, [False, True, True])])
def test_a_collision_is_expected_above_one_episode_in_thirty(episodes, expected):
    collides = [np.arange(episodes) < count for count in (0, 1, 2)]
    result = make_result(np.ones((3, episodes, 2)), base_collision=collides)
    assert evaluate_rollout(result, CELLS, CFG).collides.tolist() == expected


def test_penalties_are_found_by_name():
    result = make_result([[[7, 10, 1]] * 4], names=("stumble", "vel_x", "yaw_rate"))
    assert evaluate_rollout(result, CELLS, CFG).penalty_mean.tolist() == [[1.0, 1.0]]


@pytest.mark.parametrize("scales", [(1.0,), (1.0, 0.0), (1.0, float("nan"))])
def test_scales_must_be_positive_one_a_penalty(scales):
    with pytest.raises(ValueError, match="scales"):
        FitnessCfg(penalties=CFG.penalties, scales=scales)


def test_terrain_ratio_is_the_mean_of_the_valid_episodes_ratios():
    # episodes (1, 3) -> (1/4, 3/4) and (10, 0) -> (1, 0): mean (5/8, 3/8); the ratio of means would be (11/14, 3/14)
    # (3, 1) -> (3/4, 1/4), and without penalties one half each
    penalties = [[[1.0, 3.0], [np.nan, np.inf], [10.0, 0.0]], [[np.nan, 1.0]] * 3, [[3.0, 1.0], [0.0, 0.0], [3.0, 1.0]]]
    ratios = terrain_ratios(penalties, [[True, False, True], [False] * 3, [True, True, False]])
    assert ratios.tolist() == [[0.625, 0.375], [0.5, 0.5], [0.625, 0.375]]


@pytest.mark.parametrize(
    ("num_ratios", "intervals"), [(2, 1), (2, 7), (3, 1), (3, 2), (3, 4), (3, 10), (4, 3), (4, 6), (6, 3)]
)
def test_reachable_are_the_boxes_with_a_strictly_inner_point_on_the_plane(num_ratios, intervals):
    # Exact oracle: walk from the lower to the upper corner of a box; the sum grows linearly, so the plane sum = 1 is
    # crossed strictly inside exactly if the walk's parameter lies strictly between 0 and 1.
    def crosses(box):
        return 0 < (1 - Fraction(sum(box), intervals)) / Fraction(num_ratios, intervals) < 1

    expected = [*filter(crosses, product(range(intervals), repeat=num_ratios))]
    assert [tuple(row) for row in Cells(num_ratios, intervals).tuples.tolist()] == expected


@pytest.mark.parametrize(("num_ratios", "intervals", "count"), [(5, 10, 1750), (6, 10, 4795), (2, 49, 49)])
def test_every_reachable_cell_is_hit_by_a_point_in_its_middle(num_ratios, intervals, count):
    cells = Cells(num_ratios, intervals)
    assert cells.num_cells == count
    lower = cells.tuples / intervals
    inside = lower + (1.0 - lower.sum(axis=1, keepdims=True)) / num_ratios
    assert cells.find_cells(inside).tolist() == list(range(cells.num_cells))


@pytest.mark.parametrize(
    ("ratios", "expected"),
    [
        # all on a lower edge, indices sum to 10: down on the largest, the first of equal ones
        ([0.2, 0.2, 0.2, 0.2, 0.2], [1, 2, 2, 2, 2]),
        ([0.1, 0.5, 0.4, 0.0, 0.0], [1, 4, 4, 0, 0]),
        # 1.0 is in the last interval, so this one is reachable as it is
        ([0.0, 0.0, 1.0, 0.0, 0.0], [0, 0, 9, 0, 0]),
        # every ratio one rounding step below its upper edge, indices sum to 5: up on the ratio nearest its edge
        ([np.nextafter(0.2, 0), np.nextafter(0.2, 0) - 1e-12, 0.2 - 1e-12, 0.2 - 1e-12, 0.2 - 1e-12], [2, 1, 1, 1, 1]),
        # a knife edge inside the set stays where it is: .3 opens its interval
        ([0.3, 0.25, 0.15, 0.15, 0.15], [3, 2, 1, 1, 1]),
    ],
)
def test_knife_edges(ratios, expected):
    cells = Cells(5)
    assert cells.tuples[cells.find_cells([ratios])[0]].tolist() == expected


def test_edges_of_other_intervals_are_exact():
    cells = Cells(2, 49)  # floor(1/49 * 49) = 0 in float64; the edge belongs to interval 1
    assert cells.tuples[cells.find_cells([[1 / 49, 48 / 49]])[0]].tolist() == [1, 47]


def test_collision_bit_selects_the_upper_half():
    cells = Cells(5, collision_bit=True)
    ratios = [[0.25, 0.25, 0.25, 0.15, 0.1]] * 2
    without, with_collision = cells.find_cells(ratios, [False, True])
    assert with_collision == without + 1750 and cells.num_cells == 3500
    assert not cells.are_neighbours([without], [with_collision])[0]
    with pytest.raises(ValueError, match="collided"):
        cells.find_cells(ratios)


def test_a_described_cell_is_as_the_docstring_shows_it():
    cells = Cells(3, collision_bit=True)
    with_collision = cells.find_cells([[0.08, 0.35, 0.57]], [True])
    assert f"``{cells.describe(int(with_collision[0]))}``" in Cells.describe.__doc__
    assert Cells(2, 4).describe(0) == "0-0.25 0.75-1"


def test_neighbours():
    cells = Cells(3)

    def cell(*ratios: float) -> int:
        return int(cells.find_cells([ratios])[0])

    here = cell(0.35, 0.35, 0.30)
    assert cells.are_neighbours([here], [here])[0]
    assert cells.are_neighbours([here], [cell(0.45, 0.30, 0.25)])[0]
    assert not cells.are_neighbours([here], [cell(0.55, 0.25, 0.20)])[0]


@pytest.mark.parametrize("ratios", [[[0.5, 0.6]], [[-0.1, 1.1]], [[np.nan, 1.0]], [[0.5, 0.25, 0.25]], [0.5, 0.5]])
def test_ratios_that_are_none_are_refused(ratios):
    with pytest.raises(ValueError, match="ratios"):
        Cells(2).find_cells(ratios)
