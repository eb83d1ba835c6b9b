"""The flags of ``faultline view``."""

from dataclasses import dataclass
from pathlib import Path

from qd.run.directory import RUNS
from sim.files.command import OfRobot, Which


@dataclass(frozen=True, kw_only=True)
class View(OfRobot, Which):
    """Look at an archive in the browser: its elites, their terrains in 3-D, and the robot that crosses them.

    On the left is the archive on parallel axes. A click on a line of the plot, or of the list under "Elites", shows
    that terrain. The list begins with one terrain of each way of failing. It can be sorted and narrowed. Under "Ranges"
    you drag the ends of an axis: elites outside turn grey and leave the list. On the right is the crossing: play,
    pause, drag the time, go from mark to mark, choose the episode, the speed and the controller. Arrows at the feet are
    contact forces (1 m is 1,000 N). The green arrow over the robot is its command. The curves are its penalties.
    Crossings that are not recorded yet run on the CPU, which takes seconds, and are stored under --cache. Those of the
    neighbours in the list are recorded ahead. Buttons copy the link to what is shown, and the command that
    replays it.

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
    port: int = 8080
    """Where the page is served."""
    host: str = "127.0.0.1"
    """Address to serve it at. 127.0.0.1 is reached from this machine alone, 0.0.0.0 from the network: there is no
    password."""

    cache: Path = RUNS / "recordings"
    """Where recordings are stored."""

    def execute(self) -> None:
        """Serves the page until Ctrl-C."""
        from qd.show.view.serve import serve
        from qd.show.view.show import find_show

        show = find_show(
            self.run, robot=self.robot, elite=self.elite, minimal=self.minimal, policies=self.policies,
            space=self.space,
        )  # fmt: skip
        serve(show, host=self.host, port=self.port, cache=self.cache)
