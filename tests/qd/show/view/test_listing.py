import dataclasses
import re
from pathlib import Path

import numpy as np

from qd.show.view.panels import Clock, Selection
from qd.show.view.viewed import ViewedRun, count_endings, render_rates
from tests.builders import fresh_values, judged_archive, small_archive
from tests.qd.recordings import recording_of


def list_archive(archive, robot):
    return ViewedRun(path=Path(), archive=archive, robot=robot, controllers={})


def test_the_list_begins_with_each_cause_and_sorts_by_what_is_chosen(show):
    selection, ranking = Selection(show), show.ranking
    assert selection.picked == ranking.worst(1)[0]
    assert selection.matching.tolist() == ranking.order("cause").tolist()
    selection.choose(order="collision_rate")
    assert selection.matching.tolist() == [*range(1, 20, 2), *range(0, 20, 2)]
    selection.choose(order="goal_rate")
    selection.picked = 3
    assert selection.matching.tolist() == list(range(20)) and selection.step(1) == 4
    selection.picked = 15  # which does not fail
    cause, rows = next(iter(ranking.by_cause().items()))
    selection.choose(cause=cause, order="fitness")
    assert selection.matching.tolist() == sorted(rows.tolist())  # by fitness, so as they are numbered
    assert selection.step(1) == selection.picked == 15 and selection.step(-1) == max(rows)  # from where it was


def test_causes_are_offered_with_their_numbers_and_rows_say_what_an_elite_is(show):
    members = {cause: len(rows) for cause, rows in show.ranking.by_cause().items()}
    assert sum(members.values()) == 10  # those with a goal rate below .5
    assert list(show.causes()) == ["all", *(f"{cause} ({count})" for cause, count in members.items())]
    rows = re.findall(r'data-elite="(\d+)"><b>\1</b> (.*?) <small>', show.render_list(np.array([12, 0]), 12))
    assert rows == [("12", "crossed, 12 of 20"), ("0", show.ranking.name(0))]


def test_how_episodes_end_is_a_table_of_who_crosses_and_in_which_way(anymal):
    show = list_archive(judged_archive(), anymal)
    assert "It is a fault" in show.details(0)
    fresh, resolved, certifier = show.columns(0)
    assert all(len(show.columns(number)) == 2 for number in (1, 3))  # nobody has a certificate
    assert fresh[:2] == ("fresh", 40) and fresh[2]["goal_rate"] == 0
    # 9 at the goal, 6 base collisions and 5 others with contact resolved; S crosses it 10 times, C-G 9
    assert resolved == ("finer contact", 20, {"goal_rate": 9, "collision_rate": 6, "other_rate": 5})
    assert certifier == ("S", 20, {"goal_rate": 10, "collision_rate": 10, "other_rate": 0})
    recording = recording_of([1, 2, 3, 2], [6.0] * 4, fallen=[False, True, False, False])
    recorded = count_endings("here", recording)
    assert recorded[1:] == (4, {"goal_rate": 1, "collision_rate": 2, "other_rate": 1, "fallen_rate": 1})
    table = render_rates([resolved, recorded])
    assert [re.sub("<.*?>", "|", row).count("%") for row in table.split("</tr>")[1:5]] == [4, 4, 4, 2]
    # Wilson, z^2 = 3.8415, of 9 of 20: .4587 +- .1998
    assert "<b>45%</b> <small>26 to 66%</small>" in table


def test_an_elite_whose_fresh_episodes_are_invalid_is_listed_as_found(anymal):
    archive = dataclasses.replace(small_archive(3), collision_rate=np.array([0.0, 0.5, 1.0]))
    fresh = dataclasses.replace(fresh_values(archive), invalid_episodes=np.array([0, 0, 39]))
    show = list_archive(dataclasses.replace(archive, fresh=fresh), anymal)
    ((head, count, hits),) = show.columns(2)
    assert (head, count, hits["collision_rate"]) == ("as found", 4, 4)


def test_time_goes_by_at_its_speed_and_begins_again():
    clock = Clock(duration_s=2.0, begin_s=0.5)
    clock.tick(1.0)
    assert clock.time_s == 0.0  # it does not play yet
    clock.playing, clock.speed = True, 0.5
    clock.tick(1.0)
    assert clock.time_s == 0.5
    clock.speed = 4.0
    clock.tick(1.0)
    assert clock.time_s == 2.0  # at its end, where it stays for 1.5 s
    clock.tick(1.0)
    assert clock.time_s == 2.0
    clock.tick(0.5)
    assert (clock.time_s, clock.playing) == (0.5, True)
    clock.seek(99.0)
    assert clock.time_s == 2.0 and clock.frame(0.02, 90) == 89
