# SPDX-License-Identifier: Apache-2.0
"""Pages of `nrfgs export web` in real browsers, without a network and without a GPU:
pip install -e '.[browser]'; apt-get install chromium firefox-esr xvfb; pytest -m browser tests/export"""

import base64
import io
import json
import re

import numpy as np
import pytest
from PIL import Image
from web_pages import Page, page_with, random_scene, rendered, web_server

from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.trained.loading import load_model

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]

ALIKE = 40.0
"""dB between the page's picture and the renderer's."""
MODES = ["full", "base", "residual", "opacity residual"]
KINDS = {
    "as trained by default": ("classic", {}),
    "antialiased": ("antialiased", {"latent_dim": 7, "num_bands": 2, "hidden_width": 30}),
    "one branch": ("classic", {"split_bands": False, "opacity_bound": "logit", "use_distance": False}),
    "low band, opacity fixed": ("antialiased", {"num_bands": 1, "opacity_residual": False}),
}
"""Fields that differ in every way that the page must know."""


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_field_in_every_mode(kind, opened, tmp_path, monkeypatch):
    monkeypatch.setattr("nrfgs_ns.export.web.page.PART", 3 * 5000)  # the scene is in several parts
    scene, photographs = random_scene(tmp_path, *KINDS[kind])
    (tmp_path / "page.html").write_text(page_with(scene.read_bytes(), photographs))
    page = opened((tmp_path / "page.html").as_uri())
    for index, photograph in enumerate(photographs):
        page.call("visit", index)
        for mode, gain in [("full", 1.0), ("full", 2.0), ("full", 0.35), *((mode, 1.0) for mode in MODES[1:])]:
            page.set("show", mode, "change")
            page.set("gain", str(gain), "input")
            score = psnr(page.picture(), rendered(scene, photograph, mode, gain))
            assert score >= ALIKE, (index, mode, gain, score)


def test_a_device_that_lacks_memory_or_float_targets(opened, tmp_path):
    scene, photographs = random_scene(tmp_path, *KINDS["antialiased"])
    text = page_with(scene.read_bytes(), photographs)
    assert (kept := "const LARGEST_KEPT = 2 ** 28;") in text
    (tmp_path / "small.html").write_text(text.replace(kept, "const LARGEST_KEPT = 0;"))
    (tmp_path / "page.html").write_text(text)
    no_floats = (
        "const ask = WebGL2RenderingContext.prototype.getExtension;"
        "WebGL2RenderingContext.prototype.getExtension = function (name) {"
        " return name.startsWith('EXT_color_buffer') ? null : ask.call(this, name); };"
    )
    # Of hundreds of splats over each other, each is rounded to 8 bits.
    for name, before, least in (("small", "", ALIKE), ("page", no_floats, 30.0)):
        page = opened((tmp_path / f"{name}.html").as_uri(), before=before)
        assert psnr(page.picture(), rendered(scene, photographs[0])) >= least


def test_a_demo_scene_is_drawn_as_by_the_renderer(demo, opened, tmp_path):
    """Three photographs: the page against the scene in it, and against the model that it was written from."""
    config, path = demo
    text, scene = path.read_text(encoding="utf-8"), tmp_path / "held.nrf"
    scene.write_bytes(base64.b64decode(re.search(r'id="packed"[^>]*>([^<]*)<', text).group(1)))
    about = json.loads(re.search(r'id="about"[^>]*>([^<]*)<', text).group(1))
    page = opened(path.as_uri(), tuple(about["photographs"][0]["size"]))
    pipeline = load_model(config, "test")
    cameras = pipeline.datamanager.train_dataset.cameras
    for index in sorted({about["start"], 0, len(cameras) // 2, len(cameras) - 1})[:3]:
        page.call("visit", index)
        picture, photograph = page.picture(), about["photographs"][index]
        assert psnr(picture, rendered(scene, photograph)) >= ALIKE
        assert psnr(picture, pipeline.model.get_outputs_for_camera(cameras[index : index + 1])["rgb"]) >= ALIKE
        # What is compared has a residual, of opacity too.
        page.set("show", "opacity residual", "change")
        changes = page.picture()
        assert psnr(changes, rendered(scene, photograph, "opacity residual")) >= ALIKE
        assert changes.std() > 0.01
        page.set("show", "full", "change")


def test_a_page_asks_the_network_for_nothing_and_works_in_a_frame(demo, opened, tmp_path):
    outer = tmp_path / "outer.html"
    outer.write_text(f'<iframe src="{demo[1].as_uri()}#photograph=2" width="300" height="200"></iframe>')
    page = opened(outer.as_uri(), (400, 300), begun=False)
    (frame,) = page.page.frames[1:]
    frame.evaluate("nrfgs.ready")
    assert frame.locator("#panel").is_hidden()
    assert frame.locator("#photograph").input_value() == "1"
    assert all(url.startswith(("file:", "blob:", "data:")) for url in page.requests)


def test_a_broken_page_says_so(demo, browser, tmp_path):
    text = demo[1].read_text(encoding="utf-8")
    start, middle = text.index(">", at := text.index('id="packed"')) + 1, at + (len(text) - at) // 2
    scene = base64.b64decode(text[start : text.index("<", start)])
    later = base64.b64encode(scene[:8] + (9).to_bytes(4, "little") + scene[12:]).decode()
    unparsable = text.replace("async function", "async async function", 1)
    letter = "A" if text[middle] != "A" else "B"
    for fault, (broken, said) in {
        "a letter changed": (text[:middle] + letter + text[middle + 1 :], "checksum"),
        "cut short": (text[:middle], "cut short"),
        "without its scene": (text[: text.rindex("<script", 0, at)], "cut short"),
        "cut in its scripts": (text[: text.index("async function main")], "incomplete"),
        "cut in its style": (text[: text.index("</style>") - 9], "incomplete"),
        "cut in its poster": (text[: text.index('src="data:image') + 400], "incomplete"),
        "scripts that do not parse": (unparsable, "cannot run this page"),
        "not base64": (text[:middle] + "!" + text[middle + 1 :], "damaged"),
        "of a later version": (text[:start] + later + text[text.index("<", start) :], "version"),
    }.items():
        (tmp_path / "broken.html").write_text(broken, encoding="utf-8")
        page = Page(browser, (tmp_path / "broken.html").as_uri(), (400, 300))
        page.page.wait_for_selector("#failed:not([hidden])")
        assert said in page.page.inner_text("#failed"), fault
        assert page.page.locator("#loading").is_hidden(), fault
        assert np.asarray(Image.open(io.BytesIO(page.page.screenshot()))).std() > 5, "the poster is there"
        page.page.close()


@pytest.mark.parametrize("said, before", [
    ("Turn on graphics acceleration", "HTMLCanvasElement.prototype.getContext = () => null"),
    ("textures are too small for", "WebGL2RenderingContext.prototype.getParameter = () => 64"),
    ("graphics memory is too small", "WebGL2RenderingContext.prototype.getError = () => 0x505"),
    ("graphics driver cannot", "WebGL2RenderingContext.prototype.getProgramParameter = () => false"),
    ("Something went wrong", "WebGL2RenderingContext.prototype.bufferData = () => { throw Error('raw text') }"),
    ("cannot be read", "Worker = null; Uint32Array.prototype.reverse = () => { throw Error('raw text') }"),
])  # fmt: skip
def test_a_browser_that_lacks_something_says_so_in_a_sentence(said, before, demo, browser):
    page = Page(browser, demo[1].as_uri(), before=before)
    page.page.wait_for_selector("#failed:not([hidden])")
    text = page.page.inner_text("#failed")
    assert said in text and "raw text" not in text
    assert bool(page.errors) == ("driver" in said or "raw text" in before), "the console has the details"
    page.page.close()


def test_a_folder_on_a_web_server(opened, browser, tmp_path):
    (folder := tmp_path / "served").mkdir()
    scene, photographs = random_scene(folder, *KINDS["as trained by default"])
    (folder / "index.html").write_text(page_with("scene.nrf", photographs))
    with web_server(folder) as address:
        page = opened(f"{address}/")
        assert psnr(page.picture(), rendered(scene, photographs[0])) >= ALIKE
        assert {url.rsplit("/", 1)[1] for url in page.requests if url.startswith("http")} == {"", "scene.nrf"}
        scene.unlink()
        page = Page(browser, f"{address}/")
        page.page.wait_for_selector("#failed:not([hidden])")
        assert "scene.nrf cannot be loaded" in page.page.inner_text("#failed")
        page.page.close()
