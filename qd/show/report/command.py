"""The flags of ``faultline report``."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

from msgspec import Meta

from sim.files.command import InSpace, OnDevice, Who


@dataclass(frozen=True, kw_only=True)
class Report(Who, OnDevice, InSpace):
    """Write one HTML page about a run, with its figures beside it; it opens from disk, without a network.

    Robots cross the elites that it shows again, 20 times each. The crossings are stored, so the same command goes on
    after a stop. The evaluation's tables are those of results/<robot>/tables.json, if there are any.
    """

    run: Path | None = None
    """Run directory; the newest of this robot under runs/, else its published archive. Of a `faultline harden` the page
    is about its rounds, and nothing is crossed."""
    out: Path | None = None
    """Page to write, *.html; report.html in the run, or of published results in runs/<robot>-published; with another
    controller report-<its name>.html."""
    elites: Annotated[int, Meta(ge=1, le=10)] = 5
    """How many of the worst and of the most reproducible elites to show, with one of each failure mode."""

    def execute(self) -> None:
        """Writes the page."""
        from qd.show.report.report import write_report

        write_report(
            self.run, robot=self.robot, policy=self.policy, space=self.space, out=self.out, num_elites=self.elites,
            device=self.device,
        )  # fmt: skip
