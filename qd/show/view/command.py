"""``faultline view``: what is shown, and the page that shows it; what a user may have got wrong is found before."""

import errno
import socket
import time
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

from qd.archive import goal_rates
from qd.run.directory import RUNS
from qd.show.elites import Found, find_archive
from qd.workers.evaluator import check_policy
from sim.files.atomic import prepare_output
from sim.files.command import OfRobot, Which
from sim.files.settings import check, setting
from sim.policy.spec import ControllerSpec, controller_hash

if TYPE_CHECKING:
    from qd.show.minima import MinimalFound
    from qd.show.view.plots import Axes
    from sim.robots.robot import RobotCfg

SEARCHED = "as searched"
"""What the page calls the controller of the search, if no other is named."""


@dataclass(frozen=True, kw_only=True)
class View(OfRobot, Which):
    """Look at an archive in the browser: its elites, their terrains in 3-D, and the robot that crosses them.

    On the left is the archive on parallel axes. A click on a line of the plot, or of the list under "Elites", shows
    that terrain. The list begins with one terrain of each way of failing. It can be sorted and narrowed. Under "Ranges"
    you drag the ends of an axis: elites outside turn grey and leave the list. On the right is the crossing: play,
    pause, drag the time, go from mark to mark, choose the episode, the speed and the controller. Arrows at the feet are
    contact forces (1 m is 1,000 N). The green arrow over the robot is its command. The curves are its penalties.
    Crossings that are not recorded yet run on the CPU, which takes seconds. They are kept under --cache. Those of the
    neighbours in the list are recorded ahead. Buttons make a film, files of the terrain, and the command that replays
    what is shown.

    Browser tabs do not affect each other. The address of a tab holds what it shows: ?elite=12&controller=C-G&t=8.4
    opens just that.

    Ctrl-C ends it. No GPU and no screen are needed: over ssh, forward the port (ssh -L 8080:localhost:8080 HOST) and
    open the page at home.
    """

    elite: str = ""
    """Number of the elite to show first; the first of the list if left out."""
    policies: tuple[str, ...] = ()
    """Controllers to choose from, each NAME=FILE, NAME=module:callable or NAME=shipped, such as base=shipped
    C-G=runs/tuned/policy.pt; if none is given, the one the archive was made with, and those of the robot's panel that
    certify its faults."""
    replicas: int = setting(20, least=1, most=100)
    """Episodes of each elite, from different starts; fewer are recorded sooner."""
    port: int = 8080
    """Where the page is served."""
    host: str = "127.0.0.1"
    """Address to serve it at. 127.0.0.1 is reached from this machine alone, 0.0.0.0 from the network: there is no
    password."""
    cache: Path = RUNS / "recordings"
    """Where recordings are kept."""

    def execute(self) -> None:
        """Serves the page until Ctrl-C."""
        serve(self)


@dataclass(frozen=True, kw_only=True)
class Show:
    """What is to be shown, and is there."""

    cfg: View
    found: Found
    elite: int | None
    """Which to show first; None for the first of the list."""
    controllers: dict[str, str]
    """What each controller is loaded from, by its name; empty if that of the search is lost."""
    note: str
    """Why there is no controller; empty if there is one."""
    minima: "MinimalFound | None" = None
    """Minimal terrains of the elites, if there are some."""

    @cached_property
    def axes(self) -> "Axes":
        """All elites, and the orders to list them in."""
        from qd.show.view.plots import axes_of

        minimal = () if self.minima is None else tuple(self.minima.genes)
        return axes_of(self.found.archive, self.found.space, minimal)

    @cached_property
    def _certifiers(self) -> dict[str, int]:
        """Place among the archive's certifiers of the controllers that are some."""
        faults = self.found.archive.faults
        known = () if faults is None else faults.certifier_sha256
        hashes = {name: controller_hash(policy) for name, policy in self.controllers.items()}
        return {name: known.index(digest) for name, digest in hashes.items() if digest in known}

    def certifying(self, number: int) -> str | None:
        """The controller that crosses an elite which fails, the best of several; None if none of these does."""
        archive = self.found.archive
        faults = archive.faults
        if faults is None or not archive.certified[number]:
            return None
        crosses, rates = faults.certificates()[number], goal_rates(faults.certifier_outcomes[number])
        found = [name for name, place in self._certifiers.items() if crosses[place]]
        return max(found, key=lambda name: rates[self._certifiers[name]], default=None)

    @property
    def robot(self) -> "RobotCfg":
        """Whose archive it is."""
        return self.found.robot


def serve(cfg: View) -> None:
    """Serves the page until Ctrl-C.

    Raises:
        FileNotFoundError: If there is no archive.
        ValueError: If anything else is not as it must be.
    """
    began = time.perf_counter()
    check_port(cfg.host, cfg.port)
    show = show_of(cfg)
    from qd.show.recordings import Recordings
    from qd.show.view.app import App

    app = App(show, Recordings(show.robot, folder=cfg.cache))
    try:
        took, count = time.perf_counter() - began, len(show.found.archive)
        print(f"{show.found.run}: {count:,} elites of {show.robot.name}, ready after {took:.1f} s.")
        print(f"Open http://{cfg.host}:{cfg.port} in a browser; Ctrl-C ends.", flush=True)
        app.run()
    except KeyboardInterrupt:
        print("\nStopped.")
    finally:
        app.close()


def show_of(cfg: View) -> Show:
    """What a command line asks to see.

    Raises:
        FileNotFoundError: If there is no archive.
        ValueError: If robot, archive, controllers or a number are not as they must be.
    """
    from qd.show.minima import read_minimal_numbers

    check(cfg)
    found = find_archive(cfg.robot, cfg.run, space=cfg.space)
    if not len(found.archive):
        raise ValueError(f"{found.run} has no elites yet: {found.go_on}, or give another --run")
    elite = found.one(cfg.elite) if cfg.elite else None
    minima = read_minimal_numbers(found.folder, found.archive) if cfg.minimal is None else found.minima()
    if minima is not None and cfg.minimal is not None:
        elite = minima.chosen(cfg.minimal, found.run)[0]
    controllers, note = _controllers_of(cfg, found)
    prepare_output(cfg.cache / "recording.npz")
    return Show(cfg=cfg, found=found, elite=elite, controllers=controllers, note=note, minima=minima)


def _controllers_of(cfg: View, found: Found) -> tuple[dict[str, str], str]:
    """The controllers by name, and why there are none; terrains can be looked at without."""
    from sim.policy.spec import controllers_of

    if any(map(str.strip, cfg.policies)):
        controllers = controllers_of(cfg.policies, found.robot)
        for policy in controllers.values():
            check_policy(policy, found.robot, "cpu")
        return controllers, ""
    searched, _ = found.as_searched()
    try:
        if ControllerSpec.parse(searched).runs_code:
            raise ValueError(f"the search's controller {searched} is code, and what a run names is never run")
        policy = found.policy(None)
        check_policy(policy, found.robot, "cpu")
    except ValueError as error:
        return {}, f"{error}; name a controller with --policies to see crossings"
    return {SEARCHED: policy, **_panel_of(found, policy)}, ""


def _panel_of(found: Found, searched: str) -> dict[str, str]:
    """The robot's panel as far as it crossed the archive, by the names it has there."""
    from qd.run.judge import panel_files

    faults = found.archive.faults
    if faults is None:
        return {}
    names = dict(zip(faults.certifier_sha256, faults.certifiers, strict=True))
    files = panel_files(found.robot, lambda file: controller_hash(file) == controller_hash(searched))
    return {names[digest]: file for file in files.values() if (digest := str(controller_hash(file))) in names}


def check_port(host: str, port: int) -> None:
    """Makes sure that a page can be served on a port.

    Raises:
        ValueError: If the port is in use, or the address is none of this machine's.
    """
    if not 0 < port < 65536:
        raise ValueError(f"port must lie in 1..65535, got {port}")
    reason = _trouble(host, port)
    if reason is not None and reason.errno == errno.EADDRINUSE:
        raise ValueError(f"port {port} of {host} is in use by another program: close that, or give another --port")
    if reason is not None:
        raise ValueError(
            f"nothing can be served at port {port} of {host}: {reason.strerror or reason}: give a --port above 1023 "
            "and a --host that is an address of this machine"
        )


def _trouble(host: str, port: int) -> OSError | None:
    """Why nothing could listen at a port; None if something could."""
    try:
        family, kind, protocol, _, address = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[0]
        with socket.socket(family, kind, protocol) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # as the server has it
            probe.bind(address)
    except OSError as error:
        return error
    return None
