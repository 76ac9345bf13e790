# SPDX-License-Identifier: Apache-2.0
"""The demo's pictures: test views with error maps, and a highlight seen along an arc."""

from itertools import zip_longest
from pathlib import Path

from PIL import Image
from torch import Tensor

from nrfgs_lab.demo.views import Highlight, SeenView, brightest_window
from nrfgs_lab.sheets import picture, sheet

CELL = 240  # Width of a picture, pixels.
ERROR_GAIN = 4.0  # Factor of absolute errors in the error maps.
RESIDUAL_GAIN = 4.0  # Factor of the field's view-dependent part, around mid grey.


def contact_sheet(views: dict[str, list[SeenView]], path: Path) -> None:
    """Write a picture of three test views, each whole and below it where it shines most: truth, each method and its
    error, and what the field adds to its base colour. `views`: label -> its test views; the first is the field's."""
    label, nrf = next(iter(views.items()))
    columns = {"truth": [view.truth for view in nrf]}
    for name, seen in views.items():
        columns[name] = [view.rendered for view in seen]
        columns[f"error of {name} x {ERROR_GAIN:g}"] = [ERROR_GAIN * (v.rendered - v.truth).abs() for v in seen]
    columns[f"{label}'s base colour alone"] = [view.base for view in nrf]
    columns[f"its error x {ERROR_GAIN:g}"] = [ERROR_GAIN * (view.base - view.truth).abs() for view in nrf]
    columns[f"{label}'s residual x {RESIDUAL_GAIN:g}"] = [0.5 + RESIDUAL_GAIN * (v.rendered - v.base) for v in nrf]
    rows: list[list[Tensor]] = []
    for index in range(0, len(nrf), max(len(nrf) // 3, 1))[:3]:
        top, left, height, width = brightest_window(nrf[index].shine)
        rows.append([images[index] for images in columns.values()])
        rows.append([image[top : top + height, left : left + width] for image in rows[-1]])
    grid(rows, list(columns), path)


def strip(highlights: dict[str, Highlight], path: Path) -> None:
    """Write a picture of a highlight: a column for each place of the camera; truth, and each method with its errors."""
    first, *_ = highlights.values()
    top, left, height, width = first.window

    def cut(images: list[Tensor]) -> list[Tensor]:
        return [image[top : top + height, left : left + width] for image in images]

    rows, labels = [cut(first.truths)], ["truth"]
    for label, highlight in highlights.items():
        pairs = zip(highlight.rendered, highlight.truths, strict=True)
        rows += [cut(highlight.rendered), cut([ERROR_GAIN * (image - truth).abs() for image, truth in pairs])]
        labels += [label, f"error of {label} x {ERROR_GAIN:g}"]
    grid(rows, ["the camera moves around a highlight; rows: " + ", ".join(labels)], path)


def grid(rows: list[list[Tensor]], titles: list[str], path: Path) -> None:
    """Write rows of pictures [H, W, 3], with values in [0, 1], as cells of one size below a line of titles."""
    size = CELL, round(CELL * rows[0][0].shape[0] / rows[0][0].shape[1])
    cells = [[picture(image).resize(size, Image.Resampling.BICUBIC) for image in row] for row in rows]
    names = [titles, *[[]] * (len(rows) - 1)]
    titled = [[*zip_longest(names_, row, fillvalue="")] for names_, row in zip(names, cells, strict=True)]
    sheet(titled, gap=6, title=26, font=16).save(path)
