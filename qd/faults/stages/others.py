"""Other controllers: does one of them cross what the controller fails."""

from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from qd.faults.stages.base import Judging, Stage
from qd.search.archive import Archive, goal_rates
from qd.search.fitness import FAILING_GOAL_RATE
from qd.workers.seeds import Stream
from sim.controllers.spec import controller_hash


class Others(Stage):
    """Lets certifiers cross the failing elites in 20 episodes, at the search's settings and with contact resolved.

    A terrain that a certifier crosses less than half of the time at the search's settings is not crossed with contact
    resolved, since it cannot get a certificate. Outcomes of a certifier that is not asked stay; another controller of
    the same name replaces them.
    """

    name = "others"
    calls = (0, 2)

    def run(self, archive: Archive, judging: Judging) -> Archive:
        """The archive with outcomes of each certifier."""
        rows = np.flatnonzero(archive.failing)
        for name, policy in judging.certifiers.items():
            outcomes = judging.cross(archive, rows, policy, "search", stream=Stream.OTHERS, label=name)
            crossed = goal_rates(outcomes) >= FAILING_GOAL_RATE
            resolved = np.zeros_like(outcomes)
            resolved[crossed] = judging.cross(
                archive, rows[crossed], policy, "resolved", stream=Stream.OTHERS_RESOLVED,
                label=f"{name}, contact resolved",
            )  # fmt: skip
            archive = _add_outcomes(archive, name, policy, rows, outcomes, resolved)
        return archive


def _add_outcomes(
    archive: Archive, name: str, policy: str, rows: NDArray[np.int64], outcomes: NDArray[np.int64],
    resolved: NDArray[np.int64],
) -> Archive:  # fmt: skip
    """The archive with what a certifier did on some rows; what another controller of its name did is gone."""
    hashes = dict(zip(archive.certifiers, archive.certifier_sha256, strict=True))
    is_same = hashes.get(name) == controller_hash(policy)
    hashes[name] = str(controller_hash(policy))
    column = [*hashes].index(name)
    num_new = len(hashes) - len(archive.certifiers)
    columns: dict[str, Any] = {}
    for field, values in (("certifier_outcomes", outcomes), ("certifier_resolved_outcomes", resolved)):
        columns[field] = np.pad(getattr(archive, field), ((0, 0), (0, num_new), (0, 0)))
        if not is_same:
            columns[field][:, column] = 0
        columns[field][rows, column] = values
    if not is_same:
        columns |= {"varied_outcomes": None, "certifier_varied_outcomes": None}
    return replace(archive, certifiers=tuple(hashes), certifier_sha256=tuple(hashes.values()), **columns)
