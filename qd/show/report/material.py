"""What a report is made from: the files of a run and of an evaluation, and what was worked out and crossed for it."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qd.archive import ARCHIVE_FILE, Archive
from qd.evaluate.tables import read_tables
from qd.groups import Elites, Modes, Ranking
from qd.run.directory import CONFIG_FILE, METRICS_FILE, RESULTS, Metrics, RunDirectory, folder_for
from qd.run.settings import SearchCfg
from qd.show.crossed import Crossed
from qd.show.elites import find_archive
from qd.show.figures import summary
from qd.show.minima import MinimalFound, read_minimal_numbers
from qd.show.report.pdf import find_browser
from qd.show.report.tables import Change, Changes
from sim.files.atomic import prepare_output
from sim.files.command import command_line
from sim.policy.spec import ControllerSpec, spec_of
from sim.robots.robot import RobotCfg
from sim.spaces.base import TerrainSpace
from sim.spaces.registry import get_space

if TYPE_CHECKING:
    from qd.show.report.command import Report

_ORIGIN = ("command", "commit", "device", "versions", "seed", "date")


@dataclass(frozen=True, kw_only=True)
class Material:
    """Everything read; None where there is no such file."""

    cfg: "Report"
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
    minimal: MinimalFound | None
    tables: dict[str, Any] | None
    tables_file: Path
    """Where the tables are, or would be looked for."""

    @property
    def summary(self) -> dict[str, Any] | None:
        """The run in numbers, as ``archive.json`` has them; None without metrics."""
        return None if self.metrics is None else summary(self.archive, self.metrics, gpus=self.gpus or 0, origin={})

    @property
    def space(self) -> TerrainSpace:
        """What the archive's genes mean."""
        return get_space(self.archive.space, self.archive.space_sha256)

    @property
    def policy(self) -> str:
        """Controller to cross with: what was asked for, or that of the search."""
        return spec_of(self.cfg.policy or self.searched, self.robot)

    @property
    def is_unnamed_code(self) -> bool:
        """Whether that is code which only the run names: what a file names is never run."""
        return self.cfg.policy is None and ControllerSpec.parse(self.searched).runs_code


@dataclass(frozen=True, kw_only=True)
class Shown:
    """All that the sections take their numbers from."""

    material: Material
    ranking: Ranking
    worst: list[int]
    """Numbers of the worst terrains: one of each way of failing, then of other families, then others."""
    steady: list[int]
    """Numbers of the most reproducible ones."""
    crossed: Mapping[int, Crossed] = field(default_factory=dict)
    """Crossings by the elite's number."""
    not_crossed: str = ""
    """Why there are none, if so."""
    changes: Changes | None = None
    """Terrains to show before and after fine-tuning."""
    no_changes: str = ""
    """Why there are none, if there are tables."""
    pairs: Mapping[Change, tuple[Crossed, Crossed]] = field(default_factory=dict)
    """What both controllers make of each."""

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
        from qd.show.report.relief import reliefs_of

        return reliefs_of(self.material.archive.genes[self.elites.numbers], self.material.space)


def gather(cfg: "Report") -> Material:
    """Reads what there is and makes sure that the page can be written.

    Raises:
        FileNotFoundError: If there is no run or no such tables.
        ValueError: If something is damaged, half-written, empty or of another robot, or OUT cannot be written.
    """
    _refuse_unbegun(cfg.run, cfg)
    found = find_archive(cfg.robot, cfg.run, cfg.policy, space=cfg.space)
    archive, robot, run = found.archive, found.robot, found.run
    if not len(archive):
        raise ValueError(
            f"{run} must have elites to report on, got an archive of none after {archive.iterations} iterations: "
            f"{found.go_on}"
        )
    searched, _ = found.as_searched()
    folder = RunDirectory(found.folder)
    search = folder.read_cfg() if (folder.path / CONFIG_FILE).exists() else None
    numbers = folder.read_summary()
    again = numbers.get("reproduced_by")
    config = {} if search is None else folder.read_config()
    tables_file = cfg.tables or RESULTS / robot.name / "tables.json"
    suffix = "" if cfg.policy is None else found.suffix(spec_of(cfg.policy, robot))
    has_tables = cfg.tables is not None or tables_file.exists()
    material = Material(
        cfg=cfg,
        robot=robot,
        run=run,
        out=cfg.out or folder_for(run, robot.name) / f"report{suffix}.{cfg.format}",
        archive=archive,
        metrics=_metrics_of(folder, archive, cfg),
        searched=searched,
        search=search,
        origin={key: config[key] for key in _ORIGIN if key in config},
        reproduced_by=again if archive.fresh is not None and isinstance(again, dict) else {},
        gpus=numbers["gpus"] if type(numbers.get("gpus")) is int else None,
        minimal=read_minimal_numbers(found.folder, archive),
        tables={**read_tables(tables_file, robot)} if has_tables else None,
        tables_file=tables_file,
    )
    _check_out(material.out, cfg.format)
    return material


def _refuse_unbegun(run: Path | None, cfg: "Report") -> None:
    if run is not None and (run / CONFIG_FILE).exists() and not (run / ARCHIVE_FILE).exists():
        raise ValueError(
            f"{run} must hold a search that has ended an iteration, got one without {ARCHIVE_FILE}: "
            f"let it go on with `{command_line('archive', robot=cfg.robot, resume=run, policy=cfg.policy)}`"
        )


def _metrics_of(folder: RunDirectory, archive: Archive, cfg: "Report") -> Metrics | None:
    """The rows up to the archive's iteration; a run that goes on meanwhile may have some more."""
    file = folder.path / METRICS_FILE
    if not file.exists():
        return None
    rows = folder.read_metrics()
    if len(rows) < archive.iterations:
        again = command_line("archive", robot=cfg.robot, resume=folder.path, policy=cfg.policy)
        raise ValueError(
            f"{file} must have a row for each of the archive's {archive.iterations} iterations, got {len(rows)}: the "
            f"run is half-written; `{again}` writes both again"
        )
    return rows[: archive.iterations]


def _check_out(out: Path, ending: str) -> None:
    if out.suffix != f".{ending}":
        name = out / f"report.{ending}"
        raise ValueError(f"out must be a file named *.{ending}, got {out}: name for example {name}")
    if ending == "pdf":
        find_browser()
    prepare_output(out)
