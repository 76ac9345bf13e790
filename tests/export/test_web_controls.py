# SPDX-License-Identifier: Apache-2.0
"""Every control of a page, by mouse, finger and key, in windows of a desktop and of a phone held both ways."""

import functools
import re

import numpy as np
import pytest
from PIL import Image
from web_pages import Page, different

from nrfgs_ns.image.metrics import psnr

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]

pytest.importorskip("playwright.sync_api", reason="no playwright: pip install -e '.[browser]'")

TOUCH = {"has_touch": True}
WINDOWS = {"desktop": ((800, 560), {}), "phone": ((360, 640), TOUCH), "turned": ((640, 360), TOUCH)}
TABS = ["View", "Photographs", "Share", "Help"]
LARGE = 44
"""CSS pixels that a fingertip needs."""
CONTROLS = (
    "#bar button, #panel button, #panel select, #panel input:not([type=checkbox]), #panel label.line, #panel summary"
)


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


def test_the_picture_comes_first(window, on_demo):
    (width, height), touch = window
    page = on_demo((width, height), **touch)
    assert page.page.locator("#panel").is_hidden()
    assert [button["name"] for button in boxes(page, "button")] == TABS
    (bar,) = boxes(page, "#bar")
    assert bar["width"] * bar["height"] < 0.15 * width * height
    for tab in TABS:
        page.page.get_by_role("button", name=tab, exact=True).click()
        assert [section["name"] for section in boxes(page, "#panel section")] == [tab.lower()]
        (panel,) = boxes(page, "#panel")
        assert panel["x"] >= 0 and panel["x"] + panel["width"] <= width
        assert panel["y"] >= 0 and panel["y"] + panel["height"] <= bar["y"] + 1
        if width < 600:
            assert panel["height"] <= 0.56 * height, "the scene is seen above the sheet"
        assert page.page.locator("#show").is_hidden() and page.page.locator("#freeze").is_hidden()
    page.page.keyboard.press("Escape")
    assert page.page.locator("#panel").is_hidden()
    assert page.page.evaluate("document.activeElement.textContent") == "Help"
    page.page.get_by_role("button", name="View", exact=True).click()
    page.page.mouse.click(40, 120)
    assert page.page.locator("#panel").is_hidden() == (width < 600), "a sheet gives way to the scene"


def test_fingers_hit_every_control(window, on_demo):
    size, touch = window
    page = on_demo(size, **touch)
    page.page.evaluate("nrfgs.setNotes([{ text: 'here', position: nrfgs.getCamera().target }])")
    seen = set()
    for tab in TABS:
        page.tab(tab)
        if tab == "Share":
            page.page.click("#embed")
            page.page.click("#copy-link")
        for box in boxes(page, CONTROLS + ", .note button"):
            assert box["width"] >= LARGE and box["height"] >= LARGE, box
            seen.add(box["name"])
        assert page.page.locator("#panel").evaluate("(panel) => panel.scrollWidth - panel.clientWidth") <= 0, tab
    assert {"home", "drag", "gain", "photograph", "copy-link", "embed", "add-note", "save-tour"} <= seen


def devtools(page: Page):
    """Chromium's own protocol, which emulates safe areas and fingers; skips in Firefox, which has no such thing."""
    if page.is_firefox:
        pytest.skip("Firefox emulates neither safe areas nor fingers")
    return page.page.context.new_cdp_session(page.page)


def test_controls_stay_within_the_safe_area(on_demo):
    page = on_demo((360, 640), has_touch=True)
    insets = {"top": 40, "bottom": 34, "left": 0, "right": 0}
    devtools(page).send("Emulation.setSafeAreaInsetsOverride", {"insets": insets})
    assert all(box["y"] + box["height"] <= 640 - 34 for box in boxes(page, "#bar button"))
    page.tab("Share")
    assert boxes(page, "#caption")[0]["y"] >= 40


def test_every_control_changes_the_picture(window, on_demo):
    size, touch = window
    page = on_demo(size, **touch)
    first = page.picture()

    def changed(act, than=first):
        act()
        now = page.picture()
        assert different(now, than)
        return now

    def same(act) -> None:
        act()
        assert not different(page.picture(), first)

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

    page.page.check("#rotate")
    page.page.wait_for_timeout(1500)
    changed(lambda: page.page.uncheck("#rotate"))
    same(home)
    for button in ("previous", "next"):
        page.tab("Photographs")
        changed(lambda button=button: page.page.click(f"#{button}"))
        same(home)
    page.page.keyboard.press("Escape")

    press_home = functools.partial(page.page.keyboard.press, "Home")
    for act in (page.drag, lambda: page.drag(shift=True), lambda: page.page.mouse.wheel(0, -300)):
        changed(act)
        same(press_home)
    page.set("drag", "fly", "change")
    where = page.camera()[0]
    changed(page.drag)
    assert np.allclose(page.camera()[0], where), "looking around leaves the camera where it is"
    page.set("drag", "orbit", "change")
    same(press_home)
    for key in ("ArrowLeft", "ArrowUp", "+", "]", *"wsadqe"):
        changed(lambda key=key: page.page.keyboard.press(key, delay=300))
        same(press_home)
    changed(lambda: page.double_click(120, 200))
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


def test_marks_say_how_many_are_in_view_and_lead_there(wall):
    page = wall((480, 480))
    page.tab("Photographs")
    page.page.check("#mark")
    page.call("finished")
    assert re.findall(r"\d+", page.page.inner_text("#mark-said")) == ["9"], "all are where the camera is, or beside it"
    page.call("setCamera", {"position": [8, 0.1, 0.1], "target": [0, 0.1, 0.1], "fov": 50})
    page.call("finished")
    assert re.findall(r"\d+", page.page.inner_text("#mark-said")) == ["9", "9"]
    page.page.keyboard.press("Escape")
    camera = page.call("photographs")[8]["position"]
    assert camera == [3, 0.5, 0.5]
    # From +x, with z up, +y is to the right: 0.4 from the axis at a distance of 5.
    off = 240 / np.tan(np.radians(25)) * 0.4 / 5
    x, y = 240 + off, 240 - off
    page.page.mouse.click(x, y)
    page.call("finished")
    assert np.allclose(page.camera()[0], camera) and page.page.locator("#photograph").input_value() == "8"
    page.tab("Photographs")
    page.page.uncheck("#mark")
    assert page.page.locator("#mark-said").is_hidden()
    page.page.keyboard.press("Escape")
    page.call("setCamera", {"position": [8, 0.1, 0.1], "target": [0, 0.1, 0.1]})
    page.page.mouse.click(x, y)
    assert np.allclose(page.camera()[0], [8, 0.1, 0.1]), "what is not shown leads nowhere"


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


def test_no_frame_around_what_a_mouse_drags(wall):
    page = wall((480, 360))
    style = "getComputedStyle(document.getElementById('scene')).outlineStyle"
    page.page.keyboard.press("Tab")
    page.page.focus("#scene")
    assert page.page.evaluate(style) == "solid", "the keyboard's place is seen"
    page.drag()
    assert page.page.evaluate("document.activeElement.id") == "scene"
    assert page.page.evaluate(style) == "none"
    page.page.keyboard.press("ArrowLeft")
    assert page.page.evaluate(style) == "solid"


def test_fingers_turn_move_and_zoom(on_demo):
    page = on_demo((480, 360))
    touch = devtools(page)

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
        assert all(different(now, before) for before in seen)
        seen.append(now)
        page.page.evaluate("document.getElementById('home').click()")
        assert not different(page.picture(), first)


SLOW_SORT = """
const Quick = Worker;
window.Worker = class extends Quick {
  postMessage(message, ...more) {
    setTimeout(() => super.postMessage(message, ...more), message.camera && window.nrfgs.begun ? 60000 : 0);
  }
};
"""


def test_the_picture_moves_while_splats_are_sorted(wall):
    page = wall((240, 180), before=SLOW_SORT)
    page.page.evaluate("nrfgs.begun = true")
    shots = [page.page.screenshot()]
    for _ in range(2):
        page.page.keyboard.press("ArrowLeft")
        page.page.wait_for_timeout(500)
        shots.append(page.page.screenshot())
    assert len(set(shots)) == 3


SLOW_FRAMES = """
window.widths = [];
const frame = requestAnimationFrame, viewport = WebGL2RenderingContext.prototype.viewport;
window.requestAnimationFrame = (act) => frame(() => setTimeout(() => act(performance.now()), window.late ?? 0));
WebGL2RenderingContext.prototype.viewport = function (x, y, width, height) {
  if (height <= this.canvas.height && width <= this.canvas.width) window.widths.push(width);  // else a table's
  viewport.call(this, x, y, width, height);
};
"""


def test_slow_frames_make_pictures_coarser_until_the_camera_rests(wall):
    page = wall((240, 180), before=SLOW_FRAMES)
    sharp = page.picture()
    page.page.evaluate("late = 100; nrfgs.play('rotation')")
    page.until("widths.some((width) => width <= 100)")
    page.page.evaluate("nrfgs.stop(); nrfgs.visit(0)")
    assert psnr(page.picture(), sharp) > 60
    assert page.page.evaluate("Math.min(...widths) >= 96"), "0.4 of the whole at the coarsest"


def test_whoever_cannot_see_the_page_is_told_what_is_there(on_demo):
    page = on_demo((900, 700))
    assert page.page.locator("html").get_attribute("lang") == "en"
    for tab, roles in {
        "View": {
            "application": ["page: a scene in three dimensions"],
            "heading": ["page"],
            "slider": [re.compile("^Residual gain")],
            "combobox": [re.compile("^Show"), re.compile("^Drag to")],
            "checkbox": ["Freeze view", "Turn slowly"],
            "button": [*TABS, "First view", "Full screen"],
        },
        "Photographs": {
            "combobox": ["Photograph"],
            "checkbox": ["Mark where taken"],
            "button": ["Previous photograph", "Next photograph"],
        },
        "Share": {"button": ["Copy link to this view", "Save picture", "Embed in a page", "Add note", "Save tour"]},
    }.items():
        page.tab(tab)
        assert page.page.get_by_role("region", name=tab, exact=True).count() == 1
        for role, names in roles.items():
            for name in names:
                assert page.page.get_by_role(role, name=name, exact=isinstance(name, str)).count() == 1, name
    unnamed = page.page.evaluate(
        "[...document.querySelectorAll('button, select, input, textarea')].filter((one) => !one.labels?.length"
        " && !one.ariaLabel && !one.textContent.trim()).map((one) => one.id)"
    )
    assert unnamed == []

    # The keyboard alone gets everywhere, and what happens is said.
    reached = set()
    for tab in TABS:
        page.tab(tab)
        for _ in range(20):
            page.page.keyboard.press("Tab")
            reached.add(page.page.evaluate("document.activeElement.id"))
    assert set("scene show gain freeze drag rotate photograph mark home embed save".split()) <= reached
    page.page.focus("#scene")
    page.page.keyboard.press("]")
    assert page.page.get_by_role("status").filter(has_text=re.compile("^Photograph ")).count() == 1
    for role, expanded in (("true", "Help"), ("false", "View")):
        assert page.page.get_by_role("button", name=expanded, exact=True).get_attribute("aria-expanded") == role
