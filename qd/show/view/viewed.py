"""The run that the viewer shows. What a user may have got wrong is refused before a page opens."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import compress
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from qd.faults.minimise.minimise import MinimalTerrains, read_minimal
from qd.show.elites import OpenedRun, open_run
from qd.show.recordings import CrossingRequest, request_elite
from qd.show.view.listing import Listing
from qd.workers.compute import check_policy
from sim.controllers.spec import ControllerSpec, parse_controllers
from sim.robots.robot import RobotCfg

SEARCHED = "searched controller"
"""Name of the search's controller on the page, if no other is given."""


@dataclass(frozen=True, kw_only=True)
class ViewedRun:
    """What the viewer shows."""

    opened_run: OpenedRun
    elite: int | None
    """Which to show first; None for the first of the list."""
    controllers: dict[str, str]
    """File or code of each controller, by its name; empty if the search's controller is lost."""
    note: str = ""
    """Why there is no controller; empty if there is one."""
    minima: MinimalTerrains | None = None
    minimal: bool = False
    """Whether the first terrain is the elite's minimal one."""

    @cached_property
    def listing(self) -> Listing:
        """All elites, and the orders to list them in."""
        return Listing(opened_run=self.opened_run, minima=self.minima)

    @property
    def robot(self) -> RobotCfg:
        """The run's robot."""
        return self.opened_run.robot

    def minimal_genes(self, elite: int) -> NDArray[np.float32] | None:
        """Genes of the minimal terrain of an elite; None if it has none."""
        return None if self.minima is None else self.minima.genes.get(elite)

    def request(self, elite: int, controller: str | None, *, minimal: bool = False) -> CrossingRequest | None:
        """A controller's crossings of an elite, or of its minimal terrain if it has one; None without a controller."""
        if controller is None:
            return None
        genes = self.minimal_genes(elite) if minimal else None
        return request_elite(self.opened_run.archive, elite, policy=self.controllers[controller], minimal=genes)

    def find_certifier(self, number: int) -> tuple[str | None, str]:
        """Name of the controller that crosses a failing elite most often, or why there is none to show."""
        archive = self.opened_run.archive
        name = self.opened_run.certifier(number)
        if name is not None and self.controllers.get(name) == self.opened_run.certifiers()[name]:
            return name, ""
        if not archive.certified[number]:
            return None, "No other controller is known to cross it." if archive.failing[number] else ""
        names = compress(archive.certifiers, archive.certificates[number].tolist())
        return None, f"{' and '.join(names)} crosses it, but is not at hand: name its file with --policies."


def open_viewed_run(
    run: Path | None = None,
    *,
    robot: str | None = None,
    elite: str = "",
    minimal: str | None = None,
    policies: Sequence[str] = (),
    space: str | None = None,
) -> ViewedRun:
    """What a user asks to see, by the flags of ``faultline view``."""
    opened_run = open_run(robot, run, space=space)
    if not len(opened_run.archive):
        raise ValueError(f"{opened_run.path} has no elites yet: let its search go on, or give another --run")
    if elite and minimal:
        raise ValueError(f"elite and minimal both say what to open, got '{elite}' and '{minimal}': leave one out")
    numbers: list[int | None] = [None]
    if elite or minimal is not None:
        numbers = [terrain.number for terrain in opened_run.terrains(elite, minimal)]
    if len(numbers) > 1:
        raise ValueError(f"elite must be one number, since the viewer opens one, got '{elite or minimal}'")
    controllers, note = _find_controllers(policies, opened_run)
    return ViewedRun(
        opened_run=opened_run,
        elite=numbers[0],
        controllers=controllers,
        note=note,
        minima=read_minimal(opened_run.folder, opened_run.archive),
        minimal=minimal is not None,
    )


def _find_controllers(policies: Sequence[str], opened_run: OpenedRun) -> tuple[dict[str, str], str]:
    """The controllers by name, and why there are none."""
    certifiers = opened_run.certifiers()
    if any(map(str.strip, policies)):
        controllers = parse_controllers(policies, opened_run.robot)
        for policy in controllers.values():
            check_policy(policy, opened_run.robot, "cpu")
        return controllers | {name: file for name, file in certifiers.items() if name not in controllers}, ""
    searched, _ = opened_run.as_searched()
    try:
        if ControllerSpec.parse(searched).runs_code:
            raise ValueError(f"the search's controller {searched} is code, and what a run names is never run")
        policy = opened_run.policy(None)
        check_policy(policy, opened_run.robot, "cpu")
    except ValueError as error:
        return {}, f"{error}; name a controller with --policies to see crossings"
    return {SEARCHED: policy, **certifiers}, ""
