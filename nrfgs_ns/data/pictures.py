# SPDX-License-Identifier: Apache-2.0
"""Files of photographs and masks: formats, memory for decoding, EXIF."""

import contextlib
import math
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import psutil
from PIL import ExifTags, Image
from rich.progress import track

from nrfgs_ns.errors import InputError, refusing

FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "PPM")
"""Formats that PIL may open, by a file's first bytes; for some others it would start Ghostscript."""
HEIF = (".heic", ".heif")
"""Suffixes of HEIF, which pillow-heif reads for PIL."""
MASK_MODES = ("1", "L", "I", "I;16")
"""PIL modes of masks: one value for each pixel, no palette index."""
HALF = 127
"""A JPEG mask is inside above this, since its edges ring."""
BYTES_PER_PIXEL = 16
"""Memory for decoding a picture: decoded, converted, resized or undistorted, and a tensor."""

RESTORE = "Restore or remove it."
"""The fix for a broken file, for which PIL may raise anything."""

Result = TypeVar("Result")


@cache
def read_heif() -> None:
    """Let PIL read HEIF from now on; ImportError without pillow-heif."""
    import pillow_heif

    pillow_heif.register_heif_opener()


def is_heif(path: Path) -> bool:
    """Whether a file is HEIF by its suffix, or, whatever its name, by its first bytes."""
    with contextlib.suppress(OSError), path.open("rb") as file:
        return path.suffix.lower() in HEIF or file.read(11)[4:] in (b"ftyphei", b"ftypmif", b"ftypmsf")
    return False


def open_picture(path: Path) -> Image.Image:
    """An image whose header alone is read; InputError if it is of no known format."""
    if heif := is_heif(path):
        fix = "Run `pip install pillow-heif`, or convert it to JPEG."
        with refusing(f"{path} is a HEIC photograph", fix, ImportError):
            read_heif()
    with refusing(f"{path} is not a readable image", RESTORE, Exception):
        return Image.open(path, formats=(*FORMATS, "HEIF") if heif else FORMATS)


def picture_names(paths: Sequence[Path]) -> list[str]:
    """Names that tell pictures apart: the files', or where two are alike the paths below their common folder."""
    names = [path.name for path in paths]
    if len(set(names)) < len(names):
        names = [path.relative_to(os.path.commonpath(paths)).as_posix() for path in paths]
    return names


def read_size(path: Path) -> tuple[int, int]:
    """Width and height of an image, by its header."""
    with open_picture(path) as image:
        return image.size


def check_depth(image: Image.Image, path: Path) -> None:
    """Refuse more than 8 bits per channel, whose range is unknown: 12 bits in 16 would be black."""
    if image.mode[0] in "IF" or any(";16" in str(tile[3]) for tile in image.tile):
        raise InputError(f"{path} has more than 8 bits a channel (mode {image.mode}). Convert it to 8-bit PNG or JPEG.")


def read_picture(path: Path) -> Image.Image:
    """A photograph of any mode with 8 bits, decoded to RGB, or to RGBA if it has transparency: nerfstudio takes a
    palette's indices for grey, and CMYK for RGBA."""
    with open_picture(path) as image:
        check_depth(image, path)
        transparent = image.mode.endswith(("A", "a")) or (image.mode == "P" and "transparency" in image.info)
        with refusing(f"{path} cannot be decoded", RESTORE, Exception):
            return image.convert("RGBA" if transparent else "RGB")


def read_mask(path: Path) -> Image.Image:
    """A decoded mask, of mode L: 0 outside, 255 inside."""
    with open_picture(path) as image:
        if image.mode not in MASK_MODES:
            raise InputError(f"{path}: a mask has one grey channel, 0 outside and more inside. Save it as 8-bit grey.")
        with refusing(f"{path} cannot be decoded", RESTORE, Exception):
            inside = np.array(image) > (HALF if image.format == "JPEG" else 0)
    return Image.fromarray(inside.astype(np.uint8) * 255)


def in_parallel(
    read: Callable[[int], Result], sizes: Sequence[tuple[int, int]], what: str, workers: int | None = None
) -> Iterator[Result]:
    """Results of `read(0)`, `read(1)`, ..., which decode pictures of these sizes (width, height), on `workers` threads
    (default: one for each processor, fewer for small pictures), as far as half of the free memory allows. The first
    failure ends the reading, as does a lack of memory for the largest (InputError). `what` labels the progress bar."""
    from nerfstudio.utils.rich_utils import CONSOLE  # slow to import, and not needed by `nrfgs prepare`

    width, height = max(sizes, key=math.prod, default=(1, 1))
    each = BYTES_PER_PIXEL * width * height
    free = psutil.virtual_memory().available
    if each > free:
        takes = f"takes about {each / 1e9:.1f} GB of memory, and {free / 1e9:.1f} are free"
        fix = "Close other programs, or make the images and masks smaller."
        raise InputError(f"Decoding an image of {width} x {height} {takes}. {fix}")
    helpful = 4 + width * height // 250_000  # threads; more would wait for Python's lock between decodings
    workers = min(workers or min(os.cpu_count() or 1, helpful), free / (2 * each + 1))
    with ThreadPoolExecutor(max(int(workers), 1)) as pool:
        try:
            yield from track(pool.map(read, range(len(sizes))), what, len(sizes), console=CONSOLE, transient=True)
        finally:
            pool.shutdown(cancel_futures=True)


def cache_folder() -> Path:
    """Folder of cached files, in XDG_CACHE_HOME or ~/.cache."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nrfgs-ns"


NUMBERS = {
    "exposure_time": ExifTags.Base.ExposureTime,
    "f_number": ExifTags.Base.FNumber,
    "iso": ExifTags.Base.ISOSpeedRatings,
    "focal_length": ExifTags.Base.FocalLength,
}


def read_exif(path: Path) -> dict[str, float | str]:
    """A photograph's EXIF, as far as known: exposure_time (seconds), f_number, iso, focal_length (mm), each finite and
    above 0, and model. Empty for a file that is not an image."""
    try:
        with open_picture(path) as image:
            exif = exif_of(image)
    except InputError:
        return {}
    details = exif.get_ifd(ExifTags.IFD.Exif)
    values = {name: tag_number(details.get(tag)) for name, tag in NUMBERS.items()}
    values["model"] = str(exif.get(ExifTags.Base.Model) or "").strip(" \0")
    return {name: value for name, value in values.items() if value}


def known_exif(stored: Any) -> dict[str, float]:
    """The numbers of a frame's "exif" in transforms.json, as `nrfgs prepare` writes it."""
    values = {name: tag_number(stored.get(name)) for name in NUMBERS} if isinstance(stored, dict) else {}
    return {name: value for name, value in values.items() if value}


def exif_of(image: Image.Image) -> Image.Exif:
    """An image's EXIF; empty if it is damaged."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # PIL's "corrupt EXIF data"
            exif = image.getexif()
            for part in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):
                exif.get_ifd(part)
        return exif
    except Exception:  # whatever damaged bytes lead to
        return Image.Exif()


def tag_number(value: Any) -> float | None:
    """A tag's (first) value if it is a finite number above 0."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, IndexError, ArithmeticError):
        return None
    return number if math.isfinite(number) and number > 0 else None
