"""Contact resolved: does the controller fail where contact is simulated in steps of 1 ms, too."""

from dataclasses import replace

import numpy as np

from qd.faults.stages.base import Judging, Stage, put_rows
from qd.search.archive import Archive
from qd.workers.seeds import Stream


class Resolved(Stage):
    """Crosses the failing elites in 20 episodes with contact resolved."""

    name = "resolved"
    needs = ("fresh",)

    def is_done(self, archive: Archive) -> bool:
        """Whether anything was crossed so."""
        return bool(archive.resolved_outcomes.any())

    def run(self, archive: Archive, judging: Judging) -> Archive:
        """The archive with outcomes of the controller that was searched."""
        rows = np.flatnonzero(archive.failing)
        outcomes = judging.cross(
            archive, rows, judging.search.policy, engine="resolved", stream=Stream.RESOLVED, label="contact resolved"
        )
        return replace(archive, resolved_outcomes=put_rows(archive.resolved_outcomes, rows, outcomes))
