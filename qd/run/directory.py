"""The directory of a search's run: where it is, what it was asked to do, how far it is, and what it found.

The checkpoint is the one truth and is written first. Metrics and archive are made from it, and made again on resume, so
a run that was killed between any two writes goes on as if nothing had been.
"""

import itertools
import json
import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

from qd.archive import ARCHIVE_FILE, Archive, read_archive, write_archive
from qd.run.checkpoint import load_checkpoint, save_checkpoint
from qd.run.progress import clock
from qd.run.settings import SearchCfg, as_settings, differences, from_settings
from sim.files.atomic import check_writable, locked, read_json, to_json, write_atomically
from sim.files.command import command_line
from sim.files.records import check_identity

if TYPE_CHECKING:
    from qd.scheduler import Scheduler
    from sim.robots.robot import RobotCfg

RUNS = Path("runs")
_OWN_RESULTS = Path(__file__).resolve().parents[2] / "results"
RESULTS = Path("results") if Path("results").is_dir() or not _OWN_RESULTS.is_dir() else _OWN_RESULTS
"""Where published archives, tables and panels lie, <robot>/archive and so on: results/ of the present folder, or of
this checkout where that has none."""
CONFIG_FILE = "config.json"
CHECKPOINT_FILE = "checkpoint.bin"
METRICS_FILE = "metrics.jsonl"
SUMMARY_FILE = "archive.json"
ROUNDS_FILE = "rounds.json"
"""Rounds of search and training, in the directory that holds the runs of both."""
JUDGED_BY = ("confirmed_by", "certified_by")
"""Keys of the summary that say where fault counts come from."""
_REMEDY = "put a copy of it back, or start a new run"

Metrics = list[dict[str, Any]]
"""One row an iteration."""


def newest_run(robot: "RobotCfg", policy: str | None = None, *, flag: str = "run") -> Path:
    """The run of a robot under runs/ whose archive changed last.

    Args:
        robot: The robot.
        policy: Controller that the command line names, for the command that makes a run.
        flag: The flag that names a run.

    Raises:
        FileNotFoundError: If there is none.
    """
    run = _newest(robot.name)
    if run is not None:
        return run
    published = _published(robot.name)
    such = f", such as the published {published}" if published else ""
    make = f"`{command_line('archive', robot=robot.spec, policy=policy)}`"
    raise FileNotFoundError(f"no archive of {robot.name} under {RUNS}/: make one with {make}, or give --{flag}{such}")


def newest_or_published(robot: "RobotCfg", policy: str | None = None) -> Path:
    """The newest run of a robot under runs/, or its published archive where there is none; as :func:`newest_run`.

    Raises:
        FileNotFoundError: If there is neither.
    """
    return _newest(robot.name) or _published(robot.name) or newest_run(robot, policy)


def published_or_newest(robot: "RobotCfg", policy: str | None = None, *, flag: str = "run") -> Path:
    """The published archive of a robot, or its newest run under runs/ where there is none; as :func:`newest_run`.

    Raises:
        FileNotFoundError: If there is neither.
    """
    return _published(robot.name) or newest_run(robot, policy, flag=flag)


def _newest(name: str) -> Path | None:
    files = sorted(RUNS.glob(f"*/{ARCHIVE_FILE}"), key=lambda file: file.stat().st_mtime, reverse=True)
    return next((file.parent for file in files if read_archive(file).robot == name), None)


def _published(name: str) -> Path | None:
    folder = RESULTS / name / "archive"
    return folder if (folder / ARCHIVE_FILE).exists() else None


def directory_of(run: Path) -> Path:
    """The directory of a run that is given as such or as its archive file."""
    return run if run.is_dir() else run.parent


def named_by(run: Path, archive: Archive) -> dict[str, Any]:
    """What an archive is of (:func:`sim.files.records.identity`), or the config beside it where the file names none.

    Args:
        run: Run directory or archive file.
        archive: What it holds.
    """
    folder = RunDirectory(directory_of(run))
    if archive.robot_sha256 is not None or not (folder.path / CONFIG_FILE).exists():
        return archive.named()
    settings = folder.read_config()["settings"]
    return archive.named() | {name: settings[name] for name in ("robot_sha256", "policy_sha256") if name in settings}


def search_seed(run: Path) -> int | None:
    """Seed of the search that left an archive; None where nothing beside it says.

    Args:
        run: Run directory or archive file.

    Raises:
        ValueError: If the run's config is damaged.
    """
    folder = RunDirectory(directory_of(run))
    if not (folder.path / CONFIG_FILE).exists():
        return None
    seed = folder.read_config()["settings"].get("seed")
    return seed if isinstance(seed, int) else None


def read_archive_of(robot: "RobotCfg", run: Path, space: str | None = None) -> Archive:
    """An archive whose terrains alone are taken; of another robot's name it is for the caller to refuse.

    Args:
        robot: Who is to cross them.
        run: Run directory or archive file.
        space: Terrain space that the command line names.

    Raises:
        FileNotFoundError: If there is none.
        ValueError: If it is damaged, of the robot as it was before it changed, of penalties defined otherwise, or of a
            space of a user's own that the command line does not name or that has changed.
    """
    archive = read_archive(run)
    check_space(archive, run, space)
    if archive.robot == robot.name:
        check_identity(named_by(run, archive), robot, run, "search again, or give another archive")
    return archive


def check_space(archive: Archive, run: Path, named: str | None) -> None:
    """Has the terrain space of an archive at hand.

    Args:
        archive: The archive.
        run: Where it lies, for errors.
        named: Terrain space that the command line names.

    Raises:
        ValueError: If it is none, or one of a user's own that the command line does not name or that has changed.
    """
    from sim.spaces.registry import get_space, load_space  # which imports Warp: not for `--help`

    if named is not None:
        load_space(named)
    get_space(archive.space, archive.space_sha256)


def folder_for(run: Path, robot: str) -> Path:
    """Where what is made from a run goes: into its directory, or of a published one to runs/<robot>-published.

    Args:
        run: Run directory or archive file.
        robot: Name of its robot.
    """
    folder = directory_of(run)
    published = RESULTS.resolve() in folder.resolve().parents
    return RUNS / f"{robot}-published" if published else folder


def numbered(root: Path, name: str) -> Iterator[Path]:
    """Directories a run may be put in: ``name``, ``name-2``, ``name-3`` and so on."""
    yield root / name
    yield from (root / f"{name}-{number}" for number in itertools.count(2))


def origin_in(config: dict[str, Any]) -> dict[str, Any]:
    """Where a run comes from, as its config has it: provenance of its beginning, and its sessions."""
    return {name: value for name, value in config.items() if name not in ("settings", "iterations")}


def reached(sessions: list[dict[str, Any]], iterations: int) -> list[dict[str, Any]]:
    """The sessions of a run, of which the last has come to a number of iterations."""
    return [*sessions[:-1], *({**last, "iterations": iterations} for last in sessions[-1:])]


@contextmanager
def claimed(path: Path) -> Iterator[None]:
    """Makes a run directory if need be and keeps other searches out of it.

    Args:
        path: The directory; if it was made here and is still empty at the end, it is removed again.

    Raises:
        ValueError: If it cannot be made or written to, its name cannot be typed into a command to go on, or another
            search works in it.
    """
    if not str(path).isprintable():
        raise ValueError(f"run directory {str(path)!a} must have a name of printable characters: rename it")
    try:
        made = not path.exists()
        path.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ValueError(f"run directory {path} cannot be made: {error.strerror}: give another --run-dir") from None
    check_writable(path)
    with locked(path, f"another command works in {path}: let it end, or name another folder"):
        try:
            yield
        finally:
            if made and not any(path.iterdir()):
                path.rmdir()


class RunDirectory:
    """Files of one run.

    Args:
        path: The directory, claimed.
    """

    def __init__(self, path: Path) -> None:
        self.path = path

    def read_config(self) -> dict[str, Any]:
        """What the run was asked to do: ``settings``, ``iterations``, and its origin.

        Raises:
            FileNotFoundError: If there is no run here.
            ValueError: If the file is damaged.
        """
        file = self.path / CONFIG_FILE
        if not os.path.lexists(file):
            raise FileNotFoundError(f"no run at {self.path}: it has no {CONFIG_FILE}; give the directory of a run")
        config = read_json(file)
        kinds = {"settings": dict, "iterations": int, "device": str, "sessions": list}
        if any(type(config.get(name)) is not kind for name, kind in kinds.items()):
            raise ValueError(
                f"{file} must hold settings, iterations, device and sessions, got {', '.join(config)}; {_REMEDY}"
            )
        return config

    def read_cfg(self) -> SearchCfg:
        """The search as its config has it.

        Raises:
            FileNotFoundError: If there is no run here.
            ValueError: If the file is damaged, or of another version.
        """
        config = self.read_config()
        try:
            return from_settings(config["settings"], config["iterations"])
        except ValueError as error:
            raise ValueError(f"{self.path / CONFIG_FILE}: {error}; {_REMEDY}") from None

    def write_config(self, cfg: SearchCfg, origin: dict[str, Any]) -> None:
        """Writes what the run is asked to do, and where it comes from (:func:`origin_in`)."""
        content = {"settings": as_settings(cfg), "iterations": cfg.iterations, **origin}
        write_atomically(self.path / CONFIG_FILE, to_json(content))

    def save(self, cfg: SearchCfg, search: "Scheduler", metrics: Metrics, archive: Archive) -> None:
        """Saves an iteration; killed anywhere in here, the run is either before or after it.

        Args:
            cfg: The run's settings, so that a checkpoint that strayed here is noticed.
            search: The search after ``tell``.
            metrics: All rows up to this iteration.
            archive: What the search has found.
        """
        state = {"settings": as_settings(cfg), "metrics": metrics, **search.state()}
        save_checkpoint(self.path / CHECKPOINT_FILE, state)
        self.write_derived(metrics, archive)

    def write_derived(self, metrics: Metrics, archive: Archive) -> None:
        """Writes the files that follow from a checkpoint: metrics and archive."""
        rows = "".join(json.dumps(row, allow_nan=False) + "\n" for row in metrics)
        write_atomically(self.path / METRICS_FILE, rows.encode())
        write_archive(self.path / ARCHIVE_FILE, archive)

    def with_fresh_values(self, found: Archive) -> Archive:
        """An archive with the fresh values of its file, where those are of just these elites; else as it is.

        Args:
            found: What the search has found.
        """
        there = self.fresh_archive()
        return replace(there, iterations=found.iterations) if there and there.has_elites_of(found) else found

    def with_faults(self, corrected: Archive) -> Archive:
        """An archive of fresh values with the fault counts of its file, where those are of just these elites."""
        there = self.fresh_archive()
        return corrected if there is None else corrected.with_faults_of(there)

    def fresh_archive(self) -> Archive | None:
        """The archive of the file if it has fresh values; a damaged one, which is made again, has none."""
        try:
            archive = read_archive(self.path)
        except (OSError, ValueError):
            return None
        return None if archive.fresh is None else archive

    def read_summary(self) -> dict[str, Any]:
        """The run in numbers; nothing where they were not written or are damaged, as they are made again."""
        try:
            return read_json(self.path / SUMMARY_FILE)
        except (OSError, ValueError):
            return {}

    def read_metrics(self) -> Metrics:
        """Rows of the metrics file, without reading the checkpoint.

        Raises:
            FileNotFoundError: If there is none.
            ValueError: If it is damaged.
        """
        file = self.path / METRICS_FILE
        try:
            rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
        except ValueError as error:
            raise ValueError(f"{file} is damaged: {error}; {_REMEDY}") from None
        if not rows or not all(isinstance(row, dict) for row in rows):
            raise ValueError(f"{file} must have a row an iteration, got {len(rows)}; {_REMEDY}")
        return rows

    def iterations_done(self) -> int:
        """Rows of the metrics file, without reading the checkpoint."""
        file = self.path / METRICS_FILE
        return len(file.read_text(encoding="utf-8").splitlines()) if file.exists() else 0

    def load(self, cfg: SearchCfg) -> tuple["Scheduler", Metrics] | None:
        """The search as its checkpoint has it.

        Args:
            cfg: The search that the run's config has.

        Returns:
            The search and its metrics, or None if the run was killed before its first checkpoint.

        Raises:
            ValueError: If the checkpoint is damaged, lost, or belongs to a run of other settings.
        """
        file = self.path / CHECKPOINT_FILE
        derived = [self.path / name for name in (METRICS_FILE, ARCHIVE_FILE)]
        for made in (*derived, self.path / SUMMARY_FILE):
            if made.is_dir():
                raise ValueError(f"{made} is a directory, expected a file or nothing: move it away")
        if not file.exists():
            lost = [made.name for made in derived if made.exists()]
            if lost:
                raise ValueError(f"{file} is lost: expected it beside {' and '.join(lost)}; {_REMEDY}")
            return None
        from qd.scheduler import Scheduler  # pyribs takes two seconds to import: not for `--help`

        state = load_checkpoint(file)
        there, metrics = state.get("settings"), state.get("metrics")
        if not isinstance(there, dict) or not isinstance(metrics, list):
            raise ValueError(f"{file} is no checkpoint of a search: it lacks settings or metrics; {_REMEDY}")
        try:
            there = as_settings(from_settings(there, cfg.iterations))  # with what an older one does not name yet
        except ValueError as error:
            raise ValueError(f"{file} is no checkpoint of a search: {error}; {_REMEDY}") from None
        different = differences(there, as_settings(cfg))
        if different:
            raise ValueError(f"{file} belongs to a run of other settings: {', '.join(different)}; {_REMEDY}")
        try:
            return Scheduler.from_state(state), metrics
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{file} is no checkpoint of a search: {error}; {_REMEDY}") from None


def archive_of(cfg: SearchCfg, search: "Scheduler", iterations: int) -> Archive:
    """What a search has found after a number of iterations."""
    return Archive(
        robot=cfg.robot,
        space=cfg.space,
        penalties=cfg.fitness.penalties,
        scales=cfg.fitness.scales,
        intervals=cfg.intervals,
        collision_bit=cfg.collision_bit,
        iterations=iterations,
        robot_sha256=cfg.robot_sha256,
        policy_sha256=cfg.policy_sha256,
        space_sha256=cfg.space_sha256,
        penalty_definition=cfg.penalty_definition,
        **search.elites(),
    )


def write_results(
    run: RunDirectory,
    archive: Archive,
    metrics: Metrics,
    origin: dict[str, Any],
    *,
    reproduced_by: dict[str, Any] | None = None,
    suffix: str = "",
) -> None:
    """Writes what a search leaves to look at, and says what it is.

    Args:
        run: The run directory, claimed.
        archive: What was found; with fresh values its numbers and figures have them.
        metrics: One row an iteration.
        origin: Provenance, with the sessions of the run.
        reproduced_by: Provenance of the fresh values; left out, what the run's summary says stays.
        suffix: Ending of the names of archive and summary, where the fresh values are of another controller than the
            search's; all other files stay as they are.
    """
    from qd.show.figures import summary, write_figures

    archive_file, summary_file = (
        file.with_stem(file.stem + suffix) for file in (run.path / ARCHIVE_FILE, run.path / SUMMARY_FILE)
    )
    if suffix:
        write_archive(archive_file, archive)
    else:
        run.write_derived(metrics, archive)
    there = run.read_summary()
    if reproduced_by is None and archive.fresh is not None:
        reproduced_by = there.get("reproduced_by")
    judged_by = {name: there[name] for name in JUDGED_BY if archive.faults is not None and name in there}
    sessions = reached(origin["sessions"], len(metrics))
    origin = {**origin, "sessions": sessions, "reproduced_by": reproduced_by, **judged_by}
    figures = [] if suffix else write_figures(run.path, archive, metrics)
    gpus = 0 if origin["device"].startswith("CPU") else max((row.get("workers", 1) for row in metrics), default=1)
    numbers = summary(archive, metrics, gpus=gpus, origin=origin)
    write_atomically(summary_file, to_json(numbers))
    if archive.fresh is None:
        print(
            f"{len(archive):,} elites in {archive.reachable_coverage:.1%} of the reachable cells, QD score "
            f"{archive.qd_score:.0f}, mean fitness {archive.mean_fitness:.2f}, after {numbers['episodes']:,} episodes "
            f"in {clock(numbers['wall_s'])}"
        )
        print(f"Figures: {', '.join(map(str, figures))}")
        return
    print(
        f"Corrected by fresh episodes: {numbers['elites_reproduced']:,} of {len(archive):,} elites reproduced, "
        f"{numbers['corrected_coverage']:.1%} of the reachable cells, QD score {numbers['corrected_qd_score']:.0f}; "
        f"in {summary_file} and {archive_file if suffix else 'the figures'}"
    )
