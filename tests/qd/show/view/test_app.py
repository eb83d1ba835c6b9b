import dataclasses
import re
import signal
import time
import urllib.request
from pathlib import Path

import numpy as np
import pytest

from kernels.episode import Outcome
from qd.archive import read_archive
from qd.minimise import MinimalFound
from qd.show.recordings import Recordings, on_elite
from qd.show.view.app import App
from qd.show.view.recorder import Report
from qd.show.view.show import find_show
from qd.show.view.tab import Tab
from sim.recording.file import read_recording
from tests.builders import free_port
from tests.qd.show.view.visitor import Visitor, serve, view_command

PICK_LIMIT_S = 1.0
"""From a click to the terrain on its way to the browser; it takes 0.15 s."""


@pytest.fixture(scope="module")
def run(published):
    return published / "anymal" / "archive"


@pytest.fixture(scope="module")
def show(anymal, run):
    policies = (f"base=shipped other={anymal.policy_file}",)
    return find_show(run, elite="0", policies=policies)


class Shown:
    """A viewer with one tab, and what its visitor does; what it would record is kept in ``asked``."""

    def __init__(self, show, recordings, query=""):
        self.app = App(show, recordings, host="127.0.0.1", port=free_port())
        self.asked = []
        self.ahead = []
        self.app._recorder.record = lambda wanted, tab=0: self.asked.append(wanted)
        self.app._recorder.record_ahead = lambda wanted, tab=0: self.ahead.append([one.label for one in wanted])
        self.visitors = []
        self.tab = self.come(query)

    def come(self, query="") -> Tab:
        """The tab of another visitor, whose address says so."""
        before = set(self.app.tabs)
        self.visitors.append(Visitor(self.app.page.get_port(), query))
        until = time.perf_counter() + 20.0
        while not (new := set(self.app.tabs) - before):
            assert time.perf_counter() < until, "no tab was opened"
            self.app.do_asked(wait_s=0.1)
        return self.app.tabs[new.pop()]

    def do(self, *asked):
        """What visitors do, done by the loop."""
        for act, *args in asked:
            self.app.post(act, *args)
            self.app.do_asked(wait_s=0.2)

    def close(self):
        for visitor in self.visitors:
            visitor.close()
        self.app.close()


def _lasting(recording, frames):
    """The same whose longest arrays have so many frames; the last of an episode is repeated."""
    longest = recording.base_position.shape[2]
    same = {}
    for field in dataclasses.fields(recording):
        value = getattr(recording, field.name)
        if getattr(value, "shape", ())[2:3] == (longest,):
            rows = np.minimum(np.arange(frames), recording.num_frames[..., None] - 1)  # (1, episodes, frames)
            rows = rows.reshape(*rows.shape, *[1] * (value.ndim - 3))
            same[field.name] = np.take_along_axis(value, rows, axis=2)
    every = np.full_like(recording.num_frames, frames)
    duration_s = np.full_like(recording.duration_s, (frames - 1) * recording.dt)
    return dataclasses.replace(recording, **same, num_frames=every, duration_s=duration_s)


@pytest.fixture(scope="module")
def worst_crossed(show):
    """What is asked for of elite 0, and a recording: an episode of ANYmal made 20 s long, 20 times, one cut short."""
    recording = _lasting(read_recording(Path(__file__).with_name("crossing.npz")), 1001)
    places = [recording.penalty_names.index(name) for name in ("stumble", "collision")]
    happened = (recording.penalties[0, :, -1][:, places] > 0.0).all(axis=1)
    longest = int(np.argmax(recording.num_frames[0] * happened))
    same = {
        field.name: np.repeat(value[:, longest : longest + 1], recording.outcome.size, axis=1)
        for field in dataclasses.fields(recording)
        if getattr(value := getattr(recording, field.name), "shape", ())[:2] == recording.outcome.shape
    }
    recording = dataclasses.replace(recording, **same)
    outcome, frames = np.full_like(recording.outcome, Outcome.TIME_OUT), recording.num_frames.copy()
    outcome[0, 16], frames[0, 16] = Outcome.BASE_COLLISION, round(5.3 / recording.dt)
    duration_s = np.where(outcome == Outcome.TIME_OUT, recording.duration_s, 5.3).astype(np.float32)
    wanted = on_elite(show.opened_run.archive, 0, policy=str(show.robot.policy_file), replicas=20)
    return wanted, dataclasses.replace(recording, outcome=outcome, num_frames=frames, duration_s=duration_s)


@pytest.fixture
def shown(show, worst_crossed, tmp_path):
    recordings = Recordings(show.robot, folder=tmp_path)
    recordings.keep(*worst_crossed)
    shown = Shown(show, recordings)
    yield shown
    shown.close()


@pytest.fixture
def tab(shown):
    return shown.tab


def status(tab) -> str:
    return re.sub(r"<.*?>", "", tab._panel._status.content)


def notes(shown, count, visitor=0):
    """The last notes at the top of a page, once there are so many."""
    until = time.perf_counter() + 10.0
    while len(found := shown.visitors[visitor].notes) < count:
        assert time.perf_counter() < until, found
        time.sleep(0.05)
    return found


def test_the_worst_elite_is_there_with_its_crossing(tab):
    assert "Elite 0" in tab._panel._details.content
    assert status(tab).startswith("Episode 1: out of time after 20.0 s. All 20: 19 out of time, 1 base collision")
    assert tab.scene._robot.visible and not tab._panel._play.disabled
    place = tab._selection.listed.index(0)
    assert tab._list._lines[place].label.startswith("0: fault · goal 2% ")
    assert tab._clock.duration_s == pytest.approx(20.0)


def test_what_one_tab_does_no_other_tab_sees(shown):
    one, two = shown.tab, shown.come("?elite=171&t=3")
    assert "Elite 0" in one._panel._details.content and "Elite 171" in two._panel._details.content
    before = two._list._count.content
    shown.do(
        (one.choose_replica, 16), (one.seek, 2.0), (one._list.brush, "goal_rate", 0.9, 1.0), (one.set_follow, True)
    )
    shown.do((one.play,))
    assert one.playing and not two.playing and not two.scene.follow
    assert two._list._count.content == before and two._selection.picked == 171 and two._replica == 0
    shown.do((two.pick, 0))
    assert status(two).startswith("Episode 1: out of time") and two._clock.time_s == 0.0
    assert status(one).startswith("Episode 17: base collision")
    shown.visitors[1].close()
    until = time.perf_counter() + 10.0
    while len(shown.app.tabs) > 1 and time.perf_counter() < until:
        shown.app.do_asked(wait_s=0.1)
    assert list(shown.app.tabs.values()) == [one] and one.playing  # one is left alone


def test_a_link_opens_what_it_was_copied_from(shown):
    shown.do(
        (shown.tab.choose_replica, 16),
        (shown.tab.choose_controller, "other"),
        (shown.tab.seek, 1.25),
        (shown.tab.set_follow, True),
        (shown.tab.copy_link,),
    )
    query = shown.tab._query
    assert query.startswith("elite=0&controller=other&episode=17&t=1.25&follow=1&initialCameraPosition=")
    two = shown.come(f"?{query}&darkMode=")
    assert (two._controller, two._replica, two._clock.time_s) == ("other", 16, 1.25)
    assert two._panel._controller.value == "other" and two._panel._episode.value.startswith("17: base collision")
    assert two.scene.follow and two._panel._follow.value
    two.show_address()
    assert two._query.startswith("darkMode=&elite=0&controller=other&episode=17&t=1.25&follow=1")
    until = time.perf_counter() + 10.0
    while not any(two._query in script for script in shown.visitors[1].scripts):
        assert time.perf_counter() < until
        time.sleep(0.05)


def test_what_is_not_there_is_refused_in_words(shown):
    count = len(shown.tab._archive)
    shown.come("?elite=99999&controller=C-HR&episode=21&t=soon")
    assert notes(shown, 4, visitor=1) == [
        "t=soon in the address is no time in seconds: it is left out.",
        f"There is no elite 99999 here: there are 0 to {count - 1}.",
        "There is no controller 'C-HR' here: there are base, other.",
        "There is no episode 21 here: there are 1 to 20.",
    ]
    shown.do((shown.tab.pick_typed, "99999"), (shown.tab.pick_typed, "-3"), (shown.tab.pick_typed, "17.5"))
    assert [words.split(" here")[0] for words in notes(shown, 3)] == [
        f"There is no elite '{text}'" for text in ("99999", "-3", "17.5")
    ]
    assert shown.tab._selection.picked == 0 and shown.tab._list._number.value == "0"
    shown.do((shown.tab.pick_typed, " 171 "))
    assert shown.tab._selection.picked == 171


def test_what_touches_is_coloured_while_it_touches(shown):
    tab = shown.tab
    touching, names = tab._recording.touching[0, 0], tab._recording.geom_names
    shank = names.index("RF_SHANK")
    for frame in (int(np.argmax(touching[:, shank])), int(np.flatnonzero(~touching[:, shank])[0])):
        shown.do((tab.seek, 0.02 * frame))
        assert [tab.scene._touches[name].visible for name in names] == touching[frame].tolist()
    tab._recording = dataclasses.replace(tab._recording, touching=None, geom_names=())
    tab._show_episode()
    assert not any(handle.visible for handle in tab.scene._touches.values())
    assert "before touches of bodies were kept" in status(tab)


def test_a_pick_shows_its_terrain_within_a_second(shown):
    tab = shown.tab
    for number in (171, 0, 171, 0):  # without a recording and with one
        began = time.perf_counter()
        shown.do((tab.pick, number))
        assert time.perf_counter() - began < PICK_LIMIT_S
        assert f"Elite {number}" in tab._panel._details.content
    assert "All 20: 19 out of time, 1 base collision" in status(tab)


def test_playing_and_dragging_move_the_robot(shown):
    tab = shown.tab
    before = tab.scene._bodies[0].position.copy()
    shown.do((tab.seek, 5.0))
    assert tab.scene._bodies[0].position[0] > before[0] + 1.0
    assert tab._panel._time.value == 5.0
    shown.do((tab.play,))
    assert tab._clock.playing and tab._panel._play.label == "Pause"
    shown.do(
        (tab.play,),
        (tab.set_speed, 0.25),
        (tab.set_follow, True),
        (tab.set_forces, False),
        (tab.scene.set_show_paths, False),
    )
    assert not tab._clock.playing and tab._clock.speed == 0.25
    assert not any(arrow.visible for arrow in tab.scene._forces) and not any(path.visible for path in tab.scene._paths)
    pushing = tab._crossing.force_newtons >= 100.0
    frame = int(np.flatnonzero(pushing.any(axis=1))[0])
    shown.do((tab.set_forces, True), (tab.seek, 0.02 * frame))
    seen = np.array([arrow.visible for arrow in tab.scene._forces])
    assert seen.any() and seen[pushing[frame]].all()


def test_a_minimal_terrain_is_shown_instead(show, worst_crossed, tmp_path):
    genes = show.opened_run.archive.genes[0].copy()
    genes[:8] = 0.0
    entry = {"elite": 0, "bumps": [1], "of": 8, "goal_rate": 0.1, "goal_interval": [0.03, 0.25], "cause": None,
             "margin_m": None}  # fmt: skip
    minima = MinimalFound(numbers={"elites": [entry]}, genes={0: genes})
    recordings = Recordings(show.robot, folder=tmp_path)
    recordings.keep(*worst_crossed)
    shown = Shown(dataclasses.replace(show, minima=minima), recordings)
    tab = shown.tab
    try:
        assert tab._panel._terrain.visible and tab._panel._terrain.value == "whole"
        assert "**Minimal terrain**: 1 of 8 parts; goal reached 10% (3 to 25%)" in tab._panel._details.content
        shown.do((tab.choose_terrain, True))
        assert shown.asked[-1].label == "minimal terrain of elite 0 of anymal" and not tab.scene._robot.visible
        np.testing.assert_array_equal(shown.asked[-1].terrain, genes)
        tab.show_address()
        assert "terrain=minimal" in tab._query and shown.come(f"?{tab._query}").genes is genes
        shown.do((tab.pick, 7))
        assert tab.genes is None and not tab._panel._terrain.visible
        shown.come("?elite=7&terrain=minimal")
        assert notes(shown, 1, visitor=2) == ["Elite 7 has no minimal terrain here."]
    finally:
        shown.close()


def test_a_second_controller_crosses_beside_it_as_a_ghost(shown):
    tab = shown.tab
    assert not tab.scene._ghost.visible and tab._panel._ghost.value == "who certifies it"  # nobody does here
    assert "0% (0 to 16%)" in tab._panel._details.content  # none of 20 reached the goal: Wilson
    shown.do((tab.choose_ghost, "other"), (tab.seek, 5.0))  # the same file, so the same crossing
    assert tab._panel._details.content.count("5% (1 to 24%)") == 2  # one base collision of 20, of both
    assert tab.scene._ghost.visible and tab.scene._robot.visible
    np.testing.assert_array_equal(tab.scene._ghosts[0].position, tab.scene._bodies[0].position)
    assert tab.scene._ghosts[0].opacity == 0.4
    assert "Ghost, other: " in tab._panel._ghost_status.content
    tab.show_address()
    assert "&ghost=other" in tab._query
    assert shown.come(f"?{tab._query}").scene._ghost.visible
    shown.do((tab.choose_controller, "other"))  # none is its own ghost
    assert not tab.scene._ghost.visible and tab._panel._ghost_status.content == ""
    shown.do((tab.choose_controller, "base"), (tab.choose_ghost, "none"))
    assert not tab.scene._ghost.visible


def test_what_was_never_recorded_is_asked_for_and_shown_when_it_comes(shown):
    tab = shown.tab
    recording = tab._recording
    shown.do((tab.pick, 7))
    wanted = shown.asked[-1]
    assert (wanted.label, wanted.replicas) == ("elite 7 of anymal", 20)
    assert not tab.scene._robot.visible and tab._panel._play.disabled
    shown.do((shown.app.show_report, Report(wanted=wanted, text="crossing", share=0.4)))
    assert status(tab) == "Recording 20 episodes of base: crossing …" and tab._panel._progress.value == 40.0
    other = dataclasses.replace(wanted, terrain_seed=8)
    shown.do((shown.app.show_report, Report(wanted=other, text="no", failed=True)))
    assert "crossing" in status(tab)  # of what is not shown nothing is said
    shown.do((shown.app.show_report, Report(wanted=wanted, text="it <broke>", failed=True)))
    assert status(tab) == "No crossing: it &lt;broke&gt;"
    shown.do((shown.app.show_report, Report(wanted=wanted, text="recorded", recording=recording)))
    assert status(tab).startswith("Episode 1: out of time") and tab.scene._robot.visible


def test_without_a_controller_terrains_are_shown_all_the_same(show, tmp_path):
    bare = dataclasses.replace(show, controllers={}, note="it is <lost>")
    shown = Shown(bare, Recordings(show.robot, folder=tmp_path))
    tab = shown.tab
    try:
        shown.do((tab.pick, 3), (tab.play,), (tab.seek, 1.0), (tab.choose_replica, 2), (tab.set_follow, True))
        assert status(tab) == "No crossing: it is &lt;lost&gt;" and "Elite 3" in tab._panel._details.content
    finally:
        shown.close()


@pytest.mark.slow
def test_the_command_serves_a_page_and_ends_on_ctrl_c(run, tmp_path):
    port = free_port()
    process, lines = serve(view_command("--run", str(run), "--port", str(port), "--cache", str(tmp_path)))
    assert b"<html" in urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=10).read().lower()
    process.send_signal(signal.SIGINT)
    rest = process.communicate(timeout=180)[0]
    assert process.returncode == 0 and "Traceback" not in rest
    assert any(f"{len(read_archive(run)):,} elites of anymal." in line for line in lines)
