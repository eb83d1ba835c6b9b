"""Serves the viewer: one thread does everything that visitors and the recorder post, in turn."""

import queue
import socket
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import viser

from qd.show.recordings import Recordings
from qd.show.view.panels import PlayerBar, Selection
from qd.show.view.recorder import Recorder, TaskProgress
from qd.show.view.scene import SKY, compute_view, robot_shapes
from qd.show.view.tab import Shared, Tab
from qd.show.view.viewed import ViewedRun
from sim.files.atomic import prepare_output
from sim.recording.recorder import Recording
from sim.robots.skeleton import Skeleton

_FRAME_S = 0.04  # real time from one shown frame to the next
_IDLE_S = 0.5  # real time from one look at the cameras to the next while nothing plays
_WINDOW = (1400, 900)  # of a visitor who has not sent a size yet [pixels]


class Page(viser.ViserServer):
    """A viser page that never tunnels itself to the internet, whatever a visitor sends."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Nothing: an archive and its controllers are the user's."""
        return None


class App:
    """The page and its tabs."""

    def __init__(self, show: ViewedRun, recordings: Recordings, recorder: Recorder, *, host: str, port: int) -> None:
        self.tabs: dict[int, Tab] = {}
        self.bars: dict[int, PlayerBar] = {}
        self._tasks = queue.SimpleQueue[Callable[[], None]]()
        recorder.robot = show.robot
        recorder.report = partial(self.post, self.show_progress)
        request = show.request(Selection(show).picked, next(iter(show.controllers), None), minimal=show.minimal)
        if request is not None and recordings.read(request) is None:
            recorder.request(request, key="first")  # before a page is open
        skeleton = Skeleton(show.robot)
        self._shared = Shared(show, skeleton, robot_shapes(skeleton, show.robot), recordings, recorder, self.post)
        self.page = Page(host=host, port=port, label="faultline", verbose=False)
        self.page.gui.configure_theme(show_logo=False, show_share_button=False)
        self.page.scene.set_up_direction("+z")
        self.page.scene.configure_default_lights(enabled=True, cast_shadow=True)
        self.page.scene.set_background_image(SKY)
        self.page.initial_camera.position, self.page.initial_camera.look_at = compute_view("near", *_WINDOW)
        self.page.on_client_connect(self._connect)  # viser calls it in a thread
        self.page.on_client_disconnect(lambda client: self.post(self.leave, client.client_id))

    def _connect(self, client: viser.ClientHandle) -> None:
        self.bars[client.client_id] = PlayerBar(client, partial(self.post, self.act, client))

    def post(self, act: Callable[..., None], *args: Any) -> None:
        """Have the loop call ``act(*args)``; from any thread."""
        self._tasks.put(partial(act, *args))

    def act(self, client: viser.ClientHandle, name: str, value: Any) -> None:
        """Do an action of a visitor; the first one brings the address and the size of the window."""
        number = client.client_id
        if number in self.tabs:
            self.tabs[number].act(name, value)
        elif name == "hello" and number in self.page.get_clients():
            try:
                query, width, height = value
                window = (int(width), int(height))
            except (TypeError, ValueError, OverflowError):  # anybody may send it; the page's own comes, too
                return
            self.tabs[number] = Tab(client, self.bars[number], self._shared, window, str(query))

    def leave(self, number: int) -> None:
        """Forget a closed tab."""
        self.bars.pop(number, None)
        if (tab := self.tabs.pop(number, None)) is not None:
            tab.leave()

    def show_progress(self, progress: TaskProgress) -> None:
        """Store a recording, and show all tabs how far it is."""
        if isinstance(progress.result, Recording):
            self._shared.recordings.store(progress.task, progress.result)
            self._shared.recorder.cancel(progress.task)  # a tab may have requested it just before
        for tab in self.tabs.values():
            tab.show_progress(progress)

    def run(self) -> None:
        """Serve until interrupted."""
        last = time.perf_counter()
        while True:
            self.do_tasks(wait_s=_FRAME_S if self._playing else _IDLE_S)
            before, last = last, time.perf_counter()
            for tab in self.tabs.values():
                tab.tick(last - before)

    @property
    def _playing(self) -> bool:
        return any(tab.playing for tab in self.tabs.values())

    def do_tasks(self, wait_s: float) -> None:
        """Do posted tasks, or wait for one; while a tab plays, the whole time."""
        deadline = time.perf_counter() + wait_s
        while (remaining_s := deadline - time.perf_counter()) > 0.0:
            try:
                task = self._tasks.get(timeout=remaining_s)
            except queue.Empty:
                return
            task()
            if not self._playing and self._tasks.empty():
                return


def serve(show: ViewedRun, recorder: Recorder, *, host: str, port: int, cache: Path) -> None:
    """Serves the page until Ctrl-C; recordings are stored in the folder ``cache``."""
    prepare_output(cache / "recording.npz")
    check_port(host, port)
    app = App(show, Recordings(show.robot, folder=cache), recorder, host=host, port=port)
    try:
        print(f"{show.path}: {len(show.archive):,} elites of {show.robot.name}.")
        print(f"Open http://{host}:{port} in a browser; Ctrl-C ends.", flush=True)
        app.run()
    except KeyboardInterrupt:
        print("\nStopped.")
    finally:
        app.page.stop()


def check_port(host: str, port: int) -> None:
    """Makes sure that a page can be served on a port."""
    if not 0 < port < 65536:
        raise ValueError(f"port must lie in 1..65535, got {port}")
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server has it
            probe.bind(address)
    except OSError as error:
        problem = f"port {port} of {host}: {error.strerror or error}"
        raise ValueError(f"nothing can be served at {problem}: give another --port or --host") from None
