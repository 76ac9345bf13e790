# SPDX-License-Identifier: Apache-2.0
"""Pages of `nrfgs export web` for browser tests: of random splats or of a wall; opened, driven, and rendered by us."""

import base64
import contextlib
import functools
import http.server
import io
import math
import threading
from pathlib import Path

import numpy as np
import torch
from compact_fields import write_container
from nerfstudio.cameras.cameras import Cameras
from PIL import Image

from nrfgs_lab.scenes.cameras import look_at
from nrfgs_ns.appearance.head import Field
from nrfgs_ns.appearance.nrf import NrfConfig
from nrfgs_ns.compact.encode import encode
from nrfgs_ns.export.web.page import page as page_of
from nrfgs_ns.trained.loading import load_file
from nrfgs_ns.viewer.pictures import BASE, FULL, GREY, legends, picture

SIZE = (320, 240)


class Page:
    """A page in a window of its own, and what it complained about."""

    def __init__(self, browser, address: str, size: tuple[int, int] = SIZE, before: str = "", **context):
        self.page = browser.new_page(viewport={"width": size[0], "height": size[1]}, **context)
        self.page.set_default_timeout(120_000)
        self.is_firefox = browser.browser_type.name == "firefox"
        self.errors: list[str] = []
        self.requests: list[str] = []
        self.page.on("console", lambda said: self.errors.append(said.text) if said.type == "error" else None)
        self.page.on("pageerror", lambda error: self.errors.append(str(error)))
        self.page.on("request", lambda request: self.requests.append(request.url))
        if before:
            self.page.add_init_script(before)
        self.page.goto(address)

    def picture(self) -> torch.Tensor:
        """What the canvas shows when it is finished, [H, W, 3] in [0, 1]."""
        address = self.page.evaluate("nrfgs.finished().then(() => nrfgs.picture())")
        image = Image.open(io.BytesIO(base64.b64decode(address.split(",")[1]))).convert("RGB")
        return torch.from_numpy(np.asarray(image).astype(np.float32) / 255)

    def call(self, name: str, *arguments):
        """Call a function of the page's interface; a promise is waited for."""
        return self.page.evaluate("([name, given]) => nrfgs[name](...given)", [name, list(arguments)])

    def until(self, condition: str) -> None:
        """Wait for a condition; the page's policy forbids what Playwright's own waiting needs."""
        self.page.evaluate(
            f"new Promise((done) => {{ const look = () => (({condition}) ? done() : setTimeout(look, 20)); look(); }})"
        )

    def camera(self) -> tuple[np.ndarray, np.ndarray]:
        """Position and target of a camera that has come to rest."""
        self.call("finished")
        camera = self.call("getCamera")
        return np.array(camera["position"]), np.array(camera["target"])

    def tab(self, name: str) -> None:
        """Open a part of the panel, and its researcher's half."""
        tab = self.page.get_by_role("button", name=name, exact=True)
        if tab.get_attribute("aria-expanded") == "false":
            tab.click()
        for closed in self.page.locator("#panel section:not([hidden]) details:not([open]) summary").all():
            closed.click()

    def set(self, control: str, value: str, event: str) -> None:
        """Give a control a value, whether the panel is open or not."""
        self.page.evaluate(
            "([id, value, event]) => { const control = document.getElementById(id);"
            " if (control.type === 'checkbox') control.checked = value === 'on'; else control.value = value;"
            " control.dispatchEvent(new Event(event)); }",
            [control, value, event],
        )

    def double_click(self, x: int, y: int) -> None:
        """Double-click on the scene. Firefox, driven from outside, counts single clicks only: it gets the event."""
        if self.is_firefox:
            self.page.dispatch_event("#scene", "dblclick", {"clientX": x, "clientY": y})
        else:
            self.page.mouse.dblclick(x, y)

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
    count = 1500
    splats = {
        "means": torch.randn(count, 3) * torch.tensor([1.0, 1.0, 0.5]),
        "quats": torch.randn(count, 4),
        "scales": torch.randn(count, 3) * 0.6 - 2.8,
        "opacities": torch.randn(count, 1) * 2,
        "features_dc": torch.randn(count, 3),
    }
    # The third is inside: splats behind the camera, across it, and beyond the picture's edges.
    eyes = [[3 * math.cos(2.1 * k) * r, 3 * math.sin(2.1 * k) * r, 0.8 * r] for k, r in enumerate((1, 1, 0.2))]
    return written(folder, splats, mode, options), [photograph(str(k), eye) for k, eye in enumerate(eyes)]


def wall_scene(folder: Path) -> tuple[Path, list[dict]]:
    """An opaque wall at x = 0, 4 x 4, and nine photographs from x = 3, which take its distance for 5."""
    y, z = torch.meshgrid(torch.linspace(-2, 2, 33), torch.linspace(-2, 2, 33), indexing="ij")
    means = torch.stack([torch.zeros_like(y), y, z], dim=-1).reshape(-1, 3)
    torch.manual_seed(5)
    splats = {
        "means": means,
        "quats": torch.tensor([[1.0, 0, 0, 0]]).repeat(len(means), 1),
        "scales": torch.tensor([[0.01, 0.1, 0.1]]).log().repeat(len(means), 1),
        "opacities": torch.full((len(means), 1), 4.0),
        "features_dc": torch.randn(len(means), 3),
    }
    eyes = [[3.0, 0.5 * (k % 3 - 1), 0.5 * (k // 3 - 1)] for k in range(9)]
    photographs = [photograph(str(k), eye, [0.0, *eye[1:]]) | {"distance": 5.0} for k, eye in enumerate(eyes)]
    return written(folder, splats, "classic", {}), photographs


def written(folder: Path, splats: dict[str, torch.Tensor], mode: str, options: dict) -> Path:
    """A compact file of splats with a network that was never trained."""
    head = NrfConfig(output_init="default", **options).setup().requires_grad_(False)
    head.scene_unit = 0.7
    for weight in head.parameters():
        weight.mul_(2.0)
    splats["latents"] = torch.randn(len(splats["means"]), head.config.latent_dim)
    render = {"rasterize_mode": mode, "background": [0.1, 0.2, 0.3]}
    write_container(folder / "scene.nrf", *encode(Field(head, splats), render))
    return folder / "scene.nrf"


def photograph(name: str, eye: list[float], aim: list[float] | None = None) -> dict:
    """A photograph's values in a page, from a place towards another, the origin."""
    eye, aim = np.array(eye), np.array(aim or [0.0, 0.0, 0.0])
    pose, distance = look_at(eye, aim)[:3].flatten().tolist(), float(np.linalg.norm(eye - aim))
    place = {"name": f"{name}.png", "pose": pose, "distance": distance}
    return {**place, "lens": [260.0, 250.0, 150.0, 130.0], "size": list(SIZE)}


def page_with(scene: bytes | str, photographs: list[dict], **more) -> str:
    """A page's text; more: values for its scripts, such as a tour."""
    about = {"photographs": photographs, "start": 0, "up": [0, 0, 1], **more}
    poster = io.BytesIO()
    Image.new("RGB", (8, 6), "red").save(poster, "jpeg")
    return page_of(about, poster.getvalue(), scene, "Splats <1 & 2>", 'Me & "you"')


@torch.no_grad()
def rendered(scene: Path, photograph: dict, mode: str = FULL, gain: float = 1.0) -> torch.Tensor:
    """What this project draws of a compact file, [H, W, 3] in [0, 1]; grey is no change of what a field lacks."""
    model, (width, height) = load_file(scene), photograph["size"]
    mode = BASE if mode == "base" else mode  # which the page calls so
    if mode not in legends(model.field):
        return torch.full((height, width, 3), GREY)
    camera = Cameras(torch.tensor(photograph["pose"]).view(1, 3, 4), *photograph["lens"], width, height)
    return picture(model, camera, mode, gain=gain)["rgb"]


@contextlib.contextmanager
def web_server(folder: Path):

    class Quiet(http.server.SimpleHTTPRequestHandler):
        def log_message(self, *_):
            pass

    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=str(folder))) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield f"http://127.0.0.1:{server.server_port}"
        server.shutdown()


def different(picture: torch.Tensor, other: torch.Tensor) -> bool:
    """Whether a difference is visible: more than one pixel in a hundred by more than two levels of 256."""
    return bool(((picture - other).abs().amax(dim=-1) > 2 / 255).float().mean() > 0.01)
