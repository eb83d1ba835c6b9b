"""A browser tab: what it shows, and what happens when its visitor does something. No tab knows of another."""

import time
from collections.abc import Callable
from html import escape

import numpy as np
import viser
from numpy.typing import NDArray

from qd.show.crossed import crossed_of
from qd.show.recordings import Wanted, on_elite
from qd.show.view.address import Address, copy_link, copy_text, keep_keys, show_query
from qd.show.view.common import Common
from qd.show.view.ghost import CERTIFYING, Ghost
from qd.show.view.panels import ArchivePanel, Clock, CrossingPanel, Selection, add_keys
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
from qd.show.view.pointing import let_point
from qd.show.view.recorder import Report
from qd.show.view.scene import Scene, View, first_view_of, overview_of
from qd.show.view.show import SEARCHED
from sim.bank import terrains_of
from sim.crossing import CrossingCfg
from sim.files.command import command_line
from sim.recording.recorder import Recording

_NUMBERS_S = 0.2
"""Real time from one update of curves and numbers to the next, while playing."""
_ADDRESS_S = 1.0
"""Real time from one update of the address to the next; browsers take no more than some three a second."""
_KEPT_KEYS = ("ArrowLeft", "ArrowRight")


class Tab:
    """What one tab shows; all methods are called by the loop."""

    def __init__(self, client: viser.ClientHandle, common: Common, address: Address, refused: list[str]) -> None:
        """Lay out the page and show what its address asks for.

        Args:
            client: Its browser.
            common: What all tabs share.
            address: What its address says.
            refused: What of its address means nothing, in words.
        """
        self.client, self.common = client, common
        show = common.show
        self._archive, self._others = show.opened_run.archive, address.others
        self._selection, self._clock = Selection(common.axes), Clock()
        self._controller = next(iter(show.controllers), None)
        self._minimal = False  # whether the elite's minimal terrain is wanted, where it has one
        self._replica = 0
        self._begin_s = address.time_s or 0.0  # of the next crossing to be shown
        self._recording: Recording | None = None
        self._groups: dict[str, list[int]] = {}
        self._group = ""  # of the episodes to choose from
        self._crossing: Crossing | None = None
        self._curves: Curves | None = None
        self._query, self._told, self._addressed = "", 0.0, time.perf_counter()
        self.ghost = Ghost(common, client.client_id)
        self.scene = Scene(client, common.shapes, CrossingCfg())
        title = f"{show.robot.name} · {show.opened_run.folder} · {len(self._archive):,} elites"
        self._list = ArchivePanel(client, common.axes, self._selection, title, self)
        self._panel = CrossingPanel(client, list(show.controllers), self)
        add_keys(client, self)
        keep_keys(client, _KEPT_KEYS)
        let_point(client)
        self._open(address, refused)

    def _open(self, address: Address, refused: list[str]) -> None:
        show, episodes = self.common.show, self.common.show.replicas
        first = self._selection.picked if show.elite is None else show.elite
        elite = first if address.elite is None else address.elite
        if not 0 <= elite < len(self._archive):
            refused.append(self._no_elite(elite))
            elite = first
        if address.controller in show.controllers:
            self._controller = address.controller
        elif address.controller is not None:
            refused.append(self._no_controller(address.controller))
        if address.ghost in self.ghost.choices:
            self.ghost.choice = address.ghost
        elif address.ghost is not None:
            refused.append(self._no_controller(address.ghost))
        self._minimal = address.minimal or (address.elite is None and show.minimal)
        if address.minimal and (show.minima is None or elite not in show.minima.genes):
            refused.append(f"Elite {elite} has no minimal terrain here.")
        if address.episode is not None and not 1 <= address.episode <= episodes:
            refused.append(f"There is no episode {address.episode} here: there are 1 to {episodes}.")
        elif address.episode is not None:
            self._replica = address.episode - 1
        for words in refused:
            self.refuse(words)
        if address.camera is None:
            self.look(first_view_of)
        self._selection.pick(elite)
        self._list.show()
        self._panel.show_controller(self._controller)
        self._show_elite()
        if address.follow:
            self.set_follow(True)

    @property
    def playing(self) -> bool:
        """Whether time goes by."""
        return self._clock.playing and self._crossing is not None

    def tick(self, real_s: float) -> None:
        """Let real time go by [s]: show the next frame if it plays, and keep the address up to date."""
        now = time.perf_counter()
        if self.playing:
            self._clock.tick(real_s)
            self._show_frame()
            if now - self._told > _NUMBERS_S or not self._clock.playing:
                self._told = now
                self._show_moment()
        if now - self._addressed > _ADDRESS_S:
            self.show_address()

    def show_address(self) -> None:
        """Have the browser's address say what the tab shows."""
        self._addressed = time.perf_counter()
        camera = self.client.camera
        position, look_at = ((float(x), float(y), float(z)) for x, y, z in (camera.position, camera.look_at))
        shown = Address(
            elite=self._selection.picked,
            controller=self._controller,
            ghost=None if self.ghost.choice == CERTIFYING else self.ghost.choice,
            minimal=self.genes is not None,
            episode=self._replica + 1,
            time_s=self._clock.time_s if self._crossing is not None else self._begin_s,
            follow=self.scene.follow,
            camera=(position, look_at),
            others=self._others,
        )
        query = shown.query()
        if query != self._query:
            self._query = query
            show_query(self.client, query)

    def copy_link(self) -> None:
        """Have the browser copy the link to what the tab shows."""
        self.show_address()
        copy_link(self.client)
        self.client.add_notification("Link copied", "It opens what this tab shows.", auto_close_seconds=3.0)

    def copy_command(self) -> None:
        """Have the browser copy the command that replays what the tab shows."""
        show, name, number = self.common.show, self._controller, self._selection.picked
        which = {"elite": number} if self.genes is None else {"minimal": number}
        policy = None if name is None or name == SEARCHED else show.controllers[name]
        space = show.opened_run.space
        text = command_line(
            "replay", robot=show.robot.spec, run=show.opened_run.path, space=space.name if space.sha256 else None,
            **which, policy=policy, replicas=show.replicas,
        )  # fmt: skip
        copy_text(self.client, text)
        self.client.add_notification("Command copied", text, auto_close_seconds=6.0)

    @property
    def genes(self) -> NDArray[np.float32] | None:
        """Of the minimal terrain that is shown; None of a whole elite."""
        minima = self.common.show.minima
        return None if minima is None or not self._minimal else minima.genes.get(self._selection.picked)

    def choose_terrain(self, minimal: bool) -> None:
        """Show the elite's minimal terrain, or the whole one."""
        if minimal != self._minimal:
            self._minimal, self._begin_s = minimal, 0.0
            self._show_elite()

    def refuse(self, words: str) -> None:
        """Say at the top of the page what is not to be had."""
        self.client.add_notification("Not here", words, color="red", auto_close_seconds=12.0)

    def _no_elite(self, number: object) -> str:
        return f"There is no elite {number} here: there are 0 to {len(self._archive) - 1}."

    def _no_controller(self, name: str) -> str:
        there = ", ".join(self.common.show.controllers) or "none"
        return f"There is no controller '{name}' here: there are {there}."

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
        listed = self._selection.listed
        if line < len(listed):  # else the list was drawn anew while the click was on its way
            self.pick(listed[line])

    def step(self, by: int) -> None:
        """Show the next (1) or previous (-1) elite of the list."""
        self.pick(self._selection.step(by))

    def pick_typed(self, text: str) -> None:
        """Show the elite whose number was typed, or say that there is none."""
        number = int(text) if text.strip().isdecimal() else -1
        if number < len(self._archive) and number >= 0:
            self.pick(number)
        else:
            self.refuse(self._no_elite(f"'{text}'"))
            self._list.show()

    def pick(self, number: int) -> None:
        """Show an elite."""
        changed = self._selection.pick(number)
        self._list.show()
        if changed:
            self._begin_s = 0.0
            self._show_elite()

    def choose_controller(self, name: str) -> None:
        """Show the crossings of another controller."""
        if name in self.common.show.controllers and name != self._controller:
            self._controller = name
            self._begin_s = 0.0
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
            if self._replica not in self._groups[name]:
                self.choose_replica(self._groups[name][0])
            self._show_episodes()

    def step_replica(self, by: int) -> None:
        """Show the next (1) or previous (-1) episode of those to choose from; the first follows the last."""
        episodes = self._groups.get(self._group, [])
        if episodes:
            place = episodes.index(self._replica) if self._replica in episodes else -1
            self.choose_replica(episodes[(place + by) % len(episodes)])

    def choose_replica(self, replica: int) -> None:
        """Show another episode, counted from 0."""
        if not 0 <= replica < self.common.show.replicas:
            self.refuse(f"There is no episode {replica + 1} here: there are 1 to {self.common.show.replicas}.")
            return
        self._replica, self._begin_s = replica, 0.0
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

    def go_on(self, by_s: float) -> None:
        """Stop, some time later or earlier [s]."""
        self._clock.playing = False
        self.seek(self._clock.time_s + by_s)

    def go_to_next_mark(self) -> None:
        """Stop at the next thing that happens."""
        if self._crossing is not None:
            self._clock.playing = False
            self.seek(next_mark(self._crossing.marks, self._clock.time_s).time_s)

    def set_speed(self, speed: float) -> None:
        """Play so many simulated seconds in a real one."""
        self._clock.speed = speed

    def set_follow(self, follow: bool) -> None:
        """Go along with the robot, or stay."""
        self.scene.set_follow(follow)
        self._panel.show_follow(follow)

    def toggle_follow(self) -> None:
        """Go along with the robot if the camera does not, or stay if it does."""
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
        """Say how a recording goes on, and show it, if it is one that is wanted here."""
        told = self.ghost.take(report)
        if told is not None:
            self._panel.show_ghost(self.ghost.choice, told)
            if report.recording is not None:
                self._show_details()
                self._show_ghost()
        if report.wanted != self._wanted() or self._recording is not None:
            return
        if report.recording is not None:
            self._show_recording(report.recording)
        elif report.failed:
            self._panel.show_status(f"No crossing: {escape(report.text)}")
        else:
            text = f"Recording {report.wanted.replicas} episodes of {escape(str(self._controller))}: {report.text} …"
            self._panel.show_status(text, report.share)

    def leave(self) -> None:
        """Ask for nothing more; the browser is gone."""
        self._clock.playing = False
        self.common.record(None, self.client.client_id)
        self.common.record_ahead([], self.client.client_id)
        self.ghost.leave()

    def _wanted(self) -> Wanted | None:
        """The crossings that are to be shown; None without a controller."""
        show = self.common.show
        if self._controller is None:
            return None
        policy, replicas = show.controllers[self._controller], show.replicas
        return on_elite(self._archive, self._selection.picked, policy=policy, replicas=replicas, minimal=self.genes)

    def _record_ahead(self) -> None:
        """Have the crossings of the neighbours in the list recorded while nobody waits."""
        show, wanted = self.common.show, []
        if self._controller is not None and self._recording is not None:
            near = dict.fromkeys(self._selection.step(by) for by in (1, -1))
            policy, replicas = show.controllers[self._controller], show.replicas
            there = [on_elite(self._archive, number, policy=policy, replicas=replicas) for number in near]
            wanted = [one for one in there if self.common.recordings.may_keep(one)]
        self.common.record_ahead(wanted, self.client.client_id)

    def _show_elite(self) -> None:
        show, elite, genes = self.common.show, self._selection.picked, self.genes
        self._panel.show_terrain(show.minima is not None and elite in show.minima.genes, genes is not None)
        shown = self._archive.genes[elite] if genes is None else genes
        heights, ground = terrains_of(shown[None], show.opened_run.space)
        self.scene.set_terrain(heights[0], ground)
        self._show_crossings()

    def _show_details(self) -> None:
        """Say what is known of the elite, with the rates of the crossings that are shown."""
        shown = ((self._controller, self._recording, "shown"), (self.ghost.name, self.ghost.recording, "ghost"))
        penalties, scales = self._archive.penalties, self._archive.scales
        rates = {
            f"{name} ({what})": crossed_of(recording, penalties, scales).rates
            for name, recording, what in shown
            if recording is not None
        }
        details, minima = self.common.axes.details(self._selection.picked, rates), self.common.show.minima
        if minima is not None and self._selection.picked in minima.genes:
            which = "It is shown." if self.genes is not None else "Terrain: minimal shows it."
            details += f"\n\n**Minimal terrain**: {minima.words(self._selection.picked)}. {which}"
        self._panel.show_elite(details)

    def _load_ghost(self) -> None:
        """Take the ghost of the elite and the controller that are shown."""
        words = self.ghost.load(self._selection.picked, self._controller, self.genes)
        self._panel.show_ghost(self.ghost.choice, words)
        self._show_details()

    def _show_ghost(self) -> None:
        """Show the ghost's crossing of the episode beside the robot's; time lasts as long as the longer one."""
        words = self.ghost.show_episode(self._replica)
        crossing, ghost = self._crossing, self.ghost.crossing
        self.scene.hide_ghost()
        if crossing is not None:
            self._clock.duration_s = max(crossing.duration_s, 0.0 if ghost is None else ghost.duration_s)
            self._clock.seek(self._clock.time_s)
            self._panel.show_ghost(self.ghost.choice, words)
            self._panel.show_controls(self._clock, enabled=True)
            self._show_frame()

    def _show_crossings(self) -> None:
        """Show the picked elite's crossings if they are recorded, else have them recorded."""
        self._recording = self._crossing = self._curves = None
        self._groups = {}
        self.scene.hide_crossing()
        self._load_ghost()
        self._clock.load(0.0)
        self._panel.show_controls(self._clock, enabled=False)
        self._panel.show_moment("", "")
        wanted = self._wanted()
        recording = None if wanted is None else self.common.recordings.read(wanted)
        self.common.record(None if recording is not None else wanted, self.client.client_id)
        if recording is not None:
            self._show_recording(recording)
        elif wanted is None:
            self._panel.show_status(f"No crossing: {escape(self.common.show.note)}")
        else:
            self._panel.show_status(f"Recording {wanted.replicas} episodes of {escape(str(self._controller))} …", 0.0)

    def _show_recording(self, recording: Recording) -> None:
        self._recording = recording
        self._groups = episodes_by_outcome(recording)
        self._group = next(iter(self._groups))
        self._show_details()
        self.scene.set_paths(paths_of(recording))
        self._show_episode()
        self._record_ahead()

    def _show_episodes(self) -> None:
        """Offer the episodes to choose from, and say which is shown."""
        recording = self._recording
        if recording is not None:
            named = {k: f"{k + 1}: {ending_words(recording, k)}" for k in self._groups[self._group]}
            self._panel.show_episodes(list(self._groups), self._group, named, self._replica)

    def _show_episode(self) -> None:
        assert self._recording is not None
        archive, recording = self._archive, self._recording
        if self._replica not in self._groups[self._group]:
            self._group = next(iter(self._groups))
        crossing = crossing_of(recording, self._replica, self.common.skeleton, archive.penalties, archive.scales)
        self._crossing = crossing
        made = escape(
            f"recorded {str(recording.origin.get('date', ''))[:10]} at {str(recording.origin.get('commit', ''))[:8]}"
        )
        all_of_them = f"All {recording.num_episodes}: {endings(recording)} ({made})."
        if crossing is None:
            self._clock.load(0.0)
            self._panel.show_status(f"<b>Episode {self._replica + 1} broke at once.</b> {all_of_them}")
        else:
            self._clock.load(crossing.duration_s)
            self._show_ghost()
            self._clock.seek(self._begin_s)
            self._curves = Curves(crossing.times_s, crossing.penalties, archive.penalties, crossing.marks)
            ended = f"<b>Episode {self._replica + 1}: {crossing.ending} after {crossing.duration_s:.1f} s.</b>"
            unknown = "" if crossing.touching is not None else " It was recorded before touches of bodies were kept."
            self._panel.show_status(f"{ended} {all_of_them}{unknown}")
            self._show_frame()
            self._show_moment()
        self._show_episodes()
        self._panel.show_controls(self._clock, enabled=crossing is not None)

    def _show_frame(self) -> None:
        if self._crossing is not None:
            self.scene.show_frame(self._crossing, self._clock.frame(self._crossing.dt, self._crossing.num_frames))
            if (ghost := self.ghost.crossing) is not None:
                self.scene.show_ghost(ghost, self._clock.frame(ghost.dt, ghost.num_frames))

    def _show_moment(self) -> None:
        crossing, curves = self._crossing, self._curves
        if crossing is not None and curves is not None:
            frame = self._clock.frame(crossing.dt, crossing.num_frames)
            numbers = moment_text(crossing, frame, self._archive.penalties, self.common.shapes.feet)
            self._panel.show_moment(curves.at(self._clock.time_s), numbers)
        self._panel.show_time(self._clock)
