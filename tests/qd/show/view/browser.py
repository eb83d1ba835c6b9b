"""A real browser without a screen, chromium driven by playwright: for tests of the page, and for its screenshots."""

import shutil
import time
from contextlib import contextmanager
from urllib.parse import parse_qs, urlsplit

BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
LIMIT_MS = 120_000
"""From a click to what it shows, on a busy machine that draws without a GPU."""
WITHOUT_GPU = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@contextmanager
def open_chromium():
    """The browser, closed in the end."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started:
        browser = started.chromium.launch(executable_path=BROWSER, args=WITHOUT_GPU)
        yield browser
        browser.close()


def said(page):
    """What the page's address says."""
    return {name: values[0] for name, values in parse_qs(urlsplit(page.url).query).items()}


def wait_until(page, true):
    """Waits until something is true of what the address says."""
    until = time.perf_counter() + LIMIT_MS / 1000
    while not true(said(page)):
        assert time.perf_counter() < until, page.url
        page.wait_for_timeout(100)


def wait_for(page, script):
    """Waits until a script, such as ``time() > 3``, is true; it may name ``time`` and ``button`` of the player bar."""
    bar = "const button = document.querySelector('#faultline [data-do=play]')?.ariaLabel, "
    bar += "time = () => Number(document.querySelector('#faultline input[type=range]').value);"
    page.wait_for_function(f"() => {{ {bar} return {script}; }}", timeout=LIMIT_MS)


def until_it_plays(page):
    """Waits until the robot plays."""
    wait_for(page, "button === 'Pause'")
