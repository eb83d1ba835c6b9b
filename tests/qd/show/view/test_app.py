import dataclasses
import re
import time
from contextlib import closing
from pathlib import Path
from unittest.mock import Mock

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.faults.numbers import MinimalTerrains
from qd.show.crossed import find_failure_time, find_typical_episode
from qd.show.recordings import Recordings, request_elite
from qd.show.view.app import App
from qd.show.view.recorder import TaskProgress
from qd.show.view.tab import Tab
from qd.show.view.viewed import open_viewed_run
from sim.recording.recorder import read_recording
from tests.builders import free_port
from tests.qd.show.view.browser import visit

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def show(anymal, published):
    policies = (f"base=shipped other={anymal.policy_file}",)
    return open_viewed_run(published / "anymal" / "archive", elite="0", policies=policies)


class Shown:
    """A viewer with one tab, and what its visitor does; what it would record is kept in ``asked``."""

    def __init__(self, show, recordings):
        self.recorder = Mock()
        self.app = App(show, recordings, self.recorder, host="127.0.0.1", port=free_port())
        self.sockets, self.clients = [], []
        self.tab = self.come()

    @property
    def asked(self):
        asked = [call.args[0] for call in self.recorder.request.call_args_list]
        return [wanted for wanted in asked if wanted is not None and "panel" not in wanted.policy]

    def come(self, query="") -> Tab:
        """The tab of another visitor, whose address says so."""
        self.connect()
        self.do((self.app.act, self.clients[-1], "hello", [query, 1400, 900]))
        return self.app.tabs[self.clients[-1].client_id]

    def connect(self):
        """Another visitor who says nothing yet; what is noted at the top of its page is kept."""
        before = set(self.app.bars)
        self.sockets.append(visit(self.app.page.get_port()))
        wait_until(lambda: set(self.app.bars) - before)
        self.clients.append(self.app.page.get_clients()[(set(self.app.bars) - before).pop()])
        self.clients[-1].add_notification = Mock()

    def do(self, *asked):
        """What visitors do, done by the loop."""
        for act, *args in asked:
            self.app.post(act, *args)
            self.app.do_tasks(wait_s=0.2)

    def close(self):
        for socket in self.sockets:
            socket.close()
        self.app.page.stop()


@pytest.fixture(scope="module")
def worst_crossed(show):
    """What is asked for of elite 0, and a recording of 20 episodes: the 17th out of time, 19 base collisions."""
    recording = read_recording(Path(__file__).with_name("crossing.npz"))
    outcome = recording.outcome.copy()
    outcome[0, 16] = Outcome.TIME_OUT
    wanted = request_elite(show.archive, 0, policy=str(show.robot.policy_file), replicas=20)
    return wanted, dataclasses.replace(recording, outcome=outcome)


@pytest.fixture
def shown(show, worst_crossed, tmp_path):
    recordings = Recordings(show.robot, folder=tmp_path)
    recordings.store(*worst_crossed)
    with closing(Shown(show, recordings)) as shown:
        yield shown


def status(tab) -> str:
    return re.sub(r"<.*?>", "", tab.bar.shown["status"])


def wait_until(true):
    until = time.perf_counter() + 20.0
    while not true():
        assert time.perf_counter() < until
        time.sleep(0.05)


def notes(client):
    """What stands at the top of a page."""
    return [call.args[1] for call in client.add_notification.call_args_list]


def test_an_elite_opens_a_second_before_the_robot_fails_and_plays(shown, show, worst_crossed):
    tab, (_, recording) = shown.tab, worst_crossed
    typical = find_typical_episode(recording, show.scales)
    moment = find_failure_time(recording, typical)
    assert tab.replica == typical and tab.bar.shown["episode"] == typical + 1
    assert tab.clock.time_s == pytest.approx(max(0.0, moment - 1.0)) and tab.playing and tab.scene.follow
    name = show.ranking.name(0)
    assert tab.bar.shown["title"] == name and name in tab.panel.head.content and "elite 0 " in tab.panel.head.content
    assert tab.scene.robot.visible and tab.bar.shown["enabled"]
    assert status(tab).startswith("hits the ground") and tab.bar.shown["episodes"][0][0] == "19 of 20: hits the ground"
    shown.do((tab.choose_replica, 0))
    assert tab.clock.duration_s == pytest.approx(6.19) and tab.bar.shown["duration"] == tab.clock.duration_s
    assert tab.clock.time_s == pytest.approx(max(0.0, find_failure_time(recording, 0) - 1.0)) and tab.playing
    shown.do((tab.choose_replica, 16), (tab.pick, 7), (tab.pick, 0))
    assert tab.replica == typical and tab.playing  # as at first


def test_what_a_visitor_does_on_the_bar_is_done_if_it_makes_sense(shown):
    tab = shown.tab
    for name, value in (("speed", 0.25), ("open", "?elite=0&t=3"), ("resize", [390, 844])):
        shown.do((shown.app.act, shown.clients[0], name, value))
    assert tab.clock.speed == 0.25
    for name, value in (("seek", "far"), ("seek", float("inf")), ("resize", 3), ("episode", None), ("nothing", 1)):
        shown.do((shown.app.act, shown.clients[0], name, value))
    assert tab.clock.time_s == 3.0 and tab.window == (390, 844)


def test_a_visitor_who_does_not_say_the_size_of_a_window_has_no_tab_yet(shown):
    shown.connect()
    for value in (5, ["?elite=0"], ["", "wide", 900], ["", None, 900], ["", float("inf"), 900], {}):
        shown.do((shown.app.act, shown.clients[1], "hello", value))
    assert len(shown.app.tabs) == 1
    shown.do((shown.app.act, shown.clients[1], "hello", ["?elite=7", 390, 844]))
    assert (list(shown.app.tabs.values())[1].selection.picked, shown.tab.selection.picked) == (7, 0)


@pytest.mark.slow
def test_what_one_tab_does_no_other_tab_sees(shown):
    first, second = shown.tab, shown.come("?elite=171&t=3")
    assert first.selection.picked == 0 and second.selection.picked == 171
    before = second.list.list.content
    shown.do((first.choose_replica, 16), (first.seek, 2.0), (first.set_follow, True))
    first.selection.choose(order="goal_rate")
    first.list.show()
    assert first.playing and not second.playing and not second.scene.follow
    assert second.list.list.content == before != first.list.list.content and second.selection.picked == 171
    shown.do((second.pick, 0))
    assert status(second).startswith("hits the ground") and second.playing
    assert status(first).startswith("gets stuck")
    shown.sockets[1].close()
    wait_until(lambda: shown.app.do_tasks(wait_s=0.1) or len(shown.app.tabs) == 1)
    assert list(shown.app.tabs.values()) == [first] and first.playing  # it is left alone


def test_a_link_opens_what_it_was_copied_from(shown):
    tab = shown.tab
    shown.do((tab.choose_replica, 16), (tab.choose_controller, "other"), (tab.seek, 1.25), (tab.set_follow, True))
    tab.show_address()
    query = tab.address.query()
    assert query.startswith("elite=0&controller=other&episode=17&t=1.25&follow=1&initialCameraPosition=")
    second = shown.come(f"?{query}")
    assert (second.controller, second.replica, second.clock.time_s) == ("other", 16, 1.25)
    assert second.panel.controller.value == "other" and status(second).startswith("gets stuck")
    assert second.scene.follow and second.bar.shown["follow"] and not second.playing
    second.show_address()
    assert second.address.query().startswith("elite=0&controller=other&episode=17&t=1.25&follow=1")


def test_what_is_not_there_is_refused_in_words(shown):
    shown.come("?elite=99999&controller=C-HR&episode=21&t=soon")
    for words, part in zip(notes(shown.clients[1]), ("t=soon", "elite 99999", "'C-HR'", "episode 21"), strict=True):
        assert part in words
    shown.do((shown.tab.pick, "99999"), (shown.tab.pick, "-3"), (shown.tab.pick, "17.5"))
    for words, text in zip(notes(shown.clients[0]), ("99999", "-3", "17.5"), strict=True):
        assert f"'{text}'" in words
    assert shown.tab.selection.picked == 0
    shown.do((shown.tab.pick, " 171 "))
    assert shown.tab.selection.picked == 171


def test_a_frame_has_the_robot_in_its_place_what_touches_in_colour_and_forces(shown):
    tab = shown.tab
    touching, names = tab.robot.recording.touching[0, 0], tab.robot.recording.geom_names
    shown.do((tab.choose_replica, 0), (tab.play, False))
    assert not any(path.visible for path in tab.scene.paths)  # it follows, and they would hide the robot
    shank, forces = touching[:, names.index("RF_SHANK")], tab.robot.crossing.forces
    pushed = (forces[:, :, 1] != forces[:, :, 0]).any(axis=2)
    for frame in (np.argmax(shank), np.argmin(shank), np.argmax(pushed.any(axis=1))):
        shown.do((tab.seek, 0.02 * frame))
        shapes = zip(tab.shared.shapes, tab.scene.shapes, tab.scene.touched, strict=True)
        columns = {column for shape, _, touched in shapes if touched.visible for column in shape.touches}
        assert columns == set(np.flatnonzero(touching[frame]).tolist())
        np.testing.assert_allclose(tab.scene.bodies[0].position, tab.robot.recording.base_position[0, 0, frame])
        assert [arrow.visible for arrow in tab.scene.forces] == pushed[frame].tolist()
    assert pushed[frame].any()


@pytest.mark.slow
def test_a_minimal_terrain_is_shown_instead(show, worst_crossed, tmp_path):
    genes = show.archive.genes[0].copy()
    genes[:8] = 0.0
    entry = {"elite": 0, "bumps": [1], "of": 8, "goal_rate": 0.1, "goal_interval": [0.03, 0.25], "cause": None,
             "margin_m": None}  # fmt: skip
    minima = MinimalTerrains(numbers={"elites": [entry]}, genes={0: genes})
    recordings = Recordings(show.robot, folder=tmp_path)
    recordings.store(*worst_crossed)
    with closing(Shown(dataclasses.replace(show, minima=minima), recordings)) as shown:
        tab = shown.tab
        assert tab.panel.terrain.visible and tab.panel.terrain.value == "whole"
        assert "**Minimal terrain**: 1 of 8 parts; passed 10% (3 to 25%)" in tab.panel.details.content
        assert "fresh" in tab.panel.rates.content
        shown.do((tab.choose_terrain, True))
        assert shown.asked[-1].label == "minimal terrain of elite 0 of anymal" and not tab.scene.robot.visible
        np.testing.assert_array_equal(shown.asked[-1].terrain.genes[0], genes)
        tab.show_address()
        assert "terrain=minimal" in tab.address.query() and shown.come(f"?{tab.address.query()}").minimal
        assert tab.panel.rates.content == ""  # what is known is of the whole terrain
        shown.do((tab.pick, 7))
        assert not tab.minimal and not tab.panel.terrain.visible
        shown.come("?elite=7&terrain=minimal")
        assert notes(shown.clients[2]) == ["Elite 7 has no minimal terrain here."]


@pytest.mark.slow
def test_a_second_controller_crosses_beside_it_as_a_ghost(shown):
    tab = shown.tab
    shown.do((tab.choose_ghost, "none"))
    assert not tab.scene.ghost.visible
    shown.do((tab.choose_ghost, "other"), (tab.seek, 5.0))  # the same file, so the same crossing
    assert tab.scene.ghost.visible and tab.scene.robot.visible
    np.testing.assert_array_equal(tab.scene.ghost_bodies[0].position, tab.scene.bodies[0].position)
    assert "Ghost, other: hits the ground" in status(tab)  # it arrives in no episode
    arrives = tab.ghost.recording.outcome.copy()
    arrives[0, 3] = Outcome.GOAL
    tab.ghost.recording = dataclasses.replace(tab.ghost.recording, outcome=arrives)
    for episode, words in ((3, "other"), (0, "other in episode 4")):
        shown.do((tab.choose_replica, episode))
        assert f"Ghost, {words}: reaches the goal" in status(tab)
    tab.show_address()
    assert "&ghost=other" in tab.address.query()
    assert shown.come(f"?{tab.address.query()}").scene.ghost.visible
    shown.do((tab.choose_controller, "other"))  # none is its own ghost
    assert not tab.scene.ghost.visible and "Ghost" not in status(tab)
    assert re.search("`faultline replay .*anymal.pt --elite 0`$", tab.panel.details.content)
    assert tab.panel.rates.content.count("<th>other<") == 1  # another controller than the search's has a column
    shown.do((tab.choose_controller, "base"), (tab.choose_ghost, "none"))
    assert not tab.scene.ghost.visible


def test_the_ghost_is_who_certifies_it_or_words_say_why_there_is_none(show):
    certified = int(np.flatnonzero(show.archive.certified)[0])
    name, words = show.find_certifier(certified)
    assert (name, words) == (show.certifier(certified), "") and name in ("C-G", "S")
    lost = dataclasses.replace(show, controllers={"base": "shipped"})
    name, words = lost.find_certifier(certified)
    assert name is None and "--policies" in words


def test_what_was_never_recorded_is_asked_for_and_shown_when_it_comes(shown):
    tab = shown.tab
    recording = tab.robot.recording
    shown.do((tab.pick, 7))
    wanted = shown.asked[-1]
    assert (wanted.label, wanted.replicas) == ("elite 7 of anymal", 20)
    assert not tab.scene.robot.visible and not tab.bar.shown["enabled"]
    shown.do((shown.app.show_progress, TaskProgress(task=wanted, text="", share=0.4)))
    assert tab.bar.shown["task"] == "Recording 20 episodes of base: 40%" and tab.bar.shown["share"] == 0.4
    other = dataclasses.replace(wanted, replicas=8)
    shown.do((shown.app.show_progress, TaskProgress(task=other, text="no", failed=True)))
    assert tab.bar.shown["share"] == 0.4  # of what is not shown nothing is said
    shown.do((shown.app.show_progress, TaskProgress(task=wanted, text="it <broke>", failed=True)))
    assert status(tab) == "No crossing: it &lt;broke&gt;" and tab.bar.shown["share"] is None
    shown.do((shown.app.show_progress, TaskProgress(task=wanted, text="", result=recording)))
    assert status(tab).startswith("hits the ground") and tab.scene.robot.visible


def test_a_film_is_made_and_offered_or_cancelled(shown, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tab = shown.tab
    shown.do((tab.film,))
    wanted = shown.recorder.request.call_args.args[0]
    assert wanted.keywords["out"].name == f"elite-0-base-episode-{tab.replica + 1}.mp4"
    shown.do((shown.app.show_progress, TaskProgress(task=wanted, text="", share=0.4)))
    assert "40%" in tab.panel.film_status.content
    shown.do((tab.cancel_film,), (tab.film,))
    shown.recorder.cancel.assert_called_once_with(wanted)
    wanted = shown.recorder.request.call_args.args[0]
    made = tmp_path / "film.mp4"
    made.write_bytes(bytes(1_500_000))
    shown.do((shown.app.show_progress, TaskProgress(task=wanted, text="", result=made)))
    assert "film.mp4 (1.5 MB)" in tab.panel.film_status.content


def test_without_a_controller_terrains_are_shown_all_the_same(show, tmp_path):
    bare = dataclasses.replace(show, controllers={}, note="it is <lost>")
    with closing(Shown(bare, Recordings(show.robot, folder=tmp_path))) as shown:
        tab = shown.tab
        shown.do((tab.pick, 3), (tab.play, True), (tab.seek, 1.0), (tab.choose_replica, 2), (tab.set_follow, True))
        assert status(tab) == "No crossing: it is &lt;lost&gt;" and "elite 3 " in tab.panel.head.content
