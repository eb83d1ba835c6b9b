"""A page as a PDF, printed by a browser that is installed here."""

import os
import shutil
import subprocess
import tempfile
from pathlib import Path

from sim.files.atomic import write_atomically

_BROWSERS = ("chromium", "chromium-browser", "google-chrome", "google-chrome-stable", "chrome")
_FLAGS = ("--headless", "--disable-gpu", "--no-pdf-header-footer")
_PATIENCE_S = 180


def find_browser() -> str:
    """The browser that prints.

    Raises:
        ValueError: If there is none.
    """
    found = next(filter(None, map(shutil.which, _BROWSERS)), None)
    if found is None:
        raise ValueError(
            "a PDF is printed by a browser, and none of chromium, chrome and google-chrome is installed here: install "
            "one (Debian, Ubuntu: apt-get install chromium), or leave --format out and print the page yourself"
        )
    return found


def print_page(page: bytes, out: Path) -> None:
    """Prints a page.

    Args:
        page: HTML that fetches nothing.
        out: The PDF.

    Raises:
        ValueError: If there is no browser.
        OSError: If it does not print, or the file cannot be written.
    """
    browser = find_browser()
    own = ["--no-sandbox"] if os.geteuid() == 0 else []  # it has no other way for root; the page is ours
    with tempfile.TemporaryDirectory() as folder:
        source, draft = Path(folder) / "page.html", Path(folder) / "page.pdf"
        source.write_bytes(page)
        command = [browser, *_FLAGS, *own, f"--user-data-dir={folder}/browser", f"--print-to-pdf={draft}"]
        try:
            done = subprocess.run([*command, source.as_uri()], capture_output=True, text=True, timeout=_PATIENCE_S)
            said = (done.stderr.strip().splitlines() or ["nothing"])[-1]
        except subprocess.TimeoutExpired:
            said = f"nothing within {_PATIENCE_S} s"
        if not draft.exists():
            raise OSError(f"{browser} did not print the page to {out}; it said: {said}")
        write_atomically(out, draft.read_bytes())
