"""A search that takes a fraction of a second, by its own command over the stand-in evaluator, and what it comes to."""

import json
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qd import search as searching
from qd.archive import ARCHIVE_FILE, read_archive
from qd.commands import Archive as ArchiveCommand
from qd.run.checkpoint import load_checkpoint
from qd.run.directory import CHECKPOINT_FILE, CONFIG_FILE, METRICS_FILE
from qd.scheduler import Scheduler
from qd.show import figures
from sim.files.atomic import write_atomically
from sim.files.command import run_command
from tests.kills.steps import Steps
from tests.qd.searches import TIMES, crossing_by
from tests.qd.stand_in import open_stand_in

POLICY = "tests.sim.policies:stand"
SIZE = ["--scheduler.emitters", "2", "--scheduler.batch-size", "4", "--replicas", "2", "--seed", "5"]
SIZE += ["--scheduler.restart-rule", "4", "--fitness.intervals", "3"]  # few cells: a small checkpoint
SIZE += ["--method", "cma_mae+map_elites"]  # networks of a surrogate would learn longer than the stand-in takes
_TIMES = (*TIMES, "rollout_s", "physics_steps", "robot_steps", "idle_share")  # of this machine and session


def arguments(path: Path, iterations: int, *, policy: str = POLICY) -> list[str]:
    """Command line that begins a search, or goes on with what is left of it."""
    common = ["--device", "cpu", "--iterations", str(iterations), "--policy", policy]
    if (path / CONFIG_FILE).exists():
        return ["--resume", str(path), *common]
    return ["--run-dir", str(path), *SIZE, *common]


def search(path: Path, *, iterations: int) -> None:
    """Begins a search or goes on with it; exits as the command does."""
    run(arguments(path, iterations))


def search_watched(path: Path, *, iterations: int, **watched: Any) -> None:
    """The same while its steps are watched (:class:`tests.kills.steps.Steps`)."""
    Steps(path, **watched)
    search(path, iterations=iterations)


@dataclass(frozen=True, kw_only=True)
class StandInArchive(ArchiveCommand):
    """The search's command over the stand-in evaluator."""

    def execute(self) -> None:
        """Runs the search."""
        with crossing_by(open_stand_in):
            super().execute()


def run(argv: list[str]) -> None:
    """Runs the command, with figures that take no time to draw; exits if it fails."""
    without_figures()
    if status := run_command(StandInArchive, argv, name="archive"):
        sys.exit(status)


def without_figures() -> None:
    """From now on figures take no time to draw."""
    for module in (figures, searching):
        module.write_figures = _write_plain_figures


def _write_plain_figures(folder: Path, archive: Any, metrics: Any) -> list[Path]:
    paths = [folder / name for name in ("curves.png", "archive.png")]
    for path in paths:
        write_atomically(path, b"a figure")
    return paths


def rows_of(path: Path) -> list[dict[str, Any]]:
    """Metrics rows without what a clock says."""
    rows = [json.loads(line) for line in (path / METRICS_FILE).read_text().splitlines()]
    return [{key: value for key, value in row.items() if key not in _TIMES} for row in rows]


def saved_iterations(path: Path) -> int:
    """Iterations that a checkpoint has, 0 without one; whatever lies there must be whole."""
    if (path / ARCHIVE_FILE).exists():
        read_archive(path)
    if not (path / CHECKPOINT_FILE).exists():
        return 0
    return len(load_checkpoint(path / CHECKPOINT_FILE)["metrics"])


def outcome(path: Path) -> tuple[bytes, list[dict[str, Any]], bytes]:
    """What a search comes to: the archive's bytes, its metrics, and what it would ask next."""
    state = load_checkpoint(path / CHECKPOINT_FILE)
    asked = Scheduler.from_state(state).ask()
    rows = rows_of(path)
    assert [row["iteration"] for row in rows] == list(range(1, len(rows) + 1))
    assert [row["iteration"] for row in state["metrics"]] == [row["iteration"] for row in rows]
    return (path / ARCHIVE_FILE).read_bytes(), rows, asked.tobytes()
