"""What is read before a page opens, what it lists, its clock and its address."""

import dataclasses
import json
import re
import shutil
import socket
from pathlib import Path

import numpy as np
import pytest

from qd.search.archive import write_archive
from qd.show.view.app import check_port
from qd.show.view.panels import Address, Clock, Selection
from qd.show.view.viewed import ViewedRun, count_endings, open_viewed_run, render_rates
from sim.rates import rate_labels
from tests.builders import fresh_values, judged_archive, small_archive
from tests.qd.recordings import recording_of


def list_archive(archive, robot):
    return ViewedRun(path=Path(), archive=archive, robot=robot, controllers={})


@pytest.fixture
def run(published):
    return published / "anymal" / "archive"


@pytest.fixture
def show(anymal):
    """Twenty elites whose goal rate is their number / 20, and collision rate 1 where the number is odd."""
    numbers = np.arange(20)
    rates = {"goal_rate": numbers / 20, "collision_rate": (numbers % 2).astype(float)}
    values = {"fitness": 10.0 - numbers, "episodes": np.full(20, 20)}
    return list_archive(dataclasses.replace(small_archive(20), **rates, **values), anymal)


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
    assert rows == [("12", "reaches the goal, 12 of 20"), ("0", show.ranking.name(0))]


def test_how_episodes_end_is_a_table_of_who_crosses_and_in_which_way(anymal):
    show = list_archive(judged_archive(), anymal)
    assert "It is a fault" in show.details(0)
    fresh, resolved, certifier = show.columns(0)
    assert all(len(show.columns(number)) == 2 for number in (1, 3))  # nobody has a certificate
    assert fresh[:2] == ("fresh", 40) and fresh[2]["goal_rate"] == 0
    # 9 at the goal, 6 base collisions and 5 others with contact resolved; S crosses it 10 times, C-G 9
    assert resolved == ("finer contact", 20, {"goal_rate": 9, "collision_rate": 6, "other_rate": 5})
    assert certifier == ("S", 20, {"goal_rate": 10, "collision_rate": 10, "other_rate": 0})
    recorded = count_endings("here", recording_of([1, 2, 3, 2], [6.0] * 4, fallen=[False, True, False, False]))
    assert recorded[1:] == (4, {"goal_rate": 1, "collision_rate": 2, "other_rate": 1, "fallen_rate": 1})
    table = render_rates([resolved, recorded], rate_labels(show.space.asks))
    assert [re.sub("<.*?>", "|", row).count("%") for row in table.split("</tr>")[1:5]] == [4, 4, 4, 2]
    # Wilson, z^2 = 3.8415, of 9 of 20: .4587 +- .1998
    assert "<b>45%</b> <small>26 to 66%</small>" in table


def test_an_elite_whose_fresh_episodes_are_invalid_is_listed_as_found(anymal):
    archive = dataclasses.replace(small_archive(3), collision_rate=np.array([0.0, 0.5, 1.0]))
    fresh = dataclasses.replace(fresh_values(archive), invalid_episodes=np.array([0, 0, 39]))
    ((head, count, hits),) = list_archive(dataclasses.replace(archive, fresh=fresh), anymal).columns(2)
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
    assert clock.time_s == 2.0


@pytest.mark.parametrize(
    "address",
    [
        Address(),
        Address(elite=12, controller="C-G", episode=3, time_s=8.4, follow=True),
        Address(elite=0, controller="as searched & more=50%", time_s=0.0, terrain="minimal"),
        Address(position="1.00,-2.50,3.25", look_at="4.00,5.00,0.00"),
    ],
)
def test_what_an_address_says_comes_back(address):
    assert Address.parse(address.query()) == (address, [])
    assert Address.parse("?" + address.query()) == (address, [])


def test_what_means_nothing_is_said_and_left_out():
    address, refused = Address.parse("elite=twelve&episode=1.5&t=nan&more=1")
    assert address == Address()
    assert [text.split("=")[0] for text in refused] == ["elite", "episode", "t"]
    assert Address(elite=7, time_s=1.25, follow=True).query() == "elite=7&t=1.25&follow=1"


def test_the_controller_of_the_search_comes_first_and_certifiers_follow(anymal, run):
    controllers = open_viewed_run(run).controllers
    assert next(iter(controllers.items())) == ("searched controller", str(anymal.policy_file)) and "C-G" in controllers


def test_terrains_are_shown_when_the_controller_of_the_search_is_code(tmp_path, run):
    copied = Path(shutil.copytree(run, tmp_path / "run"))
    settings = json.loads((copied / "config.json").read_text())
    settings["settings"] |= {"policy": "tests.sim.policies:stand", "policy_sha256": None}
    (copied / "config.json").write_text(json.dumps(settings))
    show = open_viewed_run(copied)
    assert show.controllers == {} and "tests.sim.policies:stand is code" in show.note
    named = open_viewed_run(copied, policies=("mine=tests.sim.policies:stand",))
    assert next(iter(named.controllers.items())) == ("mine", "tests.sim.policies:stand")


@pytest.mark.parametrize(
    ("changes", "field"),
    [
        ({"robot": "spot"}, "spot"),
        ({"elite": "5000"}, "5000"),
        ({"elite": "0 1"}, "0 1"),
        ({"elite": "0", "minimal": "1"}, "leave one out"),
        ({"policies": ("shipped",)}, "policies"),
    ],
)
def test_what_is_wrong_is_said_before_a_page_opens(changes, field, run):
    with pytest.raises((ValueError, FileNotFoundError), match=field):
        open_viewed_run(**{"run": run} | changes)


def test_a_run_without_elites_is_refused(tmp_path):
    write_archive(tmp_path / "archive.npz", small_archive(0))
    with pytest.raises(ValueError, match="no elites"):
        open_viewed_run(tmp_path)


def test_a_port_in_use_is_refused_until_it_is_free():
    with socket.socket() as busy:
        busy.bind(("127.0.0.1", 0))
        busy.listen()
        port = busy.getsockname()[1]
        with pytest.raises(ValueError, match=f"port {port}"):
            check_port("127.0.0.1", port)
    check_port("127.0.0.1", port)
