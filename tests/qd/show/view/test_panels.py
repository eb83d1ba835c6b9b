import dataclasses

import numpy as np
import pytest

from qd.show.view.panels import PAGE, Clock, Selection
from qd.show.view.plots import KINDS, Choice, axes_of
from sim.spaces.super_gaussian import SUPER_GAUSSIAN
from tests.builders import fresh_values, judged_archive, small_archive


@pytest.fixture
def selection(axes):
    selection = Selection(axes)
    selection.choose(order="fault")  # by the goal rate, so as they are numbered
    return selection


def test_ranges_keep_what_lies_in_all_of_them(selection):
    assert selection.matching.tolist() == list(range(20))
    selection.brush("goal_rate", 0.25, 0.5)  # ends included
    assert selection.matching.tolist() == [5, 6, 7, 8, 9, 10]
    selection.brush("collision_rate", 0.5, 1.0)
    assert selection.matching.tolist() == [5, 7, 9]
    selection.brush("goal_rate", 0.0, 0.95)  # its full range
    assert selection.ranges == {"collision_rate": (0.5, 1.0)}
    assert selection.matching.tolist() == list(range(1, 20, 2))
    selection.clear()
    assert selection.matching.tolist() == list(range(20)) and selection.ranges == {}


def test_the_list_has_pages(selection):
    assert PAGE == 8 and selection.num_pages == 3
    selection.turn(1)
    assert selection.listed == list(range(8, 16))
    selection.turn(20)
    assert selection.listed == [16, 17, 18, 19]
    selection.turn(-20)
    assert selection.page == 0
    selection.turn(2)
    selection.brush("collision_rate", 1.0, 1.0)
    assert selection.listed == list(range(1, 17, 2))  # a new list is read from its beginning


def test_a_pick_stays_when_a_range_leaves_it_out(selection):
    assert selection.pick(12) and not selection.pick(12)
    assert selection.page == 1
    selection.brush("collision_rate", 1.0, 1.0)
    assert selection.picked == 12
    assert (selection.step(1), selection.step(-1)) == (13, 11)


def test_the_list_begins_with_each_way_of_failing_and_sorts_by_what_is_chosen(axes):
    selection = Selection(axes)
    ranking = axes.ranking
    leaders = ranking.leaders()
    assert selection.picked == 0 and selection.matching[: len(leaders)].tolist() == leaders
    assert sorted(selection.matching.tolist()) == list(range(20))
    selection.choose(order="collision_rate")
    assert selection.matching.tolist() == [*range(1, 20, 2), *range(0, 20, 2)]
    selection.choose(order="goal_rate")
    assert selection.matching.tolist() == list(range(20)) and (selection.pick(3), selection.step(1)) == (True, 4)
    selection.choose(kind="not failing", order="fitness")
    assert selection.matching.tolist() == list(range(10, 20)) and selection.step(1) == 10  # on from where it was
    selection.choose(kind="faults")
    assert selection.matching.tolist() == []
    selection.choose(kind="all", mode=1)
    assert selection.matching.tolist() == ranking.modes.modes[0].members.tolist()


def test_faults_come_before_certified_confirmed_and_other_failing_elites():
    axes = axes_of(judged_archive(), SUPER_GAUSSIAN)  # fault, confirmed, certified, failing, not failing
    assert axes.listed(Choice(ranges={}, order="fault")).tolist() == [0, 2, 1, 3, 4]
    listed = {kind: sorted(axes.listed(Choice(ranges={}, kind=kind)).tolist()) for kind in KINDS}
    assert listed == {
        "all": [0, 1, 2, 3, 4], "faults": [0], "certified": [0, 2], "confirmed": [0, 1], "failing": [0, 1, 2, 3],
        "not failing": [4],
    }  # fmt: skip
    assert list(axes.kinds()) == ["all (5)", "faults (1)", "certified (2)", "confirmed (2)", "failing (4)",
                                  "not failing (1)"]  # fmt: skip
    assert (
        axes.line(0).startswith("0: fault · goal 0% ")
        and "C-G" in axes.details(0, {})
        and "It is a fault" in axes.details(0, {})
    )


def test_numbers_of_fresh_episodes_come_first():
    archive = dataclasses.replace(small_archive(3), collision_rate=np.array([0.0, 0.5, 1.0]))
    fresh = fresh_values(archive)
    fresh = dataclasses.replace(
        fresh, collision_rate=np.array([0.5, 0.25, 0.0]), invalid_episodes=np.array([0, 0, 39]), fitness=np.zeros(3)
    )
    axes = axes_of(dataclasses.replace(archive, fresh=fresh), SUPER_GAUSSIAN)
    assert axes.elites.fresh.tolist() == [True, True, False]
    assert axes.elites.counted.tolist() == [40, 40, 4]
    assert axes.axis("collision_rate").values.tolist() == [0.5, 0.25, 1.0]
    assert axes.axis("fitness").values.tolist() == [0.0, 0.0, archive.fitness[2]]
    # Wilson, z^2 = 3.8415, of 20 of 40: .5 +- 1.96 sqrt(.25/40 + 3.8415/6400) / 1.0960 = .5 +- .148
    assert axes.rate_text("collision_rate", 0) == "50% (35 to 65%)"
    assert "collision 50%" in axes.line(0) and "as searched, 40 fresh episodes" in axes.details(0, {})
    assert "the 4 episodes that found it" in axes.details(2, {})


def test_time_goes_by_at_its_speed():
    clock = Clock()
    clock.load(2.0)
    clock.tick(1.0)
    assert clock.time_s == 0.0  # it does not play yet
    clock.toggle()
    clock.speed = 0.5
    clock.tick(1.0)
    assert clock.time_s == 0.5
    clock.speed = 4.0
    clock.tick(1.0)
    assert (clock.time_s, clock.playing) == (2.0, False)  # at its end
    clock.toggle()
    assert (clock.time_s, clock.playing) == (0.0, True)  # from the beginning
    clock.toggle()
    clock.seek(1.23)
    assert clock.frame(0.02, 101) == 62  # 61.5, to the even one
    clock.seek(99.0)
    assert clock.time_s == 2.0 and clock.frame(0.02, 90) == 89
    clock.seek(-1.0)
    assert clock.frame(0.02, 90) == 0
    clock.load(1.0)
    assert clock.duration_s == 1.0
