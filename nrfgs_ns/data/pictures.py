# SPDX-License-Identifier: Apache-2.0
"""Photographs and masks as files: which are read at all, and smaller copies, made once and kept in a cache."""

import hashlib
import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Literal

from PIL import Image
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from nrfgs_ns.errors import InputError
from nrfgs_ns.files import whole

FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "PPM")
"""PIL's names of what is a photograph. PIL knows others by their first bytes, whatever a file is called, and starts
Ghostscript for one of them."""


def open_picture(path: Path) -> Image.Image:
    """PIL's `Image.open` for photographs alone: the header is read, the pixels are not.

    Raises:
        InputError: it is none.
    """
    try:
        return Image.open(path, formats=FORMATS)
    except Exception as error:  # PIL lets out whatever its many readers meet in a broken file
        raise InputError(
            f"{path} is not a readable image ({_reason(error)}). Restore the file, or remove its frame from the data "
            "set."
        ) from error


def read_header(path: Path) -> tuple[tuple[int, int], str]:
    """Size (width, height) and PIL mode of an image, without decoding it."""
    with open_picture(path) as image:
        return image.size, image.mode


def read_picture(path: Path) -> Image.Image:
    """A decoded photograph, RGB, or RGBA where it has transparency.

    Grey, palette, bilevel, CMYK and YCbCr images are converted. Images of more than 8 bits are refused: their range is
    unknown.
    """
    with open_picture(path) as image:
        if image.mode[0] in "IF":
            raise InputError(
                f"{path} has more than 8 bits per channel (mode {image.mode}). Convert it to an 8-bit PNG or JPEG."
            )
        transparent = image.mode.endswith(("A", "a")) or (image.mode == "P" and "transparency" in image.info)
        try:
            return image.convert("RGBA" if transparent else "RGB")
        except Exception as error:  # as above
            raise InputError(
                f"{path} cannot be decoded ({_reason(error)}). Restore the file, or remove its frame from the data set."
            ) from error


def read_mask(path: Path) -> Image.Image:
    """A decoded image with one value per pixel."""
    with open_picture(path) as image:
        try:
            image.load()
            return image.copy()
        except Exception as error:  # as above
            raise InputError(f"{path} cannot be decoded ({_reason(error)}). Restore the mask.") from error


def cache_folder() -> Path:
    """Where smaller copies are kept: nrfgs-ns in XDG_CACHE_HOME, or else in .cache of the home folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nrfgs-ns" / "images"


def smaller_copies(
    paths: Sequence[Path], sizes: Sequence[tuple[int, int]], kind: Literal["images", "masks"]
) -> list[Path]:
    """Copies of pictures at smaller sizes, from the cache; those that are not in it are made.

    A copy is made anew where its original has changed. Copies have the names of their originals. Photographs are
    filtered (Lanczos; JPEG stays JPEG, of quality 95, the rest is kept without loss), masks are sampled.

    Args:
        sizes: (width, height) of the copies.
    """
    copies = [_copy_of(path, size, kind) for path, size in zip(paths, sizes, strict=True)]
    missing = [job for job in zip(paths, sizes, copies, strict=True) if not job[2].is_file()]
    if missing:
        from nerfstudio.utils.rich_utils import CONSOLE  # 20 seconds, which `nrfgs prepare` need not spend

        columns = TextColumn(f"Resizing {kind}"), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
        with ThreadPoolExecutor(os.cpu_count()) as pool, Progress(*columns, console=CONSOLE, transient=True) as bar:
            list(bar.track(pool.map(lambda job: _resize(*job, kind), missing), total=len(missing)))
        CONSOLE.print(f"{len(missing)} {kind} were resized into {cache_folder()}.", markup=False, soft_wrap=True)
    return copies


def _copy_of(path: Path, size: tuple[int, int], kind: str) -> Path:
    """Where the copy belongs: in a folder named after all that decides its pixels."""
    stat = path.stat()
    identity = f"{path.resolve()} {stat.st_size} {stat.st_mtime_ns} {size} {kind}"
    return cache_folder() / hashlib.sha256(identity.encode("utf-8", "surrogateescape")).hexdigest()[:24] / path.name


def _resize(path: Path, size: tuple[int, int], copy: Path, kind: str) -> None:
    from nrfgs_ns.data.exif import exif_of_copy  # which reads with what is above

    picture = read_picture(path) if kind == "images" else read_mask(path)
    sampling = Image.Resampling.LANCZOS if kind == "images" else Image.Resampling.NEAREST
    lossy = kind == "images" and picture.mode == "RGB" and read_format(path) in ("JPEG", "MPO")
    exif = exif_of_copy(picture.getexif())
    form = "JPEG" if lossy else "PNG"
    try:
        with whole(copy) as aside:
            picture.resize(size, sampling).save(aside, form, quality=95, compress_level=1, exif=exif)
    except OSError as error:
        raise InputError(
            f"{copy} cannot be written ({error.strerror}). Make room there, or set XDG_CACHE_HOME to another folder."
        ) from error


def read_format(path: Path) -> str:
    """PIL's name of an image's format."""
    with open_picture(path) as image:
        return image.format


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__
