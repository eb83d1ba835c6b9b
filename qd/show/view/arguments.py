"""What a command line of the viewer means; whatever a user may have got wrong is found before a page opens."""

import errno
import socket
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from qd.run.directory import RESULTS
from qd.show.recordings import Found, archive_of_robot, policy_of
from qd.show.replay import as_searched
from qd.workers.evaluator import check_policy
from sim.policy.spec import ControllerSpec

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg

SEARCHED = "as searched"
"""What the page calls the controller of the search, if no other is named."""
_CACHE = Path("runs") / "view-cache"
_LOOK_AHEAD = 50
"""Ports looked at for a free one."""


@dataclass(frozen=True, kw_only=True)
class ViewCfg:
    """Look at an archive in the browser: its elites, their terrains in 3-D, and the robot that crosses them.

    Left, the archive on parallel axes. Under "Ranges" drag the ends of an axis: elites outside turn grey and leave the
    list under "Worst first". Click a line of the list to see that terrain. Right, its crossing: play, pause, drag the
    time, choose the episode, the speed and the controller. Arrows at the feet are contact forces (1 m is 1,000 N), the
    green one over the robot is its command; curves are what it is penalised for. Crossings that were not recorded
    before are run on the CPU, which takes seconds, and are kept under --cache.

    Ctrl-C ends it. No GPU and no screen are needed: over ssh, forward the port (ssh -L 8080:localhost:8080 HOST) and
    open the page at home.
    """

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the Python file of your own."""
    run: Path | None = None
    """Run directory; the newest of this robot under runs/, or if there is none the published one under results/."""
    policies: tuple[str, ...] = ()
    """Controllers to choose from, each NAME=FILE, NAME=module:callable or NAME=shipped, such as base=shipped
    C-G=runs/tuned/policy.pt; the one the archive was made with if none is given."""
    elite: int = 0
    """Which elite to show first; 0 is the worst for the robot."""
    replicas: int = 20
    """Episodes of each elite, from different starts; fewer are recorded sooner."""
    port: int = 8080
    """Where the page is served."""
    host: str = "127.0.0.1"
    """Whom to serve it to: this machine alone, as whoever reaches the page may use it, without a password. 0.0.0.0
    serves it to the network."""
    cache: Path = _CACHE
    """Where recordings made here are kept."""


@dataclass(frozen=True, kw_only=True)
class Show:
    """What is to be shown, looked at and found to be there."""

    cfg: ViewCfg
    found: Found
    robot: "RobotCfg"
    controllers: dict[str, str]
    """What each controller is loaded from, by its name; empty if that of the search is lost."""
    note: str
    """Why there is no controller; empty if there is one."""
    published: Path
    """Folder of the recordings that come with the project."""


def show_of(cfg: ViewCfg) -> Show:
    """What a command line asks to see.

    Raises:
        FileNotFoundError: If there is no archive.
        ValueError: If robot, archive, controllers or a number are not as they must be.
    """
    from sim.policy.spec import controllers_of

    found = archive_of_robot(cfg.robot, cfg.run)
    robot = found.robot
    if not len(found.archive):
        raise ValueError(f"{found.run} has no elites yet: let its search go on, or give another --run")
    if not 0 <= cfg.elite < len(found.archive):
        raise ValueError(f"{found.run} has no elite {cfg.elite}: expected 0 to {len(found.archive) - 1}")
    if not 1 <= cfg.replicas <= 100:
        raise ValueError(f"replicas must lie in 1..100, got {cfg.replicas}")
    note = ""
    if any(map(str.strip, cfg.policies)):
        controllers = controllers_of(cfg.policies, robot)
        for policy in controllers.values():
            check_policy(policy, robot, "cpu")
    else:
        searched, _ = as_searched(found.run, found.archive)
        try:  # without a controller the terrains can be looked at all the same
            if ControllerSpec.parse(searched).runs_code:
                raise ValueError(f"the search's controller {searched} is code, and what a run names is never run")
            controllers = {SEARCHED: policy_of(found, robot, None)}
            check_policy(controllers[SEARCHED], robot, "cpu")
        except ValueError as error:
            controllers, note = {}, f"{error}; name a controller with POLICIES to see crossings"
    published = RESULTS / robot.name / "view"
    return Show(cfg=cfg, found=found, robot=robot, controllers=controllers, note=note, published=published)


def check_port(host: str, port: int) -> None:
    """Makes sure that a page can be served on a port.

    Raises:
        ValueError: If the port is in use, which names a free one, or the address is none of this machine's.
    """
    if not 0 < port < 65536:
        raise ValueError(f"port must lie in 1..65535, got {port}")
    reason = _trouble(host, port)
    if reason is not None and reason.errno == errno.EADDRINUSE:
        others = range(port + 1, min(port + 1 + _LOOK_AHEAD, 65536))
        free = next((other for other in others if _trouble(host, other) is None), None)
        remedy = "close that program" if free is None else f"take PORT={free}, which is free"
        raise ValueError(f"port {port} of {host} is in use by another program: {remedy}")
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
