# SPDX-License-Identifier: Apache-2.0
"""Pictures in rows, with titles."""

from collections.abc import Sequence

import numpy as np
from PIL import Image, ImageDraw, ImageFont

GAP = 4  # Pixels between pictures.


def picture(values) -> Image.Image:
    """A picture of values [H, W, 3], a tensor or an array on the CPU, cut off at 0 and 1."""
    return Image.fromarray((np.asarray(values).clip(0, 1) * 255).round().astype(np.uint8))


def sheet(
    rows: Sequence[Sequence[tuple[str, Image.Image]]], gap: int = GAP, title: int = 16, font: int = 10
) -> Image.Image:
    """Rows of pictures, each with its title above; a row without titles leaves no room for them. Pixels: `gap` between
    pictures, `title` for a line of titles, `font` of its letters."""
    rooms = [title * any(name for name, _ in row) for row in rows]
    heights = [room + max(part.height for _, part in row) for room, row in zip(rooms, rows, strict=True)]
    width = max(sum(part.width + gap for _, part in row) for row in rows) - gap
    result = Image.new("RGB", (width, sum(heights) + gap * (len(rows) - 1)), "white")
    draw, letters, y = ImageDraw.Draw(result), ImageFont.load_default(font), 0
    for row, room, height in zip(rows, rooms, heights, strict=True):
        x = 0
        for name, part in row:
            draw.text((x + 2, y + title // 8), name, fill="black", font=letters)
            result.paste(part, (x, y + room))
            x += part.width + gap
        y += height + gap
    return result
