"""The pictures of the viewer and the report in docs/: ``python -m tests.qd.show.view.screenshots [--run RUN]``.

It serves the archive, drives a browser as the tests of the page do, and writes the report of the same archive if it is
not there yet. Pictures are JPEGs of docs/pictures.
"""

import argparse
import io
from pathlib import Path

from PIL import Image

from qd.groups import rank
from qd.show.elites import open_run
from qd.show.report.report import write_report
from tests.qd.show.view.browser import LIMIT_MS, open_chromium, see
from tests.qd.show.view.visitor import ROOT, serve

FOLDER = ROOT / "docs" / "pictures"
WIDE, NARROW = (1400, 900), (390, 844)
REPORT_HEIGHT = 1400
QUALITY = 80
SETTLE_MS = 3000  # for the last frames of a browser that draws without a GPU


def take(page, name: str) -> None:
    """Writes what a page shows."""
    for note in page.get_by_role("button", name="Close").all():  # such as that there is no GPU
        if note.is_visible():
            note.click()
    for close in page.locator(".mantine-Notification-closeButton").all():
        close.click()
    page.wait_for_timeout(SETTLE_MS)
    picture = Image.open(io.BytesIO(page.screenshot())).convert("RGB")
    FOLDER.mkdir(exist_ok=True)
    picture.save(FOLDER / f"{name}.jpg", quality=QUALITY)
    print(FOLDER / f"{name}.jpg", flush=True)


def viewer_pictures(browser, address: str, elite: int) -> None:
    """The viewer at a desk, along with the robot, with one failure mode listed, and on a phone."""

    def opened(size):
        page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        page.set_default_timeout(LIMIT_MS)
        page.goto(f"{address}?elite={elite}&episode=1")
        see(page, "^Episode 1: ")
        page.wait_for_timeout(SETTLE_MS)
        return page

    page = opened(WIDE)
    page.keyboard.press("m")
    take(page, "viewer")
    page.keyboard.press("f")
    take(page, "viewer-follow")
    page.keyboard.press("f")
    page.keyboard.press("o")
    page.get_by_role("combobox", name="Mode").click()
    page.get_by_role("option").nth(1).click()
    take(page, "viewer-mode")
    page.close()
    page = opened(NARROW)
    take(page, "viewer-phone")
    page.close()


def report_picture(browser, file: Path) -> None:
    """The top of a report, down to the first failure."""
    page = browser.new_page(viewport={"width": WIDE[0], "height": REPORT_HEIGHT})
    page.goto(file.absolute().as_uri())
    take(page, "report")
    page.close()


def main() -> None:
    """Takes all pictures."""
    flags = argparse.ArgumentParser(description=__doc__)
    flags.add_argument("--run", type=Path, default=Path("results/anymal/archive"))
    flags.add_argument("--elite", type=int, help="the first of the list if left out")
    flags.add_argument("--report", type=Path, default=Path("runs/anymal-published/report.html"))
    args = flags.parse_args()
    report = args.report if args.report.exists() else write_report(args.run, out=args.report, device="cpu")
    opened_run = open_run(None, args.run)
    elite = rank(opened_run.archive, opened_run.space).worst(1)[0] if args.elite is None else args.elite
    with serve("--run", str(args.run)) as (address, _), open_chromium() as browser:
        viewer_pictures(browser, address, elite)
        report_picture(browser, report)


if __name__ == "__main__":
    main()
