# SPDX-License-Identifier: Apache-2.0
"""Browsers for tests of pages and the pictures in the docs.

pip install -e '.[browser]'; apt-get install chromium; for Firefox: apt-get install firefox-esr xvfb
"""

import contextlib
import os
import shutil
import subprocess
from collections.abc import Iterator

CHROMIUM = shutil.which("chromium") or shutil.which("chromium-browser") or shutil.which("google-chrome")
FIREFOX = shutil.which("firefox") or shutil.which("firefox-esr")


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
