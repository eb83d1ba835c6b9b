"""The page in a real browser: chromium without a screen, driven by playwright."""

import re

import pytest

from tests.qd.show.view.browser import BROWSER, LIMIT_MS, click_another, open_chromium, said, see, wait_until
from tests.qd.show.view.visitor import serve

pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(BROWSER is None, reason="there is no browser: apt-get install chromium"),
]


@pytest.fixture(scope="module")
def address(tmp_path_factory, published):
    """Of a viewer of the published archive, with one controller under two names."""
    cache, run = tmp_path_factory.mktemp("cache"), published / "anymal" / "archive"
    flags = f"--run {run} --elite 0 --cache {cache} --policies base=shipped C-G=shipped"
    with serve(*flags.split()) as (address, _):
        yield address


@pytest.fixture(scope="module")
def chromium():
    with open_chromium() as browser:
        yield browser


@pytest.fixture
def opened(chromium, address):
    """Opens tabs; in the end, none of them may have had an error."""
    errors = []
    context = chromium.new_context(permissions=["clipboard-read", "clipboard-write"])
    context.set_default_timeout(LIMIT_MS)

    def open_tab(query="", width=1400, height=900):
        page = context.new_page()
        page.set_viewport_size({"width": width, "height": height})
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(address + query if not query.startswith("http") else query)
        return page

    yield open_tab
    context.close()
    assert errors == []


def test_an_elite_is_chosen_and_the_address_says_so(opened):
    page = opened()
    see(page, "^Episode 1: ")
    wait_until(page, lambda now: now.get("elite") == "0" and now.get("controller") == "base")
    number = click_another(page, "0")
    see(page, f"^Elite {number}$")
    wait_until(page, lambda now: now["elite"] == number)


def test_a_line_of_the_plot_is_named_and_clicked(opened):
    page = opened("?elite=0")
    see(page, "^Elite 0$")
    plot = page.locator("svg:has(path[data-elites])").first
    box = plot.bounding_box()
    assert box is not None
    x, y = box["x"] + 0.3 * box["width"], box["y"] + 0.5 * box["height"]
    for step in range(100):  # down a line across the plot, until an elite is near
        page.mouse.move(x, y + step)
        if page.locator("svg text.pointed").count():
            break
    page.wait_for_timeout(1000)  # a browser takes pointers frame by frame
    named = re.match(r"elite (\d+)", page.locator("svg text.pointed").text_content() or "")
    assert named is not None
    page.mouse.down()
    page.mouse.up()
    wait_until(page, lambda now: now["elite"] == named[1])
    see(page, f"^Elite {named[1]}$")


def test_keys_do_what_the_panels_do(opened):
    page = opened("?elite=0")
    see(page, "^Episode 1: ")
    page.wait_for_timeout(1500)
    page.keyboard.press("ArrowRight")
    wait_until(page, lambda now: now["t"] == "0.1")
    camera = said(page)["initialCameraPosition"]
    page.keyboard.press("ArrowLeft")
    wait_until(page, lambda now: now["t"] == "0")
    assert said(page)["initialCameraPosition"] == camera  # arrows are the time's, not the camera's
    page.keyboard.press("Space")
    wait_until(page, lambda now: float(now["t"]) > 0.5)
    see(page, "^Pause$")
    page.get_by_role("button", name="Pause").click()
    see(page, "^Play$")
    page.keyboard.press("Space")  # with the button in focus: once, not twice
    see(page, "^Pause$")
    page.keyboard.press("f")
    wait_until(page, lambda now: now.get("follow") == "1")
    page.keyboard.press("3")
    see(page, "^Episode 3: ")
    page.keyboard.press("n")
    wait_until(page, lambda now: now["elite"] != "0")
    page.keyboard.press("p")
    wait_until(page, lambda now: now["elite"] == "0")


def at_rest(element):
    """Where an element is after what stands above it has come or gone, as a progress bar does."""
    boxes = [element.bounding_box()]
    while len(boxes) < 6 or boxes[-1] != boxes[-6]:  # 2.5 s without a move
        assert len(boxes) < LIMIT_MS / 500, boxes[-6:]
        element.page.wait_for_timeout(500)
        boxes.append(element.bounding_box())
    assert boxes[-1] is not None
    return boxes[-1]


@pytest.mark.parametrize("size", [(1400, 900), (1024, 768), (390, 844)])
def test_the_robot_can_be_seen_in_windows_of_all_sizes(opened, size):
    page = opened("?elite=0", *size)
    see(page, "^Episode 1: ")
    page.wait_for_timeout(2000)
    width = size[0]
    assert page.evaluate("document.documentElement.scrollWidth") <= width
    play = at_rest(page.get_by_role("button", name="Play"))
    assert play["x"] >= 0 and play["x"] + play["width"] <= width
    canvas = page.locator("canvas").first.bounding_box()
    assert canvas is not None and canvas["width"] >= 0.4 * width
    if width < 1200:
        assert not page.get_by_text("Sort", exact=True).first.is_visible()  # the archive is folded
    if width < 576:
        assert play["y"] + play["height"] <= size[1]  # in sight without scrolling
        panel = page.get_by_text("faultline", exact=True).first
        panel.click()  # folds the rest
        page.get_by_role("button", name="Play").wait_for(state="hidden")
