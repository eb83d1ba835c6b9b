"""Contact resolved: does the controller fail where contact is simulated in steps of 1 ms, too."""

from dataclasses import replace

import numpy as np

from qd.faults.stages.base import Judging, Stage
from qd.search.archive import Archive
from qd.workers.seeds import Stream


class Resolved(Stage):
    """Crosses the failing elites in 20 episodes with contact resolved."""

    name = "resolved"

    def run(self, archive: Archive, judging: Judging) -> Archive:
        """The archive with outcomes of the controller that was searched."""
        rows = np.flatnonzero(archive.failing)
        policy = judging.search.policy
        outcomes = archive.resolved_outcomes.copy()
        outcomes[rows] = judging.cross(
            archive, rows, policy, "resolved", stream=Stream.RESOLVED, label="contact resolved"
        )
        return replace(archive, resolved_outcomes=outcomes)
