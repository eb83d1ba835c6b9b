"""Child processes that may be killed: forked from a clean process that has everything imported."""

import multiprocessing
import os
import signal
import sys
import threading
from collections.abc import Callable
from multiprocessing import connection
from multiprocessing.context import ForkServerProcess
from pathlib import Path
from typing import Any

_CONTEXT = multiprocessing.get_context("forkserver")
_CONTEXT.set_forkserver_preload(["tests.kills.nursery"])
_PATIENCE_S = 120.0
_LOCK = threading.Lock()  # starting a process reads the exit codes of all others


class Child:
    """A function at work in a process of its own, whose output goes to a file.

    Args:
        log: File for stdout and stderr, appended to.
        function: Module-level function.
        arguments: Handed to it.
    """

    def __init__(self, log: Path, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> None:
        self.log = log
        self._process: ForkServerProcess = _CONTEXT.Process(target=_live, args=(log, function, arguments, named))
        with _LOCK:
            self._process.start()

    def kill_after(self, seconds: float) -> bool:
        """Kills it at a moment [s]; False if it was done before."""
        done = self._is_over(seconds)
        self._process.kill()
        return not done and self.wait() == -signal.SIGKILL

    def wait(self) -> int:
        """Its exit code: what it exits with, or minus the signal that ended it."""
        if not self._is_over(_PATIENCE_S):
            self._process.kill()
            raise AssertionError(f"a child hangs:\n{self.output}")
        with _LOCK:
            self._process.join()
            return self._process.exitcode or 0

    def _is_over(self, seconds: float) -> bool:
        """Whether it ended within a time [s]; its exit code is left to be read."""
        return bool(connection.wait([self._process.sentinel], seconds))

    @property
    def output(self) -> str:
        """Everything it printed."""
        return self.log.read_text(errors="replace") if self.log.exists() else ""


def _live(log: Path, function: Callable[..., Any], arguments: tuple[Any, ...], named: dict[str, Any]) -> None:
    handle = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_APPEND)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(handle, stream.fileno())
    signal.signal(signal.SIGINT, signal.default_int_handler)  # the fork server ignores it
    sys.exit(function(*arguments, **named))


def run_child(log: Path, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> tuple[int, str]:
    """Exit code and output of a function in a process of its own."""
    log.unlink(missing_ok=True)
    child = Child(log, function, *arguments, **named)
    return child.wait(), child.output
