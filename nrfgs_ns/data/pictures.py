# SPDX-License-Identifier: Apache-2.0
"""Photographs and masks as files: which are read at all, what EXIF says of them, and smaller copies, made once and kept
in a cache."""

import hashlib
import math
import os
import warnings
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, Literal

from PIL import ExifTags, Image
from rich.progress import track

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

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            made = pool.map(lambda job: _resize(*job, kind), missing)
            list(track(made, f"Resizing {kind}", total=len(missing), console=CONSOLE, transient=True))
        CONSOLE.print(f"{len(missing)} {kind} were resized into {cache_folder()}.", markup=False, soft_wrap=True)
    return copies


def _copy_of(path: Path, size: tuple[int, int], kind: str) -> Path:
    """Where the copy belongs: in a folder named after all that decides its pixels."""
    stat = path.stat()
    identity = f"{path.resolve()} {stat.st_size} {stat.st_mtime_ns} {size} {kind}"
    return cache_folder() / hashlib.sha256(identity.encode("utf-8", "surrogateescape")).hexdigest()[:24] / path.name


def _resize(path: Path, size: tuple[int, int], copy: Path, kind: str) -> None:
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
    """How a photograph was taken, as far as its file says; nothing for a file without EXIF, or one that is no image.

    Returns:
        Some of exposure_time (seconds), f_number, iso, focal_length (mm), each finite and above 0, and make, model.
    """
    try:
        with open_picture(path) as image:
            return known(exif_of(image))
    except InputError:
        return {}


def stored_exif(frame: dict[str, Any], source: Path) -> dict[str, float | str]:
    """The same from a frame of transforms.json, as `nrfgs prepare` writes it; nothing where there is no "exif".

    Raises:
        InputError: it is no dictionary, one of its numbers is none above 0, or a name is no text.
    """
    told = frame.get("exif", {})
    good = isinstance(told, dict) and all(
        isinstance(value, str) if name in NAMES else isinstance(value, int | float) and 0 < value < math.inf
        for name, value in told.items()
        if name in NUMBERS or name in NAMES
    )
    if not good:
        raise InputError(
            f'{source}: "exif" of {frame.get("file_path")} must hold numbers above 0 ({", ".join(NUMBERS)}) and text '
            f"({', '.join(NAMES)}). Correct or remove it."
        )
    return told


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


def known(exif: Image.Exif) -> dict[str, float | str]:
    """The same from what PIL has read."""
    details = exif.get_ifd(ExifTags.IFD.Exif)
    found: dict[str, float | str] = {}
    for name, tag in NUMBERS.items():
        value = _number(details.get(tag))
        if value is not None:
            found[name] = value
    for name, tag in NAMES.items():
        if text := str(exif.get(tag) or "").strip(" \0"):
            found[name] = text
    return found


def _number(value: Any) -> float | None:
    """A tag's value, or the first of several, if it is a finite number above 0."""
    try:
        number = float(value[0] if isinstance(value, tuple) else value)
    except (TypeError, ValueError, IndexError, ZeroDivisionError):
        return None
    return number if math.isfinite(number) and number > 0 else None


def exif_of_copy(exif: Image.Exif) -> bytes:
    """For PIL's `exif` option: what of it holds for a copy that was turned, undistorted or made smaller.

    Camera, lens, exposure, date and position are kept; orientation, sizes, thumbnails and makers' notes are not.
    """
    copy = Image.Exif()
    for tag in KEPT:
        if tag in exif:
            copy[tag] = exif[tag]
    details = exif.get_ifd(ExifTags.IFD.Exif)
    if kept := {tag: details[tag] for tag in KEPT_EXIF if tag in details}:
        copy.get_ifd(ExifTags.IFD.Exif).update(kept)
    if position := exif.get_ifd(ExifTags.IFD.GPSInfo):
        copy.get_ifd(ExifTags.IFD.GPSInfo).update(position)
    return copy.tobytes() if {*copy, *copy.get_ifd(ExifTags.IFD.Exif), *copy.get_ifd(ExifTags.IFD.GPSInfo)} else b""


def share_of_size(path: Path) -> float:
    """Width of an image as a share of the one in its EXIF: below 1 where it was made smaller and EXIF was kept as it
    was; 1 where nothing is known.

    A focal length in millimetres comes with the sensor's resolution, in pixels of the size in EXIF, except where it is
    also given for 35 mm film (then 1, too)."""
    try:
        with open_picture(path) as image:
            details = exif_of(image).get_ifd(ExifTags.IFD.Exif)
            sides = [_number(details.get(tag)) for tag in (ExifTags.Base.ExifImageWidth, ExifTags.Base.ExifImageHeight)]
            if None in sides or ExifTags.Base.FocalLengthIn35mmFilm in details:
                return 1.0
            return max(image.size) / max(sides)
    except InputError:
        return 1.0


def read_position(path: Path) -> tuple[float, float] | None:
    """Latitude and longitude in degrees where a photograph was taken, or None."""
    try:
        with open_picture(path) as image:
            gps = exif_of(image).get_ifd(ExifTags.IFD.GPSInfo)
    except InputError:
        return None
    found = []
    for value, side, negative, bound in (
        (ExifTags.GPS.GPSLatitude, ExifTags.GPS.GPSLatitudeRef, "S", 90.0),
        (ExifTags.GPS.GPSLongitude, ExifTags.GPS.GPSLongitudeRef, "W", 180.0),
    ):
        try:
            degrees, minutes, seconds = (float(part) for part in gps[value])
        except (KeyError, TypeError, ValueError, ZeroDivisionError):
            return None
        angle = degrees + minutes / 60 + seconds / 3600
        if not abs(angle) <= bound:
            return None
        found.append(-angle if str(gps.get(side, "")).strip(" \0").upper() == negative else angle)
    return (found[0], found[1]) if any(found) else None  # 0, 0 is what devices without a fix write
