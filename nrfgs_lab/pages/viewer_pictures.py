# SPDX-License-Identifier: Apache-2.0
"""The pictures of docs/viewer.md, from a finished training of the demo scene.

    nrfgs demo
    python -m nrfgs_lab.pages.viewer_pictures demo/outputs/*/nrfgs/*/config.yml

Writes docs/images/viewer-modes.jpg, every mode of the panel on one test view, and docs/images/viewer.jpg, the page of
ns-viewer in a headless Chromium (`pip install -e '.[browser]'`), which shows the residual.
"""

import argparse
import tempfile
from pathlib import Path

from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image, ImageDraw

from nrfgs_lab.pages.browser import VIEWER, Page, Served, chromium
from nrfgs_ns.viewer.pictures import Shown, modes, picture

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
WIDTH = 300
"""Of one mode's picture, pixels."""
COLUMNS, GAP, TITLE = 3, 4, 18


def sheet(config: Path, view: int) -> Image.Image:
    """Every mode on one test view, each with its name above it."""
    _, pipeline, _, _ = eval_setup(config, test_mode="test")
    model = pipeline.model
    camera, _ = pipeline.datamanager.fixed_indices_eval_dataloader[view]
    names = modes(model.field)
    height = round(WIDTH * camera.height.item() / camera.width.item())
    rows = -(-len(names) // COLUMNS)
    size = (COLUMNS * (WIDTH + GAP) - GAP, rows * (TITLE + height + GAP) - GAP)
    page = Image.new("RGB", size, "white")
    draw = ImageDraw.Draw(page)
    for i, name in enumerate(names):
        x, y = i % COLUMNS * (WIDTH + GAP), i // COLUMNS * (TITLE + height + GAP)
        pixels = (255 * picture(model, camera, Shown(name))["rgb"]).round().byte().cpu().numpy()
        draw.text((x + 2, y + 3), name, fill="black")
        page.paste(Image.fromarray(pixels).resize((WIDTH, height), Image.Resampling.LANCZOS), (x, y + TITLE))
    return page


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.split("\n")[0])
    parser.add_argument("config", type=Path, help="config.yml of the training")
    parser.add_argument("--view", type=int, default=1, help="which test view")
    options = parser.parse_args()
    sheet(options.config, options.view).save(IMAGES / "viewer-modes.jpg", quality=88)
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        with Served(VIEWER, Path(folder) / "log", "--load-config", options.config) as viewer:
            page = Page(browser, viewer.port, width=1180, height=680)
            page.hide_cameras()
            page.come_closer()
            page.set_resolution(900)
            full = page.settled()
            page.show("residual")
            page.settled(unlike=full)
            page.save(IMAGES / "viewer.jpg")


if __name__ == "__main__":
    main()
