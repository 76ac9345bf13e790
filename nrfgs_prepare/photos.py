# SPDX-License-Identifier: Apache-2.0
"""Photographs, found, checked and turned upright, and the frames of a video."""

import hashlib
import itertools
import os
import re
import shlex
import shutil
from collections.abc import Iterator
from operator import itemgetter
from pathlib import Path

import numpy as np
from PIL import ExifTags, Image, ImageOps

from nrfgs_ns.data.pictures import NUMBERS, RESTORE, check_depth, exif_of, is_heif, open_picture, read_exif, read_size
from nrfgs_ns.errors import InputError, refusing
from nrfgs_prepare.pairs import Advance

PHOTOS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".heic", ".heif")
VIDEOS = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm")
KEPT = {".jpg": ("JPEG", "MPO"), ".jpeg": ("JPEG", "MPO"), ".png": ("PNG",)}
"""Suffixes of files that are copied if they are what the suffix says; files with others become PNG."""
KEPT_TAGS = (ExifTags.Base.Make, ExifTags.Base.Model, ExifTags.Base.DateTime)
KEPT_DETAILS = (*NUMBERS.values(), ExifTags.Base.FocalLengthIn35mmFilm, ExifTags.Base.DateTimeOriginal)
"""Tags of the main and the photographic directory that hold for a turned or smaller copy, too."""
FEWEST, FEW = 3, 15
"""Minimum number of photographs, and number below which a warning appears."""
SHARPNESS_WIDTH = 320
"""Width at which the sharpness of frames is compared, pixels: motion blur counts, not noise."""
SMALLEST = 16
"""Minimum of the shorter side, pixels."""
LONGEST_STEM = 120
"""Maximum length of a stored name, letters."""


def find_inputs(source: Path) -> list[Path]:
    """The photographs of a folder by sorted name, or a video as a list of one; InputError without enough of them."""
    if source.is_file():
        if source.suffix.lower() in VIDEOS:
            return [source]
        raise InputError(f"{source} is neither a folder of photographs nor a video ({', '.join(VIDEOS)}).")
    if not source.is_dir():
        raise InputError(f"{source}: no such folder or video. Check the path.")
    if (source / "transforms.json").is_file():
        raise InputError(
            f"{source} is a scene already: its transforms.json has the poses. Train with `ns-train nrfgs --data "
            f"{shlex.quote(str(source))}`, or name its folder of photographs."
        )
    files = sorted(path for path in source.iterdir() if path.is_file() and not path.name.startswith("."))
    photos = [path for path in files if path.suffix.lower() in PHOTOS]
    if heif := next(filter(is_heif, photos), None):
        open_picture(heif).close()  # reports a missing pillow-heif before any work
    if len(photos) < FEWEST:
        raise InputError(
            f"{source} directly holds {len(photos)} photographs ({', '.join(PHOTOS)}); at least {FEWEST} are needed, "
            "better 30 or more, from different places, each seeing most of what the one before it sees. "
            f"{left_out(source, photos)}"
        )
    return photos


def left_out(source: Path, photos: list[Path]) -> str:
    """A sentence about other contents of a folder, by suffix; "" without any."""
    others = [path for path in source.iterdir() if not path.name.startswith(".") and path not in set(photos)]
    kinds = {"folders" if path.is_dir() else path.suffix.lower() or "no suffix" for path in others}
    hint = "To use a video, name that file itself." if kinds & set(VIDEOS) else ""
    return f"Left out, since they are not read here: {', '.join(sorted(kinds))}. {hint}" if kinds else ""


def digest(paths: list[Path]) -> str:
    """SHA-256 of names and contents."""
    total = hashlib.sha256()
    for path in paths:
        total.update(os.fsencode(path.name))
        with path.open("rb") as file:
            for block in iter(lambda: file.read(1 << 20), b""):
                total.update(block)
    return total.hexdigest()


def stored_names(photos: list[Path]) -> list[str]:
    """Different short file names in ASCII without blanks, which end names in COLMAP's lists."""
    names: dict[str, None] = {}  # an ordered set
    for index, path in enumerate(photos):
        suffix = path.suffix.lower() if path.suffix.lower() in KEPT else ".png"
        name = re.sub(r"[^\w.-]", "_", path.stem, flags=re.ASCII)[:LONGEST_STEM] + suffix
        while name in names:
            name = f"{index:05d}_{name}"
        names[name] = None
    return list(names)


def make_empty(folder: Path) -> None:
    """Make a folder, without what was in it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)


def import_photos(photos: list[Path], folder: Path, advance: Advance) -> None:
    """Copy photographs into a folder, turned upright by EXIF; InputError names a file that cannot be decoded."""
    make_empty(folder)
    for path, name in zip(photos, stored_names(photos), strict=True):
        with open_picture(path) as image:
            _store(image, path, folder / name)
        advance(1)


def _store(image: Image.Image, path: Path, target: Path) -> None:
    """Copy one photograph if it is upright and of 8 bits in a common format, else convert it to upright RGB."""
    check_depth(image, path)
    if min(image.size) < SMALLEST:
        raise InputError(f"{path} is {image.width} x {image.height} pixels, too small to show anything. Remove it.")
    with refusing(f"{path} cannot be decoded", RESTORE, Exception):
        image.load()
    exif = exif_of(image)
    upright = exif.get(ExifTags.Base.Orientation, 1) == 1
    if upright and image.mode in ("RGB", "L") and image.format in KEPT.get(path.suffix.lower(), ()):
        shutil.copyfile(path, target)
        return
    for name in ("exif", "Raw profile type exif"):  # PIL would write it anew, which tags of other types prevent
        image.info.pop(name, None)
    turned = ImageOps.exif_transpose(image)
    if turned.mode in ("RGBA", "LA", "PA") or "transparency" in turned.info:  # put a cut-out object on white
        turned = Image.alpha_composite(Image.new("RGBA", turned.size, "white"), turned.convert("RGBA"))
    turned.convert("RGB").save(target, quality=97, subsampling=0, exif=exif_of_copy(exif))


def exif_of_copy(exif: Image.Exif) -> bytes:
    """The camera, exposure, date and position of a turned copy, for PIL's `exif` option; empty if PIL cannot write
    them."""
    copy = Image.Exif()
    details = exif.get_ifd(ExifTags.IFD.Exif)
    copy.update({tag: exif[tag] for tag in KEPT_TAGS if tag in exif})
    copy.get_ifd(ExifTags.IFD.Exif).update({tag: details[tag] for tag in KEPT_DETAILS if tag in details})
    copy.get_ifd(ExifTags.IFD.GPSInfo).update(exif.get_ifd(ExifTags.IFD.GPSInfo))
    try:
        return copy.tobytes()
    except Exception:  # tags of other types
        return b""


def same_cameras(folder: Path, names: list[str]) -> list[list[str]]:
    """Photographs that agree in size and, by EXIF, in camera model and focal length."""
    alike: dict[tuple, list[str]] = {}
    for name in names:
        exif = read_exif(folder / name)
        lens = exif.get("model"), round(float(exif.get("focal_length", 0)), 2)
        alike.setdefault((read_size(folder / name), *lens), []).append(name)
    return list(alike.values())


def import_video(video: Path, folder: Path, frames: int, advance: Advance) -> None:
    """Write the sharpest frame (by the variance of the Laplacian) of each of `frames` equal pieces of a video, as
    frame_00000.jpg and so on; InputError if it cannot be used."""
    import cv2  # slow

    reader = cv2.VideoCapture(str(video))
    total = int(reader.get(cv2.CAP_PROP_FRAME_COUNT))
    frames = min(frames, total)
    written = 0
    make_empty(folder)

    def decoded() -> Iterator[tuple[int, np.ndarray]]:
        for index in range(total):
            there, frame = reader.read()
            if not there:
                return
            yield index * frames // total, frame

    def sharpness(frame: np.ndarray) -> float:
        height = max(round(frame.shape[0] * SHARPNESS_WIDTH / frame.shape[1]), 1)
        small = cv2.resize(frame, (SHARPNESS_WIDTH, height), interpolation=cv2.INTER_AREA)
        return cv2.Laplacian(cv2.cvtColor(small, cv2.COLOR_BGR2GRAY), cv2.CV_64F).var()

    for _, piece in itertools.groupby(decoded(), key=itemgetter(0)):
        sharpest = max((frame for _, frame in piece), key=sharpness)
        coded = cv2.imencode(".jpg", sharpest, [cv2.IMWRITE_JPEG_QUALITY, 97])[1]
        (folder / f"frame_{written:05d}.jpg").write_bytes(coded)  # imwrite is silent where the disk is full
        written += 1
        advance(1)
    if written < FEWEST:
        raise InputError(
            f"{video}: OpenCV decodes {written} frames of it. Convert it to MP4 (H.264), or extract frames and "
            "name their folder."
        )
