"""What a report is made from: the files of a run and of an evaluation, read and checked before any work."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qd.archive import ARCHIVE_FILE, Archive, read_archive
from qd.run.directory import (
    CONFIG_FILE,
    METRICS_FILE,
    RESULTS,
    Metrics,
    RunDirectory,
    directory_of,
    folder_for,
    newest_or_published,
)
from qd.run.next_commands import make_command
from qd.run.settings import SearchCfg
from qd.show.figures import summary
from qd.show.replay import as_searched, check_penalties
from qd.show.report.tables import read_tables
from sim.files.atomic import prepare_output
from sim.policy.spec import ControllerSpec, spec_of
from sim.robots.robot import RobotCfg, get_robot

_ORIGIN = ("command", "commit", "device", "versions", "seed", "date")


@dataclass(frozen=True, kw_only=True)
class HtmlReportCfg:
    """Write one HTML page about a run, with its figures beside it; it opens from disk, without a network.

    Elites shown are crossed again for it, 20 times each; what was crossed is kept beside the page, so that the same
    command, stopped or made again, goes on from there.
    """

    robot: str = "anymal"
    """Which robot: anymal, cassie, or the settings file of another (my_robot.py)."""
    run: Path | None = None
    """Run directory; the newest of this robot under runs/, or without one results/<robot>/archive."""
    tables: Path | None = None
    """File of the evaluation tables; results/<robot>/tables.json if it is there."""
    out: Path | None = None
    """Page to write, *.html; report.html in the run, or of published results in runs/<robot>-published."""
    policy: str | None = None
    """Controller other than the one the archive was made with; that one too, if it is code."""
    device: str | None = None
    """cpu, cuda or cuda:N; CUDA where there is one."""
    elites: int = 5
    """How many of the worst and of the most reproducible elites to show, beside one of each failure mode."""
    episodes: int = 20
    """Crossings of each elite shown."""

    def __post_init__(self) -> None:
        if not 1 <= self.elites <= 10:
            raise ValueError(f"elites must be 1 to 10 of each kind, got {self.elites}: each takes a figure and a table")
        if not 1 <= self.episodes <= 100:
            raise ValueError(f"episodes must be 1 to 100 of each elite, got {self.episodes}")


@dataclass(frozen=True, kw_only=True)
class Material:
    """Everything read; None where there is no such file."""

    cfg: HtmlReportCfg
    robot: RobotCfg
    run: Path
    """Directory or archive file that was read."""
    out: Path
    archive: Archive
    metrics: Metrics | None
    """One row an iteration, up to those of the archive."""
    searched: str
    """Controller of the search, :data:`sim.policy.spec.SHIPPED` where it lies without its config."""
    search: SearchCfg | None
    origin: dict[str, Any]
    """Command, commit, device, versions, seed and date of the search, as far as they are known."""
    reproduced_by: dict[str, Any]
    """Where the fresh episodes come from, likewise; empty if there are none or that is not on record."""
    gpus: int | None
    tables: dict[str, Any] | None
    tables_file: Path
    """Where the tables are, or would be looked for."""

    @property
    def summary(self) -> dict[str, Any] | None:
        """The run in numbers, as ``archive.json`` has them; None without metrics."""
        return None if self.metrics is None else summary(self.archive, self.metrics, gpus=self.gpus or 0, origin={})

    @property
    def policy(self) -> str:
        """Controller to cross with: what was asked for, or that of the search."""
        return spec_of(self.cfg.policy or self.searched, self.robot)

    @property
    def is_unnamed_code(self) -> bool:
        """Whether that is code which only the run names: what a file names is never run."""
        return self.cfg.policy is None and ControllerSpec.parse(self.searched).runs_code


def gather(cfg: HtmlReportCfg) -> Material:
    """Reads what there is and makes sure that the page can be written.

    Raises:
        FileNotFoundError: If there is no run or no such tables.
        ValueError: If something is damaged, half-written, empty or of another robot, or OUT cannot be written.
    """
    robot = get_robot(cfg.robot)
    run = cfg.run or newest_or_published(robot)
    archive = _archive_of(run, robot)
    searched, _ = as_searched(run, archive)
    folder = RunDirectory(directory_of(run))
    search = folder.read_cfg() if (folder.path / CONFIG_FILE).exists() else None
    numbers = folder.read_summary()
    again = numbers.get("reproduced_by")
    config = {} if search is None else folder.read_config()
    tables_file = cfg.tables or RESULTS / robot.name / "tables.json"
    has_tables = cfg.tables is not None or tables_file.exists()
    material = Material(
        cfg=cfg,
        robot=robot,
        run=run,
        out=cfg.out or folder_for(run, robot.name) / "report.html",
        archive=archive,
        metrics=_metrics_of(folder, archive),
        searched=searched,
        search=search,
        origin={key: config[key] for key in _ORIGIN if key in config},
        reproduced_by=again if archive.fresh is not None and isinstance(again, dict) else {},
        gpus=numbers["gpus"] if type(numbers.get("gpus")) is int else None,
        tables=read_tables(tables_file, robot.name) if has_tables else None,
        tables_file=tables_file,
    )
    _check_out(material.out)
    return material


def _archive_of(run: Path, robot: RobotCfg) -> Archive:
    if run.is_dir() and (run / CONFIG_FILE).exists() and not (run / ARCHIVE_FILE).exists():
        raise ValueError(
            f"{run} must hold a search that has ended an iteration, got one without {ARCHIVE_FILE}: "
            f"let it go on with `{make_command('archive', robot=robot.spec, resume=run)}`"
        )
    archive = read_archive(run)
    if archive.robot != robot.name:
        raise ValueError(
            f"{run} is of robot {archive.robot}, got --robot {robot.spec}: give that robot or another --run"
        )
    check_penalties(archive, robot, run)
    if not len(archive):
        raise ValueError(
            f"{run} must have elites to report on, got an archive of none after {archive.iterations} iterations: "
            f"let it go on with `{make_command('archive', robot=robot.spec, resume=run)} ITERATIONS=N`"
        )
    return archive


def _metrics_of(folder: RunDirectory, archive: Archive) -> Metrics | None:
    """The rows up to the archive's iteration; a run that goes on meanwhile may have some more."""
    file = folder.path / METRICS_FILE
    if not file.exists():
        return None
    rows = folder.read_metrics()
    if len(rows) < archive.iterations:
        again = make_command("archive", robot=archive.robot, resume=folder.path)
        raise ValueError(
            f"{file} must have a row for each of the archive's {archive.iterations} iterations, got {len(rows)}: the "
            f"run is half-written; `{again}` writes both again"
        )
    return rows[: archive.iterations]


def _check_out(out: Path) -> None:
    if out.suffix != ".html":
        raise ValueError(f"out must be a file named *.html, got {out}: name for example {out / 'report.html'}")
    prepare_output(out)
