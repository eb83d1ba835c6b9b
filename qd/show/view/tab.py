"""A browser tab: what it shows, and what happens when its visitor does something. No tab knows of another."""

import math
import time
from collections.abc import Callable
from contextlib import suppress
from html import escape
from typing import Any

import viser

from qd.show.crossed import find_ghost_episode, find_typical_episode
from qd.show.recordings import Wanted
from qd.show.view.address import Address, read_address
from qd.show.view.bar import Bar
from qd.show.view.crosser import Common, Crosser
from qd.show.view.filming import Filming
from qd.show.view.listing import count_endings
from qd.show.view.panels import ArchivePanel, Clock, CrossingPanel, Selection
from qd.show.view.playing import episodes_by_ending, trace_paths
from qd.show.view.recorder import Report
from qd.show.view.scene import Points, Scene, View, compute_first_view, compute_overview
from qd.show.view.show import SEARCHED
from sim.recording.recorder import Recording
from sim.terrains.bank import terrains_of

_BAR_S = 0.1  # real time from one update of the bar's time to the next, while playing
_ADDRESS_S = 1.0  # real time from one update of the address to the next; browsers take no more than some three a second
_SETTLES_S = 3.0  # how long a browser that has just come may still say where its camera stood before it was moved
_BEFORE_S = 1.0  # how long before the robot fails an episode begins to be shown
CERTIFYING, NOBODY = "who certifies it", "none"
"""Ghosts to choose beside the controllers: the one that certifies the elite, if it is at hand, and no ghost."""


class Tab:
    """What one tab shows; all methods are called by the loop."""

    def __init__(
        self, client: viser.ClientHandle, bar: Bar, common: Common, window: tuple[int, int], query: str
    ) -> None:
        """Show what the address asks for behind its question mark, in a window of so many CSS pixels."""
        self.client, self.bar, self.common, self.window = client, bar, common, window
        show = common.show
        self._archive = show.opened_run.archive
        self.selection, self.clock = Selection(show.listing), Clock()
        self.controller = next(iter(show.controllers), None)
        self.choice, self.choices = CERTIFYING, (CERTIFYING, NOBODY, *show.controllers)  # of the ghost
        self._minimal = False  # whether the elite's minimal terrain is wanted, where it has one
        self.replica: int | None = None  # the typical one of the recording that comes
        self._begin_s: float | None = None  # where the next crossing begins; just before the robot fails if None
        self.query, self._bar_at, self._near_until, self._address_at = "", 0.0, 0.0, time.perf_counter()
        self.robot, self.ghost = Crosser(common, client.client_id), Crosser(common, (client.client_id, "ghost"))
        self.scene = Scene(client, common.parts, common.skeleton.num_bodies, len(show.robot.foot_geoms))
        title = f"{show.robot.name} · {show.opened_run.folder} · {len(self._archive):,} elites"
        self.list = ArchivePanel(client, self.selection, title, self)
        self.filming = Filming(client, common, lambda words: self.panel.show_film(words))
        self.panel = CrossingPanel(client, list(show.controllers), self)
        self.go_to(query)

    def act(self, name: str, value: Any) -> None:
        """Do what a visitor did on the bar, by a key or with an elite; what makes no sense is left out."""
        tasks: dict[str, tuple[Callable[[Any], Any], Callable[..., None]]] = {
            "play": (bool, self.play), "seek": (float, self.seek), "speed": (float, self.set_speed),
            "episode": (int, lambda number: self.choose_replica(number - 1)), "follow": (bool, self.set_follow),
            "overview": (bool, lambda _: self.overview()), "pick": (str, self.pick), "step": (int, self.step),
            "resize": (list, self.resize), "open": (str, self.go_to),
        }  # fmt: skip
        kind, method = tasks.get(name, (bool, lambda _: None))
        with suppress(TypeError, ValueError, OverflowError):
            value = kind(value)
            if not isinstance(value, float) or math.isfinite(value):
                method(value)

    def resize(self, window: list[int]) -> None:
        """Know another width and height of the window [CSS pixels]."""
        self.window = (int(window[0]), int(window[1]))

    def go_to(self, query: str) -> None:
        """Show what an address asks for; one that names no time opens just before the robot fails, and plays."""
        show, (address, refused) = self.common.show, read_address(query)
        for words in refused:
            self.refuse(words)
        first = self.selection.picked if show.elite is None else show.elite
        elite = first if address.elite is None else address.elite
        if not 0 <= elite < len(self._archive):
            self.refuse(self._no_elite(elite))
            elite = first
        for name, choices in ((address.controller, show.controllers), (address.ghost, self.choices)):
            if name is not None and name not in choices:
                self.refuse(f"There is no controller '{name}' here: there are {', '.join(show.controllers) or 'none'}.")
        if address.controller in show.controllers:
            self.controller = address.controller
            self.panel.controller.value = address.controller
        if address.ghost in self.choices:
            self.choice = address.ghost
        self._minimal = address.minimal or (address.elite is None and show.minimal)
        if address.minimal and self.common.show.genes(elite, True) is None:
            self.refuse(f"Elite {elite} has no minimal terrain here.")
        self.replica, self._begin_s, self.clock.playing = None, address.time_s, address.time_s is None
        if address.episode is not None:
            self.choose_replica(address.episode - 1, address.time_s, playing=self.clock.playing)
        if address.camera is None:
            self.look(compute_first_view)
        self.selection.picked = elite
        self.list.show()
        self._show_elite()
        self._near_until = time.perf_counter() + _SETTLES_S
        self.set_follow(address.follow or (address.time_s is None and address.camera is None))

    @property
    def playing(self) -> bool:
        """Whether time goes by."""
        return self.clock.playing and self.robot.crossing is not None

    def tick(self, real_s: float) -> None:
        """Let real time go by [s]: show the next frame if it plays, and keep the address up to date."""
        now = time.perf_counter()
        if self.playing:
            self.clock.tick(real_s)
            self._show_frame()
            if self.scene.follow and now < self._near_until:
                self.scene.set_follow(True)
            if now - self._bar_at > _BAR_S:
                self._bar_at = now
                self._show_moment()
        if now - self._address_at > _ADDRESS_S:
            self.show_address()

    def show_address(self) -> None:
        """Have the browser's address say what the tab shows."""
        self._address_at = time.perf_counter()
        position, look_at = self.client.camera.position, self.client.camera.look_at
        address = Address(
            elite=self.selection.picked,
            controller=self.controller,
            ghost=None if self.choice == CERTIFYING else self.choice,
            minimal=self.minimal,
            episode=None if self.replica is None else self.replica + 1,
            time_s=self.clock.time_s if self.robot.crossing is not None else self._begin_s,
            follow=self.scene.follow,
            camera=(_point_words(position), _point_words(look_at)),
        )
        query = address.query()
        if query != self.query:
            before, _ = read_address(self.query)
            is_new = before.elite not in (None, address.elite)
            self.query = query
            self.bar.show_address(query, is_new=is_new)

    def copy_command(self) -> None:
        """Have the browser copy the command that replays what the tab shows."""
        show, name = self.common.show, self.controller
        policy = None if name is None or name == SEARCHED else show.controllers[name]
        terrain = {"minimal" if self.minimal else "elite": self.selection.picked}
        text = show.opened_run.command("replay", policy=policy, **terrain)
        self.bar.copy(text)
        self.client.add_notification("Command copied", text, auto_close_seconds=6.0)

    def film(self) -> None:
        """Have the shown episode filmed in a process of its own."""
        if self.robot.recording is not None and self.replica is not None:
            name, ghost = self.ghost.name, self.ghost.recording
            self.filming.begin(
                self.robot.recording, self.replica, f"{'minimal' if self.minimal else 'elite'}-{self.selection.picked}",
                scales=self._scales, by="" if self.controller in (None, SEARCHED) else str(self.controller),
                beside=None if name is None or ghost is None else (name, ghost),
            )  # fmt: skip

    @property
    def minimal(self) -> bool:
        """Whether a minimal terrain is shown."""
        return self.common.show.genes(self.selection.picked, self._minimal) is not None

    @property
    def _scales(self) -> dict[str, float]:
        return dict(zip(self._archive.penalties, self._archive.scales, strict=True))

    def choose_terrain(self, minimal: bool) -> None:
        """Show the elite's minimal terrain, or the whole one."""
        if minimal != self._minimal:
            self._minimal = minimal
            self._begin_anew()
            self._show_elite()

    def _begin_anew(self) -> None:
        self.replica, self._begin_s, self.clock.playing = None, None, True

    def refuse(self, words: str) -> None:
        """Say at the top of the page what does not exist here."""
        self.client.add_notification("Not here", words, color="red", auto_close_seconds=12.0)

    def _no_elite(self, number: object) -> str:
        return f"There is no elite {number} here: there are 0 to {len(self._archive) - 1}."

    def look(self, view_of: Callable[[int, int], View]) -> None:
        """Move the camera to a view that depends on the window's width and height."""
        self.scene.go_to(view_of(*self.window))

    def overview(self) -> None:
        """Show the whole terrain, and stop following."""
        self.set_follow(False)
        self.look(compute_overview)

    def step(self, by: int) -> None:
        """Show the next (1) or previous (-1) elite of the list."""
        self.pick(self.selection.step(by))

    def pick(self, text: str | int) -> None:
        """Show the elite of a number, just before the robot fails, or say that there is none."""
        number = int(text) if str(text).strip().isdecimal() else -1
        if not 0 <= number < len(self._archive):
            self.refuse(self._no_elite(f"'{text}'"))
        elif number != self.selection.picked:
            self.selection.picked = number
            self._begin_anew()
            self.list.show()
            self._show_elite()

    def choose_controller(self, name: str) -> None:
        """Show the crossings of another controller."""
        if name in self.common.show.controllers and name != self.controller:
            self.controller = name
            self._begin_s, self.clock.playing = None, True
            self._show_crossings()

    def choose_ghost(self, name: str) -> None:
        """Show the crossings of a second controller beside the chosen one's."""
        if name in self.choices and name != self.choice:
            self.choice = name
            self._load_ghost()

    def choose_replica(self, replica: int, begin_s: float | None = None, *, playing: bool = True) -> None:
        """Show another episode, counted from 0, from a time [s]; from just before the robot fails if None."""
        if not 0 <= replica < Wanted.replicas:
            self.refuse(f"There is no episode {replica + 1} here: there are 1 to {Wanted.replicas}.")
            return
        self.replica, self._begin_s, self.clock.playing = replica, begin_s, playing
        if self.robot.recording is not None:
            self._show_episode()

    def play(self, playing: bool) -> None:
        """Play or pause."""
        self.clock.playing = playing
        self._show_moment()

    def seek(self, time_s: float) -> None:
        """Show a time [s]."""
        if self.robot.crossing is not None:
            self.clock.seek(time_s)
            self._show_frame()
            self._show_moment()

    def set_speed(self, speed: float) -> None:
        """Play at a speed in simulated seconds a real one."""
        self.clock.speed = min(max(speed, 0.01), 100.0)
        self.bar.show({"speed": self.clock.speed})

    def set_follow(self, follow: bool) -> None:
        """Go along with the robot, or stay."""
        self.scene.set_follow(follow)
        self.bar.show({"follow": follow})

    def show_report(self, report: Report) -> None:
        """Say how far a recording or film is, and show it, if it is one of this tab."""
        self.filming.take_report(report)
        if self.ghost.takes(report):
            self._show_ghost(f"no ghost: {report.text}" if report.failed else f"{report.share:.0%}")
            self._show_rates()
        if not self.robot.takes(report):
            return
        if report.result is not None:
            self._show_recording(report.result)
        elif report.failed:
            self.bar.show({"share": None, "status": f"No crossing: {escape(report.text)}"})
        else:
            self._show_progress(report.text, report.share)

    def leave(self) -> None:
        """Ask for nothing more; the browser is gone."""
        self.clock.playing = False
        self.robot.leave()
        self.ghost.leave()
        self.filming.cancel()

    def _show_elite(self) -> None:
        show, elite, listing = self.common.show, self.selection.picked, self.common.show.listing
        name, verdict = listing.ranking.name(elite), listing.verdict(elite)
        genes = self.common.show.genes(elite, self._minimal)
        shown = self._archive.genes[elite] if genes is None else genes
        words = (f"elite {elite} of {len(self._archive):,}", verdict, listing.space.condition_words(shown))
        known = " · ".join(filter(None, words))
        self.bar.show({"title": name + " · minimal terrain" * self.minimal, "elite": elite})
        self.panel.show_elite(
            f"<b>{escape(name)}</b><br>{known}",
            listing.details(elite),
            has_minimal=self.common.show.genes(elite, True) is not None,
            minimal=self.minimal,
        )
        heights, ground = terrains_of(shown[None], show.opened_run.space)
        self.scene.set_terrain(heights[0], ground)
        self._show_crossings()

    def _show_rates(self) -> None:
        """Show how episodes end: what is known of the whole terrain, and what is recorded of others than that."""
        crossers = [self.robot, self.ghost] if self.minimal else [self.robot] * (self.controller != SEARCHED)
        columns = [] if self.minimal else [*self.common.show.listing.columns(self.selection.picked)]
        for crosser in crossers:
            if crosser.recording is not None:
                columns.append(count_endings(str(crosser.name), crosser.recording))
        self.panel.show_rates(columns)

    def _load_ghost(self) -> None:
        """Load the ghost's recording of the elite that is shown, or ask for it, and show what there is."""
        name, self._note = self.choice, ""
        if self.choice == CERTIFYING:
            name, self._note = self.common.show.certifying(self.selection.picked)
        is_ghost = name in self.common.show.controllers and name != self.controller
        self.ghost.load(self.selection.picked, name if is_ghost else None, minimal=self._minimal)
        self.panel.ghost.value = self.choice
        self._show_ghost()
        self._show_rates()

    def _show_ghost(self, words: str = "") -> None:
        """Show the ghost beside the robot, in the same episode or in one that arrives; the longer one says how long."""
        replica, recording = self.replica or 0, self.ghost.recording
        beside = replica if recording is None else find_ghost_episode(recording, replica, self._scales)
        self.ghost.show_episode(beside)
        crossing, ghost = self.robot.crossing, self.ghost.crossing
        self.scene.ghost.visible = False
        if crossing is not None:
            words = self._note if self.ghost.name is None else f"Ghost, {self.ghost.name}: {words or 'is recorded'}"
            if ghost is not None:
                name = f"{self.ghost.name}{f' in episode {beside + 1}' * (beside != replica)}"
                words = f"Ghost, {name}: {ghost.ending}"
            self.clock.duration_s = max(crossing.duration_s, 0.0 if ghost is None else ghost.duration_s)
            self.clock.seek(self.clock.time_s)
            self.panel.stretch_curves(self.clock.duration_s)
            status = f"{crossing.ending}{f' · {words}' * bool(words)}"
            self.bar.show({"duration": self.clock.duration_s, "status": escape(status)})
            self._show_frame()

    def _show_progress(self, words: str, share: float) -> None:
        task = f"Recording {Wanted.replicas} episodes of {self.controller}: {words or f'{share:.0%}'}"
        self.bar.show({"share": share, "task": task})

    def _show_crossings(self) -> None:
        """Show the picked elite's crossings if they are recorded, else have them recorded."""
        self.scene.hide_crossing()
        self.clock.duration_s = 0.0
        self.panel.show_curves(None)
        self.bar.show({"enabled": False, "status": "", "marks": [], "episodes": [], "share": None})
        self.robot.load(self.selection.picked, self.controller, minimal=self._minimal)
        self._load_ghost()
        if self.robot.recording is not None:
            self._show_recording(self.robot.recording)
        elif self.robot.wanted is None:
            self.bar.show({"status": f"No crossing: {escape(self.common.show.note)}"})
        else:
            self._show_progress("", 0.0)

    def _show_recording(self, recording: Recording) -> None:
        self.replica = find_typical_episode(recording, self._scales) if self.replica is None else self.replica
        self.bar.show({"share": None, "episodes": episodes_by_ending(recording)})
        self._show_rates()
        self.scene.set_paths(trace_paths(recording))
        self._show_episode()

    def _show_episode(self) -> None:
        assert self.replica is not None
        self.robot.show_episode(self.replica)
        crossing = self.robot.crossing
        self.panel.show_curves(crossing)
        self.bar.show({"status": "This episode broke at once."})
        self._show_ghost()
        if crossing is not None:
            self.clock.begin_s = max(0.0, crossing.moment_s - _BEFORE_S)
            self.seek(self.clock.begin_s if self._begin_s is None else self._begin_s)
        marks = [] if crossing is None else list(crossing.marks)
        self.bar.show({"enabled": crossing is not None, "marks": marks, "episode": self.replica + 1})
        self._show_moment()

    def _show_frame(self) -> None:
        if (crossing := self.robot.crossing) is not None:
            self.scene.show_frame(crossing, self.clock.frame(crossing.dt, crossing.num_frames))
            if (ghost := self.ghost.crossing) is not None:
                self.scene.show_ghost(ghost, self.clock.frame(ghost.dt, ghost.num_frames), self.ghost.name or "")

    def _show_moment(self) -> None:
        self.bar.show({"time": round(self.clock.time_s, 3), "playing": self.clock.playing})


def _point_words(point: Points) -> str:
    return ",".join(f"{value:.2f}" for value in point)
