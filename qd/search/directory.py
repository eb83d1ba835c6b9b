"""The directory of a search's run: where it is, what it was asked to do, how far it is, and what it found.

The checkpoint is the one truth and is written first. Metrics and archive are made from it, and again when a search goes
on, so a run that was killed between any two writes goes on as if nothing had been.
"""

import itertools
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal

from qd.search.archive import ARCHIVE_FILE, Archive, read_archive, write_archive
from qd.search.checkpoint import REMEDY, load_checkpoint, save_checkpoint
from qd.search.settings import SearchCfg, as_settings, differences
from sim.files.atomic import is_leftover, locked, prepare_output, read_json, to_json, write_atomically
from sim.files.settings import from_builtins
from sim.robots.robot import RobotCfg, check_robot_identity
from sim.terrains.spaces.registry import load_space

RUNS = Path("runs")
"""Where runs are written, below the working folder."""
_CHECKOUT = Path(__file__).resolve().parents[2]
CONFIG_FILE = "config.json"
CHECKPOINT_FILE = "checkpoint.bin"
METRICS_FILE = "metrics.jsonl"
SUMMARY_FILE = "archive.json"
ROUNDS_FILE = "rounds.json"
"""Rounds of search and training, in the directory that holds the runs of both."""
Metrics = list[dict[str, Any]]
"""One row an iteration."""


def results_folder() -> Path:
    """Folder of published archives, tables and panels: results/ of the working folder, else of this checkout."""
    folders = (Path("results"), _CHECKOUT / "results")
    return next((folder for folder in folders if folder.is_dir()), folders[0])


def find_run(
    robot: RobotCfg, named: Path | None = None, *, published: Literal["never", "last", "first"] = "last"
) -> Path:
    """The run to work on: the one that is named, else the run of a robot under runs/ whose archive changed last.

    ``published`` says when the robot's published archive is taken: where there is no such run, before it, or never.
    """
    if named is not None:
        if published == "never" and _is_published(named):
            raise ValueError(f"{named} is published and stays as it is: copy it below {RUNS}/, and name that")
        return named
    folder = results_folder() / robot.name / "archive"
    files = sorted(RUNS.glob(f"*/{ARCHIVE_FILE}"), key=lambda file: file.stat().st_mtime, reverse=True)
    runs = (file.parent for file in files if _read_robot(file) == robot.name)
    shipped = [folder] if (folder / ARCHIVE_FILE).exists() and published != "never" else []
    run = next(itertools.chain(*((shipped, runs) if published == "first" else (runs, shipped))), None)
    if run is None:
        searched = f"{RUNS}/" if published == "never" else f"{RUNS}/ or in {folder} (a clone of the project has it)"
        remedy = "search one with `faultline archive`, or name a run"
        raise FileNotFoundError(f"no archive of {robot.name} under {searched}: {remedy}")
    print(f"Run: {run}", flush=True)
    return run


def _is_published(path: Path) -> bool:
    return results_folder().resolve() in path.resolve().parents


def _read_robot(file: Path) -> str | None:
    """Robot of an archive; None, with a printed line, if it cannot be read."""
    try:
        return read_archive(file).robot
    except ValueError as error:
        print(f"Passed over: {error}", flush=True)
        return None


def find_directory(run: Path) -> Path:
    """The directory of a run that is given as such or as its archive file."""
    return run if run.is_dir() else run.parent


def search_seed(run: Path) -> int | None:
    """Seed of the search that wrote an archive; None without a config beside it."""
    folder = RunDirectory(find_directory(run))
    return folder.read_cfg().seed if folder.exists() else None


def read_robot_archive(robot: RobotCfg, run: Path, space: str | None = None) -> Archive:
    """The archive of a search against a robot as it is now; ``space`` is named for one of a user's own."""
    archive = read_archive(run)
    check_space(archive, space)
    if archive.robot != robot.name:
        raise ValueError(f"archive {run} must be of robot {robot.name}, got {archive.robot}: give one of that robot")
    check_robot_identity(archive.named(), robot, run, "search again, or give another archive")
    return archive


def check_space(archive: Archive, named: str | None) -> None:
    """Loads the terrain space that the command line names; refuses an archive whose space is not known then."""
    if named is not None:
        load_space(named)
    expected, got = archive.terrain_space.num_genes, archive.genes.shape[1]
    if got != expected:
        rule = f"must have {expected} genes a terrain of {archive.space}"
        raise ValueError(f"the archive {rule}, got {got}: put a copy of it back")


def check_config(archive: Archive, cfg: SearchCfg, folder: Path) -> None:
    """Refuses an archive that is not of the settings beside it."""
    stored = archive.robot, archive.space_sha256 or archive.space, archive.penalties, archive.scales
    if stored != (cfg.robot, cfg.space_sha256 or cfg.space, cfg.fitness.penalties, cfg.fitness.scales):
        rule = f"must have robot, space, penalties and scales of {CONFIG_FILE}, got {', '.join(map(str, stored))}"
        raise ValueError(f"{folder / ARCHIVE_FILE} {rule}: put back the one that is not this run's")


def output_folder(run: Path, robot: str) -> Path:
    """Folder for what is made from a run: its directory; for a published run runs/<robot>-published-<its name>."""
    folder = find_directory(run)
    if not _is_published(folder):
        return folder
    return RUNS / f"{robot}-published-{folder.resolve().name}".removesuffix("-archive")


def free_path(name: str) -> Path:
    """The first of runs/NAME, runs/NAME-2, runs/NAME-3 and so on that does not exist."""
    names = itertools.chain([name], (f"{name}-{number}" for number in itertools.count(2)))
    return next(path for path in map(RUNS.joinpath, names) if not path.exists())


@contextmanager
def claimed(path: Path) -> Iterator[None]:
    """Makes a run directory if need be and keeps other commands out of it; one that stays empty is removed again."""
    if not str(path).isprintable():
        raise ValueError(f"run directory {str(path)!a} must have a name of printable characters: rename it")
    is_new = not os.path.exists(path)
    try:
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"run directory {path} cannot be made: {error.strerror}: give another one") from None
    prepare_output(path / CONFIG_FILE)
    with locked(path, f"another command works in {path}: let it end, or name another folder"):
        try:
            yield
        finally:
            if is_new and not any(path.iterdir()):
                path.rmdir()


class RunDirectory:
    """Files of one run in its directory."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def exists(self) -> bool:
        """Whether there is a run."""
        return os.path.lexists(self.path / CONFIG_FILE)

    def read_config(self) -> dict[str, Any]:
        """What the run was asked to do: ``settings``, ``iterations``, ``sessions``, and provenance of its beginning."""
        file = self.path / CONFIG_FILE
        if not self.exists():
            raise FileNotFoundError(f"no run at {self.path}: it has no {CONFIG_FILE}; give the directory of a run")
        config = read_json(file)
        kinds = {"settings": dict, "iterations": int, "device": str, "sessions": list}
        if any(type(config.get(name)) is not kind for name, kind in kinds.items()):
            raise ValueError(f"{file} must hold {', '.join(kinds)}, got {', '.join(config)}; {REMEDY}")
        return config

    def read_cfg(self) -> SearchCfg:
        """The search as its config has it."""
        config = self.read_config()
        try:
            return from_builtins(SearchCfg, config["settings"] | {"iterations": config["iterations"]}, "a search")
        except ValueError as error:
            text = f"{self.path / CONFIG_FILE} is damaged or of another version: {error}; {REMEDY}"
            raise ValueError(text) from None

    def begin_session(self, cfg: SearchCfg, origin: dict[str, Any], done: int) -> None:
        """Writes what the run is asked to do from now on, after ``done`` iterations; ``origin`` is the provenance."""
        config = self.read_config() if self.exists() else {**origin, "sessions": []}
        session = {name: origin[name] for name in ("command", "commit", "device")} | {"from_iteration": done}
        config |= {"settings": as_settings(cfg), "iterations": cfg.iterations}
        config["sessions"] = [*config["sessions"], session]
        write_atomically(self.path / CONFIG_FILE, to_json(config))

    def save(self, cfg: SearchCfg, scheduler: Any, metrics: Metrics, archive: Archive) -> None:
        """Saves an iteration; killed anywhere in here, the run is either before or after it."""
        state = {"settings": as_settings(cfg), "metrics": metrics, "scheduler": scheduler}
        save_checkpoint(self.path / CHECKPOINT_FILE, state)
        self.write_derived(metrics, archive)

    def write_derived(self, metrics: Metrics, archive: Archive) -> None:
        """Writes the files that follow from a checkpoint: metrics and archive."""
        rows = "".join(json.dumps(row, allow_nan=False) + "\n" for row in metrics)
        write_atomically(self.path / METRICS_FILE, rows.encode())
        write_archive(self.path, archive)

    def load(self, cfg: SearchCfg) -> tuple[Any, Metrics]:
        """Scheduler and metrics of the search to go on with, (None, []) without a checkpoint; refuses another one."""
        if not self.exists():
            if not all(map(is_leftover, self.path.iterdir())):
                raise ValueError(f"{self.path} is not empty and holds no run: give another --run-dir")
            return None, []
        self.check_settings(cfg)
        file = self.path / CHECKPOINT_FILE
        if not file.exists():
            if (self.path / ARCHIVE_FILE).exists():
                raise ValueError(f"{file} is lost: expected it beside {ARCHIVE_FILE}; {REMEDY}")
            return None, []
        state = load_checkpoint(file)
        settings, metrics, scheduler = (state.get(name) for name in ("settings", "metrics", "scheduler"))
        if not isinstance(settings, dict) or not isinstance(metrics, list) or scheduler is None:
            raise ValueError(f"{file} must have settings, metrics and a scheduler, got {', '.join(state)}; {REMEDY}")
        self.check_settings(cfg, settings, file)
        if (done := len(metrics)) > (wanted := cfg.iterations):
            raise ValueError(f"iterations must be at least {done}, as many as {self.path} has done, got {wanted}")
        return scheduler, metrics

    def check_settings(self, cfg: SearchCfg, stored: dict[str, Any] | None = None, file: Path | None = None) -> None:
        """Refuses the run of another search, by the settings that a ``file`` stored, or by its config."""
        stored = as_settings(self.read_cfg()) if stored is None else stored
        if different := differences(stored, as_settings(cfg)):
            text = f"{file or self.path} is of other settings: {', '.join(different)}"
            raise ValueError(f"{text}: start a new run for those")

    def read_summary(self) -> dict[str, Any]:
        """The run in numbers; nothing where they were not written or are damaged, as they are made again."""
        try:
            return read_json(self.path / SUMMARY_FILE)
        except (OSError, ValueError):
            return {}

    def read_metrics(self) -> Metrics:
        """Rows of the metrics file, without reading the checkpoint."""
        file = self.path / METRICS_FILE
        try:
            rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
        except ValueError as error:
            raise ValueError(f"{file} is damaged: {error}; {REMEDY}") from None
        if not rows or not all(isinstance(row, dict) for row in rows):
            raise ValueError(f"{file} must have a row an iteration, got {len(rows)}; {REMEDY}")
        return rows
