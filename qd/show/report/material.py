"""What a report is made from: the files of a run and of an evaluation, and what was worked out and crossed for it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from qd.archive import ARCHIVE_FILE, Archive
from qd.evaluate.tables import read_tables
from qd.groups import Elites, Modes, Ranking
from qd.minimise import MinimalTerrains, read_minimal
from qd.run.directory import CONFIG_FILE, METRICS_FILE, RESULTS, Metrics, RunDirectory, folder_for
from qd.run.settings import SearchCfg
from qd.show.crossed import Crossed
from qd.show.elites import OpenedRun, open_run
from qd.show.figures import summary
from qd.show.report.pictures import reliefs_of
from sim.files.atomic import prepare_output
from sim.policy.spec import SHIPPED, spec_of
from sim.robots.robot import RobotCfg
from sim.spaces.base import TerrainSpace

_ORIGIN = ("command", "commit", "device", "versions", "seed", "date")


@dataclass(frozen=True, kw_only=True)
class Material:
    """Everything read; None where there is no such file."""

    opened_run: OpenedRun
    out: Path
    """The page."""
    named_policy: str | None
    """The controller to cross with, if it is not the search's."""
    metrics: Metrics | None
    """One row an iteration, up to those of the archive."""
    search: SearchCfg | None
    origin: dict[str, Any]
    """Command, commit, device, versions, seed and date of the search, as far as they are known."""
    gpus: int | None
    minimal: MinimalTerrains | None
    tables: dict[str, Any] | None
    tables_file: Path
    """Where the tables are, or would be looked for."""

    @property
    def run(self) -> Path:
        """Directory or archive file that was read."""
        return self.opened_run.path

    @property
    def robot(self) -> RobotCfg:
        """Whose archive it is."""
        return self.opened_run.robot

    @property
    def archive(self) -> Archive:
        """The elites."""
        return self.opened_run.archive

    @property
    def space(self) -> TerrainSpace:
        """What the archive's genes mean."""
        return self.opened_run.space

    @property
    def summary(self) -> dict[str, Any] | None:
        """The run in numbers, as ``archive.json`` has them; None without metrics."""
        return None if self.metrics is None else summary(self.archive, self.metrics, gpus=self.gpus or 0, origin={})

    @property
    def policy(self) -> str:
        """Controller to cross with: what was asked for, or that of the search."""
        searched = SHIPPED if self.search is None else self.search.policy
        return spec_of(self.named_policy or searched, self.robot)


@dataclass(frozen=True, kw_only=True)
class Shown:
    """All that the sections take their numbers from."""

    material: Material
    ranking: Ranking
    worst: list[int]
    """Numbers of the worst terrains: one of each way of failing, then of other families, then others."""
    steady: list[int]
    """Numbers of the most reproducible ones."""
    episodes: int
    """Crossings of each elite shown."""
    crossed: Mapping[int, Crossed] = field(default_factory=dict)
    """Crossings by the elite's number."""
    not_crossed: str = ""
    """Why there are none, if so."""

    @property
    def elites(self) -> Elites:
        """All elites."""
        return self.ranking.elites

    @property
    def modes(self) -> Modes:
        """Their groups."""
        return self.ranking.modes

    @property
    def numbers(self) -> list[int]:
        """Elites to be shown in detail, each once: the worst, one of each mode first, and the steadiest."""
        return list(dict.fromkeys([*self.ranking.leaders(), *self.worst, *self.steady]))

    @cached_property
    def reliefs(self) -> list[bytes]:
        """A small picture of each elite's terrain, by its row."""
        return reliefs_of(self.material.archive.genes[self.elites.numbers], self.material.space)


def gather(robot: str | None, run: Path | None, *, policy: str | None, space: str | None, out: Path | None) -> Material:
    """Reads what there is and makes sure that the page can be written."""
    if run is not None and (run / CONFIG_FILE).exists() and not (run / ARCHIVE_FILE).exists():
        raise ValueError(f"{run} must hold a search that has ended an iteration, got no {ARCHIVE_FILE}: let it go on")
    opened_run = open_run(robot, run, space=space)
    archive = opened_run.archive
    if not len(archive):
        raise ValueError(
            f"{opened_run.path} must have elites to report on, got an archive of none: let its search go on"
        )
    folder = RunDirectory(opened_run.folder)
    search = opened_run.search()
    numbers = folder.read_summary()
    config = {} if search is None else folder.read_config()
    tables_file = RESULTS / opened_run.robot.name / "tables.json"
    suffix = "" if policy is None else opened_run.suffix(spec_of(policy, opened_run.robot))
    out = out or folder_for(opened_run.path, opened_run.robot.name) / f"report{suffix}.html"
    check_page(out)
    return Material(
        opened_run=opened_run,
        out=out,
        named_policy=policy,
        metrics=_metrics_of(folder, archive),
        search=search,
        origin={key: config[key] for key in _ORIGIN if key in config},
        gpus=numbers["gpus"] if type(numbers.get("gpus")) is int else None,
        minimal=read_minimal(opened_run.folder, archive),
        tables={**read_tables(tables_file, opened_run.robot)} if tables_file.exists() else None,
        tables_file=tables_file,
    )


def _metrics_of(folder: RunDirectory, archive: Archive) -> Metrics | None:
    """The rows up to the archive's iteration; a run that goes on meanwhile may have some more."""
    file = folder.path / METRICS_FILE
    if not file.exists():
        return None
    rows = folder.read_metrics()
    if len(rows) < archive.iterations:
        raise ValueError(
            f"{file} must have a row for each of the archive's {archive.iterations} iterations, got {len(rows)}: "
            "resume the search, which writes both again"
        )
    return rows[: archive.iterations]


def check_page(out: Path) -> None:
    """Makes sure that a page can be written."""
    if out.suffix != ".html":
        raise ValueError(f"out must be a file named *.html, got {out}: name for example {out / 'report.html'}")
    prepare_output(out)
