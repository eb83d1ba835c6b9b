import dataclasses
import re
import signal
import socket
import subprocess
import sys
import time
import urllib.request
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from qd.archive import read_archive
from qd.run.directory import RESULTS
from qd.show.recordings import Recordings
from qd.show.view.app import App
from qd.show.view.command import View, show_of
from qd.show.view.recorder import Report

ROOT = Path(__file__).parents[4]
PICK_LIMIT_S = 1.0
"""From a click to the terrain on its way to the browser; it takes 0.15 s."""

ARCHIVE = RESULTS.resolve() / "anymal" / "archive"


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


@pytest.fixture(scope="module")
def show(anymal):
    policies = (f"base=shipped other={anymal.policy_file}",)
    return show_of(View(run=ARCHIVE, port=free_port(), policies=policies))


@pytest.fixture
def app(show, tmp_path, monkeypatch):
    """The viewer as it opens; what it would record is kept in ``app.asked``."""
    app = App(show, Recordings(show.robot, folder=tmp_path, published=show.published))
    app.asked = []
    monkeypatch.setattr(app._recorder, "record", app.asked.append)
    yield app
    app.close()


def done(app, *asked):
    """What visitors do, done by the loop."""
    for act, *args in asked:
        app.post(act, *args)
        app.do_asked(wait_s=0.2)


def status(app) -> str:
    return re.sub(r"<.*?>", "", app._panel._status.content)


def test_the_worst_elite_is_there_with_its_crossing(app):
    assert "Elite 0" in app._panel._details.content
    assert status(app).startswith("Episode 1: out of time after 20.0 s. All 20: 19 out of time, 1 base collision")
    assert app.scene._robot.visible and not app._panel._play.disabled
    worst = app._axes.axis("fitness").values[0]
    assert app._list._lines[0].label.startswith(f"0: {worst:.1f} ")
    assert app._clock.duration_s == pytest.approx(20.0)


def test_a_folder_of_any_name_is_shown_as_text(show, tmp_path):
    folder = tmp_path / "a`<img src=x onerror=alert(1)>"
    folder.mkdir()
    (folder / "archive.npz").write_bytes((ARCHIVE / "archive.npz").read_bytes())
    odd = show_of(dataclasses.replace(show.cfg, run=folder, port=free_port()))
    app = App(odd, Recordings(odd.robot, folder=tmp_path / "cache"))
    try:
        assert "a`&lt;img src=x onerror=alert(1)&gt;" in app._list._title.content
    finally:
        app.close()


def test_paths_have_the_colours_of_the_words(app):
    assert "#0072b2" in app._panel._status.content and "#d55e00" in app._panel._status.content
    # the browser takes a vertex's colour c as ((c / 255 + 0.055) / 1.055)^2.4 of full light
    found = np.unique(np.asarray(app.scene._paths.colors).reshape(-1, 3), axis=0)
    assert found.tolist() == [[0, 43, 114], [170, 29, 0]]


def test_penalties_are_called_alike_on_axes_curves_and_in_numbers(app):
    for shown in (app._list._plot, app._panel._curves, app._panel._numbers):
        assert "yaw-rate error" in shown.content and "yaw_rate" not in shown.content
    assert "multiples of its scale" in app._panel._numbers.content


def test_opening_waits_for_no_simulation():
    command = (
        "import sys, pathlib; from qd.show.view.command import View, show_of;"
        "show_of(View(run=pathlib.Path(sys.argv[1])));"
        "import qd.show.view.app; print('newton' in sys.modules)"
    )
    archive = str(ARCHIVE)
    done = subprocess.run(
        [sys.executable, "-c", command, archive], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert done.stdout.split()[-1:] == ["False"], done.stderr


def test_a_pick_shows_its_terrain_within_a_second(app):
    for number in (171, 0, 171, 0):  # without a recording and with one
        began = time.perf_counter()
        done(app, (app.pick, number))
        assert time.perf_counter() - began < PICK_LIMIT_S
        assert f"Elite {number}" in app._panel._details.content
    assert "All 20: 19 out of time, 1 base collision" in status(app)


def test_the_list_follows_the_ranges(app):
    done(app, (app._list.brush, "goal_rate", 0.9, 1.0))
    assert (app._axes.axis("goal_rate").values[app._selection.kept] >= 0.9).all()
    assert 0 < len(app._selection.kept) < len(app._archive)
    first = int(app._selection.kept[0])
    assert app._list._lines[0].label.startswith(f"{first}: ")
    done(app, (app.pick_line, 0))
    assert app._selection.picked == first and app._list._number.value == first
    done(app, (app._list.change, app._selection.clear), (app.step, 1))
    assert app._selection.picked == first + 1
    assert len(app._selection.kept) == len(app._archive)


def test_playing_and_dragging_move_the_robot(app):
    before = app.scene._bodies[0].position.copy()
    done(app, (app.seek, 5.0))
    assert app.scene._bodies[0].position[0] > before[0] + 1.0
    assert app._panel._time.value == 5.0
    done(app, (app.play,))
    assert app._clock.playing and app._panel._play.label == "Pause"
    done(
        app,
        (app.play,),
        (app.set_speed, 0.25),
        (app.scene.set_follow, True),
        (app.set_forces, False),
        (app.scene.set_show_paths, False),
    )
    assert not app._clock.playing and app._clock.speed == 0.25
    assert not any(arrow.visible for arrow in app.scene._forces) and not app.scene._paths.visible
    pushing = app._crossing.force_newtons >= 100.0
    frame = int(np.flatnonzero(pushing.any(axis=1))[0])
    done(app, (app.set_forces, True), (app.seek, 0.02 * frame))
    seen = np.array([arrow.visible for arrow in app.scene._forces])
    assert seen.any() and seen[pushing[frame]].all()


def test_episodes_are_stepped_through(app):
    done(app, (app.seek, 5.0), (app.choose_replica, 16))
    assert status(app).startswith("Episode 17: base collision")
    assert app._clock.time_s == 0.0 and app._clock.duration_s < 20.0
    done(app, (app.choose_replica, 99))  # typed into the field
    assert status(app).startswith("Episode 20:")


def test_another_controller_has_its_own_crossing(app):
    done(app, (app.choose_controller, "other"))  # it is the same file
    assert status(app).startswith("Episode 1: out of time")
    assert app.asked[-1] is None


def test_what_was_never_recorded_is_asked_for_and_shown_when_it_comes(app):
    recording = app._recording
    done(app, (app.pick, 7))
    wanted = app.asked[-1]
    assert (wanted.label, wanted.replicas) == ("elite 7 of anymal", 20)
    assert not app.scene._robot.visible and app._panel._play.disabled
    done(app, (app.show_report, Report(wanted=wanted, text="crossing", share=0.4)))
    assert status(app) == "Recording 20 episodes of base: crossing …" and app._panel._progress.value == 40.0
    other = dataclasses.replace(wanted, terrain_seed=8)
    done(app, (app.show_report, Report(wanted=other, text="no", failed=True)))
    assert "crossing" in status(app)  # of what is not shown nothing is said
    done(app, (app.show_report, Report(wanted=wanted, text="it <broke>", failed=True)))
    assert status(app) == "No crossing: it &lt;broke&gt;"
    done(app, (app.show_report, Report(wanted=wanted, text="recorded", recording=recording)))
    assert status(app).startswith("Episode 1: out of time") and app.scene._robot.visible


def test_without_a_controller_terrains_are_shown_all_the_same(show, tmp_path):
    bare = dataclasses.replace(show, controllers={}, note="it is <lost>")
    app = App(bare, Recordings(show.robot, folder=tmp_path))
    try:
        done(app, (app.pick, 3), (app.play,), (app.seek, 1.0), (app.choose_replica, 2), (app.scene.set_follow, True))
        assert status(app) == "No crossing: it is &lt;lost&gt;" and "Elite 3" in app._panel._details.content
    finally:
        app.close()


def test_the_command_serves_a_page_and_ends_on_ctrl_c(tmp_path):
    port = free_port()
    command = [sys.executable, "-m", "faultline", "view", "--run", str(ARCHIVE), "--port", str(port)]
    command += ["--cache", str(tmp_path)]
    process = subprocess.Popen(
        command, cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell's background ignores it
    )  # fmt: skip
    assert process.stdout is not None
    lines = []
    for line in process.stdout:
        lines.append(line)
        if line.startswith("Open "):
            break
    page = urllib.request.urlopen(f"http://127.0.0.1:{port}", timeout=10).read()
    assert b"<html" in page.lower()
    again = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert again.returncode == 2 and f"port {port} of 127.0.0.1 is in use" in again.stderr
    process.send_signal(signal.SIGINT)
    rest = process.communicate(timeout=180)[0]
    assert process.returncode == 0 and "Stopped." in rest and "Traceback" not in rest
    assert any(f"{len(read_archive(ARCHIVE))} elites of anymal, ready after" in line for line in lines)


def test_bad_input_is_one_line():
    command = [sys.executable, "-m", "faultline", "view", "--run", "nowhere", "--port", str(free_port())]
    ended = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=120)
    assert ended.returncode == 2
    assert [line for line in ended.stderr.splitlines() if "Warp" not in line] == [
        "error: no archive at nowhere: give a run directory or the archive.npz of one"
    ]


def test_the_help_says_what_to_do():
    ended = subprocess.run(
        [sys.executable, "-m", "faultline", "view", "--help"], cwd=ROOT, capture_output=True, text=True, timeout=120
    )
    assert ended.returncode == 0
    for word in ("Ranges", "Worst first", "ssh -L", "Ctrl-C", "--policies", "--host"):
        assert word in ended.stdout
