# SPDX-License-Identifier: Apache-2.0
"""Every control of a page, by mouse, finger and key, in windows of a desktop and of a phone held both ways."""

import functools
import re

import numpy as np
import pytest
from PIL import Image
from web_pages import Page

from nrfgs_lab.pages.browser import different

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]

pytest.importorskip("playwright.sync_api", reason="no playwright: pip install -e '.[browser]'")

WINDOWS = {
    "desktop": ((800, 560), {}),
    "phone": ((360, 640), {"has_touch": True}),
    "turned": ((640, 360), {"has_touch": True}),
}
TABS = ["View", "Photographs", "Share", "Help"]


@pytest.fixture(params=WINDOWS)
def window(request):
    return WINDOWS[request.param]


def boxes(page: Page, selector: str) -> list[dict]:
    """Places of what is visible, with its "name"."""
    found = []
    for one in page.page.locator(selector).all():
        if one.is_visible():
            found.append(one.bounding_box() | {"name": one.evaluate("(element) => element.id || element.textContent")})
    return found


def test_every_control_changes_the_picture(window, demo, browser):
    size, touch = window
    page = Page(browser, demo[1].as_uri(), size, **touch).begun()
    first = page.picture()

    def changed(act, than=first):
        act()
        now = page.picture()
        assert different(255 * now.numpy(), 255 * than.numpy())
        return now

    def same(act) -> None:
        act()
        assert not different(255 * page.picture().numpy(), 255 * first.numpy())

    def home() -> None:
        page.tab("View")
        page.page.click("#home")

    page.tab("View")
    for mode in ["base", "residual", "opacity residual"]:
        changed(lambda mode=mode: page.page.select_option("#show", mode))
    same(lambda: page.page.select_option("#show", "full"))
    for gain in ("0", "2"):
        changed(lambda gain=gain: page.page.fill("#gain", gain))
    same(lambda: page.page.fill("#gain", "1"))

    # Frozen, the picture from another place differs from the one that is seen there.
    same(lambda: page.page.check("#freeze"))
    page.tab("Photographs")
    start = int(page.page.locator("#photograph").input_value())
    frozen = changed(lambda: page.page.select_option("#photograph", str((start + 3) % 8)))  # of 8 training views
    page.tab("View")
    changed(lambda: page.page.uncheck("#freeze"), than=frozen)
    same(home)

    turned = changed(
        lambda: page.page.check("#rotate") or page.page.wait_for_timeout(1500) or page.page.uncheck("#rotate")
    )
    changed(lambda: None)
    assert turned is not None
    same(home)
    for button in ("previous", "next"):
        page.tab("Photographs")
        changed(lambda button=button: page.page.click(f"#{button}"))
        same(home)
    page.page.keyboard.press("Escape")

    press_home = functools.partial(page.page.keyboard.press, "Home")
    changed(page.drag)
    same(press_home)
    changed(lambda: page.drag(shift=True))
    same(press_home)
    changed(lambda: page.page.mouse.wheel(0, -300))
    same(press_home)
    page.set("drag", "fly", "change")
    where = page.camera()[0]
    changed(page.drag)
    assert np.allclose(page.camera()[0], where), "looking around leaves the camera where it is"
    page.set("drag", "orbit", "change")
    same(press_home)
    for key in ("ArrowLeft", "ArrowUp", "+", "]"):
        page.page.keyboard.press(key)
        changed(lambda: None)
        same(press_home)
    for key in "wsadqe":
        changed(lambda key=key: page.page.keyboard.press(key, delay=300))
        same(press_home)
    changed(lambda: page.page.mouse.dblclick(120, 200))
    assert np.allclose(page.camera()[0], where), "what is double-clicked is looked at, from the same place"
    same(press_home)

    page.page.keyboard.press("h")
    assert not boxes(page, "#bar, #caption, #panel")
    page.page.keyboard.press("h")
    page.tab("Share")
    with page.page.expect_download() as download:
        page.page.click("#save")
    assert Image.open(download.value.path()).size == size
    page.page.keyboard.press("Escape")
    page.tab("View")
    page.page.click("#full-screen")
    page.until("document.fullscreenElement !== null")
    page.page.click("#full-screen")
    page.until("document.fullscreenElement === null")
    assert not page.errors
    page.page.close()


def test_the_view_never_ends_inside_or_behind_the_scene(wall):
    """The wall is at x = 0; photographs at x = 3 take its distance for 5: they turn around a point behind it."""
    page = wall((480, 360))
    eyes = np.array([photograph["position"] for photograph in page.call("photographs")])

    def away(position) -> float:
        return float(np.linalg.norm(eyes - position, axis=1).min())

    for key in (None, "w"):
        for _ in range(40):
            page.page.mouse.move(240, 180)
            page.page.mouse.wheel(0, -200) if key is None else page.page.keyboard.press(key, delay=60)
        position, _ = page.camera()
        assert 0.3 < position[0] < 1.5, "close to the wall, and before it"
        assert page.picture().std() > 0.02, "the wall is seen"
        page.page.keyboard.press("Home")
    page.call("finished")
    for _ in range(40):
        page.page.mouse.wheel(0, 500)
    position, _ = page.camera()
    assert position[0] > 4 and away(position) <= 4.01
    page.page.keyboard.press("Home")
    for direction in (1, -1):
        for _ in range(12):  # more than all the way around
            page.page.mouse.move(240 - 200 * direction, 180)
            page.page.mouse.down()
            page.page.mouse.move(240 + 200 * direction, 180, steps=8)
            page.page.mouse.up()
            assert page.camera()[0][0] > 0, "never behind the wall"
        assert 1 < away(page.camera()[0]) <= 4.01
        page.page.keyboard.press("Home")

    # A script may go further, and hands come back from there.
    page.call("setCamera", {"position": [20, 0, 0], "target": [0, 0, 0]})
    page.page.mouse.wheel(0, 200)
    assert np.allclose(page.camera()[0], [20, 0, 0])
    page.page.mouse.wheel(0, -200)
    assert page.camera()[0][0] < 19


def test_fingers_turn_move_and_zoom(demo, browser):
    page = Page(browser, demo[1].as_uri(), (480, 360)).begun()
    touch = page.page.context.new_cdp_session(page.page)

    def fingers(*paths: list[tuple[int, int]]) -> None:
        """Put fingers down where their paths begin, move them along, and lift them."""
        for step, places in enumerate(zip(*paths, strict=True)):
            points = [{"x": x, "y": y, "id": finger} for finger, (x, y) in enumerate(places)]
            kind = "touchMove" if step else "touchStart"
            touch.send("Input.dispatchTouchEvent", {"type": kind, "touchPoints": points})
        touch.send("Input.dispatchTouchEvent", {"type": "touchEnd", "touchPoints": []})

    first = page.picture()
    seen = [first]
    for paths in (
        [[(100, 150), (130, 140), (160, 130)]],  # turns
        [[(100, 150), (130, 170)], [(140, 150), (170, 170)]],  # moves
        [[(200, 180), (150, 180), (100, 180)], [(240, 180), (290, 180), (340, 180)]],  # comes closer
    ):
        fingers(*paths)
        now = page.picture()
        assert all(different(255 * now.numpy(), 255 * before.numpy()) for before in seen)
        seen.append(now)
        page.page.evaluate("document.getElementById('home').click()")
        assert not different(255 * page.picture().numpy(), 255 * first.numpy())
    assert not page.errors
    page.page.close()


def test_whoever_cannot_see_the_page_is_told_what_is_there(demo, browser):
    """The keyboard alone gets everywhere, every control has a name, and what happens is said."""
    page = Page(browser, demo[1].as_uri(), (900, 700)).begun()
    unnamed = page.page.evaluate(
        "[...document.querySelectorAll('button, select, input, textarea')].filter((one) => !one.labels?.length"
        " && !one.ariaLabel && !one.textContent.trim()).map((one) => one.id)"
    )
    assert unnamed == []
    reached = set()
    for tab in TABS:
        page.tab(tab)
        assert page.page.get_by_role("region", name=tab, exact=True).count() == 1
        for _ in range(20):
            page.page.keyboard.press("Tab")
            reached.add(page.page.evaluate("document.activeElement.id"))
    assert {"scene", "show", "gain", "freeze", "drag", "rotate", "photograph", "mark", "home", "embed"} <= reached
    page.page.focus("#scene")
    page.page.keyboard.press("]")
    assert page.page.get_by_role("status").filter(has_text=re.compile("^Photograph ")).count() == 1
    assert not page.errors
    page.page.close()
