"""A real browser without a screen, chromium driven by playwright: for tests of the page, and for its screenshots."""

import re
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


def see(page, text):
    """Waits until a text is to be seen."""
    page.get_by_text(re.compile(text)).first.wait_for(timeout=LIMIT_MS)


def click_another(page, shown):
    """Clicks a line of the list that is not the one shown; returns its number."""
    for line in page.get_by_role("button", name=re.compile(r"^\d+: .*goal")).all():
        number = line.inner_text().split(":")[0]
        if number != shown:
            line.click()
            return number
    raise AssertionError("the list has no other elite")
