"""What takes its time and ends as a file: films and exported terrains, made by the commands of that name."""

import io
import os
import subprocess
import sys
import tempfile
import threading
import zipfile
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import NamedTuple

_ROOT = Path(__file__).resolve().parents[3]
_WORDS = 300  # of what a command said when it failed [characters]


Words = Callable[[Path], Sequence[str]]
"""The words of a command after ``faultline``, by the folder that it may work in."""


class Made(NamedTuple):
    """How an errand ended."""

    content: bytes
    """Of the file; a folder's files are in one zip. Empty if there is none."""
    error: str = ""
    """Why there is none."""


class Errands:
    """Runs commands in processes of their own while the page goes on answering; at most one for each tab."""

    def __init__(self) -> None:
        """Nothing is run yet."""
        self._processes: dict[int, subprocess.Popen[str] | None] = {}  # by tab
        self._stopped = False
        self._changed = threading.Lock()

    def run(
        self,
        tab: int,
        words: Callable[[Path], Sequence[str]],
        made: Callable[[Path], Path],
        done: Callable[[Made], None],
    ) -> bool:
        """Start a command; returns whether it was: a tab that still waits for one starts no other.

        Args:
            tab: Number of the tab that asks.
            words: The words after ``faultline``, given an empty folder to work in, which may get files first.
            made: The file, or the folder of files, that is made in that folder.
            done: Called in another thread when it has ended.
        """
        with self._changed:
            if self._stopped or tab in self._processes:
                return False
            self._processes[tab] = None
        threading.Thread(target=self._work, args=(tab, words, made, done), daemon=True).start()
        return True

    def _work(
        self,
        tab: int,
        words: Callable[[Path], Sequence[str]],
        made: Callable[[Path], Path],
        done: Callable[[Made], None],
    ) -> None:
        try:
            with tempfile.TemporaryDirectory() as folder:
                found = self._run(tab, words(Path(folder)), made(Path(folder)))
        except OSError as error:
            found = Made(b"", str(error))
        with self._changed:
            self._processes.pop(tab, None)
            stopped = self._stopped
        if not stopped:
            done(found)

    def _run(self, tab: int, words: Sequence[str], file: Path) -> Made:
        path = os.pathsep.join(filter(None, [str(_ROOT), os.environ.get("PYTHONPATH", "")]))
        with self._changed:
            if self._stopped:
                return Made(b"", "the viewer is stopping")
            process = self._processes[tab] = subprocess.Popen(
                [sys.executable, "-m", "faultline", *words], env={**os.environ, "PYTHONPATH": path}, text=True,
                stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, start_new_session=True,
            )  # fmt: skip
        _, said = process.communicate()
        if process.returncode:
            return Made(b"", (said.strip().splitlines() or [f"exit status {process.returncode}"])[-1][-_WORDS:])
        return Made(_zipped(file) if file.is_dir() else file.read_bytes())

    def stop(self) -> None:
        """End what is run; nothing is told of it."""
        with self._changed:
            self._stopped = True
            running = [process for process in self._processes.values() if process is not None]
        for process in running:
            process.terminate()


def _zipped(folder: Path) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for file in sorted(folder.iterdir()):
            archive.write(file, file.name)
    return content.getvalue()
