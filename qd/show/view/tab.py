"""A browser tab: what it shows, and what happens when its visitor does something. No tab knows of another."""

import time
from collections.abc import Callable
from html import escape

import numpy as np
import viser
from numpy.typing import NDArray

from qd.show.crossed import crossed_of
from qd.show.recordings import Wanted, on_elite
from qd.show.view.address import Address, copy_text, keep_keys, let_point, show_query
from qd.show.view.common import Common
from qd.show.view.ghost import CERTIFYING, Ghost
from qd.show.view.panels import ArchivePanel, Clock, CrossingPanel, Selection
from qd.show.view.playing import (
    Crossing,
    crossing_of,
    ending_words,
    endings,
    episodes_by_outcome,
    moment_text,
    next_mark,
    paths_of,
)
from qd.show.view.plots import Curves
from qd.show.view.recorder import Report
from qd.show.view.scene import Scene, View, first_view_of, overview_of
from qd.show.view.show import SEARCHED
from sim.bank import terrains_of
from sim.files.command import command_line
from sim.recording.recorder import Recording

_NUMBERS_S = 0.2
"""Real time from one update of curves and numbers to the next, while playing."""
_ADDRESS_S = 1.0
"""Real time from one update of the address to the next; browsers take no more than some three a second."""


class Tab:
    """What one tab shows; all methods are called by the loop."""

    def __init__(self, client: viser.ClientHandle, common: Common, address: Address, refused: list[str]) -> None:
        """Lay out the page and show what its address asks for; ``refused`` says what of the address means nothing."""
        self.client, self.common = client, common
        show = common.show
        self._archive, self._others = show.opened_run.archive, address.others
        self.selection, self.clock = Selection(show.axes), Clock()
        self.controller = next(iter(show.controllers), None)
        self._minimal = False  # whether the elite's minimal terrain is wanted, where it has one
        self.replica = 0
        self._begin_s = address.time_s or 0.0  # where the next crossing begins
        self.recording: Recording | None = None
        self._groups: dict[str, list[int]] = {}
        self._group = ""  # of the episodes to choose from
        self.crossing: Crossing | None = None
        self._curves: Curves | None = None
        self.query, self._numbers_at, self._address_at = "", 0.0, time.perf_counter()
        self.ghost = Ghost(common, client.client_id)
        self.scene = Scene(client, common.shapes)
        title = f"{show.robot.name} · {show.opened_run.folder} · {len(self._archive):,} elites"
        self.list = ArchivePanel(client, self.selection, title, self)
        self.panel = CrossingPanel(client, list(show.controllers), self)
        keep_keys(client)
        let_point(client)
        self._open(address, refused)

    def _open(self, address: Address, refused: list[str]) -> None:
        show = self.common.show
        for words in refused:
            self.refuse(words)
        first = self.selection.picked if show.elite is None else show.elite
        elite = first if address.elite is None else address.elite
        if not 0 <= elite < len(self._archive):
            self.refuse(self._no_elite(elite))
            elite = first
        for name, choices in ((address.controller, show.controllers), (address.ghost, self.ghost.choices)):
            if name is not None and name not in choices:
                self.refuse(f"There is no controller '{name}' here: there are {', '.join(show.controllers) or 'none'}.")
        if address.controller in show.controllers:
            self.controller = address.controller
        if address.ghost in self.ghost.choices:
            self.ghost.choice = address.ghost
        self._minimal = address.minimal or (address.elite is None and show.minimal)
        if address.minimal and (show.minima is None or elite not in show.minima.genes):
            self.refuse(f"Elite {elite} has no minimal terrain here.")
        if address.episode is not None:
            self.choose_replica(address.episode - 1, self._begin_s)
        if address.camera is None:
            self.look(first_view_of)
        self.selection.pick(elite)
        self.list.show()
        if self.controller is not None:
            self.panel.controller.value = self.controller
        self._show_elite()
        if address.follow:
            self.set_follow(True)

    @property
    def playing(self) -> bool:
        """Whether time goes by."""
        return self.clock.playing and self.crossing is not None

    def tick(self, real_s: float) -> None:
        """Let real time go by [s]: show the next frame if it plays, and keep the address up to date."""
        now = time.perf_counter()
        if self.playing:
            self.clock.tick(real_s)
            self._show_frame()
            if now - self._numbers_at > _NUMBERS_S or not self.clock.playing:
                self._numbers_at = now
                self._show_moment()
        if now - self._address_at > _ADDRESS_S:
            self.show_address()

    def show_address(self) -> None:
        """Have the browser's address say what the tab shows."""
        self._address_at = time.perf_counter()
        camera = self.client.camera
        position, look_at = ((float(x), float(y), float(z)) for x, y, z in (camera.position, camera.look_at))
        address = Address(
            elite=self.selection.picked,
            controller=self.controller,
            ghost=None if self.ghost.choice == CERTIFYING else self.ghost.choice,
            minimal=self.genes is not None,
            episode=self.replica + 1,
            time_s=self.clock.time_s if self.crossing is not None else self._begin_s,
            follow=self.scene.follow,
            camera=(position, look_at),
            others=self._others,
        )
        query = address.query()
        if query != self.query:
            self.query = query
            show_query(self.client, query)

    def copy_link(self) -> None:
        """Have the browser copy the link to what the tab shows."""
        self.show_address()
        copy_text(self.client, None)
        self.client.add_notification("Link copied", "It opens what this tab shows.", auto_close_seconds=3.0)

    def copy_command(self) -> None:
        """Have the browser copy the command that replays what the tab shows."""
        show, name, space = self.common.show, self.controller, self.common.show.opened_run.space
        terrain = {"elite" if self.genes is None else "minimal": self.selection.picked}
        text = command_line(
            "replay", robot=show.robot.spec, run=show.opened_run.path, space=space.name if space.sha256 else None,
            policy=None if name is None or name == SEARCHED else show.controllers[name], replicas=show.replicas,
            **terrain,
        )  # fmt: skip
        copy_text(self.client, text)
        self.client.add_notification("Command copied", text, auto_close_seconds=6.0)

    @property
    def genes(self) -> NDArray[np.float32] | None:
        """Of the minimal terrain that is shown; None while the whole terrain is shown."""
        minima = self.common.show.minima
        return None if minima is None or not self._minimal else minima.genes.get(self.selection.picked)

    def choose_terrain(self, minimal: bool) -> None:
        """Show the elite's minimal terrain, or the whole one."""
        if minimal != self._minimal:
            self._minimal, self._begin_s = minimal, 0.0
            self._show_elite()

    def refuse(self, words: str) -> None:
        """Say at the top of the page what does not exist here."""
        self.client.add_notification("Not here", words, color="red", auto_close_seconds=12.0)

    def _no_elite(self, number: object) -> str:
        return f"There is no elite {number} here: there are 0 to {len(self._archive) - 1}."

    def look(self, view_of: Callable[[int, int], View]) -> None:
        """Move the camera to a view that depends on the picture's width and height."""
        camera = self.client.camera
        self.scene.go_to(view_of(camera.image_width, camera.image_height))

    def overview(self) -> None:
        """Show the whole terrain, and stop following."""
        self.set_follow(False)
        self.look(overview_of)

    def pick_line(self, line: int) -> None:
        """Show the elite on a line of the list."""
        listed = self.selection.listed
        if line < len(listed):  # else the list was drawn anew while the click was on its way
            self.pick(listed[line])

    def step(self, by: int) -> None:
        """Show the next (1) or previous (-1) elite of the list."""
        self.pick(self.selection.step(by))

    def pick_typed(self, text: str) -> None:
        """Show the elite whose number was typed, or say that there is none."""
        number = int(text) if text.strip().isdecimal() else -1
        if 0 <= number < len(self._archive):
            self.pick(number)
        else:
            self.refuse(self._no_elite(f"'{text}'"))
            self.list.show()

    def pick(self, number: int) -> None:
        """Show an elite."""
        changed = self.selection.pick(number)
        self.list.show()
        if changed:
            self._begin_s = 0.0
            self._show_elite()

    def choose_controller(self, name: str) -> None:
        """Show the crossings of another controller."""
        if name in self.common.show.controllers and name != self.controller:
            self.controller, self._begin_s = name, 0.0
            self._show_crossings()

    def choose_ghost(self, name: str) -> None:
        """Show the crossings of a second controller beside the chosen one's."""
        if name in self.ghost.choices and name != self.ghost.choice:
            self.ghost.choice = name
            self._load_ghost()
            self._show_ghost()

    def choose_group(self, name: str) -> None:
        """Choose from the episodes that have something in common."""
        if name in self._groups:
            self._group = name
            if self.replica not in self._groups[name]:
                self.choose_replica(self._groups[name][0])
            self._show_episodes()

    def step_replica(self, by: int) -> None:
        """Show the next (1) or previous (-1) episode of those to choose from; the first follows the last."""
        episodes = self._groups.get(self._group, [])
        if episodes:
            place = episodes.index(self.replica) if self.replica in episodes else -1
            self.choose_replica(episodes[(place + by) % len(episodes)])

    def choose_replica(self, replica: int, begin_s: float = 0.0) -> None:
        """Show another episode, counted from 0, from a time [s]."""
        if not 0 <= replica < self.common.show.replicas:
            self.refuse(f"There is no episode {replica + 1} here: there are 1 to {self.common.show.replicas}.")
            return
        self.replica, self._begin_s = replica, begin_s
        if self.recording is not None:
            self._show_episode()

    def play(self) -> None:
        """Play or pause."""
        if self.crossing is not None:
            self.clock.toggle()
            self._show_moment()

    def seek(self, time_s: float) -> None:
        """Show a time [s]."""
        if self.crossing is not None:
            self.clock.seek(time_s)
            self._show_frame()
            self._show_moment()

    def go_on(self, by_s: float) -> None:
        """Pause, and show a later or earlier time [s]."""
        self.clock.playing = False
        self.seek(self.clock.time_s + by_s)

    def go_to_next_mark(self) -> None:
        """Pause at the next mark."""
        if self.crossing is not None:
            self.clock.playing = False
            self.seek(next_mark(self.crossing.marks, self.clock.time_s).time_s)

    def set_speed(self, speed: float) -> None:
        """Play at a speed in simulated seconds a real one."""
        self.clock.speed = speed

    def set_follow(self, follow: bool) -> None:
        """Go along with the robot, or stay."""
        self.scene.set_follow(follow)
        self.panel.follow.value = follow

    def toggle_follow(self) -> None:
        """Follow the robot, or stop following."""
        self.set_follow(not self.scene.follow)

    def set_forces(self, shown: bool) -> None:
        """Show or hide the forces of the feet."""
        self.scene.show_forces = shown
        self._show_frame()

    def set_names(self, shown: bool) -> None:
        """Show or hide the names of the feet."""
        self.scene.show_names = shown
        self._show_frame()

    def show_report(self, report: Report) -> None:
        """Say how far a recording is, and show it, if it is one of this tab."""
        ghost_words = self.ghost.take_report(report)
        if ghost_words is not None:
            self.panel.show_ghost(self.ghost.choice, ghost_words)
            if report.recording is not None:
                self._show_details()
                self._show_ghost()
        if report.wanted != self._wanted(self.selection.picked, self.genes) or self.recording is not None:
            return
        if report.recording is not None:
            self._show_recording(report.recording)
        elif report.failed:
            self.panel.show_status(f"No crossing: {escape(report.text)}")
        else:
            text = f"Recording {report.wanted.replicas} episodes of {escape(str(self.controller))}: {report.text} …"
            self.panel.show_status(text, report.share)

    def leave(self) -> None:
        """Ask for nothing more; the browser is gone."""
        self.clock.playing = False
        self.common.recorder.record(None, tab=self.client.client_id)
        self.common.recorder.record_ahead([], tab=self.client.client_id)
        self.ghost.leave()

    def _wanted(self, number: int, genes: NDArray[np.float32] | None = None) -> Wanted | None:
        """The chosen controller's crossings of an elite, or of genes of its minimal terrain; None without one."""
        show = self.common.show
        if self.controller is None:
            return None
        policy = show.controllers[self.controller]
        return on_elite(self._archive, number, policy=policy, replicas=show.replicas, minimal=genes)

    def _record_ahead(self) -> None:
        """Have the crossings of the neighbours in the list recorded while nobody waits."""
        near = dict.fromkeys(self.selection.step(by) for by in (1, -1))
        crossings = [wanted for wanted in map(self._wanted, near) if wanted is not None]
        missing = [wanted for wanted in crossings if self.common.recordings.may_keep(wanted)]
        self.common.recorder.record_ahead(missing, tab=self.client.client_id)

    def _show_elite(self) -> None:
        show, elite, genes = self.common.show, self.selection.picked, self.genes
        self.panel.show_terrain(show.minima is not None and elite in show.minima.genes, genes is not None)
        shown = self._archive.genes[elite] if genes is None else genes
        heights, ground = terrains_of(shown[None], show.opened_run.space)
        self.scene.set_terrain(heights[0], ground)
        self._show_crossings()

    def _show_details(self) -> None:
        """Say what is known of the elite, with the rates of the crossings that are shown."""
        minima, number = self.common.show.minima, self.selection.picked
        rates = {
            f"{name} ({role})": crossed_of(recording, self._archive.penalties, self._archive.scales).rates
            for name, recording, role in (
                (self.controller, self.recording, "shown"),
                (self.ghost.name, self.ghost.recording, "ghost"),
            )
            if recording is not None
        }
        details = self.common.show.axes.details(number, rates)
        if minima is not None and number in minima.genes:
            details += f"\n\n**Minimal terrain**: {minima.words(number)}."
        self.panel.details.content = details

    def _load_ghost(self) -> None:
        """Load the ghost's recording of the elite that is shown, or ask for it."""
        words = self.ghost.load(self.selection.picked, self.controller, self.genes)
        self.panel.show_ghost(self.ghost.choice, words)
        self._show_details()

    def _show_ghost(self) -> None:
        """Show the ghost's crossing of the episode beside the robot's; time lasts as long as the longer one."""
        words = self.ghost.show_episode(self.replica)
        crossing, ghost = self.crossing, self.ghost.crossing
        self.scene.hide_ghost()
        if crossing is not None:
            self.clock.duration_s = max(crossing.duration_s, 0.0 if ghost is None else ghost.duration_s)
            self.clock.seek(self.clock.time_s)
            self.panel.show_ghost(self.ghost.choice, words)
            self.panel.show_controls(self.clock, enabled=True)
            self._show_frame()

    def _show_crossings(self) -> None:
        """Show the picked elite's crossings if they are recorded, else have them recorded."""
        self.recording = self.crossing = self._curves = None
        self._groups = {}
        self.scene.hide_crossing()
        self._load_ghost()
        self.clock.load(0.0)
        self.panel.show_controls(self.clock, enabled=False)
        self.panel.curves.content = self.panel.numbers.content = ""
        wanted = self._wanted(self.selection.picked, self.genes)
        recording = None if wanted is None else self.common.recordings.read(wanted)
        self.common.recorder.record(None if recording is not None else wanted, tab=self.client.client_id)
        if recording is not None:
            self._show_recording(recording)
        elif wanted is None:
            self.panel.show_status(f"No crossing: {escape(self.common.show.note)}")
        else:
            self.panel.show_status(f"Recording {wanted.replicas} episodes of {escape(str(self.controller))} …", 0.0)

    def _show_recording(self, recording: Recording) -> None:
        self.recording = recording
        self._groups = episodes_by_outcome(recording)
        self._group = next(iter(self._groups))
        self._show_details()
        self.scene.set_paths(paths_of(recording))
        self._show_episode()
        self._record_ahead()

    def _show_episodes(self) -> None:
        """Offer the episodes to choose from, and say which is shown."""
        recording = self.recording
        if recording is not None:
            words = {k: f"{k + 1}: {ending_words(recording, k)}" for k in self._groups[self._group]}
            self.panel.show_episodes(list(self._groups), self._group, words, self.replica)

    def _show_episode(self) -> None:
        assert self.recording is not None
        archive, recording, number = self._archive, self.recording, self.replica + 1
        if self.replica not in self._groups[self._group]:
            self._group = next(iter(self._groups))
        crossing = crossing_of(recording, self.replica, self.common.skeleton, archive.penalties, archive.scales)
        self.crossing = crossing
        date, commit = (str(recording.origin.get(name, "")) for name in ("date", "commit"))
        status = (
            f"All {recording.num_episodes}: {endings(recording)} ({escape(f'recorded {date[:10]} at {commit[:8]}')})."
        )
        if crossing is None:
            self.clock.load(0.0)
            status = f"<b>Episode {number} broke at once.</b> {status}"
        else:
            self.clock.load(crossing.duration_s)
            self._show_ghost()
            self.clock.seek(self._begin_s)
            self._curves = Curves(crossing, archive.penalties)
            status = f"<b>Episode {number}: {crossing.ending} after {crossing.duration_s:.1f} s.</b> {status}"
            if crossing.touching is None:
                status += " It was recorded before touches of bodies were kept."
            self._show_frame()
            self._show_moment()
        self.panel.show_status(status)
        self._show_episodes()
        self.panel.show_controls(self.clock, enabled=crossing is not None)

    def _show_frame(self) -> None:
        if self.crossing is not None:
            self.scene.show_frame(self.crossing, self.clock.frame(self.crossing.dt, self.crossing.num_frames))
            if (ghost := self.ghost.crossing) is not None:
                self.scene.show_ghost(ghost, self.clock.frame(ghost.dt, ghost.num_frames), self.ghost.name or "")

    def _show_moment(self) -> None:
        crossing, curves = self.crossing, self._curves
        if crossing is not None and curves is not None:
            frame = self.clock.frame(crossing.dt, crossing.num_frames)
            numbers = moment_text(crossing, frame, self._archive.penalties, self.common.shapes.feet)
            self.panel.curves.content, self.panel.numbers.content = curves.at(self.clock.time_s), numbers
        self.panel.show_time(self.clock)
