"""What is to be shown; what a user may have got wrong is found before a page opens."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from qd.archive import goal_rates
from qd.judge import panel_of
from qd.minimise import MinimalFound, read_minimal
from qd.show.elites import OpenedRun, open_run
from qd.show.view.plots import Axes, axes_of
from qd.workers.evaluator import check_policy
from sim.policy.spec import ControllerSpec, controller_hash, controllers_of
from sim.robots.robot import RobotCfg

SEARCHED = "as searched"
"""What the page calls the controller of the search, if no other is named."""


@dataclass(frozen=True, kw_only=True)
class Show:
    """What is to be shown, and is there."""

    opened_run: OpenedRun
    elite: int | None
    """Which to show first; None for the first of the list."""
    controllers: dict[str, str]
    """What each controller is loaded from, by its name; empty if that of the search is lost."""
    replicas: int = 20
    """Episodes of each elite."""
    note: str = ""
    """Why there is no controller; empty if there is one."""
    minima: MinimalFound | None = None
    """Minimal terrains of the elites, if there are some."""
    minimal: bool = False
    """Whether the first terrain is the elite's minimal one."""

    @cached_property
    def axes(self) -> Axes:
        """All elites, and the orders to list them in."""
        minimal = () if self.minima is None else tuple(self.minima.genes)
        return axes_of(self.opened_run.archive, self.opened_run.space, minimal)

    @cached_property
    def _certifiers(self) -> dict[str, int]:
        """Place among the archive's certifiers of the controllers that are some."""
        faults = self.opened_run.archive.faults
        known = () if faults is None else faults.certifier_sha256
        hashes = {name: controller_hash(policy) for name, policy in self.controllers.items()}
        return {name: known.index(digest) for name, digest in hashes.items() if digest in known}

    def certifying(self, number: int) -> str | None:
        """The controller that crosses an elite which fails, the best of several; None if none of these does."""
        archive = self.opened_run.archive
        faults = archive.faults
        if faults is None or not archive.certified[number]:
            return None
        crosses, rates = faults.certificates()[number], goal_rates(faults.certifier_outcomes[number])
        names = [name for name, place in self._certifiers.items() if crosses[place]]
        return max(names, key=lambda name: rates[self._certifiers[name]], default=None)

    @property
    def robot(self) -> RobotCfg:
        """Whose archive it is."""
        return self.opened_run.robot


def find_show(
    run: Path | None = None,
    *,
    robot: str | None = None,
    elite: str = "",
    minimal: str | None = None,
    policies: Sequence[str] = (),
    space: str | None = None,
    replicas: int = 20,
) -> Show:
    """What a user asks to see.

    Args:
        run: Run directory or archive file; the newest of the robot, else its published one.
        robot: Name or settings file of the robot.
        elite: Number of the elite to show first.
        minimal: The same of a minimal terrain, or ``all``.
        policies: Controllers to choose from, ``NAME=FILE`` each; those of the search and its certifiers if empty.
        space: A user's own terrain space that the run names.
        replicas: Episodes of each elite.
    """
    opened_run = open_run(robot, run, space=space)
    if not len(opened_run.archive):
        raise ValueError(f"{opened_run.path} has no elites yet: let its search go on, or give another --run")
    number = opened_run.terrain(elite).number if elite else None
    minima = read_minimal(opened_run.folder, opened_run.archive) if minimal is None else opened_run.minima()
    if minima is not None and minimal is not None:
        number = minima.chosen(minimal, opened_run.path)[0]
    controllers, note = _controllers_of(policies, opened_run)
    return Show(
        opened_run=opened_run, elite=number, controllers=controllers, replicas=replicas, note=note, minima=minima,
        minimal=minimal is not None,
    )  # fmt: skip


def _controllers_of(policies: Sequence[str], opened_run: OpenedRun) -> tuple[dict[str, str], str]:
    """The controllers by name, and why there are none; terrains can be looked at without."""
    if any(map(str.strip, policies)):
        controllers = controllers_of(policies, opened_run.robot)
        for policy in controllers.values():
            check_policy(policy, opened_run.robot, "cpu")
        return controllers, ""
    searched, _ = opened_run.as_searched()
    try:
        if ControllerSpec.parse(searched).runs_code:
            raise ValueError(f"the search's controller {searched} is code, and what a run names is never run")
        policy = opened_run.policy(None)
        check_policy(policy, opened_run.robot, "cpu")
    except ValueError as error:
        return {}, f"{error}; name a controller with --policies to see crossings"
    return {SEARCHED: policy, **_panel_of(opened_run)}, ""


def _panel_of(opened_run: OpenedRun) -> dict[str, str]:
    """The robot's panel as far as it crossed the archive, by the names it has there."""
    faults = opened_run.archive.faults
    if faults is None:
        return {}
    names = dict(zip(faults.certifier_sha256, faults.certifiers, strict=True))
    files = panel_of(opened_run.robot).values()
    return {names[digest]: file for file in files if (digest := str(controller_hash(file))) in names}
