"""What all tabs share, and a controller that a tab shows: its recording, and one episode of that."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass

from qd.show.recordings import CrossingRequest, Recordings
from qd.show.view.meshes import Part
from qd.show.view.playing import Crossing, trace_crossing
from qd.show.view.recorder import Recorder, TaskProgress
from qd.show.view.viewed import ViewedRun
from sim.recording.recorder import Recording
from sim.robots.skeleton import Skeleton


@dataclass(frozen=True, kw_only=True)
class Shared:
    """What all tabs share."""

    show: ViewedRun
    skeleton: Skeleton
    parts: list[Part]
    recordings: Recordings
    recorder: Recorder
    post: Callable[..., None]
    """Has the loop call a function with arguments."""


class ShownController:
    """The controller that is shown, or the ghost beside it."""

    def __init__(self, shared: Shared, key: Hashable) -> None:
        """No controller yet. The recorder works on the last request of each ``key``."""
        self._shared = shared
        self._key = key
        self.name: str | None = None
        self.request: CrossingRequest | None = None
        self.recording: Recording | None = None
        self.crossing: Crossing | None = None

    def load(self, elite: int, name: str | None, *, minimal: bool = False) -> None:
        """Load the recording of another elite or controller, or request it."""
        self.name = name
        self.recording = None
        self.crossing = None
        self.request = self._shared.show.request(elite, name, minimal=minimal)
        if self.request is not None:
            self.recording = self._shared.recordings.read(self.request)
        self._shared.recorder.request(self.request if self.recording is None else None, key=self._key)

    def take(self, progress: TaskProgress) -> bool:
        """Take the recording, if it is done; returns whether the progress is of this controller's request."""
        if self.request is None or progress.task != self.request or self.recording is not None:
            return False
        self.recording = progress.result
        return True

    def show_episode(self, replica: int) -> None:
        """Trace an episode, counted from 0, if one is recorded."""
        archive = self._shared.show.opened_run.archive
        self.crossing = None
        if self.recording is not None:
            skeleton = self._shared.skeleton
            self.crossing = trace_crossing(self.recording, replica, skeleton, archive.penalties, archive.scales)
