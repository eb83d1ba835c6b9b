"""What all tabs share, and a controller on the terrain that a tab shows: its recording, and one episode of that."""

from collections.abc import Callable, Hashable
from dataclasses import dataclass

from qd.show.recordings import Recordings, Wanted
from qd.show.view.meshes import Part
from qd.show.view.playing import Crossing, trace_crossing
from qd.show.view.recorder import Recorder, Report
from qd.show.view.show import Show
from sim.recording.recorder import Recording
from sim.robots.skeleton import Skeleton


@dataclass(frozen=True, kw_only=True)
class Common:
    """What all tabs share."""

    show: Show
    skeleton: Skeleton
    parts: list[Part]
    recordings: Recordings
    recorder: Recorder
    films: Callable[[], Recorder]
    """What makes films, in a process of its own from the first call on."""
    post: Callable[..., None]


class Crosser:
    """The controller that is shown, or the ghost beside it."""

    def __init__(self, common: Common, key: Hashable) -> None:
        """Nobody yet; the recorder does what the ``key`` asked for last."""
        self._common, self._key = common, key
        self.name: str | None = None
        self.wanted: Wanted | None = None
        self.recording: Recording | None = None
        self.crossing: Crossing | None = None

    def load(self, elite: int, name: str | None, *, minimal: bool = False) -> None:
        """Load the recording of another elite or controller, or ask for it."""
        self.name, self.recording, self.crossing = name, None, None
        self.wanted = self._common.show.wanted(elite, name, minimal=minimal)
        if self.wanted is not None:
            self.recording = self._common.recordings.read(self.wanted)
        self._common.recorder.record(self.wanted if self.recording is None else None, tab=self._key)

    def leave(self) -> None:
        """Ask for nothing more."""
        self._common.recorder.record(None, tab=self._key)

    def takes(self, report: Report) -> bool:
        """Take the recording of a report, if it has one; whether it is on what was asked for here."""
        if self.wanted is None or report.wanted != self.wanted or self.recording is not None:
            return False
        self.recording = report.result
        return True

    def show_episode(self, replica: int) -> None:
        """Load the crossing of an episode, counted from 0, where one is recorded."""
        archive = self._common.show.opened_run.archive
        self.crossing = None
        if self.recording is not None:
            skeleton = self._common.skeleton
            self.crossing = trace_crossing(self.recording, replica, skeleton, archive.penalties, archive.scales)
