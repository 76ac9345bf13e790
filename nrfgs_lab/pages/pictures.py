# SPDX-License-Identifier: Apache-2.0
"""Pictures of docs/viewer.md; they need a Chromium and `pip install -e '.[browser]'`.

python -m nrfgs_lab.pages.pictures demo/outputs/*/nrfgs/*/config.yml
"""

import sys
import tempfile
from pathlib import Path

from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image, ImageDraw

from nrfgs_lab.bench.crops import GAP, TITLE
from nrfgs_lab.pages.browser import Page, Served, chromium
from nrfgs_ns.viewer.pictures import PictureOptions, legends, picture

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
WIDTH, COLUMNS = 300, 3
"""The sheet of modes: width of one in pixels, and number of columns."""


def sheet(config: Path, view: int = 1) -> None:
    """Write viewer-modes.jpg, every mode of the panel on one test view."""
    _, pipeline, _, _ = eval_setup(config, test_mode="test")
    model = pipeline.model
    camera, _ = pipeline.datamanager.fixed_indices_eval_dataloader[view]
    names = list(legends(model.field))
    height = round(WIDTH * camera.height.item() / camera.width.item())
    rows = -(-len(names) // COLUMNS)
    result = Image.new("RGB", (COLUMNS * (WIDTH + GAP) - GAP, rows * (TITLE + height + GAP) - GAP), "white")
    for i, name in enumerate(names):
        x, y = i % COLUMNS * (WIDTH + GAP), i // COLUMNS * (TITLE + height + GAP)
        pixels = (255 * picture(model, camera, PictureOptions(name))["rgb"]).round().byte().cpu().numpy()
        ImageDraw.Draw(result).text((x + 2, y + 3), name, fill="black")
        result.paste(Image.fromarray(pixels).resize((WIDTH, height), Image.Resampling.LANCZOS), (x, y + TITLE))
    result.save(IMAGES / "viewer-modes.jpg", quality=88)


def viewer(config: Path) -> None:
    """Write viewer.jpg, the page of ns-viewer close to the residual."""
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        with Served(Path(folder) / "log", "--load-config", config) as served:
            page = Page(browser, served.port, 1180, 680)
            page.hide_cameras()
            page.come_closer()
            page.set_resolution(900)
            full = page.settled()
            page.show("residual")
            page.settled(unlike=full)
            page.save(IMAGES / "viewer.jpg")


if __name__ == "__main__":
    sheet(Path(sys.argv[1]))
    viewer(Path(sys.argv[1]))
