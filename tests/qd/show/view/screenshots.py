"""Pictures of the viewer and of the report's top: ``python -m tests.qd.show.view.screenshots [--report PAGE]``.

It serves the published archive of ANYmal and drives a browser as the tests of the page do.
"""

import argparse
import io
from pathlib import Path

from PIL import Image

from tests.qd.show.view.browser import LIMIT_MS, ROOT, open_chromium, serve, until_it_plays, wait_for

DOCS = ROOT / "docs" / "pictures"
SETTLE_MS = 4000  # for the last frames of a browser that draws without a GPU


def take(page, file: Path) -> None:
    """Writes what a page shows."""
    for close in page.locator(".mantine-Notification-closeButton").all():  # such as that there is no GPU
        close.click()
    page.wait_for_timeout(SETTLE_MS)
    Image.open(io.BytesIO(page.screenshot(timeout=LIMIT_MS))).convert("RGB").save(file, quality=78)
    print(file, flush=True)


def main() -> None:
    """Takes all pictures."""
    flags = argparse.ArgumentParser(description=__doc__)
    flags.add_argument("--report", type=Path, help="a page that `faultline report` wrote")
    report = flags.parse_args().report
    with open_chromium() as browser:
        with serve("--run", "results/anymal/archive") as address:
            page = browser.new_page(viewport={"width": 1366, "height": 768})
            page.goto(address, timeout=LIMIT_MS)
            until_it_plays(page)
            wait_for(page, "/Ghost, .* after/.test(document.querySelector('#faultline .words').textContent)")
            page.get_by_title("end: ").locator("span").click(timeout=LIMIT_MS)
            page.keyboard.press("Space")
            take(page, DOCS / "viewer.jpg")
        if report is not None:
            page = browser.new_page(viewport={"width": 1400, "height": 1400})
            page.goto(report.absolute().as_uri())
            take(page, DOCS / "report.jpg")


if __name__ == "__main__":
    main()
