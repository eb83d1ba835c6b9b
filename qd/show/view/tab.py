"""A browser tab: what it shows, and what a visitor's actions do. Tabs do not know each other."""

import math
import time
from collections.abc import Callable, Hashable
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from html import escape
from typing import Any, NamedTuple

import viser

from qd.faults.families import VERDICTS
from qd.search.directory import output_folder
from qd.show.crossed import find_ghost_episode, find_typical_episode, make_title
from qd.show.film import Shot, film
from qd.show.recordings import CrossingRequest, Recordings
from qd.show.view.panels import TERRAINS, Address, ArchivePanel, Clock, CrossingPanel, PlayerBar, Selection
from qd.show.view.recorder import Recorder, TaskProgress
from qd.show.view.scene import BodyShape, Crossing, Scene, compute_view, group_episodes, trace_crossing
from qd.show.view.viewed import SEARCHED, ViewedRun, count_endings
from sim.files.atomic import prepare_output
from sim.recording.recorder import Recording
from sim.robots.skeleton import Skeleton
from sim.terrains.bank import make_terrains

_BAR_S = 0.1  # real time from one update of the bar's time to the next, while playing
_ADDRESS_S = 1.0  # real time from one update of the address to the next; browsers allow three a second
_SETTLE_S = 3.0  # a new browser may still send where its camera stood before it was moved
_LEAD_S = 1.0  # an episode is shown from so long before the robot fails
CERTIFIER = "who certifies it"  # a ghost to choose: the certifier of the elite, if it is at hand
NO_GHOST = "none"


class Shared(NamedTuple):
    """What all tabs share."""

    show: ViewedRun
    skeleton: Skeleton
    shapes: list[BodyShape]
    recordings: Recordings
    recorder: Recorder
    post: Callable[..., None]  # has the loop call a function with arguments


@dataclass(eq=False)
class ShownController:
    """The controller that is shown, or the ghost beside it; the recorder works on the last request of each key."""

    shared: Shared
    key: Hashable
    name: str | None = None
    request: CrossingRequest | None = None
    recording: Recording | None = None
    crossing: Crossing | None = None

    def load(self, elite: int, name: str | None, *, minimal: bool = False) -> None:
        """Load the recording of another elite or controller, or request it."""
        self.name = name
        self.crossing = None
        self.request = self.shared.show.request(elite, name, minimal=minimal)
        self.recording = self.request and self.shared.recordings.read(self.request)
        self.shared.recorder.request(self.request if self.recording is None else None, key=self.key)

    def take(self, progress: TaskProgress) -> bool:
        """Take the recording, if it is done; returns whether the progress is of this controller's request."""
        if self.request is None or progress.task != self.request or self.recording is not None:
            return False
        self.recording = progress.result
        return True

    def show_episode(self, replica: int) -> None:
        """Trace an episode, counted from 0, if one is recorded."""
        self.crossing = None
        if self.recording is not None:
            self.crossing = trace_crossing(self.recording, replica, self.shared.skeleton, self.shared.show.scales)


class Tab:
    """What one tab shows; the loop calls all methods."""

    def __init__(
        self, client: viser.ClientHandle, bar: PlayerBar, shared: Shared, window: tuple[int, int], query: str
    ) -> None:
        """Show what the address asks for behind its question mark, in a window of so many CSS pixels."""
        self.show = show = shared.show
        self.client = client
        self.bar = bar
        self.shared = shared
        self.window = window
        self.selection = Selection(show)
        self.clock = Clock()
        self.controller = next(iter(show.controllers), None)
        self.ghost_choices = (CERTIFIER, NO_GHOST, *show.controllers)
        self.ghost_choice = CERTIFIER
        self._prefers_minimal = False  # show the minimal terrain of elites that have one
        self.replica: int | None = None  # None: the typical one
        self._begin_s: float | None = None  # where the next crossing begins; None: just before the robot fails
        self.address = Address()  # what the browser says
        self._film: partial[None] | None = None
        self._bar_time = 0.0  # when they were updated last
        self._address_time = time.perf_counter()
        self._settled_time = 0.0
        self.robot = ShownController(shared, client.client_id)
        self.ghost = ShownController(shared, (client.client_id, "ghost"))
        self.scene = Scene(client, shared.shapes, shared.skeleton.num_bodies, len(show.robot.foot_geoms))
        self.list = ArchivePanel(self)
        self.panel = CrossingPanel(self)
        self.go_to(query)

    def act(self, name: str, value: Any) -> None:
        """Do a visitor's action on the bar, by a key or on an elite; nonsense is left out."""
        actions: dict[str, tuple[Callable[[Any], Any], Callable[..., None]]] = {
            "play": (bool, self.play),
            "seek": (float, self.seek),
            "speed": (float, self.set_speed),
            "episode": (int, lambda number: self.choose_replica(number - 1)),
            "follow": (bool, self.set_follow),
            "overview": (bool, lambda _: self.overview()),
            "pick": (str, self.pick),
            "step": (int, lambda by: self.pick(self.selection.step(by))),  # the next (1) or previous (-1)
            "resize": (list, self.resize),
            "open": (str, self.go_to),
        }
        if name not in actions:
            return
        kind, method = actions[name]
        with suppress(TypeError, ValueError, OverflowError):
            value = kind(value)
            if not isinstance(value, float) or math.isfinite(value):
                method(value)

    def resize(self, window: list[int]) -> None:
        """Note another width and height of the window [CSS pixels]."""
        self.window = (int(window[0]), int(window[1]))

    def go_to(self, query: str) -> None:
        """Show what an address asks for; one without a time opens just before the robot fails, and plays."""
        show = self.show
        address, refused = Address.parse(query)
        for text in refused:
            self.refuse(text)
        elite = self.selection.picked if address.elite is None else address.elite
        if not 0 <= elite < len(show.archive):
            self._refuse_elite(elite)
            elite = self.selection.picked
        for name, choices in ((address.controller, show.controllers), (address.ghost, self.ghost_choices)):
            if name is not None and name not in choices:
                self.refuse(f"There is no controller '{name}' here: there are {', '.join(show.controllers) or 'none'}.")
        if address.controller in show.controllers:
            self.controller = self.panel.controller.value = address.controller
        if address.ghost in self.ghost_choices:
            self.ghost_choice = address.ghost
        is_minimal = address.terrain == TERRAINS[1]
        self._prefers_minimal = is_minimal or (address.elite is None and show.minimal)
        if is_minimal and show.minimal_genes(elite) is None:
            self.refuse(f"Elite {elite} has no minimal terrain here.")
        self._begin(None, address.time_s, playing=address.time_s is None)
        if address.episode is not None:
            self.choose_replica(address.episode - 1, address.time_s, playing=self.clock.playing)
        has_camera = None not in (address.position, address.look_at)
        if not has_camera:
            self.look("near")
        self._show_elite(elite)
        self._settled_time = time.perf_counter() + _SETTLE_S
        self.set_follow(address.follow or (address.time_s is None and not has_camera))

    @property
    def playing(self) -> bool:
        """Whether time passes."""
        return self.clock.playing and self.robot.crossing is not None

    def tick(self, real_s: float) -> None:
        """Let real time pass [s]: show the next frame if it plays, and keep the address up to date."""
        now = time.perf_counter()
        if self.playing:
            self.clock.tick(real_s)
            self._show_frame()
            if self.scene.follow and now < self._settled_time:
                self.scene.set_follow(True)
            if now - self._bar_time > _BAR_S:
                self._bar_time = now
                self._show_time()
        if now - self._address_time > _ADDRESS_S:
            self.show_address()

    def show_address(self) -> None:
        """Change the browser's address to what the tab shows."""
        self._address_time = time.perf_counter()
        camera = self.client.camera
        position, look_at = (",".join(f"{x:.2f}" for x in point) for point in (camera.position, camera.look_at))
        time_s = self.clock.time_s if self.robot.crossing is not None else self._begin_s
        address = Address(
            elite=self.selection.picked,
            controller=self.controller,
            ghost=None if self.ghost_choice == CERTIFIER else self.ghost_choice,
            terrain=TERRAINS[1] if self.minimal else None,
            episode=None if self.replica is None else self.replica + 1,
            time_s=time_s if time_s is None else round(time_s, 2),
            follow=self.scene.follow,
            position=position,
            look_at=look_at,
        )
        if address != self.address:
            self.bar.show_address(address.query(), is_new=self.address.elite not in (None, address.elite))
            self.address = address

    def film(self) -> None:
        """Have the recorder film the shown episode, unless it makes a film already."""
        if self.robot.recording is None or self.replica is None or self._film is not None:
            return
        by = "" if self.controller in (None, SEARCHED) else str(self.controller)
        stem = f"{'minimal' if self.minimal else 'elite'}-{self.selection.picked}{f'-{by}' * bool(by)}"
        file = output_folder(self.show.path, self.show.robot.name) / f"{stem}-episode-{self.replica + 1}.mp4"
        try:
            prepare_output(file)
        except (OSError, ValueError) as error:
            self.panel.show_film(f"No film: {error}")
            return
        recording = self.robot.recording
        beside = None if self.ghost.recording is None else (str(self.ghost.name), self.ghost.recording)
        shot = Shot(recording=recording, episode=self.replica, title=make_title(recording, by), beside=beside)
        self._film = partial(film, shot, self.show.robot, out=file)
        self.panel.show_film("Filming: the film process starts …")
        self.shared.recorder.request(self._film, key=(self.client.client_id, "film"))

    def cancel_film(self) -> None:
        """Stop making the film."""
        if self._film is not None:
            self.shared.recorder.cancel(self._film)
            self._film = None
            self.panel.show_film("Cancelled.")

    @property
    def minimal(self) -> bool:
        """Whether a minimal terrain is shown."""
        return self._prefers_minimal and self.show.minimal_genes(self.selection.picked) is not None

    def choose_terrain(self, minimal: bool) -> None:
        """Show the elite's minimal terrain, or the whole one."""
        if minimal != self._prefers_minimal:
            self._prefers_minimal = minimal
            self._begin(None)
            self._show_elite(self.selection.picked)

    def _begin(self, replica: int | None, begin_s: float | None = None, *, playing: bool = True) -> None:
        """Note which episode to show from when on, as soon as it is recorded."""
        self.replica = replica
        self._begin_s = begin_s
        self.clock.playing = playing

    def refuse(self, text: str) -> None:
        """Say at the top of the page what does not exist."""
        self.client.add_notification("Not here", text, color="red", auto_close_seconds=12.0)

    def _refuse_elite(self, number: object) -> None:
        self.refuse(f"There is no elite {number} here: there are 0 to {len(self.show.archive) - 1}.")

    def look(self, view: str) -> None:
        """Move the camera to a view of its name."""
        self.scene.go_to(compute_view(view, *self.window))

    def overview(self) -> None:
        """Show the whole terrain, and stop following."""
        self.set_follow(False)
        self.look("overview")

    def pick(self, text: str | int) -> None:
        """Show the elite of a number, just before the robot fails, or refuse the number."""
        number = int(text) if str(text).strip().isdecimal() else -1
        if not 0 <= number < len(self.show.archive):
            self._refuse_elite(f"'{text}'")
        elif number != self.selection.picked:
            self._begin(None)
            self._show_elite(number)

    def choose_controller(self, name: str) -> None:
        """Show the crossings of another controller."""
        if name in self.show.controllers and name != self.controller:
            self.controller = name
            self._begin(self.replica)
            self._show_crossings()

    def choose_ghost(self, name: str) -> None:
        """Show the crossings of a second controller beside the chosen one's."""
        if name in self.ghost_choices and name != self.ghost_choice:
            self.ghost_choice = name
            self._load_ghost()

    def choose_replica(self, replica: int, begin_s: float | None = None, *, playing: bool = True) -> None:
        """Show another episode, counted from 0, from a time [s]; from just before the robot fails if None."""
        if not 0 <= replica < CrossingRequest.replicas:
            self.refuse(f"There is no episode {replica + 1} here: there are 1 to {CrossingRequest.replicas}.")
            return
        self._begin(replica, begin_s, playing=playing)
        if self.robot.recording is not None:
            self._show_episode(replica)

    def play(self, playing: bool) -> None:
        """Play or pause."""
        self.clock.playing = playing
        self._show_time()

    def seek(self, time_s: float) -> None:
        """Show a time [s]."""
        if self.robot.crossing is not None:
            self.clock.seek(time_s)
            self._show_frame()
            self._show_time()

    def set_speed(self, speed: float) -> None:
        """Play at a speed in simulated seconds a real one."""
        self.clock.speed = min(max(speed, 0.01), 100.0)
        self.bar.show({"speed": self.clock.speed})

    def set_follow(self, follow: bool) -> None:
        """Follow the robot, or stay."""
        self.scene.set_follow(follow)
        self.bar.show({"follow": follow})

    def show_progress(self, progress: TaskProgress) -> None:
        """Show how far a recording or film is, and what it made, if this tab requested it."""
        if self._film is not None and progress.task is self._film:
            text = f"No film: {progress.text}" if progress.failed else f"Filming: {progress.share:.0%}"
            if progress.result is not None:
                content = progress.result.read_bytes()
                size = f"{len(content) / 1e6:.1f} MB"
                text = f"{progress.result} ({size}): click to download it in the notice on the picture."
                self.client.send_file_download(progress.result.name, content)
            if progress.failed or progress.result is not None:
                self._film = None
            self.panel.show_film(text)
        if self.ghost.take(progress):
            self._show_ghost(f"no ghost: {progress.text}" if progress.failed else f"{progress.share:.0%}")
            self._show_rates()
        if not self.robot.take(progress):
            return
        if progress.result is not None:
            self._show_recording(progress.result)
        elif progress.failed:
            self.bar.show({"share": None, "status": f"No crossing: {escape(progress.text)}"})
        else:
            self._show_share(progress)

    def leave(self) -> None:
        """Withdraw all requests; the browser is gone."""
        self.clock.playing = False
        self.robot.load(self.selection.picked, None)
        self.ghost.load(self.selection.picked, None)
        self.cancel_film()

    def _show_elite(self, elite: int) -> None:
        show = self.show
        self.selection.picked = elite
        self.list.show()
        name = show.ranking.name(elite)
        minimal_genes = show.minimal_genes(elite)
        genes = minimal_genes if self.minimal and minimal_genes is not None else show.archive.genes[elite]
        conditions = show.space.condition_text(genes)
        facts = (f"elite {elite} of {len(show.archive):,}", VERDICTS[show.ranking.verdict[elite]], conditions)
        self.bar.show({"title": name + " · minimal terrain" * self.minimal, "elite": elite})
        text = f"<b>{escape(name)}</b><br>{' · '.join(filter(None, facts))}"
        self.panel.head.content = f'<div style="padding:0 0.6em 0.4em">{text}</div>'
        self.panel.terrain.visible = minimal_genes is not None
        self.panel.terrain.value = TERRAINS[self.minimal]
        heights, ground = make_terrains(genes[None], show.space)
        self.scene.set_terrain(heights[0], ground)
        self._show_crossings()

    def _show_rates(self) -> None:
        """Show how episodes ended: those of the archive on the whole terrain, and recorded ones of other crossings."""
        columns = [] if self.minimal else [*self.show.columns(self.selection.picked)]
        recorded = [self.robot, self.ghost] if self.minimal else [self.robot] * (self.controller != SEARCHED)
        columns += [count_endings(str(one.name), one.recording) for one in recorded if one.recording is not None]
        self.panel.show_rates(columns)

    def _load_ghost(self) -> None:
        """Load or request the ghost's recording of the shown elite, and show it."""
        name, self._ghost_note = self.ghost_choice, ""
        if self.ghost_choice == CERTIFIER:
            name, self._ghost_note = self.show.find_certifier(self.selection.picked)
        is_ghost = name in self.show.controllers and name != self.controller
        self.ghost.load(self.selection.picked, name if is_ghost else None, minimal=self._prefers_minimal)
        self.panel.ghost.value = self.ghost_choice
        self._show_ghost()
        self._show_rates()

    def _show_ghost(self, text: str = "is recorded") -> None:
        """Show the ghost in the same episode or in one that arrives; the longer of both crossings sets the duration."""
        replica = ghost_replica = self.replica or 0
        if self.ghost.recording is not None:
            ghost_replica = find_ghost_episode(self.ghost.recording, replica, self.show.scales)
        self.ghost.show_episode(ghost_replica)
        crossing, ghost = self.robot.crossing, self.ghost.crossing
        self.scene.ghost.visible = False
        if crossing is None:
            return
        duration_s = crossing.duration_s
        note = self._ghost_note if self.ghost.name is None else f"Ghost, {self.ghost.name}: {text}"
        if ghost is not None:
            duration_s = max(duration_s, ghost.duration_s)
            in_episode = f" in episode {ghost_replica + 1}" * (ghost_replica != replica)
            note = f"Ghost, {self.ghost.name}{in_episode}: {ghost.ending}"
        self.clock.duration_s = duration_s
        self.clock.seek(self.clock.time_s)
        self.panel.curves.scales = {"x": {"time": False, "range": (0.0, max(duration_s, 0.02))}}
        self.bar.show({"duration": duration_s, "status": escape(" · ".join(filter(None, (crossing.ending, note))))})
        self._show_frame()

    def _show_share(self, progress: TaskProgress) -> None:
        done = progress.text or f"{progress.share:.0%}"
        task = f"Recording {CrossingRequest.replicas} episodes of {self.controller}: {done}"
        self.bar.show({"share": progress.share, "task": task})

    def _show_crossings(self) -> None:
        """Show the picked elite's crossings, or have them recorded."""
        show, elite = self.show, self.selection.picked
        policy = None if self.controller in (None, SEARCHED) else show.controllers[self.controller]
        command = show.command("replay", policy=policy, **{"minimal" if self.minimal else "elite": elite})
        self.panel.details.content = f"{show.details(elite)}\n\n`{command}`"
        self.scene.hide_crossing()
        self.clock.duration_s = 0.0
        self.panel.show_curves(None)
        self.bar.show({"enabled": False, "status": "", "marks": [], "episodes": [], "share": None})
        self.robot.load(elite, self.controller, minimal=self._prefers_minimal)
        self._load_ghost()
        if self.robot.recording is not None:
            self._show_recording(self.robot.recording)
        elif self.robot.request is None:
            self.bar.show({"status": f"No crossing: {escape(show.note)}"})
        else:
            self._show_share(TaskProgress(self.robot.request))

    def _show_recording(self, recording: Recording) -> None:
        replica = find_typical_episode(recording, self.show.scales) if self.replica is None else self.replica
        self.bar.show({"share": None, "episodes": group_episodes(recording)})
        self._show_rates()
        self.scene.set_paths(recording)
        self._show_episode(replica)

    def _show_episode(self, replica: int) -> None:
        self.replica = replica
        self.robot.show_episode(replica)
        crossing = self.robot.crossing
        self.panel.show_curves(crossing)
        self.bar.show({"status": "This episode broke at once."})
        self._show_ghost()
        if crossing is not None:
            self.clock.begin_s = max(0.0, crossing.failure_s - _LEAD_S)
            self.seek(self.clock.begin_s if self._begin_s is None else self._begin_s)
        marks = crossing.marks if crossing is not None else []
        self.bar.show({"enabled": crossing is not None, "marks": marks, "episode": replica + 1})
        self._show_time()

    def _show_frame(self) -> None:
        if (crossing := self.robot.crossing) is not None:
            self.scene.show_frame(crossing, crossing.find_frame(self.clock.time_s))
            if (ghost := self.ghost.crossing) is not None:
                self.scene.show_ghost(ghost, ghost.find_frame(self.clock.time_s), self.ghost.name or "")

    def _show_time(self) -> None:
        self.bar.show({"time": round(self.clock.time_s, 3), "playing": self.clock.playing})
