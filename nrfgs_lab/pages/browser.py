# SPDX-License-Identifier: Apache-2.0
"""Browsers, and nerfstudio's viewer in one, for tests of pages and the pictures in the docs.

pip install -e '.[browser]'; apt-get install chromium; for Firefox: apt-get install firefox-esr xvfb
"""

import contextlib
import io
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
from PIL import Image

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FIREFOX = shutil.which("firefox") or shutil.which("firefox-esr")
PATIENCE = 300
"""Seconds to wait for anything on a slow, busy machine."""


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


class Served:
    """ns-viewer on a CPU, with PNG pictures, until the block ends.

    Args:
        log: file for its output.
        options: words before the viewer's.
    """

    def __init__(self, log: Path, *options):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        viewer = {"websocket-host": "127.0.0.1", "websocket-port": self.port, "image-format": "png"}
        words = [*(word for name, value in viewer.items() for word in (f"--viewer.{name}", value))]
        code = "import sys; from nerfstudio.scripts.viewer.run_viewer import entrypoint; sys.exit(entrypoint())"
        self.log = log
        with log.open("w") as out:
            self.process = subprocess.Popen(
                [sys.executable, "-c", code, *map(str, [*options, *words])],
                stdout=out,
                stderr=subprocess.STDOUT,
                env={**os.environ, "CUDA_VISIBLE_DEVICES": ""},
            )

    def __enter__(self) -> "Served":
        deadline = time.time() + PATIENCE
        while time.time() < deadline and self.process.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return self
            time.sleep(0.5)
        self.stop()
        raise AssertionError(f"the viewer did not start:\n{self.log.read_text()[-3000:]}")

    def __exit__(self, *_) -> None:
        self.stop()

    def stop(self) -> None:
        """Press Ctrl-C."""
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Page:
    """The viewer's page, in a window of `width` x `height` pixels."""

    def __init__(self, browser, port: int, width: int = 1000, height: int = 800):
        self.page = browser.new_page(viewport={"width": width, "height": height})
        self.page.set_default_timeout(1000 * PATIENCE)
        # No fonts and logos of other sites: there may be no network.
        self.page.route(re.compile(r"^https?://(?!127\.0\.0\.1)"), lambda route: route.abort())
        self.page.goto(f"http://127.0.0.1:{port}", wait_until="domcontentloaded")
        self.page.get_by_text("Residual gain", exact=True).wait_for()
        self.scene = {"x": 0, "y": 80, "width": width - 360, "height": height - 100}

    def control(self, label: str):
        """Input in the row of a label."""
        name = self.page.get_by_text(label, exact=True).first
        return name.locator("xpath=ancestor::*[.//input][1]").locator("input:not([type=hidden])").last

    def show(self, mode: str) -> None:
        """Choose a mode of the panel."""
        self.control("Show").click()
        self.page.get_by_role("option", name=mode, exact=True).click()

    def enter(self, label: str, number: float) -> None:
        """Enter a number in the row of a label."""
        self.control(label).fill(f"{number:g}")
        self.control(label).press("Enter")

    def hide_cameras(self) -> None:
        """Hide the training cameras."""
        self.page.get_by_text("Hide Train Cams").click()

    def come_closer(self, amount: int = 400) -> None:
        """Turn the mouse's wheel over the scene."""
        self.page.mouse.move(self.scene["x"] + self.scene["width"] // 2, self.scene["y"] + self.scene["height"] // 2)
        self.page.mouse.wheel(0, -amount)

    def set_resolution(self, pixels: int) -> None:
        """Set the longer side of the picture."""
        self.enter("Max res", pixels)

    def shot(self) -> np.ndarray:
        """Picture of the scene now, [H, W, 3] in 0..255."""
        png = self.page.screenshot(clip=self.scene)
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(np.float32)

    def settled(self, unlike: np.ndarray | None = None) -> np.ndarray:
        """Wait until the picture has full size, has not changed for two seconds, and differs from `unlike`; return it.

        The viewer renders small first, which may last on a busy machine: the size is checked before and after.
        """
        deadline, since, last, was_full = time.time() + PATIENCE, time.time(), self.shot(), False
        while time.time() < deadline:
            time.sleep(0.3)
            is_full = self.is_full_size()
            now = self.shot()
            if different(now, last) or not (is_full and was_full):
                since = time.time()
            last, was_full = now, is_full
            there = now.std() > 1 and (unlike is None or different(now, unlike))
            if there and time.time() - since > 2:
                return now
        raise AssertionError("the picture did not change" if unlike is not None else "no picture came to rest")

    def is_full_size(self) -> bool:
        """Whether the latest picture has full size."""
        sides = re.search(r"Resolution:\s*(\d+)x(\d+)px", self.page.inner_text("body"))
        return sides is not None and max(map(int, sides.groups())) == int(self.control("Max res").input_value())

    def save(self, path: Path, quality: int = 85) -> None:
        """Write the page as a JPEG, without the logo, which comes from another site."""
        self.page.add_style_tag(content="img { visibility: hidden }")
        path.parent.mkdir(parents=True, exist_ok=True)
        self.page.screenshot(path=path, type="jpeg", quality=quality)


def different(picture: np.ndarray, other: np.ndarray) -> bool:
    """Whether the difference is visible: more than one pixel in a hundred by more than two levels of 256."""
    return bool((np.abs(picture - other).max(axis=-1) > 2).mean() > 0.01)
