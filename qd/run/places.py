"""Where runs are, and where what is made from one goes."""

import itertools
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from qd.archive import ARCHIVE_FILE, read_archive
from sim.policy.spec import controller_suffix

if TYPE_CHECKING:
    from sim.robots.robot import RobotCfg

RUNS = Path("runs")
RESULTS = Path("results")
"""Where published archives and tables lie, <robot>/archive and <robot>/tables.json."""


def newest_run(robot: "RobotCfg") -> Path:
    """The run of a robot under runs/ whose archive changed last.

    Raises:
        FileNotFoundError: If there is none.
    """
    run = _newest(robot.name)
    if run is not None:
        return run
    published = _published(robot.name)
    such = f", such as the published {published}" if published else ""
    make = f"`make archive ROBOT={robot.spec}`"
    raise FileNotFoundError(f"no archive of {robot.name} under {RUNS}/: make one with {make}, or give --run{such}")


def newest_or_published(robot: "RobotCfg") -> Path:
    """The newest run of a robot under runs/, or its published archive where there is none.

    Raises:
        FileNotFoundError: If there is neither.
    """
    return _newest(robot.name) or _published(robot.name) or newest_run(robot)


def _newest(name: str) -> Path | None:
    files = sorted(RUNS.glob(f"*/{ARCHIVE_FILE}"), key=lambda file: file.stat().st_mtime, reverse=True)
    return next((file.parent for file in files if read_archive(file).robot == name), None)


def _published(name: str) -> Path | None:
    folder = RESULTS / name / "archive"
    return folder if (folder / ARCHIVE_FILE).exists() else None


def directory_of(run: Path) -> Path:
    """The directory of a run that is given as such or as its archive file."""
    return run if run.is_dir() else run.parent


def folder_for(run: Path, robot: str) -> Path:
    """Where what is made from a run goes: into its directory, or of a published one to runs/<robot>-published.

    Args:
        run: Run directory or archive file.
        robot: Name of its robot.
    """
    folder = directory_of(run)
    published = RESULTS.resolve() in folder.resolve().parents
    return RUNS / f"{robot}-published" if published else folder


def elite_name(elite: int, policy: str, searched: str) -> str:
    """What a file about an elite is called: elite-3; of another controller than the search's elite-3-C-G.

    Args:
        elite: Its number.
        policy: The controller that crosses it.
        searched: That of the search.
    """
    return f"elite-{elite}{controller_suffix(policy, searched)}"


def numbered(root: Path, name: str) -> Iterator[Path]:
    """Directories a run may be put in: ``name``, ``name-2``, ``name-3`` and so on."""
    yield root / name
    yield from (root / f"{name}-{number}" for number in itertools.count(2))
