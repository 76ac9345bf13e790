# SPDX-License-Identifier: Apache-2.0
"""Pictures of the pages; those of the viewer need a Chromium and `pip install -e '.[browser]'`.

python -m nrfgs_lab.pages.pictures viewer demo/outputs/*/nrfgs/*/config.yml    # docs/viewer.md
python -m nrfgs_lab.pages.pictures newcomer SCENE                              # docs/own-data.md, from nrfgs prepare
"""

import sys
import tempfile
import time
from pathlib import Path

from nerfstudio.utils.eval_utils import eval_setup
from PIL import Image, ImageDraw

from nrfgs_lab.bench.crops import GAP, TITLE
from nrfgs_lab.pages.browser import TRAIN, VIEWER, Page, Served, chromium
from nrfgs_ns.viewer.pictures import PictureOptions, legends, picture

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
WINDOW = 1180, 680
WIDTH, COLUMNS = 300, 3
"""The sheet of modes: width of one in pixels, and number of columns."""
STEPS, WATCHED = 800, 200
"""Training steps of a newcomer, and the step at which the page is photographed."""


def viewer(config: Path, view: int = 1) -> None:
    """Write viewer-modes.jpg, every mode of the panel on one test view, and viewer.jpg, the page with the residual."""
    _, pipeline, _, _ = eval_setup(config, test_mode="test")
    model = pipeline.model
    camera, _ = pipeline.datamanager.fixed_indices_eval_dataloader[view]
    names = list(legends(model.field))
    height = round(WIDTH * camera.height.item() / camera.width.item())
    rows = -(-len(names) // COLUMNS)
    sheet = Image.new("RGB", (COLUMNS * (WIDTH + GAP) - GAP, rows * (TITLE + height + GAP) - GAP), "white")
    for i, name in enumerate(names):
        x, y = i % COLUMNS * (WIDTH + GAP), i // COLUMNS * (TITLE + height + GAP)
        pixels = (255 * picture(model, camera, PictureOptions(name))["rgb"]).round().byte().cpu().numpy()
        ImageDraw.Draw(sheet).text((x + 2, y + 3), name, fill="black")
        sheet.paste(Image.fromarray(pixels).resize((WIDTH, height), Image.Resampling.LANCZOS), (x, y + TITLE))
    sheet.save(IMAGES / "viewer-modes.jpg", quality=88)
    page_of(config, IMAGES / "viewer.jpg", closer=True)


def page_of(config: Path, out: Path, closer: bool = False) -> None:
    """Photograph the page of ns-viewer, as it opens, or close to the residual."""
    with tempfile.TemporaryDirectory() as folder, chromium() as browser:
        with Served(VIEWER, Path(folder) / "log", "--load-config", config) as served:
            page = Page(browser, served.port, *WINDOW)
            page.hide_cameras()
            if closer:
                page.come_closer()
            page.set_resolution(900)
            full = page.settled()
            if closer:
                page.show("residual")
                page.settled(unlike=full)
            page.save(out)


def newcomer(scene: Path) -> None:
    """Write first-scene-training.jpg, a training's page at step 200, and first-scene-viewer.jpg, the result's."""
    words = ["nrfgs", "--data", scene, "--max-num-iterations", STEPS, "--pipeline.model.num-downscales", 0]
    data = ["nrfgs-data", "--downscale-factor", 4]
    with tempfile.TemporaryDirectory() as name, chromium() as browser:
        folder = Path(name)
        with Served(TRAIN, folder / "log", *words, "--output-dir", folder, tail=data) as training:
            page = Page(browser, training.port, *WINDOW)
            while page.step() < WATCHED:
                time.sleep(0.5)
            page.hide_cameras()
            time.sleep(5)  # while it trains, the picture never rests
            page.save(IMAGES / "first-scene-training.jpg")
            page.page.close()  # drawing takes time from the training
            while not list(folder.rglob(f"step-{STEPS - 1:09d}.ckpt")):
                assert training.process.poll() is None, training.log.read_text()[-3000:]
                time.sleep(0.5)
        page_of(next(folder.rglob("config.yml")), IMAGES / "first-scene-viewer.jpg")


if __name__ == "__main__":
    {"viewer": viewer, "newcomer": newcomer}[sys.argv[1]](*map(Path, sys.argv[2:]))
