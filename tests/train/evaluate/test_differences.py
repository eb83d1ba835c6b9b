"""What one controller can do that another cannot."""

import json

import numpy as np
import pytest

from tests.train.results import BAD, GOAL, HIT, LATE, result_of
from train.evaluate.measures import measure
from train.evaluate.tables import KINDS, difference, differences

NUMBERS = np.array([10, 3, 7, 5, 8])


def measured(goals, *, of=20, reward=10.0, bad=()):
    """A controller that reached the goal in so many of ``of`` episodes of each terrain; ``bad`` ones are invalid."""
    rows = [[GOAL] * k + [HIT if k % 2 else LATE] * (of - k) for k in goals]
    for terrain in bad:
        rows[terrain] = [BAD] * of
    return measure(result_of(rows, reward=np.full((len(goals), of), reward)), (1.0, 1.0))


def test_a_terrain_is_failed_below_half():
    # Goal rates     before: 0    .45  .5   .95  1
    #                after:  1    .5   .45  .95  .1
    before, after = measured([0, 9, 10, 19, 20]), measured([20, 10, 9, 19, 2])
    found = difference(before, after, NUMBERS, 0)
    assert found["compared"] == 5
    assert {kind: found[kind]["terrains"] for kind in KINDS} == {
        "mended": [3, 10], "still_failing": [], "newly_broken": [7, 8], "fine": [5],
    }  # fmt: skip
    assert [found[kind]["count"] for kind in KINDS] == [2, 0, 2, 1]
    assert [found[kind]["share"] for kind in KINDS] == [0.4, 0.0, 0.4, 0.2]
    # .45 to .5 may be chance: the Wilson intervals are (.26, .66) and (.30, .70). 0 to 1 and 1 to .1 are not.
    assert (found["mended"]["clear"], found["newly_broken"]["clear"]) == (1, 1)
    low, high = found["mended"]["interval"]
    assert 0.0 <= low < 0.4 < high <= 1.0
    assert found["still_failing"]["interval"] == [0.0, 0.0]


def test_both_failing_is_still_failing():
    found = difference(measured([0, 9]), measured([9, 0]), NUMBERS[:2], 0)
    assert found["still_failing"]["terrains"] == [3, 10] and found["still_failing"]["share"] == 1.0


def test_gains_are_means_of_differences_terrain_by_terrain():
    # Goal rates differ by +.5 on every terrain: no spread, however hard the terrains are.
    found = difference(measured([0, 5, 10], reward=8.0), measured([10, 15, 20], reward=9.5), NUMBERS[:3], 0)
    assert found["gain"]["goal"]["mean"] == pytest.approx(0.5)
    assert found["gain"]["goal"]["interval"] == pytest.approx([0.5, 0.5])
    assert found["gain"]["reward"] == {"mean": pytest.approx(1.5), "interval": pytest.approx([1.5, 1.5])}


def test_a_terrain_invalid_to_one_is_not_compared():
    found = difference(measured([0, 20, 0], bad=[0]), measured([20, 20, 20], bad=[2]), NUMBERS[:3], 0)
    assert found["compared"] == 1
    assert [found[kind]["terrains"] for kind in KINDS] == [[], [], [], [3]]
    nothing = difference(measured([0], bad=[0]), measured([20]), NUMBERS[:1], 0)
    assert nothing["compared"] == 0 and nothing["mended"]["share"] is None and nothing["gain"]["goal"]["mean"] is None
    json.dumps([found, nothing], allow_nan=False)


def test_every_two_controllers_are_compared_once():
    crossed = {"base": measured([0, 0]), "C-HC": measured([20, 0]), "C-G": measured([20, 20])}
    found = differences(crossed, NUMBERS[:2], 0)
    assert list(found) == ["base -> C-HC", "base -> C-G", "C-HC -> C-G"]
    assert [row["mended"]["terrains"] for row in found.values()] == [[10], [3, 10], [3]]
    assert differences({"base": measured([0])}, NUMBERS[:1], 0) == {}
