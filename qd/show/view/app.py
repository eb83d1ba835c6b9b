"""The viewer's loop: one thread does everything that visitors and the recorder ask for, in turn."""

import queue
import time
from collections.abc import Callable, Hashable
from typing import Any

import viser

from qd.show.recordings import Recordings, on_elite
from qd.show.view.address import ask_query, read_address
from qd.show.view.common import Common
from qd.show.view.recorder import Recorder, Report
from qd.show.view.scene import first_view_of, shapes_of
from qd.show.view.show import Show
from qd.show.view.tab import Tab
from sim.robots.skeleton import Skeleton

_FRAME_S = 0.04
"""Real time from one shown frame to the next."""
_IDLE_S = 0.5
"""Real time from one look at the cameras to the next while nothing plays."""
_WINDOW = (1400, 900)  # one that is not known yet [pixels]

Asked = tuple[Callable[..., None], tuple[Any, ...]]


class Page(viser.ViserServer):
    """A viser page that never tunnels itself to the internet, whatever a visitor sends."""

    def request_share_url(self, verbose: bool = True) -> str | None:
        """Nothing: an archive and its controllers are the user's own."""
        return None


class App:
    """The page and its tabs."""

    def __init__(self, show: Show, recordings: Recordings, *, host: str, port: int) -> None:
        """Open the page.

        Args:
            show: What to show.
            recordings: Those that are stored.
            host: Address to serve the page at.
            port: Likewise.
        """
        self._recordings, self.tabs = recordings, dict[int, Tab]()
        self._asked: queue.SimpleQueue[tuple[Hashable, Asked]] = queue.SimpleQueue()
        skeleton = Skeleton(show.robot)
        self._common = Common(
            show=show,
            axes=show.axes,
            skeleton=skeleton,
            shapes=shapes_of(skeleton, show.robot),
            recordings=recordings,
            record=lambda wanted, tab: self._recorder.record(wanted, tab=tab),
            record_ahead=lambda wanted, tab: self._recorder.record_ahead(wanted, tab=tab),
            post=self.post,
        )
        self._recorder = Recorder(show.robot, lambda report: self.post(self.show_report, report))
        self.page = Page(host=host, port=port, label="faultline", verbose=False)
        self.page.gui.configure_theme(show_logo=False, show_share_button=False)
        self.page.scene.set_up_direction("+z")
        self.page.scene.configure_default_lights(enabled=True, cast_shadow=False)
        self.page.initial_camera.position, self.page.initial_camera.look_at = first_view_of(*_WINDOW)
        self.page.on_client_connect(self._greet)
        self.page.on_client_disconnect(lambda client: self.post(self.leave, client.client_id))

    def _greet(self, client: viser.ClientHandle) -> None:
        """In a thread of viser's, since it waits for the browser to answer."""
        self.post(self.open, client, ask_query(client))

    def post(self, act: Callable[..., None], *args: Any, only_last: Hashable = None) -> None:
        """Have something done by the loop; from any thread.

        Args:
            act: What to call.
            args: What to call it with.
            only_last: Of several that are asked for at once and have this in common, as dragging makes them, only the
                last one is done.
        """
        self._asked.put((object() if only_last is None else only_last, (act, args)))

    def open(self, client: viser.ClientHandle, query: str) -> None:
        """Lay out the page of a browser that came.

        Args:
            client: The browser.
            query: What its address says behind the question mark.
        """
        if client.client_id in self.page.get_clients():
            self.tabs[client.client_id] = Tab(client, self._common, *read_address(query))

    def leave(self, number: int) -> None:
        """Forget a tab that is closed."""
        tab = self.tabs.pop(number, None)
        if tab is not None:
            tab.leave()

    def show_report(self, report: Report) -> None:
        """Keep what was recorded, and tell all tabs how it goes on."""
        if report.recording is not None:
            self._recordings.keep(report.wanted, report.recording)
        for tab in self.tabs.values():
            tab.show_report(report)

    def close(self) -> None:
        """End the recording processes and the page."""
        self._recorder.stop()
        self.page.stop()

    def run(self) -> None:
        """Serve until interrupted."""
        show = self._common.show
        for policy in list(show.controllers.values())[:1]:  # ready by the time that somebody has chosen an elite
            self._recorder.warm(on_elite(show.opened_run.archive, 0, policy=policy, replicas=show.replicas))
        last = time.perf_counter()
        while True:
            self.do_asked(wait_s=_FRAME_S if self._playing else _IDLE_S)
            now = time.perf_counter()
            for tab in self.tabs.values():
                tab.tick(now - last)
            last = now

    @property
    def _playing(self) -> bool:
        return any(tab.playing for tab in self.tabs.values())

    def do_asked(self, wait_s: float) -> None:
        """Do what was asked for, or wait for it; while a tab plays, the whole time."""
        until = time.perf_counter() + wait_s
        found: dict[Hashable, Asked] = {}
        while (left := until - time.perf_counter()) > 0.0:
            try:
                key, asked = self._asked.get(timeout=left)
            except queue.Empty:
                break
            found.pop(key, None)
            found[key] = asked
            if not self._playing and self._asked.empty():
                break
        for act, args in found.values():
            act(*args)
