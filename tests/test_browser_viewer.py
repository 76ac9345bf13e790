# SPDX-License-Identifier: Apache-2.0
"""The viewer in a real browser: a headless Chromium opens the page of a running training, and of a finished one.

    pip install -e '.[browser]'; apt-get install chromium; pytest -m browser

Pictures are compared as the screen shows them. The viewer sends PNG here, so that what looks the same is the same.
"""

import io
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from nrfgs_ns.viewer import BASE, DEPTH, FULL, VIEW_DEPENDENCE

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]

sync_api = pytest.importorskip("playwright.sync_api", reason="no playwright: pip install -e '.[browser]'")
CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
MODES = [
    FULL,
    BASE,
    "residual",
    "low branch",
    "high branch",
    "gate weight",
    "opacity residual",
    VIEW_DEPENDENCE,
    DEPTH,
]
PATIENCE = 120
"""Seconds in which anything must have happened, on a slow and busy machine."""


@pytest.fixture(scope="module")
def chromium():
    if CHROMIUM is None:
        pytest.skip("no Chromium on the path: apt-get install chromium")
    # Without a GPU WebGL needs Chromium's software renderer.
    flags = ["--no-sandbox", "--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--ignore-gpu-blocklist"]
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=flags)
        yield browser
        browser.close()


class Command:
    """A nerfstudio command that serves the viewer until the block ends."""

    def __init__(self, entry: str, log: Path, *options):
        with socket.socket() as free:
            free.bind(("127.0.0.1", 0))
            self.port = free.getsockname()[1]
        viewer = {"websocket-host": "127.0.0.1", "websocket-port": self.port, "image-format": "png"}
        words = [*options, *(word for name, value in viewer.items() for word in (f"--viewer.{name}", value))]
        module, function = entry.split(":")
        code = f"import sys; from {module} import {function}; sys.exit({function}())"
        self.log = log
        with log.open("w") as out:
            self.process = subprocess.Popen(
                [sys.executable, "-c", code, *map(str, words)],
                stdout=out,
                stderr=subprocess.STDOUT,
                env={**os.environ, "CUDA_VISIBLE_DEVICES": ""},
            )

    def __enter__(self):
        deadline = time.time() + PATIENCE
        while time.time() < deadline and self.process.poll() is None:
            with socket.socket() as probe:
                if probe.connect_ex(("127.0.0.1", self.port)) == 0:
                    return self
            time.sleep(0.5)
        self.stop()
        raise AssertionError(f"the viewer did not start:\n{self.log.read_text()[-3000:]}")

    def __exit__(self, *_):
        self.stop()

    def stop(self) -> None:
        self.process.send_signal(signal.SIGINT)
        try:
            self.process.wait(20)
        except subprocess.TimeoutExpired:
            self.process.kill()
            self.process.wait()


class Page:
    """The viewer's page, in the words of somebody who uses it."""

    def __init__(self, browser, port: int):
        self.page = browser.new_page(viewport={"width": 1000, "height": 800})
        self.page.set_default_timeout(1000 * PATIENCE)
        # Fonts and logos of other sites: their absence is not ours to wait for.
        self.page.route(re.compile(r"^https?://(?!127\.0\.0\.1)"), lambda route: route.abort())
        self.page.goto(f"http://127.0.0.1:{port}", wait_until="domcontentloaded")
        self.page.get_by_text("Residual gain", exact=True).wait_for()

    def control(self, label: str):
        """The input in the row of this label."""
        name = self.page.get_by_text(label, exact=True).first
        return name.locator("xpath=ancestor::*[.//input][1]").locator("input:not([type=hidden])").last

    def show(self, mode: str) -> None:
        self.control("Show").click()
        self.page.get_by_role("option", name=mode, exact=True).click()

    def set_gain(self, gain: float) -> None:
        self.control("Residual gain").fill(f"{gain:g}")
        self.control("Residual gain").press("Enter")

    def step(self) -> int:
        return int(re.search(r"Step:\s*(\d+)", self.page.inner_text("body")).group(1))

    def turn(self) -> None:
        """Drag the mouse across the scene."""
        self.page.mouse.move(250, 450)
        self.page.mouse.down()
        self.page.mouse.move(400, 430, steps=8)
        self.page.mouse.up()

    def shot(self) -> np.ndarray:
        """What the scene looks like now, [H, W, 3]."""
        png = self.page.screenshot(clip={"x": 0, "y": 80, "width": 640, "height": 700})
        return np.asarray(Image.open(io.BytesIO(png)).convert("RGB")).astype(np.float32)

    def settled(self, unlike: np.ndarray | None = None) -> np.ndarray:
        """The picture, as soon as it is one, has not changed for two seconds, and differs from the one given.

        The viewer first renders small, then at full size: two seconds are several times the pause between them.
        """
        deadline, since, last = time.time() + PATIENCE, time.time(), self.shot()
        while time.time() < deadline:
            time.sleep(0.3)
            now = self.shot()
            if different(now, last):
                since = time.time()
            last = now
            there = now.std() > 1 and (unlike is None or different(now, unlike))
            if there and time.time() - since > 2:
                return now
        raise AssertionError("the picture did not change" if unlike is not None else "no picture came to rest")


def different(one: np.ndarray, other: np.ndarray) -> bool:
    """Whether somebody would see it: at least one pixel in a hundred differs by more than two levels of 256."""
    return bool((np.abs(one - other).max(axis=-1) > 2).mean() > 0.01)


@pytest.fixture(scope="module")
def training(tiny_scene, tmp_path_factory):
    """A training that goes on until it is stopped, and its output folder."""
    out = tmp_path_factory.mktemp("browser")
    options = {
        "--data": tiny_scene,
        "--output-dir": out,
        "--max-num-iterations": 1_000_000,
        "--steps-per-save": 30,
        "--logging.profiler": "none",
        "--pipeline.model.num-downscales": 0,
        "--pipeline.model.refine-every": 20,
        "--pipeline.model.warmup-length": 20,
        "--optimizers.field.optimizer.lr": 0.05,  # something to show after a few steps
    }
    words = [word for option in options.items() for word in option]
    with Command("nerfstudio.scripts.train:entrypoint", out / "train.log", "nrfgs", *words) as command:
        yield command, out


def test_every_mode_of_a_running_training(chromium, training):
    page = Page(chromium, training[0].port)
    deadline = time.time() + PATIENCE
    while page.step() < 60:
        assert time.time() < deadline and training[0].process.poll() is None, training[0].log.read_text()[-3000:]
        time.sleep(0.5)
    assert re.fullmatch(r"[\d,]+", page.control("Splats").input_value())
    page.page.get_by_text("Pause Training").click()
    page.page.get_by_text("Hide Train Cams").click()
    at_pause = page.step()

    # What is on the screen is some steps old: the viewer does not render each, and not the last.
    page.show(BASE)
    stale = page.settled()
    page.show(FULL)
    pictures = {FULL: page.settled(unlike=stale)}
    for mode, before in zip(MODES[1:], MODES, strict=False):
        page.show(mode)
        pictures[mode] = page.settled(unlike=pictures[before])
    for one, other in combinations(MODES, 2):
        assert different(pictures[one], pictures[other]), (one, other)

    page.show(FULL)
    assert not different(page.settled(unlike=pictures[DEPTH]), pictures[FULL])
    page.set_gain(0)
    assert not different(page.settled(unlike=pictures[FULL]), pictures[BASE])
    page.set_gain(2)
    doubled = page.settled(unlike=pictures[BASE])
    assert different(doubled, pictures[FULL])
    page.set_gain(1)
    page.settled(unlike=doubled)

    page.show("residual")
    page.settled(unlike=pictures[FULL])
    page.control("Freeze view").check()
    page.settled()
    page.turn()
    frozen = page.settled(unlike=pictures["residual"])
    page.control("Freeze view").uncheck()
    page.settled(unlike=frozen)

    page.page.get_by_text("Resume Training").click()
    deadline = time.time() + PATIENCE
    while page.step() <= at_pause + 30:
        assert time.time() < deadline and training[0].process.poll() is None, "training did not go on"
        time.sleep(0.5)
    page.page.close()


def test_a_finished_training_in_ns_viewer(chromium, training, tmp_path):
    """The checkpoint that the training above leaves when it is stopped."""
    command, out = training
    (config,) = out.rglob("config.yml")
    deadline = time.time() + PATIENCE
    while not list(config.parent.glob("nerfstudio_models/*.ckpt")):
        assert time.time() < deadline and command.process.poll() is None, command.log.read_text()[-3000:]
        time.sleep(0.5)
    command.stop()
    with Command(
        "nerfstudio.scripts.viewer.run_viewer:entrypoint", tmp_path / "log", "--load-config", config
    ) as viewer:
        page = Page(chromium, viewer.port)
        page.page.get_by_text("Hide Train Cams").click()
        full = page.settled()
        page.show("gate weight")
        page.settled(unlike=full)
        page.page.close()
