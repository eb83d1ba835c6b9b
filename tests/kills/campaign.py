"""Many kills at random moments of searches, each gone on with until it is done, and what they come to."""

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np

from qd.run.directory import CONFIG_FILE
from tests.kills import searches

ROOT = Path(__file__).resolve().parents[2]
REAL_SIZE = ["--scheduler.emitters", "1", "--scheduler.batch-size", "4", "--replicas", "2", "--seed", "7"]
_LINGER_S = 30.0  # a worker learns that its parent is gone when it next has something to say: once it is built
_PATIENCE_S = 600.0


class Killable(Protocol):
    """A search in a process that may be killed."""

    def kill_after(self, seconds: float) -> bool:
        """Kills it at a moment [s]; False if it was done before."""
        ...

    def wait(self) -> int:
        """Its exit code."""
        ...

    @property
    def output(self) -> str:
        """What it printed."""
        ...


@dataclass(frozen=True, kw_only=True)
class Kill:
    """A kill, and what it left."""

    run: int
    moment_s: float
    """Since the process began."""
    saved: int
    """Iterations that were saved."""


def kill_and_resume(
    start: Callable[[Path, int], Killable],
    folder: Path,
    whole: Callable[[], tuple[Any, ...]],
    *,
    kills: int,
    longest_s: float,
    seed: int,
    report: Callable[[Kill], None] = lambda kill: None,
) -> list[Kill]:
    """Kills searches at random moments and goes on with each until it is done.

    Args:
        start: Begins a search in a directory, or goes on with it; also told how many kills there were.
        folder: Where the searches' directories go.
        whole: Gives the outcome of an undisturbed search, which every other must have.
        kills: How many.
        longest_s: Moments are uniform up to this [s].
        seed: Draws the moments.
        report: Called after each kill.

    Raises:
        AssertionError: If anything saved is lost or damaged, or a search comes to something else.
    """
    rng = np.random.default_rng(seed)
    done: list[Kill] = []
    run, saved = 0, 0
    while True:
        path = folder / f"run-{run}"
        moment = float(rng.uniform(0.0, longest_s))
        here = f"seed {seed}, kill {len(done)} at {moment:.4f} s, run {run}"
        search = start(path, len(done))
        if len(done) < kills and search.kill_after(moment):
            left = searches.saved_iterations(path) if path.exists() else 0
            assert left >= saved, f"{here}: {saved} iterations were saved, {left} are left\n{search.output}"
            saved = left
            done.append(Kill(run=run, moment_s=moment, saved=saved))
            report(done[-1])
            continue
        code = search.wait()
        assert code == 0 and "Traceback" not in search.output, f"{here}: exit code {code}\n{search.output}"
        assert searches.outcome(path) == whole(), f"{here}: another outcome than undisturbed"
        if len(done) == kills:
            return done
        run, saved = run + 1, 0


class RealSearch:
    """``faultline archive`` with the real simulation, in a session of its own.

    Args:
        path: Run directory; gone on with if it holds a run.
        iterations: Iterations to reach.
        workers: Simulation processes.
        whole_group: Whether a kill takes all of its processes or the main one alone.
        environment: Added to this process's.
    """

    def __init__(
        self, path: Path, *, iterations: int, workers: int, whole_group: bool = False, **environment: str
    ) -> None:
        self._whole_group = whole_group
        self._log = path.with_name(f"{path.name}.log")
        place = ["--resume", str(path)] if (path / CONFIG_FILE).exists() else ["--run-dir", str(path), *REAL_SIZE]
        size = ["--device", "cpu", "--iterations", str(iterations), "--workers", str(workers)]
        with self._log.open("wb") as log:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "faultline", "archive", *place, *size],
                stdout=log, stderr=log, cwd=ROOT, start_new_session=True, env={**os.environ, **environment},
            )  # fmt: skip

    @property
    def output(self) -> str:
        """What it and its workers printed."""
        return self._log.read_text(errors="replace")

    def kill_after(self, seconds: float) -> bool:
        """Kills it at a moment [s]; False if it was done before. Nothing of it may live on or complain."""
        try:
            self._process.wait(seconds)
            return False
        except subprocess.TimeoutExpired:
            pass
        if self._whole_group:
            os.killpg(self._process.pid, signal.SIGKILL)
        else:
            self._process.kill()
        self.wait()
        deadline = time.monotonic() + _LINGER_S
        while left := _members(self._process.pid):
            assert time.monotonic() < deadline, f"processes {left} live on after their search was killed"
            time.sleep(0.05)
        assert "Traceback" not in self.output, self.output
        return True

    def wait(self) -> int:
        """Its exit code."""
        return self._process.wait(_PATIENCE_S)


def _members(session: int) -> list[int]:
    """Living processes of a session."""
    members = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
            except OSError:  # it ended meanwhile
                continue
            if int(fields[3]) == session and fields[0] not in "ZX":
                members.append(int(entry.name))
    return members
