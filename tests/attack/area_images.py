# SPDX-License-Identifier: Apache-2.0
"""Images and masks: damaged, of other formats, and of sizes that nobody has."""

import io
import os
import struct
import zlib
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from area_transforms import broken, capture_in, load
from attempt import Case
from hypothesis import strategies as st
from PIL import Image
from small_capture import Capture
from values import DAMAGES, damage

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


def png_claiming(width: int, height: int, kind: int = 2) -> bytes:
    """A PNG that says it is of this size, and holds a few bytes."""

    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, kind, 0, 0, 0))
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


def deep(name: str) -> Case:
    """12 bits in 16, in three channels."""

    def change(capture: Capture) -> None:
        capture.meta["frames"][6]["file_path"] = name
        assert cv2.imwrite(str(capture.folder / name), capture.rng.integers(0, 2**12, (9, 12, 3), dtype=np.uint16))

    return broken(f"{name} of 16 bits in colour", change)


def transparent(capture: Capture) -> None:
    for one in capture.meta["frames"]:
        Image.new("RGBA", (12, 9)).save(capture.folder / one["file_path"])


def no_memory(folder: Path):
    """Ten images and masks of 12,000 x 12,000 pixels, on a machine with a gigabyte free."""
    import nrfgs_ns.data.pictures as pictures

    capture, side = capture_in(folder), 12_000
    capture.meta |= lens(side, side)
    for one in capture.meta["frames"]:
        for key in ("file_path", "mask_path"):
            (capture.folder / one[key]).write_bytes(png_claiming(side, side, 2 if key == "file_path" else 0))
    capture.save()

    def read() -> None:
        free, pictures.free_memory = pictures.free_memory, lambda: 10**9
        try:
            load(capture.folder)
        finally:
            pictures.free_memory = free

    return read


def odd_file(name: str, make) -> Case:
    path = "images/003.png"
    return broken(name, lambda capture: ((capture.folder / path).unlink(), make(capture.folder / path)))


CASES = [
    *(
        holding(f"{kind} that is EPS", EPS, file)
        for kind, file in (("image", "images/003.png"), ("mask", "masks/003.png"))
    ),
    holding("GIF", encoded("GIF")),
    holding("SVG", b'<svg xmlns="http://www.w3.org/2000/svg" width="12" height="9"/>'),
    *(holding(f"{mode} of more than 8 bits", encoded("TIFF", mode=mode)) for mode in ("I", "F")),
    *(
        holding(f"{form} cut in the middle", encoded(form)[: len(encoded(form)) // 2])
        for form in ("PNG", "TIFF", "BMP", "WEBP", "PPM")
    ),
    holding("bomb of 4 gigapixels", png_claiming(65000, 65000), size=(65000, 65000)),
    holding("bomb of 170 megapixels", png_claiming(13000, 13000), size=(13000, 13000)),
    Case("ten masks of 12,000 x 12,000", no_memory),
    *(deep(f"images/003.{ending}") for ending in ("png", "tif")),
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
        def build(folder: Path):
            capture = capture_in(folder)
            content = encoded(form, mode="L" if kind == "masks" else "RGB")
            (capture.folder / kind / "003.png").write_bytes(damage(content, chosen))
            capture.save()
            return partial(load, capture.folder)

        return Case(f"{form} {kind} {chosen}"[:200], build, hostile=False)

    forms = st.sampled_from(["PNG", "JPEG", "TIFF", "BMP", "WEBP", "PPM"])
    return st.builds(case, forms, st.sampled_from(["images", "masks"]), DAMAGES)
