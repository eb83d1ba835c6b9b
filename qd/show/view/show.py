"""What to show. What a user may have got wrong is refused before a page opens."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from qd.archive import goal_rates
from qd.judge import panel_of
from qd.minimise import MinimalTerrains, read_minimal
from qd.show.elites import OpenedRun, open_run
from qd.show.view.plots import Axes, axes_of
from qd.workers.evaluator import check_policy
from sim.policy.spec import ControllerSpec, controller_hash, controllers_of
from sim.robots.robot import RobotCfg

SEARCHED = "as searched"
"""What the page calls the controller of the search, if no other is named."""


@dataclass(frozen=True, kw_only=True)
class Show:
    """What the viewer shows."""

    opened_run: OpenedRun
    """Archive, robot and search."""
    elite: int | None
    """Which to show first; None for the first of the list."""
    controllers: dict[str, str]
    """File or code of each controller, by its name; empty if the search's controller is lost."""
    replicas: int = 20
    """Episodes of each elite."""
    note: str = ""
    """Why there is no controller; empty if there is one."""
    minima: MinimalTerrains | None = None
    """Minimal terrains of the elites, if there are some."""
    minimal: bool = False
    """Whether the first terrain is the elite's minimal one."""

    @cached_property
    def axes(self) -> Axes:
        """All elites, and the orders to list them in."""
        minimal = () if self.minima is None else tuple(self.minima.genes)
        return axes_of(self.opened_run.archive, self.opened_run.space, minimal)

    @cached_property
    def _hashes(self) -> dict[str, str | None]:
        return {name: controller_hash(policy) for name, policy in self.controllers.items()}

    def certifying(self, number: int) -> str | None:
        """Name of the controller that crosses a failing elite, the best of several; None if none of these does."""
        faults = self.opened_run.archive.faults
        if faults is None or not self.opened_run.archive.certified[number]:
            return None
        rows = zip(
            faults.certifier_sha256, faults.certificates()[number], goal_rates(faults.certifier_outcomes[number]),
            strict=True,
        )  # fmt: skip
        rates = {digest: rate for digest, crosses, rate in rows if crosses}
        names = [name for name, digest in self._hashes.items() if digest in rates]
        return max(names, key=lambda name: rates[str(self._hashes[name])], default=None)

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
) -> Show:
    """What a user asks to see.

    Args:
        run: Run directory or archive file; the newest of the robot, else its published one.
        robot: Name or settings file of the robot.
        elite: Number of the elite to show first.
        minimal: Number of the elite whose minimal terrain to show first, or ``all``.
        policies: Controllers to choose from, ``NAME=FILE`` each; those of the search and its certifiers if empty.
        space: A user's own terrain space that the run names.
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
        opened_run=opened_run,
        elite=number,
        controllers=controllers,
        note=note,
        minima=minima,
        minimal=minimal is not None,
    )


def _controllers_of(policies: Sequence[str], opened_run: OpenedRun) -> tuple[dict[str, str], str]:
    """The controllers by name, and why there are none."""
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
    """Those of the robot's panel that crossed the archive, by their names in it."""
    faults = opened_run.archive.faults
    if faults is None:
        return {}
    names = dict(zip(faults.certifier_sha256, faults.certifiers, strict=True))
    files = panel_of(opened_run.robot).values()
    return {names[digest]: file for file in files if (digest := str(controller_hash(file))) in names}
