"""What a program does to the files under a folder, step by step, and a fault before any of them.

A step is a file opened for writing, the second half of what is written, a rename, or a new folder.
"""

import builtins
import errno
import io
import multiprocessing
import os
import signal
import sys
from collections.abc import Callable
from multiprocessing import connection
from pathlib import Path
from typing import Any

_CONTEXT = multiprocessing.get_context("forkserver")
_PATIENCE_S = 300.0


def kill(name: str, path: str) -> None:
    """Ends the process as the system does when it is out of memory or power."""
    os.kill(os.getpid(), signal.SIGKILL)


def fill(name: str, path: str) -> None:
    """There is no space for what the step would write."""
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), path)


class Steps:
    """Watches a folder to the end of the process: ``log`` gets a line a step, ``fault`` is called at one and later."""

    def __init__(
        self, folder: Path, *, log: Path | None = None, fault: Callable[[str, str], None] = kill, at: int | None = None
    ) -> None:
        self._folder, self._log, self._fault, self._at, self._count = str(folder), log, fault, at, 0
        self._open = io.open
        io.open = builtins.open = self._watched_open
        for name, index in (("replace", 1), ("mkdir", 0), ("open", 0)):
            setattr(os, name, self._watched(getattr(os, name), name, index))

    def take(self, name: str, path: str | bytes) -> None:
        """Counts a step on a path of the folder and lets the fault come where it is due."""
        path = os.fsdecode(path)
        if not path.startswith(self._folder):
            return
        number, self._count = self._count, self._count + 1
        if self._log is not None:
            with self._open(self._log, "a") as log:
                log.write(f"{name} {path}\n")
        if self._at is not None and number >= self._at:
            self._fault(name, path)

    def _watched(self, function: Callable[..., Any], name: str, index: int) -> Callable[..., Any]:
        def watched(*arguments: Any, **named: Any) -> Any:
            if name != "open" or arguments[1] & os.O_CREAT:
                self.take(name, os.fspath(arguments[index]))
            return function(*arguments, **named)

        return watched

    def _watched_open(self, file: Any, mode: str = "r", *rest: Any, **named: Any) -> Any:
        if isinstance(file, int) or not set(mode) & set("wxa+"):
            return self._open(file, mode, *rest, **named)
        self.take("open", os.fspath(file))
        opened = self._open(file, mode, *rest, **named)
        return _File(opened, file, self) if os.fsdecode(file).startswith(self._folder) else opened


class _File:
    """A file being written, in two halves that reach the disk one after the other."""

    def __init__(self, file: Any, path: Any, steps: Steps) -> None:
        self._file, self._path, self._steps = file, path, steps

    def write(self, data: Any) -> int:
        half = len(data) // 2
        self._file.write(data[:half])
        self._file.flush()
        self._steps.take("rest", self._path)
        self._file.write(data[half:])
        return len(data)

    def __enter__(self) -> "_File":
        return self

    def __exit__(self, *_: object) -> None:
        self._file.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)


def run_child(log: Path, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> tuple[int | None, str]:
    """What a function returns in a forked process, None if that ends before; and the process's output."""
    code = log.with_name(f"{log.name}.code")
    code.unlink(missing_ok=True)
    process = _CONTEXT.Process(target=_run_here, args=(log, code, function, arguments, named))
    process.start()
    if not connection.wait([process.sentinel], _PATIENCE_S):
        process.kill()
        raise AssertionError(f"a child hangs:\n{log.read_text()}")
    process.join()
    return int(code.read_text()) if code.exists() else None, log.read_text(errors="replace")


def _run_here(log: Path, code: Path, function: Callable[..., Any], arguments: tuple[Any, ...], named: Any) -> None:
    handle = os.open(log, os.O_CREAT | os.O_WRONLY | os.O_TRUNC)
    for stream in (sys.stdout, sys.stderr):
        os.dup2(handle, stream.fileno())
    signal.signal(signal.SIGINT, signal.default_int_handler)  # the fork server ignores it
    code.write_text(str(function(*arguments, **named)))
