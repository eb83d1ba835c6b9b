"""The ghost: a second controller on the same terrain at the same time, such as the one that certifies a fault."""

from html import escape

from qd.show.crossed import ending_of
from qd.show.recordings import Wanted
from qd.show.view.common import Common
from qd.show.view.playing import Crossing, crossing_of
from qd.show.view.recorder import Report
from sim.recording.recorder import Recording

CERTIFYING, NOBODY = "who certifies it", "none"
"""Choices beside the names of controllers: the one that certifies the elite, if it is at hand, and no ghost."""


class Ghost:
    """Whose crossing is shown beside the chosen controller's, and its recording."""

    def __init__(self, common: Common, tab: int) -> None:
        """The controller that certifies the elite is the ghost at first, in the tab of that number."""
        self._common, self._key = common, (tab, "ghost")
        self.choice = CERTIFYING
        """A controller's name, :data:`CERTIFYING` or :data:`NOBODY`."""
        self.name: str | None = None
        """Of the controller; None if there is no ghost."""
        self.recording: Recording | None = None
        self.crossing: Crossing | None = None
        self._wanted: Wanted | None = None
        self._note = ""

    @property
    def choices(self) -> tuple[str, ...]:
        """What can be chosen."""
        return (CERTIFYING, NOBODY, *self._common.show.controllers)

    def load(self, elite: int, beside: str | None, *, minimal: bool = False) -> None:
        """Load the recording of another elite or controller, or ask for it.

        Args:
            elite: Number of the elite.
            beside: The controller that is shown already, which can be no ghost of itself.
            minimal: Whether the elite's minimal terrain is shown.
        """
        self.recording = self.crossing = None
        chosen, self._note = self._common.show.certifying(elite) if self.choice == CERTIFYING else (self.choice, "")
        self.name = chosen if chosen in self._common.show.controllers and chosen != beside else None
        self._wanted = self._common.wanted(elite, self.name, minimal=minimal)
        if self._wanted is not None:
            self.recording = self._common.recordings.read(self._wanted)
        self._common.recorder.record(self._wanted if self.recording is None else None, tab=self._key)

    def leave(self) -> None:
        """Ask for nothing more."""
        self._common.recorder.record(None, tab=self._key)

    def take_report(self, report: Report) -> str | None:
        """Take the recording of a report on this ghost; returns its status as HTML, None for another's report."""
        if self._wanted is None or report.wanted != self._wanted or self.recording is not None:
            return None
        self.recording = report.result
        if report.failed:
            return f"No ghost: {escape(report.text)}"
        return self.words(0) if report.result is not None else f"{self.words(0)} {report.share:.0%}"

    def show_episode(self, replica: int) -> str:
        """Load the crossing of an episode, counted from 0; returns its status as HTML."""
        archive = self._common.show.opened_run.archive
        self.crossing = None
        if self.recording is not None:
            skeleton = self._common.skeleton
            self.crossing = crossing_of(self.recording, replica, skeleton, archive.penalties, archive.scales)
        return self.words(replica)

    def words(self, replica: int) -> str:
        """How its episode ended, as HTML; without a ghost why there is none, if one might expect it."""
        if self.name is None:
            return escape(self._note)
        name = f"Ghost, {escape(self.name)}:"
        if self.recording is None:
            return f"{name} {self._common.show.replicas} episodes are recorded …"
        ending = ending_of(self.recording.outcome[0, replica])
        ended = f'<span style="color:{ending.color}">{ending.words}</span>'
        return f"{name} {ended} after {float(self.recording.duration_s[0, replica]):.1f} s"
