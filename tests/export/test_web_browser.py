# SPDX-License-Identifier: Apache-2.0
"""Pages of `nrfgs export web` in a real browser, without a network and without a GPU.

pip install -e '.[browser]'; apt-get install chromium; pytest -m browser tests/export
"""

import base64
import contextlib
import functools
import http.server
import io
import json
import math
import re
import threading
from pathlib import Path

import numpy as np
import pytest
import torch
from PIL import Image
from short_trainings import command_line, trained

from nrfgs_lab.pages.browser import CHROMIUM, chromium, different
from nrfgs_lab.pages.web import main as measure_page
from nrfgs_ns.appearance.field import Field
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.appearance.reduce import with_diffuse
from nrfgs_ns.compact.decode import decode
from nrfgs_ns.compact.encode import encode
from nrfgs_ns.compact.format import write_container
from nrfgs_ns.export.command import Web
from nrfgs_ns.export.web.page import page as page_of
from nrfgs_ns.image.metrics import psnr
from nrfgs_ns.model.pinhole import Pinhole, world_to_camera
from nrfgs_ns.model.renderer import composite_view, project_view, projection_options
from nrfgs_ns.trained.loading import load_model
from nrfgs_ns.viewer.pictures import AMPLIFICATION, GREY, OPACITY_AXIS, with_gain

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]

pytest.importorskip("playwright.sync_api", reason="no playwright: pip install -e '.[browser]'")

ALIKE = 40.0
"""dB between the page's picture and the renderer's."""
SIZE = (320, 240)
MODES = ["full", "base", "residual", "opacity residual"]
KINDS = {
    "as trained by default": ("classic", {}),
    "antialiased": ("antialiased", {"latent_dim": 7, "num_bands": 2, "hidden_width": 30}),
    "one branch": ("classic", {"split_bands": False, "opacity_bound": "logit", "use_distance": False}),
    "low band, opacity fixed": ("antialiased", {"num_bands": 1, "opacity_residual": False}),
}
"""Fields that differ in every way that the page must know."""


@pytest.fixture(scope="module")
def browser():
    if CHROMIUM is None:
        pytest.skip("no Chromium on the path: apt-get install chromium")
    with chromium() as browser:
        yield browser


class Page:
    """A page in a window of its own, and what it complained about."""

    def __init__(self, browser, address: str, size: tuple[int, int] = SIZE, before: str = ""):
        self.page = browser.new_page(viewport={"width": size[0], "height": size[1]})
        self.page.set_default_timeout(120_000)
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda said: self.errors.append(said.text) if said.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        if before:
            self.page.add_init_script(before)
        self.page.goto(address)

    def begun(self) -> "Page":
        self.page.evaluate("nrfgs.ready")
        return self

    def picture(self) -> torch.Tensor:
        """What the canvas shows when it is finished, [H, W, 3] in [0, 1]."""
        address = self.page.evaluate("nrfgs.finished().then(() => nrfgs.picture())")
        image = Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB")
        return torch.from_numpy(np.asarray(image).astype(np.float32) / 255)

    def visit(self, index: int) -> None:
        self.page.evaluate(f"nrfgs.visit({index})")

    def set(self, control: str, value: str, event: str) -> None:
        """Give a control a value, whether the panel is open or not."""
        self.page.evaluate(
            "([id, value, event]) => { const control = document.getElementById(id);"
            " if (control.type === 'checkbox') control.checked = value === 'on'; else control.value = value;"
            " control.dispatchEvent(new Event(event)); }",
            [control, value, event],
        )

    def drag(self, shift: bool = False) -> None:
        if shift:
            self.page.keyboard.down("Shift")
        self.page.mouse.move(100, 150)
        self.page.mouse.down()
        self.page.mouse.move(160, 130, steps=3)
        self.page.mouse.up()
        if shift:
            self.page.keyboard.up("Shift")


def random_scene(folder: Path, mode: str, options: dict) -> tuple[Path, list[dict]]:
    """A compact file with a network that was never trained, and three photographs of it."""
    torch.manual_seed(3)
    head = NrfConfig(output_init="default", **options).setup().requires_grad_(False)
    head.scene_unit = 0.7
    for weight in head.parameters():
        weight.mul_(2.0)
    count = 1500
    splats = {
        "means": torch.randn(count, 3) * torch.tensor([1.0, 1.0, 0.5]),
        "quats": torch.randn(count, 4),
        "scales": torch.randn(count, 3) * 0.6 - 2.8,
        "opacities": torch.randn(count, 1) * 2,
        "features_dc": torch.randn(count, 3),
        "latents": torch.randn(count, head.config.latent_dim),
    }
    field = with_diffuse(Field(head, splats), torch.rand(count) < 0.3, splats["features_dc"], splats["opacities"])
    header, streams = encode(field, {"rasterize_mode": mode, "background": [0.1, 0.2, 0.3]})
    write_container(folder / "scene.nrf", header, streams)
    photographs = []
    for k in range(3):
        # The third is inside: splats behind the camera, across it, and beyond the picture's edges.
        eye = torch.tensor([3 * math.cos(2.1 * k), 3 * math.sin(2.1 * k), 0.8]) * (0.2 if k == 2 else 1.0)
        back = eye / eye.norm()
        right = torch.linalg.cross(torch.tensor([0.0, 0.0, 1.0]), back)
        right = right / right.norm()
        pose = torch.stack([right, torch.linalg.cross(back, right), back, eye], dim=1)
        place = {"name": f"{k}.png", "pose": pose.flatten().tolist(), "distance": float(eye.norm())}
        photographs.append({**place, "lens": [260.0, 250.0, 150.0, 130.0], "size": list(SIZE)})
    return folder / "scene.nrf", photographs


def page_with(scene: bytes | str, photographs: list[dict]) -> str:
    about = {"photographs": photographs, "start": 0, "up": [0, 0, 1]}
    poster = io.BytesIO()
    Image.new("RGB", (8, 6), "red").save(poster, "jpeg")
    return page_of(about, poster.getvalue(), scene, "Splats <1 & 2>", 'Me & "you"')


def rendered(scene: Path, photograph: dict, mode: str = "full", gain: float = 1.0) -> torch.Tensor:
    """What this project draws of a compact file, [H, W, 3] in [0, 1]."""
    decoded = decode(scene)
    head = decoded.config.setup().requires_grad_(False)
    head.load_state_dict(decoded.weights)
    head.scene_unit = decoded.header["head"]["scene_unit"]
    field = Field(head, dict(decoded.splats))
    pose = torch.tensor(photograph["pose"]).view(1, 3, 4)
    fx, fy, cx, cy = photograph["lens"]
    lens = torch.tensor([[[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]]])
    camera = Pinhole(world_to_camera(pose), lens, *photograph["size"], pose[0, :, 3])
    options = projection_options(decoded.header["render"]["rasterize_mode"], head.scene_unit)
    view = project_view(field.splats, camera, options)
    appearance = with_gain(field, view, 0.0 if mode == "base" else gain)
    background = torch.tensor(decoded.header["render"]["background"])
    if mode.endswith("residual"):
        component = field.components_of(view).get(mode)
        change = torch.zeros(len(appearance.colors), 1) if component is None else component.values
        change = change * torch.tensor(OPACITY_AXIS) if mode == "opacity residual" else change
        appearance = appearance._replace(colors=GREY + AMPLIFICATION * gain * change.expand(-1, 3))
        background = torch.full((3,), GREY)
    return composite_view(view, appearance, background)[0]["rgb"]


@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_field_in_every_mode(kind, browser, tmp_path):
    scene, photographs = random_scene(tmp_path, *KINDS[kind])
    (tmp_path / "page.html").write_text(page_with(scene.read_bytes(), photographs))
    page = Page(browser, (tmp_path / "page.html").as_uri()).begun()
    for index, photograph in enumerate(photographs):
        page.visit(index)
        for mode, gain in [("full", 1.0), ("full", 2.0), ("full", 0.35), *((mode, 1.0) for mode in MODES[1:])]:
            page.set("show", mode, "change")
            page.set("gain", str(gain), "input")
            score = psnr(page.picture(), rendered(scene, photograph, mode, gain))
            assert score >= ALIKE, (index, mode, gain, score)
    assert not page.errors
    page.page.close()


def test_a_device_that_lacks_memory_or_float_targets(browser, tmp_path):
    scene, photographs = random_scene(tmp_path, *KINDS["antialiased"])
    text = page_with(scene.read_bytes(), photographs)
    kept = "const LARGEST_KEPT = 2 ** 28;"
    assert kept in text
    (tmp_path / "small.html").write_text(text.replace(kept, "const LARGEST_KEPT = 0;"))
    (tmp_path / "page.html").write_text(text)
    no_floats = (
        "const ask = WebGL2RenderingContext.prototype.getExtension;"
        "WebGL2RenderingContext.prototype.getExtension = function (name) {"
        " return name.startsWith('EXT_color_buffer') ? null : ask.call(this, name); };"
    )
    # Of hundreds of splats over each other, each is rounded to 8 bits.
    for name, before, least in (("small", "", ALIKE), ("page", no_floats, 30.0)):
        page = Page(browser, (tmp_path / f"{name}.html").as_uri(), before=before).begun()
        assert psnr(page.picture(), rendered(scene, photographs[0])) >= least
        assert not page.errors
        page.page.close()


@pytest.fixture(scope="module")
def demo(tiny_scene, tmp_path_factory):
    """config.yml of a short training on the procedural scene, and its page."""
    folder = tmp_path_factory.mktemp("demo")
    options = {
        "--pipeline.model.num-downscales": 0,
        "--pipeline.model.few-views": "off",
        "--pipeline.model.shrinkage": 0,
        "--pipeline.model.densification": "splatfacto,warmup_length=20,refine_every=20",
        "--pipeline.model.rasterize-mode": "antialiased",
        "--optimizers.field.optimizer.lr": 0.05,  # something to show after a few steps
    }
    config = trained(command_line("nrfgs", tiny_scene, folder, 80, options))
    Web(config, output=folder / "page.html").main()
    return config, folder / "page.html"


def test_a_demo_scene_is_drawn_as_by_the_renderer(demo, browser, tmp_path):
    """Three photographs: the page against the scene in it, and against the model that it was written from."""
    config, path = demo
    text, scene = path.read_text(encoding="utf-8"), tmp_path / "held.nrf"
    scene.write_bytes(base64.b64decode(re.search(r'id="packed"[^>]*>([^<]*)<', text).group(1)))
    about = json.loads(re.search(r'id="about"[^>]*>([^<]*)<', text).group(1))
    page = Page(browser, path.as_uri(), tuple(about["photographs"][0]["size"])).begun()
    pipeline = load_model(config, "test")
    cameras = pipeline.datamanager.train_dataset.cameras
    for index in sorted({about["start"], 0, len(cameras) // 2, len(cameras) - 1})[:3]:
        page.visit(index)
        picture, photograph = page.picture(), about["photographs"][index]
        assert psnr(picture, rendered(scene, photograph)) >= ALIKE
        assert psnr(picture, pipeline.model.get_outputs_for_camera(cameras[index : index + 1])["rgb"]) >= ALIKE
        # What is compared has a residual, of opacity too.
        page.set("show", "opacity residual", "change")
        changes = page.picture()
        assert psnr(changes, rendered(scene, photograph, "opacity residual")) >= ALIKE
        assert changes.std() > 0.01
        page.set("show", "full", "change")
    assert not page.errors
    page.page.close()


def test_every_control_changes_the_picture(demo, browser):
    page = Page(browser, demo[1].as_uri(), (480, 360)).begun()
    first = page.picture()

    def changed(act, than: torch.Tensor = first) -> torch.Tensor:
        act()
        now = page.picture()
        assert different(255 * now.numpy(), 255 * than.numpy())
        return now

    def same(act) -> None:
        act()
        assert not different(255 * page.picture().numpy(), 255 * first.numpy())

    for mode in MODES[1:]:
        changed(lambda mode=mode: page.set("show", mode, "change"))
    same(lambda: page.set("show", "full", "change"))
    for gain in ("0", "2"):
        changed(lambda gain=gain: page.set("gain", gain, "input"))
    same(lambda: page.set("gain", "1", "input"))

    # Frozen, the picture from another place differs from the one that is seen there.
    home = functools.partial(page.page.evaluate, "document.getElementById('home').click()")
    changed(page.drag)
    page.page.keyboard.press("Home")
    same(home)
    page.set("freeze", "on", "change")
    same(lambda: None)
    elsewhere = (int(page.page.locator("#photograph").input_value()) + 3) % 8  # of the tiny scene's training views
    frozen = changed(lambda: page.visit(elsewhere))
    changed(lambda: page.set("freeze", "", "change"), than=frozen)
    same(home)

    changed(lambda: page.drag(shift=True))
    same(home)
    changed(lambda: page.page.mouse.wheel(0, -300))
    same(home)
    page.set("drag", "fly", "change")
    changed(page.drag)
    page.set("drag", "orbit", "change")
    same(home)
    for key in ("ArrowLeft", "ArrowUp", "+", "]"):
        page.page.keyboard.press(key)
        changed(lambda: None)
        same(home)
    changed(lambda: page.page.keyboard.press("w", delay=300))
    same(home)
    for button in ("previous", "next"):
        changed(lambda button=button: page.page.evaluate(f"document.getElementById('{button}').click()"))
        same(home)
    changed(lambda: page.page.mouse.dblclick(120, 260))
    same(home)

    page.page.evaluate("document.activeElement.blur()")
    for _ in range(3):
        page.page.mouse.wheel(0, 1000)
        page.picture()
    page.set("mark", "on", "change")
    page.picture()
    mark = page.page.evaluate(
        "(() => { const { width, height } = document.getElementById('marks');"
        " const data = document.getElementById('marks').getContext('2d').getImageData(0, 0, width, height).data;"
        " const at = data.findIndex((value, i) => i % 4 === 3 && value > 0) >> 2;"
        " return [at % width, Math.floor(at / width)]; })()"
    )
    page.page.evaluate("document.getElementById('said').textContent = ''")
    changed(lambda: page.page.mouse.click(*mark), than=page.picture())
    assert page.page.evaluate("document.getElementById('said').textContent").startswith("Photograph ")
    same(home)
    page.page.keyboard.press("h")
    assert page.page.locator("#panel").is_visible()
    page.page.click("#embed")
    assert page.page.locator("#embed-code").input_value().startswith("<iframe src=")
    with page.page.expect_download() as download:
        page.page.click("#save")
    assert Image.open(download.value.path()).size == (480, 360)
    assert not page.errors
    page.page.close()


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
    page = Page(browser, demo[1].as_uri(), (900, 600)).begun()
    assert page.page.locator("html").get_attribute("lang") == "en"
    named = {
        "application": "page: a scene in three dimensions",
        "heading": "page",
        "slider": re.compile("^Residual gain"),
        "textbox": None,  # hidden until it is asked for
    }
    for role, name in named.items():
        assert page.page.get_by_role(role, name=name).count() == (name is not None), role
    for role, names in {
        "combobox": [re.compile("^Show"), re.compile("^Drag to"), "Photograph"],
        "checkbox": ["Freeze view", "Mark where taken"],
        "button": ["Controls", "Previous photograph", "Next photograph", "First view", "Save picture", "Embed"],
    }.items():
        for name in names:
            assert page.page.get_by_role(role, name=name, exact=isinstance(name, str)).count() == 1, name
    unnamed = page.page.evaluate(
        "[...document.querySelectorAll('button, select, input, textarea')].filter((one) => !one.labels?.length"
        " && !one.ariaLabel && !one.textContent.trim()).map((one) => one.id)"
    )
    assert unnamed == []

    # The keyboard alone gets everywhere, and what happens is said.
    page.page.evaluate("document.activeElement.blur()")
    reached = set()
    for _ in range(20):
        page.page.keyboard.press("Tab")
        reached.add(page.page.evaluate("document.activeElement.id"))
    assert {"scene", "toggle", "show", "gain", "freeze", "drag", "photograph", "mark", "home", "embed"} <= reached
    page.page.focus("#scene")
    page.page.keyboard.press("]")
    assert page.page.get_by_text(re.compile("^Photograph ")).count() == 1
    page.page.keyboard.press("h")
    assert page.page.locator("#panel").is_hidden()
    assert page.page.get_by_role("button", name="Controls").get_attribute("aria-expanded") == "false"
    assert not page.errors
    page.page.close()


def test_a_page_asks_the_network_for_nothing_and_works_in_a_frame(demo, browser, tmp_path):
    outer = tmp_path / "outer.html"
    outer.write_text(f'<iframe src="{demo[1].as_uri()}#photograph=2" width="300" height="200"></iframe>')
    page = Page(browser, outer.as_uri(), (400, 300))
    (frame,) = page.page.frames[1:]
    frame.evaluate("nrfgs.ready")
    assert frame.locator("#panel").is_hidden()
    assert frame.locator("#photograph").input_value() == "1"
    assert all(url.startswith(("file:", "blob:", "data:")) for url in page.requests)
    assert not page.errors
    page.page.close()


@pytest.mark.parametrize(
    "fault, said",
    {
        "a letter changed": "checksum",
        "cut short": "cut short",
        "without its scene": "cut short",
        "not base64": "damaged",
        "of a later version": "version",
    }.items(),
)
def test_a_broken_page_says_so(fault, said, demo, browser, tmp_path):
    text = demo[1].read_text(encoding="utf-8")
    at = text.index('id="packed"')
    start, middle = text.index(">", at) + 1, at + (len(text) - at) // 2
    scene = base64.b64decode(text[start : text.index("<", start)])
    later = base64.b64encode(scene[:8] + (9).to_bytes(4, "little") + scene[12:]).decode()
    broken = {
        "a letter changed": text[:middle] + ("A" if text[middle] != "A" else "B") + text[middle + 1 :],
        "cut short": text[:middle],
        "without its scene": text[: text.rindex("<script", 0, at)],
        "not base64": text[:middle] + "!" + text[middle + 1 :],
        "of a later version": text[:start] + later + text[text.index("<", start) :],
    }
    (tmp_path / "broken.html").write_text(broken[fault], encoding="utf-8")
    page = Page(browser, (tmp_path / "broken.html").as_uri(), (400, 300))
    page.page.wait_for_selector("#failed:not([hidden])")
    assert said in page.page.inner_text("#failed")
    assert page.page.locator("#loading").is_hidden()
    assert np.asarray(Image.open(io.BytesIO(page.page.screenshot()))).std() > 5, "the poster is there"
    page.page.close()


def test_without_webgl_the_page_says_so(demo, browser):
    page = browser.new_page()
    page.add_init_script("HTMLCanvasElement.prototype.getContext = () => null")
    page.goto(demo[1].as_uri())
    page.wait_for_selector("#failed:not([hidden])")
    assert "WebGL 2" in page.inner_text("#failed")
    page.close()


@contextlib.contextmanager
def web_server(folder: Path):
    """A static host."""

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def test_a_folder_on_a_web_server(browser, tmp_path):
    folder = tmp_path / "served"
    folder.mkdir()
    scene, photographs = random_scene(folder, *KINDS["as trained by default"])
    (folder / "index.html").write_text(page_with("scene.nrf", photographs))
    with web_server(folder) as address:
        page = Page(browser, f"{address}/").begun()
        assert psnr(page.picture(), rendered(scene, photographs[0])) >= ALIKE
        asked = {url.rsplit("/", 1)[1] for url in page.requests if url.startswith("http")}
        assert asked <= {"", "scene.nrf", "favicon.ico"}
        page.page.close()
        scene.unlink()
        page = Page(browser, f"{address}/")
        page.page.wait_for_selector("#failed:not([hidden])")
        assert "scene.nrf cannot be loaded" in page.page.inner_text("#failed")
        page.page.close()


def test_a_page_is_measured(demo, tmp_path, monkeypatch):
    """docs/web.md's times and figures."""
    if CHROMIUM is None:
        pytest.skip("no Chromium on the path: apt-get install chromium")
    config, path = demo
    record = tmp_path / "record.json"
    words = ["web", path, record, "--config", config, "--size", 320, 240, "--count", 2]
    monkeypatch.setattr("sys.argv", list(map(str, words)))
    measure_page()
    found = json.loads(record.read_text())
    assert found["size"] == [320, 240] and found["bytes"] == path.stat().st_size and found["splats"] > 0
    assert all(found[name] > 0 for name in ("seconds_to_load", "seconds_per_picture"))
    assert len(found["psnr"]) == 3 and min(found["psnr"]) >= ALIKE
    assert Image.open(tmp_path / "record-2.png").size == (320, 240)
