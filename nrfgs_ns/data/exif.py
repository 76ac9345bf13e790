# SPDX-License-Identifier: Apache-2.0
"""What a photograph's file says about how it was taken."""

import math
import warnings
from pathlib import Path
from typing import Any

from PIL import ExifTags, Image

from nrfgs_ns.data.pictures import open_picture
from nrfgs_ns.errors import InputError

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
        InputError: it is no dictionary, or one of its numbers is none above 0.
    """
    told = frame.get("exif", {})
    good = isinstance(told, dict) and all(
        isinstance(told[name], int | float) and math.isfinite(told[name]) and told[name] > 0
        for name in NUMBERS
        if name in told
    )
    if not good:
        raise InputError(
            f'{source}: "exif" of {frame.get("file_path")} must hold numbers above 0 ({", ".join(NUMBERS)}). '
            "Correct or remove it."
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
