# SPDX-License-Identifier: Apache-2.0
"""Images and masks: damaged, of other formats, and of sizes that nobody has."""

import io
import os
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
from area_transforms import broken
from attempt import DAMAGES, Case, damage
from hypothesis import strategies as st
from PIL import Image
from small_capture import Capture

AREA = "images and masks"
EPS = (
    b"%!PS-Adobe-3.0 EPSF-3.0\n%%BoundingBox: 0 0 12 9\n%%EndComments\n"
    b"%%Page: 1 1\n(ran) (w) file closefile showpage\n%%EOF\n"
)


def encoded(form: str, size: tuple[int, int] = (12, 9), mode: str = "RGB") -> bytes:
    rng = np.random.default_rng(2)
    image = Image.fromarray(rng.integers(0, 256, (size[1], size[0], 3), dtype=np.uint8)).convert(mode)
    file = io.BytesIO()
    image.save(file, form)
    return file.getvalue()


def png_claiming(width: int, height: int) -> bytes:
    """A PNG that says it is of this size, and holds a few bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
    return b"\x89PNG\r\n\x1a\n" + head + chunk(b"IDAT", zlib.compress(bytes(1000))) + chunk(b"IEND", b"")


def lens(width: int, height: int) -> dict[str, float]:
    return {"w": width, "h": height, "cx": width / 2, "cy": height / 2, "fl_x": width, "fl_y": width}


def holding(name: str, content: bytes, file: str = "images/003.png", size: tuple[int, int] = (12, 9)) -> Case:
    def change(capture: Capture) -> None:
        (capture.folder / file).write_bytes(content)
        capture.meta |= lens(*size)

    return broken(name, change)


def sized(width: int, height: int) -> Case:
    def change(capture: Capture) -> None:
        capture.meta |= lens(width, height)
        for one in capture.meta["frames"]:
            Image.new("RGB", (width, height)).save(capture.folder / one["file_path"])
            Image.new("L", (width, height), 255).save(capture.folder / one["mask_path"])

    return broken(f"all images {width} x {height}", change)


def transparent(capture: Capture) -> None:
    for one in capture.meta["frames"]:
        Image.new("RGBA", (12, 9)).save(capture.folder / one["file_path"])


def odd_file(name: str, make) -> Case:
    path = "images/003.png"
    return broken(name, lambda capture: ((capture.folder / path).unlink(), make(capture.folder / path)))


CASES = [
    *(holding(f"{file} that is EPS", EPS, file) for file in ("images/003.png", "masks/003.png")),
    holding("GIF", encoded("GIF")),
    holding("SVG", b'<svg xmlns="http://www.w3.org/2000/svg" width="12" height="9"/>'),
    *(holding(f"{mode} of more than 8 bits", encoded("TIFF", mode=mode)) for mode in ("I", "F")),
    *(
        holding(f"{form} cut in the middle", encoded(form)[: len(encoded(form)) // 2])
        for form in ("PNG", "TIFF", "BMP", "WEBP", "PPM")
    ),
    holding("bomb of 4 gigapixels", png_claiming(65000, 65000), size=(65000, 65000)),
    holding("bomb of 170 megapixels", png_claiming(13000, 13000), size=(13000, 13000)),
    *(
        holding(f"{end} of 12 bits in colour", cv2.imencode(end, np.full((9, 12, 3), 99, np.uint16))[1].tobytes())
        for end in (".png", ".tif")
    ),
    broken("all images transparent", transparent),
    holding("PNG of 0 x 0", png_claiming(0, 0)),
    *(sized(*size) for size in ((1, 1), (12, 1), (2, 2))),
    odd_file("a folder", Path.mkdir),
    odd_file("a pipe", os.mkfifo),
    odd_file("a link to itself", lambda path: path.symlink_to(path)),
    odd_file("a link to /dev/zero", lambda path: path.symlink_to("/dev/zero")),
    holding("mask cut in the middle", encoded("PNG", mode="L")[:60], "masks/003.png"),
    holding("mask empty", b"", "masks/003.png"),
    holding("mask in colours", encoded("PNG"), "masks/003.png"),
    holding("mask of another size", encoded("PNG", (6, 6), "L"), "masks/003.png"),
]


def inputs() -> st.SearchStrategy[Case]:
    """An image or a mask of some format, damaged."""

    def case(form: str, kind: str, chosen) -> Case:
        content = damage(encoded(form, mode="L" if kind == "masks" else "RGB"), chosen)
        return holding(f"{form} {kind} {chosen}"[:200], content, f"{kind}/003.png")._replace(hostile=False)

    forms = st.sampled_from(["PNG", "JPEG", "TIFF", "BMP", "WEBP", "PPM"])
    return st.builds(case, forms, st.sampled_from(["images", "masks"]), DAMAGES)
