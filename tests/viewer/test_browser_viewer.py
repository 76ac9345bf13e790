# SPDX-License-Identifier: Apache-2.0
"""The viewer in a real browser: a headless Chromium opens the page of a running training, and of a finished one.

    pip install -e '.[browser]'; apt-get install chromium; pytest -m browser

Pictures are compared as the screen shows them. The viewer sends PNG here, so that what looks the same is the same.
"""

import re
import time
from itertools import combinations

import pytest

from nrfgs_lab.pages.browser import PATIENCE, TRAIN, VIEWER, Page, Served, different
from nrfgs_ns.viewer.pictures import BASE, DEPTH, FULL, VIEW_DEPENDENCE

pytestmark = [pytest.mark.browser, pytest.mark.timeout(900)]

pytest.importorskip("playwright.sync_api", reason="no playwright: pip install -e '.[browser]'")
FIELD = ["residual", "low branch", "high branch", "gate weight", "opacity residual"]
MODES = [FULL, BASE, *FIELD, VIEW_DEPENDENCE, DEPTH]


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
        "--pipeline.model.few-views": "off",
        "--pipeline.model.shrinkage": 0,
        "--pipeline.model.densification": "splatfacto,warmup_length=20,refine_every=20",
        "--optimizers.field.optimizer.lr": 0.05,  # something to show after a few steps
    }
    words = [word for option in options.items() for word in option]
    with Served(TRAIN, out / "train.log", "nrfgs", *words) as command:
        yield command, out


def test_every_mode_of_a_running_training(browser, training):
    page = Page(browser, training[0].port)
    deadline = time.time() + PATIENCE
    while page.step() < 60:
        assert time.time() < deadline and training[0].process.poll() is None, training[0].log.read_text()[-3000:]
        time.sleep(0.5)
    assert re.fullmatch(r"[\d,]+", page.control("Splats").input_value())
    page.page.get_by_text("Pause Training").click()
    page.hide_cameras()
    at_pause = page.step()
    page.set_resolution(164)  # so that the full size comes soon behind the small one

    # What is on the screen is some steps old: the viewer does not render each, and not the last.
    old = page.settled()
    page.show(BASE)
    stale = page.settled(unlike=old)
    page.show(FULL)
    pictures = {FULL: page.settled(unlike=stale)}
    for mode, before in zip(MODES[1:], MODES, strict=False):
        page.show(mode)
        pictures[mode] = page.settled(unlike=pictures[before])
    for one, other in combinations(MODES, 2):
        assert different(pictures[one], pictures[other]), (one, other)

    page.show(FULL)
    page.returns_to(pictures[FULL])
    page.set_gain(0)
    page.returns_to(pictures[BASE])
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


def test_a_finished_training_in_ns_viewer(browser, training, tmp_path):
    """The checkpoint that the training above leaves when it is stopped."""
    command, out = training
    (config,) = out.rglob("config.yml")
    deadline = time.time() + PATIENCE
    while not list(config.parent.glob("nerfstudio_models/*.ckpt")):
        assert time.time() < deadline and command.process.poll() is None, command.log.read_text()[-3000:]
        time.sleep(0.5)
    command.stop()
    with Served(VIEWER, tmp_path / "log", "--load-config", config) as viewer:
        page = Page(browser, viewer.port)
        page.hide_cameras()
        full = page.settled()
        page.show("gate weight")
        page.settled(unlike=full)
        page.page.close()
