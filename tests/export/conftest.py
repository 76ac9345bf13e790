# SPDX-License-Identifier: Apache-2.0
import functools

import pytest
from short_trainings import PLAIN, command_line, trained
from web_pages import Page, page_with, wall_scene

from nrfgs_lab.pages import pictures as browsers
from nrfgs_ns.export.command import Web


@pytest.fixture(scope="module", params=["chromium", "firefox"])
def browser(request):
    """Both browsers, one after the other; skips where there is none."""
    pytest.importorskip("playwright.sync_api", reason="no playwright: pip install -e '.[browser]'")
    try:
        with getattr(browsers, request.param)() as browser:
            yield browser
    except FileNotFoundError as error:
        pytest.skip(str(error))


@pytest.fixture(scope="session")
def demo(tiny_scene, tmp_path_factory):
    """config.yml of a short training on the procedural scene, and its page."""
    folder = tmp_path_factory.mktemp("demo")
    options = {
        "--pipeline.model.densification": "splatfacto,warmup_length=20,refine_every=20",
        "--pipeline.model.rasterize-mode": "antialiased",
        "--optimizers.field.optimizer.lr": 0.05,  # something to show after a few steps
    }
    config = trained(command_line("nrfgs", tiny_scene, folder, 80, PLAIN, options))
    Web(config, output=folder / "page.html").main()
    return config, folder / "page.html"


@pytest.fixture
def opened(browser):
    """Open an address in a window of its own, which ends without an error in its console; `begun`: wait for it."""
    pages = []

    def page(address, *window, begun=True, **context) -> Page:
        pages.append(Page(browser, address, *window, **context))
        if begun:
            pages[-1].page.evaluate("nrfgs.ready")
        return pages[-1]

    yield page
    for page in pages:
        assert not page.errors
        page.page.close()


@pytest.fixture
def on_demo(opened, demo):
    """Open the page of `demo`, in a window of a size."""
    return functools.partial(opened, demo[1].as_uri())


@pytest.fixture
def wall(opened, tmp_path):
    """Open a page of a wall; `more`: values for its scripts; `tail`: of its address."""

    def page(size=(320, 240), before="", tail="", **more):
        scene, photographs = wall_scene(tmp_path)
        (tmp_path / "page.html").write_text(page_with(scene.read_bytes(), photographs, **more))
        return opened((tmp_path / "page.html").as_uri() + tail, size, before)

    return page
