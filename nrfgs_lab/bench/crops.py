# SPDX-License-Identifier: Apache-2.0
"""Crops of test views, from `ns-eval`'s pictures: the truth, and each run's rendering above its error."""

from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

from nrfgs_lab.sheets import GAP, picture, sheet
from nrfgs_ns.files import whole

VIEWS = 2  # Views in a sheet.
CROP_FRACTION = 0.3  # Side of a crop, in shorter sides of the image.
CROP_PIXELS = 220  # Side of a crop in the sheet.
ERROR_GAIN = 4.0  # Factor of the error maps.
ACROSS = 8  # Crops side by side, with the truth; more go below.

Images = npt.NDArray[np.float32]


def crop_sheet(pictures: dict[str, Path], path: Path) -> None:
    """Write a PNG of the views where runs differ most, if there is one that all have: renderings above |error| x 4, the
    whole truth on the left. `pictures`: label -> folder of ns-eval's; ValueError if they differ in size."""
    files = {label: files for label, folder in pictures.items() if (files := numbered(folder))}
    places = []
    for view in sorted(set.intersection(*map(set, files.values()))) if files else ():
        truth, renders = read(files, view)
        side = crop_side(truth.shape[0], truth.shape[1])
        places.append((*largest_disagreement(truth, list(renders.values()), side), view))
    if not places:
        return
    places = sorted(places, key=lambda place: -place[0])[:VIEWS]
    titles = [f"test view {view}; below: |error| x {ERROR_GAIN:g}" for *_, view in places]
    parts = [_view(*read(files, view), top, left) for _, top, left, view in places]
    with whole(path) as aside:
        sheet([[pair] for pair in zip(titles, parts, strict=True)]).save(aside, format="PNG")


def numbered(folder: Path) -> dict[int, Path]:
    """Number of the test view -> its picture."""
    return {int(file.name[9:13]): file for file in sorted(folder.glob("eval_img_[0-9][0-9][0-9][0-9]*.png"))}


def read(files: dict[str, dict[int, Path]], view: int) -> tuple[Images, dict[str, Images]]:
    """The truth and each run's rendering of a view, [H, W, 3] in [0, 1]."""
    truth, renders = None, {}
    for label, views in files.items():
        with Image.open(views[view]) as picture:
            pair = np.asarray(picture.convert("RGB"), dtype=np.float32) / 255.0
        half = pair.shape[1] // 2
        truth = pair[:, :half] if truth is None else truth
        renders[label] = pair[:, half:]
    return truth, renders


def crop_side(height: int, width: int) -> int:
    """Side of a crop, pixels of the image."""
    return max(1, int(CROP_FRACTION * min(height, width)))


def largest_disagreement(truth: Images, renders: list[Images], side: int) -> tuple[float, int, int]:
    """Square where the runs' errors differ most, or a single run's error is largest: mean deviation, top and left."""
    errors = np.stack([np.abs(render - truth).mean(axis=-1) for render in renders])
    map_ = errors.std(axis=0) if len(errors) > 1 else errors[0]
    sums = np.zeros((map_.shape[0] + 1, map_.shape[1] + 1))
    sums[1:, 1:] = map_.cumsum(axis=0, dtype=np.float64).cumsum(axis=1)
    boxes = sums[side:, side:] - sums[:-side, side:] - sums[side:, :-side] + sums[:-side, :-side]
    top, left = np.unravel_index(int(boxes.argmax()), boxes.shape)
    return float(boxes[top, left] / side**2), int(top), int(left)


def _view(truth: Images, renders: dict[str, Images], top: int, left: int) -> Image.Image:
    """One view: the whole truth, and lines of up to `ACROSS` crops above their errors."""
    side = crop_side(*truth.shape[:2])
    box = slice(top, top + side), slice(left, left + side)

    def cut(pixels: Images) -> Image.Image:
        return picture(pixels[box]).resize((CROP_PIXELS, CROP_PIXELS), Image.Resampling.NEAREST)

    columns = [("truth", cut(truth))]
    for label, image in renders.items():
        error = cut(ERROR_GAIN * np.abs(image - truth))
        columns.append((label, sheet([[("", cut(image))], [("", error)]])))
    height = 2 * CROP_PIXELS + GAP
    scale = height / truth.shape[0]
    overview = picture(truth).resize((max(1, int(truth.shape[1] * scale)), height))
    corners = [(left * scale, top * scale), ((left + side) * scale, (top + side) * scale)]
    ImageDraw.Draw(overview).rectangle(corners, outline="red", width=2)
    lines = [columns[first : first + ACROSS] for first in range(0, len(columns), ACROSS)]
    blank = Image.new("RGB", overview.size, "white")
    return sheet([[("", blank if number else overview), *line] for number, line in enumerate(lines)])
