"""Serves the viewer: one thread does everything that visitors and the recorder ask for, in turn."""

import queue
import socket
import time
from collections.abc import Callable, Hashable
from pathlib import Path
from typing import Any

import viser

from qd.show.recordings import Recordings, on_elite
from qd.show.view.address import ask_query, read_address
from qd.show.view.common import Common
from qd.show.view.recorder import Recorder, Report
from qd.show.view.scene import first_view_of, shapes_of, sky
from qd.show.view.show import Show
from qd.show.view.tab import Tab
from sim.files.atomic import prepare_output
from sim.robots.skeleton import Skeleton

_FRAME_S = 0.04
"""Real time from one shown frame to the next."""
_IDLE_S = 0.5
"""Real time from one look at the cameras to the next while nothing plays."""
_WINDOW = (1400, 900)  # one that is not known yet [pixels]

Task = tuple[Callable[..., None], tuple[Any, ...]]
"""What to call, and its arguments."""


class Page(viser.ViserServer):
    """A viser page that never tunnels itself to the internet, whatever a visitor sends."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Nothing: an archive and its controllers are the user's own."""
        return None


class App:
    """The page and its tabs."""

    def __init__(self, show: Show, recordings: Recordings, *, host: str, port: int) -> None:
        """Open the page."""
        self.tabs: dict[int, Tab] = {}
        self._tasks: queue.SimpleQueue[tuple[Hashable, Task]] = queue.SimpleQueue()
        self.recorder = Recorder(show.robot, lambda report: self.post(self.show_report, report))
        skeleton = Skeleton(show.robot)
        shapes = shapes_of(skeleton, show.robot)
        self._common = Common(
            show=show, skeleton=skeleton, shapes=shapes, recordings=recordings, recorder=self.recorder, post=self.post
        )
        self.page = Page(host=host, port=port, label="faultline", verbose=False)
        self.page.gui.configure_theme(show_logo=False, show_share_button=False)
        self.page.scene.set_up_direction("+z")
        self.page.scene.configure_default_lights(enabled=True, cast_shadow=True)
        self.page.scene.set_background_image(sky())
        self.page.initial_camera.position, self.page.initial_camera.look_at = first_view_of(*_WINDOW)
        # Viser calls this in a thread, which may wait for the browser to answer.
        self.page.on_client_connect(lambda client: self.post(self.open, client, ask_query(client)))
        self.page.on_client_disconnect(lambda client: self.post(self.leave, client.client_id))

    def post(self, act: Callable[..., None], *args: Any, only_last: Hashable = None) -> None:
        """Have the loop call ``act(*args)``; from any thread.

        Args:
            act: What to call.
            args: What to call it with.
            only_last: Of the waiting calls with an equal value, as dragging makes them, only the last one is done.
        """
        self._tasks.put((object() if only_last is None else only_last, (act, args)))

    def open(self, client: viser.ClientHandle, query: str) -> None:
        """Lay out the page of a new browser, whose address says ``query`` behind its question mark."""
        if client.client_id in self.page.get_clients():
            self.tabs[client.client_id] = Tab(client, self._common, *read_address(query))

    def leave(self, number: int) -> None:
        """Forget a closed tab."""
        tab = self.tabs.pop(number, None)
        if tab is not None:
            tab.leave()

    def show_report(self, report: Report) -> None:
        """Store a recording, and tell all tabs how far it is."""
        if report.recording is not None:
            self._common.recordings.keep(report.wanted, report.recording)
        for tab in self.tabs.values():
            tab.show_report(report)

    def close(self) -> None:
        """End the recording processes and the page."""
        self.recorder.stop()
        self.page.stop()

    def run(self) -> None:
        """Serve until interrupted."""
        show = self._common.show
        for policy in list(show.controllers.values())[:1]:  # ready before a visitor has chosen an elite
            self.recorder.warm(on_elite(show.opened_run.archive, 0, policy=policy, replicas=show.replicas))
        last = time.perf_counter()
        while True:
            self.do_tasks(wait_s=_FRAME_S if self._playing else _IDLE_S)
            now = time.perf_counter()
            for tab in self.tabs.values():
                tab.tick(now - last)
            last = now

    @property
    def _playing(self) -> bool:
        return any(tab.playing for tab in self.tabs.values())

    def do_tasks(self, wait_s: float) -> None:
        """Do what was posted, or wait for it; while a tab plays, the whole time."""
        until = time.perf_counter() + wait_s
        tasks: dict[Hashable, Task] = {}
        while (left := until - time.perf_counter()) > 0.0:
            try:
                key, task = self._tasks.get(timeout=left)
            except queue.Empty:
                break
            tasks.pop(key, None)
            tasks[key] = task
            if not self._playing and self._tasks.empty():
                break
        for act, args in tasks.values():
            act(*args)


def serve(show: Show, *, host: str, port: int, cache: Path) -> None:
    """Serves the page until Ctrl-C; recordings are stored in the folder ``cache``."""
    prepare_output(cache / "recording.npz")
    check_port(host, port)
    app = App(show, Recordings(show.robot, folder=cache), host=host, port=port)
    try:
        print(f"{show.opened_run.path}: {len(show.opened_run.archive):,} elites of {show.robot.name}.")
        print(f"Open http://{host}:{port} in a browser; Ctrl-C ends.", flush=True)
        app.run()
    except KeyboardInterrupt:
        print("\nStopped.")
    finally:
        app.close()


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
        reason = error.strerror or error
        raise ValueError(
            f"nothing can be served at port {port} of {host}: {reason}: give another --port, above 1023, and a --host "
            "that is an address of this machine"
        ) from None
