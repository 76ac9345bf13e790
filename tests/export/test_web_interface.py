# SPDX-License-Identifier: Apache-2.0
"""docs/web-interface.md in a real browser: cameras, links, messages between pages, tours, notes."""

import re

import numpy as np
import pytest
import torch
from web_pages import SIZE, Page, page_with, random_scene, rendered, wall_scene, web_server

from nrfgs_ns.export.web.guide import read_notes, read_tour
from nrfgs_ns.image.metrics import psnr

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]

playwright = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install -e '.[browser]'")

STARTED, ENDED = (f"document.getElementById('tour').ariaPressed === '{state}'" for state in ("true", "false"))
ALIKE = 50.0
"""dB between the page's picture and the renderer's, from cameras set through the interface."""
VIEWS = [
    {"position": [3, 1, 0.2], "target": [0, 0.3, 0.1]},
    {"position": [2.5, -1, 0.8], "target": [0, 0, 0], "up": [0, 0.2, 1]},
    {"position": [4, 0.2, -0.5], "target": [0, -0.2, 0], "fov": 40},
]


def test_views_set_through_the_interface_are_the_renderers(opened, tmp_path):
    scene, photographs = random_scene(tmp_path, "classic", {})
    (tmp_path / "page.html").write_text(page_with(scene.read_bytes(), photographs))
    page = opened((tmp_path / "page.html").as_uri())
    assert page.call("getCamera")["position"] == photographs[0]["pose"][3::4]
    for view in VIEWS:
        page.call("setCamera", {"fov": 55} | view)
        by_target, matrix = page.picture(), page.call("getMatrix")
        pose, focal = np.reshape(matrix, (4, 4)).T[:3], SIZE[1] / 2 / np.tan(np.radians(view.get("fov", 55)) / 2)
        seen = {"pose": pose.flatten().tolist(), "lens": [focal, focal, SIZE[0] / 2, SIZE[1] / 2], "size": list(SIZE)}
        assert psnr(by_target, rendered(scene, seen)) >= ALIKE
        page.call("visit", 1)
        page.call("setCamera", {"matrix": matrix, "fov": view.get("fov", 55)})
        assert psnr(page.picture(), by_target) >= ALIKE
        assert np.allclose(page.call("getMatrix"), matrix, atol=1e-12)
    page.call("visit", 0)  # its lens is off centre
    before = page.picture()
    page.page.evaluate("nrfgs.setCamera(nrfgs.getCamera())")
    assert psnr(page.picture(), before) >= 80, "the same, within rounding"
    assert [one["name"] for one in page.call("photographs")] == [one["name"] for one in photographs]


def test_a_camera_that_is_none_is_refused_and_changes_nothing(wall):
    page = wall()
    before, aim = page.call("getCamera"), {"target": [0, 0, 0]}
    for camera in (
        None,
        {},
        {"position": [0, 0, 0]},
        {"position": [1, 2, 3], "target": [1, 2, 3]},
        {"position": [1, 2, "3"]} | aim,
        {"position": [1, 2]} | aim,
        {"matrix": [0] * 16},
        {"matrix": [2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 2, 0, 0, 0, 0, 1]},
        {"matrix": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]},
        {"matrix": [1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1], "position": [0, 0, 0]},
        {"position": [1, 2, 3], "fov": 180} | aim,
        {"position": [1, 2, 3], "up": [0, 1]} | aim,
    ):
        with pytest.raises(playwright.Error, match="TypeError"):
            page.call("setCamera", camera)
        assert page.call("getCamera") == before, camera
    with pytest.raises(playwright.Error, match="RangeError"):
        page.call("visit", 9)


def test_a_flight_arrives_or_is_stopped_by_a_touch(wall):
    page = wall()
    page.page.evaluate("window.seen = []; nrfgs.on('moved', (camera) => seen.push(camera.position)); 0")
    assert page.call("flyTo", VIEWS[0], 2) is True
    assert np.allclose(page.call("getCamera")["position"], VIEWS[0]["position"])
    assert len(page.page.evaluate("seen")) > 2
    page.page.evaluate("(view) => { window.flight = nrfgs.flyTo(view, 60); }", VIEWS[1])
    page.page.mouse.click(20, 200)
    assert page.page.evaluate("flight") is False
    assert not np.allclose(page.call("getCamera")["position"], VIEWS[1]["position"], atol=0.1)
    still = wall(before="matchMedia = () => ({ matches: true });")
    still.page.evaluate("(view) => { nrfgs.flyTo(view, 60); }", VIEWS[1])
    assert np.allclose(still.camera()[0], VIEWS[1]["position"]), "who asked for less motion gets none"


def test_a_link_opens_the_view_it_was_copied_from(wall):
    page = wall((700, 400))
    for view in VIEWS:
        page.call("setCamera", view)
        page.tab("Share")
        page.page.click("#copy-link")
        link, camera, picture = page.page.input_value("#link"), page.call("getCamera"), page.picture()
        opened = wall((700, 400), tail="#" + link.split("#")[1])
        assert torch.equal(opened.picture(), picture) or psnr(opened.picture(), picture) >= 60
        assert np.allclose(opened.call("getMatrix"), page.call("getMatrix"), atol=1e-6)
        narrow = wall((360, 640), tail="#" + link.split("#")[1])
        assert np.allclose(narrow.call("getCamera")["target"], camera["target"], atol=1e-6)
    page.page.evaluate("location.hash = 'photograph=4'")
    page.until("document.getElementById('photograph').value === '3'")
    assert np.allclose(page.camera()[0], page.call("photographs")[3]["position"])
    for nonsense in ("#camera=1,2,3", "#photograph=99", "#camera=a,b,c,0,0,0,0,0,1", "#camera=1,1,1,1,1,1,0,0,1&fov=0"):
        assert np.allclose(wall(tail=nonsense).camera()[0], page.call("photographs")[0]["position"])


def test_embedded_where_the_code_says(opened, tmp_path):
    """The code that the page gives, in a page of another origin; and what that page may ask by message."""
    scene, photographs = wall_scene(tmp_path)
    (tmp_path / "page.html").write_text(page_with(scene.read_bytes(), photographs))
    (tmp_path / "outer").mkdir()
    with web_server(tmp_path) as inner, web_server(tmp_path / "outer") as outer:
        page = opened(f"{inner}/page.html", (700, 500))
        page.call("setCamera", VIEWS[0])
        page.tab("Share")
        page.page.click("#embed")
        code = page.page.input_value("#embed-code")
        script = (
            "<script>window.got = [];"
            "addEventListener('message', (event) => got.push({ ...event.data, origin: event.origin }));"
            "window.ask = (id, call, ...args) => document.querySelector('iframe').contentWindow.postMessage("
            "{ nrfgs: 1, id, call, args }, '*');</script>"
        )
        (tmp_path / "outer" / "index.html").write_text(script + code)
        (tmp_path / "outer" / "other.html").write_text("<p>another</p>")
        (tmp_path / "outer" / "favicon.ico").write_bytes(b"")  # else the browser complains
        host = opened(f"{outer}/", (900, 700), begun=False)

        def answer(name: str, value) -> dict:
            host.page.wait_for_function("([name, value]) => got.some((one) => one[name] === value)", arg=[name, value])
            return host.page.evaluate("([name, value]) => got.find((one) => one[name] === value)", [name, value])

        def asked(number: int, call: str, *arguments) -> dict:
            host.page.evaluate("([id, call, given]) => ask(id, call, ...given)", [number, call, list(arguments)])
            return answer("id", number)

        assert answer("event", "ready")["origin"] == inner
        assert np.allclose(asked(1, "getCamera")["result"]["position"], VIEWS[0]["position"])
        assert asked(2, "flyTo", VIEWS[1], 0.2)["result"] is True
        assert np.allclose(answer("event", "moved")["camera"]["position"], VIEWS[0]["position"], atol=3)
        assert np.allclose(asked(3, "getCamera")["result"]["position"], VIEWS[1]["position"])
        assert len(asked(4, "photographs")["result"]) == 9
        assert "target" in asked(5, "setCamera", {"position": [1, 2, 3]})["error"]
        for number, secret in enumerate(["picture", "constructor", "toString"], start=6):
            assert secret in asked(number, secret)["error"]

        # A page beside it, not around it, is not answered.
        host.page.evaluate(
            "new Promise((there) => { const beside = document.createElement('iframe'); beside.id = 'beside';"
            " beside.src = 'other.html'; beside.onload = there; document.body.append(beside); })"
        )
        (beside,) = [frame for frame in host.page.frames if frame.url.endswith("other.html")]
        beside.evaluate(
            "window.got = []; addEventListener('message', (event) => got.push(event.data));"
            "parent.frames[0].postMessage({ nrfgs: 1, id: 1, call: 'setCamera',"
            " args: [{ position: [9, 9, 9], target: [0, 0, 0] }] }, '*')"
        )
        assert np.allclose(asked(20, "getCamera")["result"]["position"], VIEWS[1]["position"])
        assert beside.evaluate("got") == []


WATCH = """
window.path = [];
const moved = ({ position }) => path.push([performance.now(), ...position]);
addEventListener("DOMContentLoaded", () => nrfgs.on("moved", moved));
"""


def test_a_tour_begins_by_itself_and_goes_smoothly_through_its_views(wall):
    page = wall((160, 120), before=WATCH, tour={"views": [2, 4, VIEWS[0], 8]})
    assert page.page.get_by_role("button", name="Stop tour").get_attribute("aria-pressed") == "true"
    page.until(ENDED)
    path = np.array(page.page.evaluate("path"))
    places = [page.call("photographs")[k]["position"] for k in (2, 4, 8)] + [VIEWS[0]["position"]]
    for place in places:
        assert np.linalg.norm(path[:, 1:] - place, axis=1).min() < 0.2
    assert np.allclose(page.camera()[0], places[2]), "it ends at the last"
    # No jump: a step is no longer than twice the mean speed allows, and the camera starts and ends slowly.
    flight = path[np.linalg.norm(path[:, 1:] - places[0], axis=1).argmin() :]
    steps, times = np.linalg.norm(np.diff(flight[:, 1:], axis=0), axis=1), np.diff(flight[:, 0])
    assert (steps <= 2.5 * steps.sum() / times.sum() * np.maximum(times, 40) + 1e-6).all()


def test_a_tour_stops_at_the_first_touch(wall):
    for touch in (lambda page: page.page.mouse.click(20, 60), lambda page: page.page.keyboard.press("x")):
        page = wall((160, 120), tour={"views": [0, 8, 2, 6]})
        page.until(STARTED)
        touch(page)
        assert page.page.locator("#tour").get_attribute("aria-pressed") == "false"
        page.call("finished")  # it would never end while a tour goes on
    page = wall((400, 300), tour={"views": [0, 8]}, tail="#photograph=5")
    assert page.page.locator("#tour").get_attribute("aria-pressed") == "false", "a link's view is kept"
    for pressed in ("true", "false"):
        page.page.click("#tour")
        assert page.page.locator("#tour").get_attribute("aria-pressed") == pressed
    page.page.evaluate("nrfgs.play('tour')")
    page.until(ENDED)
    assert np.allclose(page.camera()[0], page.call("photographs")[8]["position"])
    still = wall(before="matchMedia = () => ({ matches: true });", tour={"views": [0, 8]})
    assert still.page.locator("#tour").get_attribute("aria-pressed") == "false"


def test_notes_are_at_their_points_and_are_text(wall):
    notes = [
        {"text": "<b>left</b> & right", "position": [0, 0.5, 0.3], "camera": VIEWS[0]},
        {"text": "behind", "position": [6, 0, 0]},
    ]
    page = wall((400, 300), notes=notes)
    page.call("setCamera", {"position": [3, 0, 0], "target": [0, 0, 0], "fov": 50})
    page.call("finished")
    box = page.page.get_by_role("button", name="Note 1", exact=True).bounding_box()
    focal = 150 / np.tan(np.radians(25))
    # From +x, with z up, +y is to the right.
    expected = [200 + focal * 0.5 / 3, 150 - focal * 0.3 / 3]
    assert np.allclose([box["x"] + box["width"] / 2, box["y"] + box["height"] / 2], expected, atol=1)
    assert page.page.get_by_role("button", name="Note 2", exact=True).count() == 0
    assert page.page.get_by_text("<b>left</b> & right").is_hidden()
    page.page.get_by_role("button", name="Note 1", exact=True).click()
    assert page.page.get_by_text("<b>left</b> & right").is_visible()
    assert np.allclose(page.camera()[0], VIEWS[0]["position"])
    page.page.get_by_role("button", name="Note 1", exact=True).click()
    assert page.page.get_by_text("<b>left</b> & right").is_hidden()
    for fault in ({"text": "x", "camera": VIEWS[0]}, notes[0] | {"position": [1, 2]}):
        with pytest.raises(playwright.Error, match="position must be 3 finite numbers"):
            page.call("setNotes", [fault])
    assert page.call("getNotes") == notes


@pytest.mark.parametrize("size", [(700, 560), (360, 640)])
def test_what_is_made_in_a_page_is_saved_and_read_again(size, wall, tmp_path):
    page = wall(size)
    page.call("setCamera", {"position": [3, 0.2, 0.1], "target": [0, 0, 0]})
    page.tab("Share")
    assert page.page.locator("#save-notes").is_disabled() and page.page.locator("#save-tour").is_disabled()
    page.page.click("#add-note")
    page.page.mouse.click(150, 100)
    page.page.wait_for_selector("#note-list input")
    page.page.keyboard.type("a wall's note")
    with page.page.expect_download() as download:
        page.page.click("#save-notes")
    download.value.save_as(tmp_path / "notes.json")
    (note,) = read_notes(tmp_path / "notes.json")
    assert note["text"] == "a wall's note" and abs(note["position"][0]) < 0.05, "on the wall"
    assert note["camera"]["position"] == pytest.approx([3, 0.2, 0.1])
    for _ in range(2):
        page.page.click("#add-view")
        page.call("setCamera", VIEWS[0])
    with page.page.expect_download() as download:
        page.page.click("#save-tour")
    download.value.save_as(tmp_path / "tour.json")
    views = read_tour([str(tmp_path / "tour.json")], [])["views"]
    assert [view["position"] for view in views] == [pytest.approx([3, 0.2, 0.1]), pytest.approx(VIEWS[0]["position"])]
    again = wall(notes=[note], tour={"views": views}, tail="#photograph=1")
    assert again.call("getNotes") == [note]
    again.call("play", "tour")
    assert again.camera()[0].shape == (3,)
    page.page.get_by_role("button", name="Remove note 1").click()
    assert page.call("getNotes") == []
    page.page.click("#add-note")
    page.page.keyboard.press("Escape")
    page.page.mouse.click(150, 100)
    page.call("finished")
    assert page.call("getNotes") == [], "Escape ends the placing"


def test_events_and_versions(wall, browser, tmp_path):
    page = wall()
    page.page.evaluate("window.count = 0; window.off = nrfgs.on('moved', () => count++); 0")
    page.call("setCamera", VIEWS[0])
    page.call("finished")
    seen = page.page.evaluate("count")
    page.page.evaluate("off()")
    page.call("setCamera", VIEWS[1])
    page.call("finished")
    assert seen >= 1 and page.page.evaluate("count") == seen
    with pytest.raises(playwright.Error, match="RangeError"):
        page.call("on", "nonsense")
    scene, photographs = wall_scene(tmp_path)
    (tmp_path / "broken.html").write_text(page_with(scene.read_bytes()[:-100], photographs))
    heard = "addEventListener('DOMContentLoaded', () => nrfgs.on('failed', (fault) => (window.fault = fault)))"
    broken = Page(browser, (tmp_path / "broken.html").as_uri(), before=heard)
    broken.until("window.fault")
    assert re.search("cut short", broken.page.evaluate("fault.message"))
    broken.page.close()
