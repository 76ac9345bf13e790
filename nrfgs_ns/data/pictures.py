# SPDX-License-Identifier: Apache-2.0
"""Photographs and masks as files: formats, EXIF, and smaller copies, made once and kept in a cache."""

import hashlib
import math
import os
import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal, TypeVar

import numpy as np
from PIL import ExifTags, Image
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeRemainingColumn

from nrfgs_ns.errors import InputError
from nrfgs_ns.files import whole

FORMATS = ("JPEG", "PNG", "TIFF", "BMP", "WEBP", "PPM")
"""PIL's names of photographs' formats. PIL knows others by their first bytes, whatever a file is called, and starts
Ghostscript for one of them."""
MASK_MODES = ("1", "L", "I", "I;16")
"""PIL modes with one value per pixel that means something by itself (a palette index does not)."""
HALF = 127
"""A JPEG mask is inside above this: its edges ring, so that values near 0 are outside."""
BYTES_PER_PIXEL = 16
"""Memory for decoding a picture: as PIL has it, converted, resized or undistorted, and as a tensor."""

Result = TypeVar("Result")


def open_picture(path: Path, formats: Sequence[str] = FORMATS) -> Image.Image:
    """PIL's `Image.open` for photographs alone: the header is read, the pixels are not.

    Raises:
        InputError: it is not an image of these formats.
    """
    try:
        return Image.open(path, formats=formats)
    except Exception as error:  # PIL lets out whatever its many readers meet in a broken file
        raise InputError(
            f"{path} is not a readable image ({_reason(error)}). Restore the file, or remove its frame from the data "
            "set."
        ) from error


def read_size(path: Path) -> tuple[int, int]:
    """Width and height of an image, without decoding it."""
    with open_picture(path) as image:
        return image.size


def check_depth(image: Image.Image, path: Path) -> None:
    """8 bits per channel. Of more, the range is unknown: PIL keeps the high byte, which is black for 12 bits in 16."""
    if image.mode[0] in "IF" or any(";16" in str(tile[3]) for tile in image.tile):
        raise InputError(
            f"{path} has more than 8 bits per channel (mode {image.mode}). Convert it to an 8-bit PNG or JPEG."
        )


def read_picture(path: Path) -> Image.Image:
    """A decoded photograph of 8 bits, RGB, or RGBA where it has transparency.

    Grey, palette, bilevel, CMYK and YCbCr images are converted.
    """
    with open_picture(path) as image:
        check_depth(image, path)
        transparent = image.mode.endswith(("A", "a")) or (image.mode == "P" and "transparency" in image.info)
        try:
            return image.convert("RGBA" if transparent else "RGB")
        except Exception as error:  # as above
            raise InputError(
                f"{path} cannot be decoded ({_reason(error)}). Restore the file, or remove its frame from the data set."
            ) from error


def read_mask(path: Path) -> Image.Image:
    """A decoded mask, of mode L: 0 outside, 255 inside."""
    with open_picture(path) as image:
        if image.mode not in MASK_MODES:
            raise InputError(
                f"{path}: a mask must have one grey channel (0 outside, anything else inside), not colours or a "
                "palette. Save it as 8-bit grey."
            )
        try:
            inside = np.array(image) > (HALF if image.format == "JPEG" else 0)
        except Exception as error:  # as above
            raise InputError(f"{path} cannot be decoded ({_reason(error)}). Restore the mask.") from error
    return Image.fromarray(inside.astype(np.uint8) * 255)


def free_memory() -> int | None:
    """Bytes that programs can still have without anything being swapped out; None where the system does not tell."""
    try:
        lines = Path("/proc/meminfo").read_text(encoding="ascii").splitlines()
        return next(1024 * int(line.split()[1]) for line in lines if line.startswith("MemAvailable:"))
    except (OSError, StopIteration, ValueError):
        return None


def in_parallel(
    read: Callable[[int], Result], sizes: Sequence[tuple[int, int]], what: str, workers: int | None = None
) -> Iterator[Result]:
    """Results of `read(0)`, `read(1)`, ..., which decode pictures of these sizes, on several threads.

    Half of the free memory bounds the number of threads. Where one fails, those that have not begun are left out.

    Args:
        sizes: (width, height) in full size.
        what: text of the progress bar.
        workers: None: one for each processor.

    Raises:
        InputError: there is no memory for decoding the largest picture.
    """
    from nerfstudio.utils.rich_utils import CONSOLE  # 20 seconds, which `nrfgs prepare` need not spend

    width, height = max(sizes, key=math.prod, default=(1, 1))
    each, free = BYTES_PER_PIXEL * width * height, free_memory()
    workers = workers or os.cpu_count() or 1
    if free is not None and each > free:
        raise InputError(
            f"Decoding an image of {width} x {height} takes about {each / 1e9:.1f} GB of memory, and {free / 1e9:.1f} "
            "are free. Close other programs, or make the images and masks smaller."
        )
    if free is not None:
        workers = max(min(workers, free // (2 * each + 1)), 1)
    columns = TextColumn(what), BarColumn(), MofNCompleteColumn(), TimeRemainingColumn()
    with ThreadPoolExecutor(workers) as pool, Progress(*columns, console=CONSOLE, transient=True) as bar:
        try:
            yield from bar.track(pool.map(read, range(len(sizes))), total=len(sizes))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise


def cache_folder(kind: str = "images") -> Path:
    """Folder of a kind of files in nrfgs-ns in XDG_CACHE_HOME, or else in .cache of the home folder."""
    return Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "nrfgs-ns" / kind


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
        from nerfstudio.utils.rich_utils import CONSOLE

        full = [read_size(path) for path, _, _ in missing]
        list(in_parallel(lambda index: _resize(*missing[index], kind), full, f"Resizing {kind}"))
        CONSOLE.print(f"{len(missing)} {kind} were resized into {cache_folder()}.", markup=False, soft_wrap=True)
    return copies


def _copy_of(path: Path, size: tuple[int, int], kind: str) -> Path:
    """Path of a copy, in a folder named after all that decides its pixels."""
    stat = path.stat()
    identity = f"{path.resolve()} {stat.st_size} {stat.st_mtime_ns} {size} {kind}"
    return cache_folder() / hashlib.sha256(identity.encode("utf-8", "surrogateescape")).hexdigest()[:24] / path.name


def _resize(path: Path, size: tuple[int, int], copy: Path, kind: str) -> None:
    picture = read_picture(path) if kind == "images" else read_mask(path)
    sampling = Image.Resampling.LANCZOS if kind == "images" else Image.Resampling.NEAREST
    with open_picture(path) as image:
        lossy = kind == "images" and picture.mode == "RGB" and image.format in ("JPEG", "MPO")
    exif = exif_of_copy(picture.getexif())
    form = "JPEG" if lossy else "PNG"
    try:
        with whole(copy) as aside:
            picture.resize(size, sampling).save(aside, form, quality=95, compress_level=1, exif=exif)
    except OSError as error:
        raise InputError(
            f"{copy} cannot be written ({error.strerror}). Make room there, or set XDG_CACHE_HOME to another folder."
        ) from error


def _reason(error: Exception) -> str:
    return str(error) or type(error).__name__


NUMBERS = {
    "exposure_time": ExifTags.Base.ExposureTime,
    "f_number": ExifTags.Base.FNumber,
    "iso": ExifTags.Base.ISOSpeedRatings,
    "focal_length": ExifTags.Base.FocalLength,
}
NAMES = {"make": ExifTags.Base.Make, "model": ExifTags.Base.Model}
KEPT = (*NAMES.values(), ExifTags.Base.DateTime)
"""Tags of the main directory that hold for copies of a photograph in another size, too."""
KEPT_EXIF = (*NUMBERS.values(), ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.DateTimeOriginal)
"""The same of the photographic directory."""


def read_exif(path: Path) -> dict[str, float | str]:
    """EXIF about the taking of a photograph; empty for a file without EXIF, or one that is no image.

    Returns:
        Some of exposure_time (seconds), f_number, iso, focal_length (mm), each finite and above 0, and make, model.
    """
    return known(_exif_at(path)[0])


def stored_exif(frame: dict[str, Any], source: Path) -> dict[str, float | str]:
    """The same from a frame of transforms.json, as `nrfgs prepare` writes it; empty where there is no "exif".

    Raises:
        InputError: it is not a dictionary of positive numbers and text.
    """
    stored = frame.get("exif", {})
    good = isinstance(stored, dict) and all(
        isinstance(value, str) if name in NAMES else isinstance(value, int | float) and 0 < value < math.inf
        for name, value in stored.items()
        if name in NUMBERS or name in NAMES
    )
    if not good:
        raise InputError(
            f'{source}: "exif" of {frame.get("file_path")} must hold numbers above 0 ({", ".join(NUMBERS)}) and text '
            f"({', '.join(NAMES)}). Correct or remove it."
        )
    return stored


def exif_of(image: Image.Image) -> Image.Exif:
    """An image's EXIF; empty where it is damaged, which is no reason to refuse the image."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # PIL's "corrupt EXIF data"
            exif = image.getexif()
            for part in (ExifTags.IFD.Exif, ExifTags.IFD.GPSInfo):
                exif.get_ifd(part)
        return exif
    except Exception:  # PIL lets out whatever it meets in damaged bytes
        return Image.Exif()


def _exif_at(path: Path) -> tuple[Image.Exif, tuple[int, int]]:
    """EXIF and size of a file; empty for one that is no image."""
    try:
        with open_picture(path) as image:
            return exif_of(image), image.size
    except InputError:
        return Image.Exif(), (0, 0)


def known(exif: Image.Exif) -> dict[str, float | str]:
    """What `read_exif` returns, from PIL's EXIF."""
    details = exif.get_ifd(ExifTags.IFD.Exif)
    numbers = {name: _number(details.get(tag)) for name, tag in NUMBERS.items()}
    names = {name: str(exif.get(tag) or "").strip(" \0") for name, tag in NAMES.items()}
    return {name: value for name, value in (numbers | names).items() if value}


def _number(value: Any) -> float | None:
    """A tag's value, or the first of several, if it is a finite number above 0."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, IndexError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def exif_of_copy(exif: Image.Exif) -> bytes:
    """EXIF, for PIL's `exif` option, of a copy that was turned, undistorted or made smaller.

    Camera, lens, exposure, date and position are kept; orientation, sizes, thumbnails and makers' notes are not.
    """
    copy = Image.Exif()
    details, position = exif.get_ifd(ExifTags.IFD.Exif), exif.get_ifd(ExifTags.IFD.GPSInfo)
    main = {tag: exif[tag] for tag in KEPT if tag in exif}
    kept = {tag: details[tag] for tag in KEPT_EXIF if tag in details}
    if not (main or kept or position):
        return b""
    copy.update(main)
    if kept:
        copy.get_ifd(ExifTags.IFD.Exif).update(kept)
    if position:
        copy.get_ifd(ExifTags.IFD.GPSInfo).update(position)
    return copy.tobytes()


def share_of_size(path: Path) -> float:
    """Width of an image as a share of the one in its EXIF: below 1 where it was made smaller and EXIF was kept as it
    was; 1 where nothing is known.

    A focal length in millimetres comes with the sensor's resolution, in pixels of the size in EXIF, except where it is
    also given for 35 mm film (then 1, too)."""
    exif, size = _exif_at(path)
    details = exif.get_ifd(ExifTags.IFD.Exif)
    sides = [_number(details.get(tag)) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)]
    if None in sides or ExifTags.Base.FocalLengthIn35mmFilm in details:
        return 1.0
    return max(size) / max(sides)


def read_position(path: Path) -> tuple[float, float] | None:
    """Latitude and longitude in degrees where a photograph was taken, or None."""
    gps = _exif_at(path)[0].get_ifd(ExifTags.IFD.GPSInfo)
    angles = []
    for tag, side, negative, bound in (
        (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef, "S", 90.0),
        (ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef, "W", 180.0),
    ):
        try:
            degrees, minutes, seconds = (float(part) for part in gps[tag])
        except (KeyError, TypeError, ValueError, ZeroDivisionError):
            return None
        angle = degrees + minutes / 60 + seconds / 3600
        if not abs(angle) <= bound:
            return None
        angles.append(-angle if str(gps.get(side, "")).strip(" \0").upper() == negative else angle)
    return (angles[0], angles[1]) if any(angles) else None  # 0, 0 is what devices without a fix write
