"""What a report says, before it is drawn: elites chosen, failure modes, crossings in numbers."""

import dataclasses

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.groups import MAX_MODES, elites_of, failure_modes, find_modes, rank
from qd.show.crossed import crossed_of, penalties_by_place
from qd.show.report.elites import choice_told
from qd.show.report.page import percent
from sim.files.records import robot_digest
from sim.robots.find import get_robot
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import fresh_values, small_archive
from tests.qd.recordings import NAMES, recording_of


def grouped_archive(sizes=(6, 9, 5)):
    """Elites of three kinds, far apart: stuck with the first penalty, collided with the second, across with both."""
    centres = np.array([[0.9, 0.1, 0.0, 0.0], [0.1, 0.9, 0.0, 1.0], [0.5, 0.5, 1.0, 0.0]])
    kinds = np.repeat(np.arange(3), sizes)
    noise = np.random.default_rng(0).uniform(-0.01, 0.01, len(kinds))
    values = centres[kinds]
    archive = small_archive(len(kinds))
    archive = dataclasses.replace(
        archive,
        robot_sha256=robot_digest(get_robot("anymal")),
        ratios=np.column_stack([values[:, 0] + noise, values[:, 1] - noise]),
        goal_rate=values[:, 2],
        collision_rate=values[:, 3],
        fallen_rate=np.zeros(len(kinds)),
        fitness=np.linspace(9.0, 1.0, len(kinds)),
        cell=np.arange(len(kinds)) % archive.cells.num_cells,
    )
    return archive, kinds


def test_elites_are_as_found_without_fresh_values_and_else_those_that_are_valid():
    archive = small_archive(4)
    found = elites_of(archive)
    assert not found.fresh.any() and found.numbers.tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(found.goal_rate, archive.goal_rate)
    fresh = dataclasses.replace(fresh_values(archive), invalid_episodes=np.array([0, 40, 8, 0]))
    corrected = elites_of(dataclasses.replace(archive, fresh=fresh), judged=True)
    assert corrected.fresh.all() and corrected.numbers.tolist() == [0, 2, 3]
    assert corrected.counted.tolist() == [40, 32, 40]
    np.testing.assert_array_equal(corrected.fitness, archive.fitness[[0, 2, 3]] / 2)
    assert [corrected.place_of(number) for number in (0, 2, 3)] == [0, 1, 2]


def test_variation_and_rates_by_hand():
    archive = dataclasses.replace(
        small_archive(2),
        penalty_mean=np.array([[3.0, 1.0], [2.0, 0.0]]),
        penalty_std=np.array([[0.5, 0.5], [1.5, 0.5]]),
        goal_rate=np.array([0.5, 0.25]),
        collision_rate=np.array([0.25, 0.75]),
    )
    elites = elites_of(archive)
    assert elites.variation.tolist() == [0.25, 1.0]  # 1 of 4, 2 of 2
    assert elites.failing.tolist() == [False, True]
    assert elites.other_rate.tolist() == [0.25, 0.0]


def test_the_steadiest_by_hand():
    archive = dataclasses.replace(
        small_archive(4),
        fitness=np.array([1.0, 4.0, 2.0, 3.0]),
        penalty_mean=np.ones((4, 2)),
        penalty_std=np.array([[0.1, 0.1], [0.2, 0.3], [0.2, 0.2], [0.0, 0.0]]),
        goal_rate=np.array([0.0, 0.4, 0.0, 0.9]),
    )
    # the last is the steadiest of all, but the robots cross it
    assert elites_of(archive).most_reproducible(4) == [0, 2, 1, 3]
    fresh = dataclasses.replace(fresh_values(archive), reproduced=np.array([False, True, True, True]))
    assert elites_of(dataclasses.replace(archive, fresh=fresh)).most_reproducible(4) == [2, 1, 0, 3]


@pytest.mark.parametrize(
    ("goal_rates", "chosen", "told"),
    [
        ([0.0, 0.9, 0.2], ([0, 2], [0]), "no two alike while there are others (0, 2);"),
        ([0.9, 0.0, 1.0], ([1, 0], [1]), "others (1); other terrains on which it does not fail (0);"),
        ([0.9], ([0], [0]), "Shown are terrains on which it does not fail (0);"),
    ],
    ids=["enough fail", "too few fail", "one elite, crossed"],
)
def test_which_elites_are_shown_is_told_truly(goal_rates, chosen, told):
    ranking = rank(dataclasses.replace(small_archive(len(goal_rates)), goal_rate=np.array(goal_rates)), SUPER_GAUSSIAN)
    elites = ranking.elites
    assert (ranking.worst(len(chosen[0])), elites.most_reproducible(1)) == chosen
    sentence = choice_told(elites, *chosen)
    assert told in sentence
    assert sentence.endswith(f"failed ones first ({chosen[1][0]}).")


def test_modes_are_the_kinds_that_were_made():
    archive, kinds = grouped_archive()
    found = find_modes(elites_of(archive))
    assert len(found.modes) == 3
    # the lowest goal rate first; stuck and collided share a rate of none, and are told apart by what they do
    by_kind = {int(kinds[mode.members[0]]): mode for mode in found.modes}
    assert all(set(kinds[mode.members]) == {kind} for kind, mode in by_kind.items())
    assert {kind: len(mode.members) for kind, mode in by_kind.items()} == {0: 6, 1: 9, 2: 5}
    assert [by_kind[kind].ending for kind in range(3)] == ["gets stuck", "strikes the terrain", "reaches the goal"]
    assert [by_kind[kind].marked_by for kind in range(2)] == ["yaw_rate", "vel_x"]
    assert found.modes[-1] is by_kind[2]
    assert all(mode.typical in mode.members for mode in found.modes)
    assert sorted(found.silhouettes) == list(range(2, MAX_MODES + 1))
    assert max(found.silhouettes, key=lambda count: found.silhouettes[count]) == 3
    np.testing.assert_array_equal(found.labels[by_kind[1].members], by_kind[1].number)


def test_a_mode_whose_robots_end_fallen_topples():
    archive, kinds = grouped_archive()
    archive = dataclasses.replace(archive, fallen_rate=np.where(kinds == 1, 0.8, 0.0))
    assert "topples" in {mode.ending for mode in find_modes(elites_of(archive)).modes}


@pytest.mark.parametrize("archive", [small_archive(1), small_archive(9)])
def test_few_elites_are_one_mode(archive):
    found = find_modes(elites_of(archive))
    assert len(found.modes) == 1 and not found.silhouettes
    assert found.modes[0].members.tolist() == list(range(len(archive)))


def test_failure_modes_are_of_failing_elites_alone():
    archive, kinds = grouped_archive()
    found = failure_modes(elites_of(archive))
    assert sorted(mode.ending for mode in found.modes) == ["gets stuck", "strikes the terrain"]
    assert {tuple(sorted(set(kinds[mode.members]))) for mode in found.modes} == {(0,), (1,)}
    assert (found.labels[kinds == 2] == 0).all() and (found.labels[kinds != 2] > 0).all()
    for mode in found.modes:
        assert mode.typical in mode.members and (found.labels[mode.members] == mode.number).all()
    crossed = dataclasses.replace(archive, goal_rate=np.ones(len(kinds)))
    assert failure_modes(elites_of(crossed)).modes == []


def test_equal_elites_are_one_mode():
    archive = small_archive(12)
    same = {name: np.zeros(12) for name in ("goal_rate", "collision_rate", "fallen_rate")}
    archive = dataclasses.replace(archive, ratios=np.full((12, 2), 0.5), **same)
    assert len(find_modes(elites_of(archive)).modes) == 1


def test_crossings_in_numbers_by_hand():
    outcomes = [Outcome.GOAL, Outcome.BASE_COLLISION, Outcome.BASE_COLLISION, Outcome.INVALID]
    sums = np.arange(24.0).reshape(4, 6)
    recording = recording_of(outcomes, [14.0, 5.0, 7.0, 3.0], penalties=sums, fallen=[False, True, False, True])
    crossed = crossed_of(recording, ("vel_x", "stumble"), (2.0, 4.0))
    assert crossed.chosen.tolist() == [0, 1, 2]
    assert crossed.scaled.tolist() == [[0.5, 1.0], [3.5, 2.5], [6.5, 4.0]]
    assert str(crossed.rates["reached the goal"]) == "1 of 3 (33%, 6 to 79%)"
    hits = {label: rate.hits for label, rate in crossed.rates.items()}
    assert hits == {"reached the goal": 1, "base collision": 2, "out of time": 0, "left the terrain": 0, "fallen": 1}
    np.testing.assert_allclose(crossed.ends[:, 0], [14.0, 5.0, 7.0])
    assert crossed.failed_at == pytest.approx(6.0)


def test_penalties_by_place_add_up():
    recording = recording_of([Outcome.GOAL, Outcome.TIME_OUT], [12.0, 2.0], penalties=np.full((2, 6), 10.0))
    edges = np.array([0.0, 3.0, 16.0])
    amounts = penalties_by_place(crossed_of(recording, NAMES, (1.0,) * 6), NAMES, edges)
    # the first robot makes a step of 0.5 m twenty times, of which one ends below x = 3; the second stays at 2
    np.testing.assert_allclose(amounts[:, 0], [(0.5 + 10.0) / 2, 9.5 / 2], rtol=1e-5)
    np.testing.assert_allclose(amounts.sum(axis=0), 10.0, rtol=1e-5)


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.0, "0 %"), (1.0, "100 %"), (0.5, "50 %"), (0.051, "5.1 %"), (0.9996, "over 99.9 %"),
     (0.0002, "less than 0.1 %"), (0.998, "99.8 %")],
)  # fmt: skip
def test_a_share_is_none_or_all_only_if_it_is(share, text):
    assert percent(share) == text
