"""What a program does to the files under a folder, one step after the other, and a fault at any of them.

A step is what the system sees: a file opened for writing, a half of what is written, a flush to the disk, a rename, the
folder's flush, a removal. A fault strikes before its step is done, so that all of them together leave every state of
the disk that a kill can leave.
"""

import builtins
import errno
import io
import os
import signal
from collections.abc import Callable
from pathlib import Path
from typing import Any

NEEDS_SPACE = ("open", "write", "rest", "fsync", "close", "mkdir", "replace")


def kill(name: str, path: str) -> None:
    """Ends the process as the system does when it is out of memory or power."""
    os.kill(os.getpid(), signal.SIGKILL)


def fill(name: str, path: str) -> None:
    """There is no space for what the step would write."""
    if name in NEEDS_SPACE:
        named = [path] if name in ("open", "mkdir", "replace") else []  # what works on a handle names no file
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), *named)


class Steps:
    """Watches a folder from its construction to the end of the process.

    Args:
        folder: What is watched.
        log: File that gets a line a step; None for none.
        fault: Called with name and path of a step, before it.
        at: Number of the step at which ``fault`` strikes; None for never.
        lasting: Whether it strikes at every later step too.
    """

    def __init__(
        self,
        folder: Path,
        *,
        log: Path | None = None,
        fault: Callable[[str, str], None] = kill,
        at: int | None = None,
        lasting: bool = False,
    ) -> None:
        self._folder, self._log, self._fault, self._at, self._lasting = str(folder), log, fault, at, lasting
        self._count = 0
        self._real = {name: getattr(os, name) for name in ("open", "fsync", "replace", "unlink", "mkdir", "write")}
        self._real_open = io.open
        for name in ("fsync", "replace", "unlink", "mkdir"):
            setattr(os, name, getattr(self, f"_{name}"))
        os.open = self._os_open
        io.open = builtins.open = self._open

    def step(self, name: str, path: str | bytes) -> None:
        """Counts a step on a path of the folder and lets the fault strike where it is due."""
        path = os.fsdecode(path)
        if not path.startswith(self._folder):
            return
        number, self._count = self._count, self._count + 1
        if self._log is not None:
            handle = self._real["open"](self._log, os.O_CREAT | os.O_WRONLY | os.O_APPEND)
            self._real["write"](handle, f"{name} {path}\n".encode())
            os.close(handle)
        if self._at is not None and (number == self._at or (self._lasting and number > self._at)):
            self._fault(name, path)

    def _open(self, file: Any, mode: str = "r", *rest: Any, **named: Any) -> Any:
        if isinstance(file, int) or not set(mode) & set("wxa+"):
            return self._real_open(file, mode, *rest, **named)
        self.step("open", os.fspath(file))
        opened = self._real_open(file, mode, *rest, **named)
        return _File(opened, file, self) if os.fsdecode(file).startswith(self._folder) else opened

    def _os_open(self, path: Any, flags: int, *rest: Any, **named: Any) -> int:
        if flags & os.O_CREAT:
            self.step("open", os.fspath(path))
        return self._real["open"](path, flags, *rest, **named)

    def _fsync(self, handle: int) -> None:
        self.step("fsync", os.readlink(f"/proc/self/fd/{handle}"))
        self._real["fsync"](handle)

    def _replace(self, source: Any, target: Any, **named: Any) -> None:
        self.step("replace", os.fspath(target))
        self._real["replace"](source, target, **named)

    def _unlink(self, path: Any, **named: Any) -> None:
        self.step("unlink", os.fspath(path))
        self._real["unlink"](path, **named)

    def _mkdir(self, path: Any, *rest: Any, **named: Any) -> None:
        self.step("mkdir", os.fspath(path))
        self._real["mkdir"](path, *rest, **named)


class _File:
    """A file being written, in two halves that reach the disk one after the other."""

    def __init__(self, file: Any, path: Any, steps: Steps) -> None:
        self._file, self._path, self._steps = file, os.fsdecode(path), steps

    def write(self, data: Any) -> int:
        half = len(data) // 2
        for name, part in (("write", data[:half]), ("rest", data[half:])):
            self._steps.step(name, self._path)
            self._file.write(part)
            self._file.flush()
        return len(data)

    def close(self) -> None:
        if not self._file.closed:
            try:
                self._steps.step("close", self._path)
            finally:
                self._file.close()

    def __enter__(self) -> "_File":
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def __getattr__(self, name: str) -> Any:
        return getattr(self._file, name)
