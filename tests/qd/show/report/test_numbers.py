"""What a report says, before it is drawn: elites chosen and failure modes."""

import dataclasses

import numpy as np
import pytest

from qd.groups import MAX_MODES, elites_of, failure_modes, find_modes, rank
from qd.show.report.page import percent
from sim.files.records import robot_digest
from sim.robots.find import get_robot
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import fresh_values, small_archive


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
    elites = elites_of(archive)
    assert not elites.fresh.any() and elites.numbers.tolist() == [0, 1, 2, 3]
    np.testing.assert_array_equal(elites.goal_rate, archive.goal_rate)
    fresh = dataclasses.replace(fresh_values(archive), invalid_episodes=np.array([0, 40, 8, 0]))
    corrected = elites_of(dataclasses.replace(archive, fresh=fresh), judged=True)
    assert corrected.fresh.all() and corrected.numbers.tolist() == [0, 2, 3]
    assert corrected.counted.tolist() == [40, 32, 40]
    np.testing.assert_array_equal(corrected.fitness, archive.fitness[[0, 2, 3]] / 2)
    assert [corrected.place_of(number) for number in (0, 2, 3)] == [0, 1, 2]


def test_the_worst_and_the_steadiest_by_hand():
    archive = dataclasses.replace(
        small_archive(4),
        fitness=np.array([1.0, 4.0, 2.0, 3.0]),
        penalty_mean=np.array([[1.0, 1.0], [1.0, 1.0], [1.0, 0.0], [1.0, 1.0]]),
        penalty_std=np.array([[0.1, 0.1], [0.2, 0.3], [0.1, 0.1], [0.0, 0.0]]),
        goal_rate=np.array([0.0, 0.4, 0.0, 0.9]),
        collision_rate=np.array([0.25, 0.6, 0.5, 0.1]),
    )
    elites = elites_of(archive)
    np.testing.assert_allclose(elites.variation, [0.1, 0.25, 0.2, 0.0])  # .2 of 2, .5 of 2, .2 of 1, 0 of 2
    assert elites.failing.tolist() == [True, True, True, False]
    np.testing.assert_allclose(elites.other_rate, [0.75, 0.0, 0.5, 0.0], atol=1e-12)
    # the last is the steadiest of all, but the robots cross it
    assert elites.most_reproducible(4) == [0, 2, 1, 3] and rank(archive, SUPER_GAUSSIAN).worst(4)[3] == 3
    fresh = dataclasses.replace(fresh_values(archive), reproduced=np.array([False, True, True, True]))
    assert elites_of(dataclasses.replace(archive, fresh=fresh)).most_reproducible(4) == [2, 1, 0, 3]


def test_modes_are_the_kinds_that_were_made():
    archive, kinds = grouped_archive()
    found = find_modes(elites_of(archive))
    assert len(found.modes) == 3
    # the lowest goal rate first; stuck and collided share a rate of none, and are told apart by what they do
    by_kind = {int(kinds[mode.members[0]]): mode for mode in found.modes}
    assert all(set(kinds[mode.members]) == {kind} for kind, mode in by_kind.items())
    assert {kind: len(mode.members) for kind, mode in by_kind.items()} == {0: 6, 1: 9, 2: 5}
    assert [by_kind[kind].marked_by for kind in range(2)] == ["yaw_rate", "vel_x"]
    assert found.modes[-1] is by_kind[2] and len({mode.ending for mode in found.modes}) == 3
    assert all(mode.typical in mode.members for mode in found.modes)
    assert sorted(found.silhouettes) == list(range(2, MAX_MODES + 1))
    assert max(found.silhouettes, key=lambda count: found.silhouettes[count]) == 3
    np.testing.assert_array_equal(found.labels[by_kind[1].members], by_kind[1].number)
    fallen = dataclasses.replace(archive, fallen_rate=np.where(kinds == 1, 0.8, 0.0))
    assert "topples" in {mode.ending for mode in find_modes(elites_of(fallen)).modes}


def equal_archive():
    same = {name: np.zeros(12) for name in ("goal_rate", "collision_rate", "fallen_rate")}
    return dataclasses.replace(small_archive(12), ratios=np.full((12, 2), 0.5), **same)


@pytest.mark.parametrize("archive", [small_archive(1), small_archive(9), equal_archive()])
def test_few_or_equal_elites_are_one_mode(archive):
    (mode,) = find_modes(elites_of(archive)).modes
    assert mode.members.tolist() == list(range(len(archive)))


def test_failure_modes_are_of_failing_elites_alone():
    archive, kinds = grouped_archive()
    found = failure_modes(elites_of(archive))
    assert {tuple(sorted(set(kinds[mode.members]))) for mode in found.modes} == {(0,), (1,)}
    assert (found.labels[kinds == 2] == 0).all() and (found.labels[kinds != 2] > 0).all()
    for mode in found.modes:
        assert mode.typical in mode.members and (found.labels[mode.members] == mode.number).all()
    crossed = dataclasses.replace(archive, goal_rate=np.ones(len(kinds)))
    assert failure_modes(elites_of(crossed)).modes == []


@pytest.mark.parametrize(
    ("share", "text"),
    [(0.0, "0 %"), (1.0, "100 %"), (0.051, "5.1 %"), (0.9996, "over 99.9 %"), (0.0002, "less than 0.1 %"),
     (0.998, "99.8 %")],
)  # fmt: skip
def test_a_share_is_none_or_all_only_if_it_is(share, text):
    assert percent(share) == text
