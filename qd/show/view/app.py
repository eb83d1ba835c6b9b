"""The viewer's loop: one thread does everything that visitors and the recorder ask for, in turn."""

import queue
import time
from collections.abc import Callable
from html import escape
from typing import Any

import viser

from qd.show.recordings import Recordings, Wanted, on_elite
from qd.show.view.command import Show
from qd.show.view.meshes import body_meshes
from qd.show.view.panels import ArchivePanel, Clock, CrossingPanel, Selection
from qd.show.view.playing import Crossing, crossing_of, endings, moment_text, paths_of
from qd.show.view.plots import Curves, axes_of
from qd.show.view.recorder import Recorder, Report
from qd.show.view.scene import Scene
from sim.bank import heights_of
from sim.crossing import CrossingCfg
from sim.recording.recorder import Recording
from sim.robots.skeleton import Skeleton

_FRAME_S = 0.04
"""Real time from one shown frame to the next."""
_NUMBERS_S = 0.2
"""Real time from one update of curves and numbers to the next."""


class Page(viser.ViserServer):
    """A viser page that never tunnels itself to the internet, whatever a visitor sends."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Nothing: an archive and its controllers are the user's own."""
        return None


class App:
    """What is shown, and what happens when a visitor does something."""

    def __init__(self, show: Show, recordings: Recordings) -> None:
        """Open the page and show an elite.

        Args:
            show: What to show.
            recordings: Those that are kept.

        Raises:
            ValueError: If the robot's file cannot be shown.
        """
        self._show, self._recordings = show, recordings
        self._archive = show.found.archive
        self._skeleton = Skeleton(show.robot)
        self._axes = axes_of(self._archive)
        self._selection, self._clock = Selection(self._axes), Clock()
        self._controller = next(iter(show.controllers), None)
        self._replica = 0
        self._recording: Recording | None = None
        self._crossing: Crossing | None = None
        self._curves: Curves | None = None
        self._asked: queue.SimpleQueue[tuple[Callable[..., None], tuple[Any, ...]]] = queue.SimpleQueue()
        self.page = Page(host=show.cfg.host, port=show.cfg.port, label="faultline", verbose=False)
        self._recorder = Recorder(show.robot, lambda report: self.post(self.show_report, report))
        self._open()

    def _open(self) -> None:
        gui, show = self.page.gui, self._show
        gui.configure_theme(show_logo=False, show_share_button=False)
        bodies, num_feet = body_meshes(self._skeleton, show.robot), len(show.robot.foot_geoms)
        self.scene = Scene(self.page, bodies, num_feet, CrossingCfg())
        title = f"{show.robot.name} · {show.found.folder} · {len(self._archive):,} elites"
        self._list = ArchivePanel(self.page, self._axes, self._selection, title, self)
        self._panel = CrossingPanel(self.page, list(show.controllers), show.cfg.replicas, self)
        self._selection.pick(show.elite)
        self._list.show()
        self._show_elite()

    def post(self, act: Callable[..., None], *args: Any) -> None:
        """Have one of the methods below called by the loop; from any thread."""
        self._asked.put((act, args))

    def close(self) -> None:
        """End the recording processes and the page."""
        self._recorder.stop()
        self.page.stop()

    def run(self) -> None:
        """Serve until interrupted."""
        last = told = time.perf_counter()
        while True:
            self.do_asked(wait_s=_FRAME_S if self._clock.playing else 1.0)
            now = time.perf_counter()
            if self._clock.playing and self._crossing is not None:
                self._clock.tick(now - last)
                self._show_frame()
                if now - told > _NUMBERS_S or not self._clock.playing:
                    told = now
                    self._show_moment()
            last = now

    def do_asked(self, wait_s: float) -> None:
        """Do what was asked for, or wait for it; while playing, the whole time.

        Of several settings of one control, as dragging makes, only the last one counts.
        """
        until = time.perf_counter() + wait_s
        only_last = (self.seek, self.choose_replica, self.show_report)
        found: dict[Any, tuple[Callable[..., None], tuple[Any, ...]]] = {}
        while (left := until - time.perf_counter()) > 0.0:
            try:
                act, args = self._asked.get(timeout=left)
            except queue.Empty:
                break
            key: Any = act if act in only_last else (act, args[0]) if act == self._list.brush else object()
            found.pop(key, None)
            found[key] = (act, args)
            if not self._clock.playing and self._asked.empty():
                break
        for act, args in found.values():
            act(*args)

    def pick_line(self, line: int) -> None:
        """Show the elite on a line of the list."""
        listed = self._selection.listed
        if line < len(listed):  # else the list was drawn anew while the click was on its way
            self.pick(listed[line])

    def step(self, by: int) -> None:
        """Show the next (1) or previous (-1) elite of the list."""
        self.pick(self._selection.step(by))

    def pick(self, number: int) -> None:
        """Show an elite."""
        if not 0 <= number < len(self._archive):  # a number field can be typed into
            return
        changed = self._selection.pick(number)
        self._list.show()
        if changed:
            self._show_elite()

    def choose_controller(self, name: str) -> None:
        """Show the crossings of another controller."""
        if name in self._show.controllers and name != self._controller:
            self._controller = name
            self._show_crossings()

    def choose_replica(self, replica: int) -> None:
        """Show another episode, counted from 0."""
        self._replica = min(max(replica, 0), self._show.cfg.replicas - 1)
        if self._recording is not None:
            self._show_episode()

    def play(self) -> None:
        """Play or pause."""
        if self._crossing is not None:
            self._clock.toggle()
            self._show_moment()

    def seek(self, time_s: float) -> None:
        """Show a time [s]."""
        if self._crossing is not None:
            self._clock.seek(time_s)
            self._show_frame()
            self._show_moment()

    def set_speed(self, speed: float) -> None:
        """Play so many simulated seconds in a real one."""
        self._clock.speed = speed

    def set_forces(self, shown: bool) -> None:
        """Show or hide the forces of the feet."""
        self.scene.show_forces = shown
        self._show_frame()

    def show_report(self, report: Report) -> None:
        """Say how a recording goes on, keep it, and show it if it is still wanted."""
        if report.recording is not None:
            self._recordings.keep(report.wanted, report.recording)
        if report.wanted != self._wanted():
            return
        if report.recording is not None:
            self._show_recording(report.recording)
        elif report.failed:
            self._panel.show_status(f"No crossing: {escape(report.text)}")
        else:
            text = f"Recording {report.wanted.replicas} episodes of {self._controller}: {report.text} …"
            self._panel.show_status(text, report.share)

    def _wanted(self) -> Wanted | None:
        """The crossings that are to be shown; None without a controller."""
        if self._controller is None:
            return None
        policy, replicas = self._show.controllers[self._controller], self._show.cfg.replicas
        return on_elite(self._archive, self._selection.picked, policy=policy, replicas=replicas)

    def _show_elite(self) -> None:
        elite = self._selection.picked
        self.scene.set_terrain(heights_of(self._archive.genes[elite : elite + 1], self._show.found.space)[0])
        self._panel.show_elite(self._axes.details(elite))
        self._show_crossings()

    def _show_crossings(self) -> None:
        """Show the picked elite's crossings if they are recorded, else have them recorded."""
        self._recording = self._crossing = self._curves = None
        self.scene.hide_crossing()
        self._clock.load(0.0)
        self._panel.show_controls(self._clock, self._replica, enabled=False)
        self._panel.show_moment("", "")
        wanted = self._wanted()
        recording = None if wanted is None else self._recordings.read(wanted)
        self._recorder.record(None if recording is not None else wanted)
        if recording is not None:
            self._show_recording(recording)
        elif wanted is None:
            self._panel.show_status(f"No crossing: {escape(self._show.note)}")
        else:
            self._panel.show_status(f"Recording {wanted.replicas} episodes of {self._controller} …", 0.0)

    def _show_recording(self, recording: Recording) -> None:
        self._recording = recording
        self.scene.set_paths(paths_of(recording))
        self._show_episode()

    def _show_episode(self) -> None:
        assert self._recording is not None
        archive = self._archive
        crossing = crossing_of(self._recording, self._replica, self._skeleton, archive.penalties, archive.scales)
        self._crossing = crossing
        origin = self._recording.origin
        made = escape(f"recorded {str(origin.get('date', ''))[:10]} at {str(origin.get('commit', ''))[:8]}")
        all_of_them = f"All {self._recording.num_episodes}: {endings(self._recording)} ({made})."
        if crossing is None:
            self._clock.load(0.0)
            self._panel.show_status(f"<b>Episode {self._replica + 1} broke at once.</b> {all_of_them}")
        else:
            self._clock.load(crossing.duration_s)
            self._curves = Curves(crossing.times_s, crossing.penalties, self._archive.penalties)
            ended = f"<b>Episode {self._replica + 1}: {crossing.ending} after {crossing.duration_s:.1f} s.</b>"
            self._panel.show_status(f"{ended} {all_of_them}")
            self._show_frame()
            self._show_moment()
        self._panel.show_controls(self._clock, self._replica, enabled=crossing is not None)

    def _show_frame(self) -> None:
        if self._crossing is not None:
            self.scene.show_frame(self._crossing, self._clock.frame(self._crossing.dt, self._crossing.num_frames))

    def _show_moment(self) -> None:
        crossing, curves = self._crossing, self._curves
        if crossing is not None and curves is not None:
            frame = self._clock.frame(crossing.dt, crossing.num_frames)
            self._panel.show_moment(
                curves.at(self._clock.time_s), moment_text(crossing, frame, self._archive.penalties)
            )
        self._panel.show_time(self._clock)
