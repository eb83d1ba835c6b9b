"""The page in a real browser: chromium without a screen, driven by playwright."""

import re

import pytest

from tests.qd.show.view import browser
from tests.qd.show.view.browser import LIMIT_MS, PLAYS, open_chromium, said, serve, wait_for, wait_until

pytest.importorskip("playwright.sync_api", reason="playwright is not installed: pip install playwright")
REASON = "there is no browser: apt-get install chromium"
pytestmark = [pytest.mark.slow, pytest.mark.skipif(browser.BROWSER is None, reason=REASON)]


@pytest.fixture(scope="module")
def address(tmp_path_factory, published):
    """Of a viewer of the published archive, with one controller under two names."""
    cache, run = tmp_path_factory.mktemp("cache"), published / "anymal" / "archive"
    flags = f"--run {run} --elite 0 --cache {cache} --policies base=shipped C-G=shipped"
    with serve(*flags.split()) as address:
        yield address


@pytest.fixture(scope="module")
def chromium():
    with open_chromium() as browser:
        yield browser


@pytest.fixture
def opened(chromium, address):
    """Opens tabs; in the end, none of them may have had an error."""
    errors, contexts = [], []

    def open_tab(query="", width=1366, height=768, ratio=1):
        size = {"width": width, "height": height}
        permissions = ["clipboard-read", "clipboard-write"]
        contexts.append(chromium.new_context(viewport=size, device_scale_factor=ratio, permissions=permissions))
        contexts[-1].set_default_timeout(LIMIT_MS)
        page = contexts[-1].new_page()
        page.on("pageerror", lambda error: errors.append(str(error)))
        page.on("console", lambda message: errors.append(message.text) if message.type == "error" else None)
        page.goto(address + query)
        return page

    yield open_tab
    for context in contexts:
        context.close()
    assert errors == []


def test_it_opens_on_the_moment_and_an_elite_of_the_list_does_too(opened):
    page = opened()
    wait_for(page, PLAYS)
    wait_until(page, lambda now: now.get("elite") == "0" and now.get("follow") == "1" and float(now.get("t", 0)) > 0)
    row = page.locator(".faultline-list [data-elite]").nth(1)
    number = row.get_attribute("data-elite")
    row.click()
    wait_until(page, lambda now: now["elite"] == number)
    wait_for(page, PLAYS)
    page.go_back()  # the elites are the page's history
    wait_until(page, lambda now: now["elite"] == "0")
    field = page.get_by_placeholder("number, Enter")
    field.fill("171")
    field.press("Enter")
    wait_until(page, lambda now: now["elite"] == "171")
    page.keyboard.press("p")  # the field has not kept the keys
    wait_until(page, lambda now: now["elite"] != "171")
    page.locator('circle[data-elite="171"]').dispatch_event("click")  # on the map
    wait_until(page, lambda now: now["elite"] == "171")


def test_keys_and_the_bar_move_time(opened):
    page = opened("?elite=0&t=0")
    wait_until(page, lambda now: now.get("episode") is not None)
    page.wait_for_timeout(1500)
    page.keyboard.press("ArrowRight")
    wait_until(page, lambda now: now["t"] == "0.1")
    camera = said(page)["initialCameraPosition"]
    page.keyboard.press("ArrowLeft")
    wait_until(page, lambda now: now["t"] == "0")
    assert said(page)["initialCameraPosition"] == camera  # arrows are the time's, not the camera's
    page.get_by_role("button", name="Play").click()
    wait_for(page, PLAYS)
    page.keyboard.press("Space")  # the button has not kept the keys: once, not twice
    wait_for(page, "button === 'Play'")
    page.get_by_title(re.compile("^end: ")).locator("span").click()
    wait_for(page, "time() > 1")
    page.locator("#faultline input[type=range]").fill("0.5")
    wait_until(page, lambda now: now["t"] == "0.5")
    page.get_by_label("Episode", exact=True).select_option("3")
    wait_until(page, lambda now: now["episode"] == "3")
    page.keyboard.press("f")
    wait_until(page, lambda now: now.get("follow") == "1")
    page.keyboard.press("n")
    wait_until(page, lambda now: now["elite"] != "0")


@pytest.mark.parametrize(
    ("width", "height", "ratio"), [(390, 844, 3), (390, 844, 1), (1100, 760, 2), (1366, 768, 1), (1920, 1080, 1)]
)
def test_the_player_and_the_scene_are_in_sight_in_windows_of_all_sizes(opened, width, height, ratio):
    page = opened("?elite=0&t=1", width, height, ratio)
    wait_until(page, lambda now: now.get("episode") is not None)
    page.wait_for_timeout(1500)
    is_phone = width < 576

    def top_element_is_the_bars(part):
        box = page.locator(part).bounding_box()
        assert box["x"] >= 0 and box["x"] + box["width"] <= width and box["y"] + box["height"] <= height, part
        middle = box["x"] + box["width"] / 2, box["y"] + box["height"] / 2
        return page.evaluate("([x, y]) => Boolean(document.elementFromPoint(x, y).closest('#faultline'))", middle)

    assert page.evaluate("document.documentElement.scrollWidth") <= width
    parts = [f"#faultline {part}" for part in ("[data-do=play]", "input[type=range]", "[data-do=follow]", "output",
                                               "[data-do=episode]", "[data-do=speed]", "[data-do=mark]")]  # fmt: skip
    assert all(map(top_element_is_the_bars, parts))
    canvas, bar = page.locator("canvas").first.bounding_box(), page.locator("#faultline").bounding_box()
    assert bar["width"] == width and canvas["y"] + canvas["height"] <= bar["y"] + 1
    assert canvas["height"] >= 0.5 * height and canvas["width"] >= 0.4 * width
    assert page.get_by_text("Cause", exact=True).first.is_visible() == (width >= 1300)  # else the archive is folded
    if is_phone:  # the sheet is folded; open, it covers neither player nor scene
        sheet = page.locator('.mantine-Paper-root[style*="position: fixed"]')
        assert sheet.bounding_box()["y"] >= bar["y"] + bar["height"] - 1
        page.get_by_text("faultline", exact=True).first.click()
        page.get_by_text("Controller", exact=True).first.wait_for()
        page.wait_for_timeout(1000)
        assert all(map(top_element_is_the_bars, parts))
        assert page.locator("canvas").first.bounding_box()["height"] >= 0.25 * height
