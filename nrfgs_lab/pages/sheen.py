# SPDX-License-Identifier: Apache-2.0
"""The README's picture: a few columns of the first view of a benchmark's crops.

python -m nrfgs_lab.pages.sheen            # docs/images/comparison-bonsai.jpg -> docs/images/sheen.jpg
"""

from pathlib import Path

from PIL import Image, ImageDraw, ImageFont

from nrfgs_lab.bench.crops import CROP_PIXELS, GAP, TITLE, VIEWS

IMAGES = Path(__file__).resolve().parents[2] / "docs" / "images"
COLUMNS = {0: "photograph", 1: "3DGS", 2: "the field"}
"""Columns of the sheet, and what stands above them."""
SIDE, HEAD = 230, 22
"""Side of a crop and height of the titles, pixels."""


def sheen(sheet: Image.Image, image_ratio: float) -> Image.Image:
    """The whole view, and crops with their errors.

    Args:
        sheet: of `nrfgs bench`, perhaps scaled; its first columns are the truth and the runs of `COLUMNS`.
        image_ratio: width of the views over their height.
    """
    tall = 2 * CROP_PIXELS + GAP
    scale = sheet.height / (VIEWS * (2 * TITLE + tall + GAP))
    across, top = int(tall * image_ratio), 2 * TITLE

    def cut(left: int, upper: int, width: int, height: int) -> Image.Image:
        return sheet.crop([round(scale * edge) for edge in (left, upper, left + width, upper + height)])

    view = cut(0, top, across, tall)
    result = Image.new("RGB", (view.width + len(COLUMNS) * (SIDE + GAP), HEAD + 2 * SIDE + GAP), "white")
    draw, font = ImageDraw.Draw(result), ImageFont.load_default(15)
    result.paste(view, (0, HEAD))
    draw.text((2, 2), "a test view", fill="black", font=font)
    for column, title in COLUMNS.items():
        x = view.width + GAP + column * (SIDE + GAP)
        draw.text((x + 2, 2), title, fill="black", font=font)
        for line in range(1 if column == 0 else 2):
            left, step = across + GAP + column * (CROP_PIXELS + GAP), CROP_PIXELS + GAP
            crop = cut(left, top + line * step, CROP_PIXELS, CROP_PIXELS)
            result.paste(crop.resize((SIDE, SIDE), Image.Resampling.LANCZOS), (x, HEAD + line * (SIDE + GAP)))
    draw.text((view.width + GAP + 2, HEAD + SIDE + 100), "error, four times\namplified:", fill="black", font=font)
    return result


if __name__ == "__main__":
    with Image.open(IMAGES / "comparison-bonsai.jpg") as sheet:
        sheen(sheet.convert("RGB"), 799 / 532).save(IMAGES / "sheen.jpg", quality=88)
