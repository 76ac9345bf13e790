# SPDX-License-Identifier: Apache-2.0
"""Pictures of the docs, and browsers for them and for tests of pages.

pip install -e '.[browser]'; apt-get install chromium; for Firefox: apt-get install firefox-esr xvfb

python -m nrfgs_lab.pages.pictures demo/outputs/*/nrfgs/*/config.yml    # docs/viewer.md: the viewer, and its modes
python -m nrfgs_lab.pages.pictures PAGE.html OUT    # a page of `nrfgs export web`, on a desktop and on a phone
python -m nrfgs_lab.pages.pictures THEIRS OURS    # README.md: `pictures` of two benched trainings with `quick: false`
"""

import contextlib
import os
import re
import shutil
import subprocess
import sys
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path

import numpy as np
from PIL import Image
from scipy.spatial.transform import Rotation

from nrfgs_lab.sheets import picture, sheet

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FIREFOX = shutil.which("firefox") or shutil.which("firefox-esr")
IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
PATIENCE, REST = 300_000, 60_000
"""Milliseconds to wait for anything on a slow, busy machine, and until the viewer's picture is whole."""
PORT = 7011  # Of the viewer.
WIDTH, COLUMNS = 300, 3  # The sheet of modes: width of one in pixels, and number of columns.
WINDOWS = {"desktop": ((1280, 760), {}), "phone": ((390, 844), {"has_touch": True, "device_scale_factor": 2})}
SHOWN = {"page": None, "view": "View", "share": "Share"}
"""Pictures of each window: the part of the panel that is open."""
HEIGHT, BETWEEN = 600, 16  # Pixels of the picture of a page, and of the gap between its two halves.
NAMES = "photograph", "splatfacto", "nrfgs"  # In the picture of test views.
SWING, FRAMES = 0.35, 40  # Of the moving picture: radians to each side, and pictures.
PICTURE = {"x": 0, "y": 0, "width": 1130, "height": 700}  # The part of the page that it shows, without the buttons.


@contextlib.contextmanager
def chromium() -> Iterator:
    """A headless browser, without a GPU; FileNotFoundError if there is no Chromium on the path."""
    from playwright.sync_api import sync_playwright

    if CHROMIUM is None:
        raise FileNotFoundError("no Chromium on the path: apt-get install chromium")
    # Without a GPU WebGL needs Chromium's software renderer.
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
        yield browser
        browser.close()


@contextlib.contextmanager
def firefox() -> Iterator:
    """A Firefox of the system's on a screen of its own, because a headless one has no WebGL without a GPU;
    FileNotFoundError if Firefox or Xvfb is not on the path."""
    from playwright.sync_api import sync_playwright

    if FIREFOX is None or shutil.which("Xvfb") is None:
        raise FileNotFoundError("no Firefox and Xvfb on the path: apt-get install firefox-esr xvfb")
    ours, theirs = os.pipe()
    command = ["Xvfb", "-displayfd", str(theirs), "-screen", "0", "1600x1200x24", "-nolisten", "tcp"]
    screen = subprocess.Popen(command, pass_fds=[theirs], stderr=subprocess.DEVNULL)
    os.close(theirs)
    try:
        with os.fdopen(ours) as told, sync_playwright() as playwright:
            display = f":{int(told.readline())}"
            browser = playwright.firefox.launch(
                channel="moz-firefox",
                executable_path=FIREFOX,
                headless=False,
                # The panel of downloads would take the focus from the page.
                firefox_user_prefs={"webgl.force-enabled": True, "browser.download.alwaysOpenPanel": False},
                env={**os.environ, "DISPLAY": display},
            )
            yield browser
            browser.close()
    finally:
        screen.terminate()
        screen.wait()


def modes(config: Path, view: int = 1) -> None:
    """Write viewer-modes.jpg, every mode of the panel on one test view."""
    from nerfstudio.utils.eval_utils import eval_setup  # takes seconds

    from nrfgs_ns.viewer import pictures as viewed

    _, pipeline, _, _ = eval_setup(config, test_mode="test")
    model = pipeline.model
    camera, _ = pipeline.datamanager.fixed_indices_eval_dataloader[view]
    size = WIDTH, round(WIDTH * camera.height.item() / camera.width.item())
    shown = []
    for name in viewed.legends(model.field):
        rgb = viewed.picture(model, camera, name)["rgb"]
        shown.append((name, picture(rgb.cpu()).resize(size, Image.Resampling.LANCZOS)))
    result = sheet([shown[first : first + COLUMNS] for first in range(0, len(shown), COLUMNS)])
    result.save(IMAGES / "viewer-modes.jpg", quality=88)


def viewer(config: Path) -> None:
    """Write viewer.jpg, the page of `nrfgs view` close to the residual."""
    command = [sys.executable, "-m", "nrfgs_ns.cli", "view", str(config), "--port", str(PORT)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server, chromium() as browser:
        try:
            next(line for line in server.stdout if str(PORT) in line)  # it listens
            tab = browser.new_page(viewport={"width": 1180, "height": 680})
            tab.set_default_timeout(PATIENCE)
            # No fonts and logos of other sites: there may be no network.
            tab.route(re.compile(r"^https?://(?!127\.0\.0\.1)"), lambda route: route.abort())
            tab.goto(f"http://127.0.0.1:{PORT}", wait_until="domcontentloaded")
            tab.get_by_text("Hide Train Cams").click()
            tab.mouse.move(410, 340)
            tab.mouse.wheel(0, -400)
            _control(tab, "Max res").fill("900")
            _control(tab, "Max res").press("Enter")
            _control(tab, "Show").click()
            tab.get_by_role("option", name="residual", exact=True).click()
            tab.wait_for_timeout(REST)
            tab.add_style_tag(content="img { visibility: hidden }")  # the logo, of another site
            tab.screenshot(path=IMAGES / "viewer.jpg", type="jpeg", quality=85)
        finally:
            server.terminate()


def _control(tab, label: str):
    """Input in the row of a label."""
    row = tab.get_by_text(label, exact=True).first.locator("xpath=ancestor::*[.//input][1]")
    return row.locator("input:not([type=hidden])").last


def page(path: Path, folder: Path) -> None:
    """Write WINDOW-PICTURE.jpg for each of both, and web.jpg, the docs' picture. The page's tour does not run: the page
    begins at the photograph that the export chose."""
    folder.mkdir(parents=True, exist_ok=True)
    with chromium() as browser:
        for window, ((width, height), options) in WINDOWS.items():
            viewport = {"width": width, "height": height}
            tab = browser.new_page(viewport=viewport, reduced_motion="reduce", **options)
            tab.set_default_timeout(PATIENCE)
            tab.goto(path.resolve().as_uri())
            tab.evaluate("nrfgs.ready")
            if window == "desktop":
                swing(tab, folder / "swing.webp")
            for name, part in SHOWN.items():
                if part:
                    tab.get_by_role("button", name=part, exact=True).click()
                tab.evaluate("nrfgs.finished()")
                tab.screenshot(path=folder / f"{window}-{name}.jpg", type="jpeg", quality=85)
            tab.close()
    shown = [Image.open(folder / name) for name in ("desktop-view.jpg", "phone-page.jpg")]
    shown = [("", image.resize((image.width * HEIGHT // image.height, HEIGHT))) for image in shown]
    sheet([shown], gap=BETWEEN).save(folder / "web.jpg", quality=85)


def swing(tab, file: Path) -> None:
    """Write a moving picture of a page whose camera swings about its target and back."""
    began, shown = tab.evaluate("nrfgs.getCamera()"), []
    position, target, up = (np.array(began[name]) for name in ("position", "target", "up"))
    for angle in SWING * np.sin(2 * np.pi * np.arange(FRAMES) / FRAMES):
        turned = Rotation.from_rotvec(angle * up / np.linalg.norm(up)).apply(position - target) + target
        tab.evaluate("camera => (nrfgs.setCamera(camera), nrfgs.finished())", began | {"position": turned.tolist()})
        shown.append(Image.open(BytesIO(tab.screenshot(clip=PICTURE))).resize((480, 297)))
    shown[0].save(file, save_all=True, append_images=shown[1:], duration=80, loop=0, quality=55, method=6)
    tab.evaluate("camera => nrfgs.setCamera(camera)", began)


def beside(theirs: Path, ours: Path) -> None:
    """Write views.jpg: the test views of the median and the largest gain over a training, from pictures of both."""
    rows = []
    for files in zip(*(sorted(folder.glob("*.png")) for folder in (theirs, ours)), strict=True):
        (truth, first), (_, second) = (np.split(np.asarray(Image.open(file)) / 255, 2, axis=1) for file in files)
        gain = np.log(np.square(first - truth).mean() / np.square(second - truth).mean())
        rows.append((gain, list(zip(NAMES, map(picture, (truth, first, second)), strict=True))))
    rows.sort(key=lambda row: row[0])
    sheet([rows[len(rows) // 2][1], rows[-1][1]], title=36, font=26).save(IMAGES / "views.jpg", quality=80)


if __name__ == "__main__":
    first, *others = map(Path, sys.argv[1:])
    if first.is_dir():
        beside(first, *others)
    elif others:
        page(first, *others)
    else:
        modes(first)
        viewer(first)
