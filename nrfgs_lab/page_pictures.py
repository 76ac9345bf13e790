# SPDX-License-Identifier: Apache-2.0
"""Pictures of a page of `nrfgs export web` for the docs, on a desktop and on a phone.

python -m nrfgs_lab.page_pictures PAGE.html OUT    # needs a Chromium and `pip install -e '.[browser]'`
"""

import argparse
from pathlib import Path

from PIL import Image

from nrfgs_lab.pages.browser import PATIENCE, chromium

WINDOWS = {"desktop": ((1280, 760), {}), "phone": ((390, 844), {"has_touch": True, "device_scale_factor": 2})}
SHOWN = {"page": None, "view": "View", "share": "Share"}
"""Pictures of each window: the part of the panel that is open."""
HEIGHT, GAP = 600, 16
"""Pixels of the docs' picture, and of the gap between its two halves."""


def pictures(page: Path, folder: Path) -> list[Path]:
    """Write WINDOW-PICTURE.jpg for each of both, and web.jpg, the docs' picture; return their paths. The page's tour
    does not run: it begins at the photograph that the export chose."""
    folder.mkdir(parents=True, exist_ok=True)
    written = []
    with chromium() as browser:
        for window, ((width, height), options) in WINDOWS.items():
            viewport = {"width": width, "height": height}
            tab = browser.new_page(viewport=viewport, reduced_motion="reduce", **options)
            tab.set_default_timeout(1000 * PATIENCE)
            tab.goto(page.resolve().as_uri())
            tab.evaluate("nrfgs.ready")
            for name, part in SHOWN.items():
                if part:
                    tab.get_by_role("button", name=part, exact=True).click()
                tab.evaluate("nrfgs.finished()")
                written.append(folder / f"{window}-{name}.jpg")
                tab.screenshot(path=written[-1], type="jpeg", quality=85)
            tab.close()
    shown = [Image.open(folder / name) for name in ("desktop-view.jpg", "phone-page.jpg")]
    shown = [image.resize((image.width * HEIGHT // image.height, HEIGHT)) for image in shown]
    pair = Image.new("RGB", (sum(image.width for image in shown) + GAP, HEIGHT), "white")
    pair.paste(shown[0])
    pair.paste(shown[1], (shown[0].width + GAP, 0))
    written.append(folder / "web.jpg")
    pair.save(written[-1], quality=85)
    return written


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("page", type=Path, help="page of nrfgs export web, one file")
    parser.add_argument("folder", type=Path, help="folder for the pictures")
    options = parser.parse_args()
    for path in pictures(options.page, options.folder):
        print(path)


if __name__ == "__main__":
    main()
