"""The viewer as a user begins it, a tab without a browser, and chromium without a screen driven by playwright.

``python -m tests.qd.show.view.browser`` takes pictures of the viewer, with the published archive of ANYmal, and of the
top of its report.
"""

import io
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from itertools import takewhile
from pathlib import Path
from urllib.parse import parse_qs, urlsplit

import msgspec
import viser
from PIL import Image
from websockets.sync.client import ClientConnection, connect

from results.make.docs import PICTURES, note_picture
from tests.builders import free_port

ROOT = Path(__file__).parents[4]
BROWSER = next(filter(None, map(shutil.which, ("chromium", "chromium-browser", "google-chrome"))), None)
LIMIT_MS = 120_000
"""From a click to what it shows, on a busy machine that draws without a GPU."""
SETTLE_MS = 4000  # for the last frames of a browser that draws without a GPU
PLAYS = "button === 'Pause'"
WITHOUT_GPU = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]


@contextmanager
def serve(*flags: str) -> Iterator[str]:
    """Address of a viewer that serves its page; Ctrl-C must end it well."""
    port = free_port()
    process = subprocess.Popen(
        [sys.executable, "-m", "faultline", "view", "--port", str(port), *flags], cwd=ROOT, text=True,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.SIG_DFL),  # a shell's background ignores it
    )  # fmt: skip
    assert process.stdout is not None
    lines = list(takewhile(lambda line: not line.startswith("Open "), process.stdout))
    try:
        yield f"http://127.0.0.1:{port}/"
    finally:
        process.send_signal(signal.SIGINT)
        rest = process.communicate(timeout=180)[0]
    assert process.returncode == 0 and "Traceback" not in rest, [*lines, rest]


def visit(port: int) -> ClientConnection:
    """A tab without a browser, as far as viser's protocol goes: it comes, looks somewhere, and hears nothing."""
    protocol = f"viser-v{viser.__version__}"
    socket = connect(f"ws://127.0.0.1:{port}", subprotocols=[protocol], max_size=None, max_queue=None, compression=None)
    camera = {
        "wxyz": (1.0, 0.0, 0.0, 0.0), "position": (1.0, 2.0, 3.0), "look_at": (4.0, 5.0, 0.0), "fov": 1.3, "near": 0.01,
        "far": 1000.0, "image_height": 900, "image_width": 1400, "up_direction": (0.0, 0.0, 1.0),
    }  # fmt: skip
    socket.send(msgspec.msgpack.encode({"type": "ViewerCameraMessage", **camera}))
    return socket


@contextmanager
def open_chromium():
    """The browser, closed in the end."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as started, started.chromium.launch(executable_path=BROWSER, args=WITHOUT_GPU) as browser:
        yield browser


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


def take(page, file: Path) -> None:
    """Writes what a page shows."""
    for close in page.locator(".mantine-Notification-closeButton").all():  # such as that there is no GPU
        close.click()
    page.wait_for_timeout(SETTLE_MS)
    Image.open(io.BytesIO(page.screenshot(timeout=LIMIT_MS))).convert("RGB").save(file, quality=78)
    print(file, flush=True)


def main() -> None:
    """Takes all pictures."""
    run = "results/anymal/archive"
    shown = f"{run}/archive.npz"
    report = ROOT / "runs/pictures/report.html"
    command = [sys.executable, "-m", "faultline", "report", "--run", run, "--out", str(report)]
    subprocess.run(command, cwd=ROOT, check=True)
    with open_chromium() as browser:
        with serve("--run", run) as address:
            page = browser.new_page(viewport={"width": 1366, "height": 768})
            page.goto(address, timeout=LIMIT_MS)
            wait_for(page, PLAYS)
            wait_for(page, "/Ghost, .* after/.test(document.querySelector('#faultline .words').textContent)")
            page.get_by_title("end: ").locator("span").click(timeout=LIMIT_MS)
            page.keyboard.press("Space")
            take(page, PICTURES / "viewer.jpg")
            note_picture("viewer.jpg", shown)
        page = browser.new_page(viewport={"width": 1400, "height": 1400})
        page.goto(report.as_uri())
        take(page, PICTURES / "report.jpg")
        note_picture("report.jpg", shown)


if __name__ == "__main__":
    main()
