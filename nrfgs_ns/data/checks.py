# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a data set, found before any training time is spent.

Every check raises InputError with the file or field, what was found, and the fix. `source` is the transforms.json that
the messages name. What only deserves attention goes through `warn`.
"""

from __future__ import annotations

import json
import math
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, CameraType
from nerfstudio.utils.rich_utils import CONSOLE

from nrfgs_ns.data.pictures import read_header
from nrfgs_ns.errors import InputError

ROTATION_TOLERANCE = 1e-2
"""Largest entry of |R^T R - 1| that is still a rotation. Rounding a pose to three decimals leaves 3e-3; a scale of 1 %
inside the rotation gives 2e-2, and would distort what the camera sees."""
LAST_ROW_TOLERANCE = 1e-6
POSITION_TOLERANCE = 1e-8
"""Camera positions that agree to this fraction of their size are one place. In UTM coordinates it is 5 cm."""
FAR_OUTSIDE = 100.0
"""A camera this many times as far from the middle as three in four are has a wrong pose."""
RATHER_FAR = 20.0
"""A camera this many times as far away deserves a look."""
DRAWN = (CameraType.PERSPECTIVE, CameraType.FISHEYE)
"""Cameras that are drawn: pinholes, and those whose photographs are undistorted to a pinhole's."""
WIDEST, NARROWEST = 1e-2, 1e3
"""Focal lengths in image sizes between which there are lenses: fields of view of 179 degrees and of 3.4 minutes."""
ODDEST_PIXEL = 4.0
"""Ratio of a pixel's sides; anamorphic lenses have 2."""
FARTHEST_CENTER = 10.0
"""The principal point is not farther outside than so many image sizes."""
SMALLEST, LARGEST = 4, 2**16
"""Pixels that an image has along each side."""
LONGEST_JSON = 2**26
"""Bytes of a transforms.json: 64 MB, a hundred thousand frames."""
LONGEST_NAME, LONGEST_PATH = 255, 4095
"""Bytes of a name, and of a path, that file systems take."""
PHOTOGRAPHS = (".jpg", ".jpeg", ".png", ".tif", ".tiff", ".bmp", ".webp", ".heic", ".dng")
"""Endings of what a camera writes."""
SHOWN = 3
"""How many offenders a message lists before it counts the rest."""
LONGEST = 160
"""Characters of a value in a message."""


def warn(message: str) -> None:
    """Prints one warning. Plain text: a file name may hold brackets, which the console would take for markup."""
    CONSOLE.print(f"Warning: {message}", style="bold yellow", markup=False, soft_wrap=True)


def some(items: Sequence[Any]) -> str:
    """The first few items for a message, and how many there are beyond them."""
    rest = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(shown(str(item)) for item in items[:SHOWN]) + rest


def shown(value: Any) -> str:
    """A value from a file for a message: one line, of bounded length, that every terminal can print."""
    text = value if isinstance(value, str) and value.isprintable() else ascii(value)
    return text if len(text) <= LONGEST else f"{text[: LONGEST // 2]}...{text[-LONGEST // 2 :]}"


def read_transforms(data: Path) -> tuple[dict[str, Any], Path]:
    """Reads the transforms.json of `data`, a folder or the file itself.

    Returns:
        Its content, with `frames` a non-empty list of objects, and its path.
    """
    if not exists(data):
        raise InputError(f"{shown(str(data))}: no such file or folder. Check the path that --data names.")
    source = data if data.suffix == ".json" else data / "transforms.json"
    if not source.is_file():
        raise InputError(f"{source} is missing. {_what_is_there(data)}")
    if source.stat().st_size > LONGEST_JSON:
        raise InputError(
            f"{source} has {source.stat().st_size} bytes, more than the {LONGEST_JSON} that are read. Make it anew."
        )
    try:
        meta = json.loads(source.read_text(encoding="utf-8-sig"))
    except (OSError, ValueError, RecursionError) as error:
        raise InputError(f"{source} cannot be read as JSON: {error}. Repair the file or make it anew.") from error
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{source}: `frames` must be a non-empty list of objects. Make the file anew.")
    return meta, source


def exists(path: Path) -> bool:
    """Whether there is something at a path; a path that cannot be is not there."""
    try:
        return path.exists()
    except (OSError, ValueError):
        return False


def _what_is_there(folder: Path) -> str:
    """What to do with a folder (or what was to be a file in one) that has no transforms.json."""
    if not folder.is_dir():
        return "Point --data at a folder that holds a transforms.json, or at the file."
    for model in ("colmap/sparse/0", "sparse/0", "sparse"):
        if any((folder / model / f"cameras.{ending}").is_file() for ending in ("bin", "txt")):
            return f"There is a COLMAP model: put `colmap --colmap-path {model}` at the end of the command."
    if (folder / "transforms_train.json").is_file():
        return "There is a data set of Blender's: put `blender-data` at the end of the command."
    places = [folder, folder / "images"]
    if any(file.suffix.lower() in PHOTOGRAPHS for place in places if place.is_dir() for file in place.iterdir()):
        return (
            f"There are photographs without poses: `nrfgs prepare {folder} SCENE` finds the poses; then train on SCENE."
        )
    return (
        "Point --data at a folder that holds one; `nrfgs prepare PHOTOS SCENE` (or nerfstudio's ns-process-data) makes "
        "one from photographs."
    )


def check_options(config: Any) -> None:
    """The parser's options, whatever the data set."""
    bounds = {
        "scale_factor": (0, math.inf, "a positive number"),
        "scene_scale": (0, math.inf, "a positive number"),
        "downscale_factor": (1, LARGEST, "1 or more, or leave it out"),
        "eval_interval": (1, math.inf, "1 or more"),
    }
    for name, (low, high, fix) in bounds.items():
        value = getattr(config, name)
        good = value is None or (low <= value < high and value > 0)
        if not good:
            raise InputError(f"--{name.replace('_', '-')} is {value}. Give {fix}.")


def check_frames(frames: list[dict[str, Any]], source: Path) -> None:
    """Every frame names an image; an auxiliary image is named by all frames or by none."""
    nameless = [f"frames[{i}]" for i, frame in enumerate(frames) if not _is_name(frame.get("file_path"))]
    if nameless:
        raise InputError(f"{source}: {some(nameless)} without a file_path. Name the image, or remove the frame.")
    names = [frame[key] for frame in frames for key in FILES_OF_A_FRAME if _is_name(frame.get(key))]
    odd = [name for name in names if not could_exist(name)]
    if odd:
        raise InputError(f"{source}: {some(odd)} cannot be the name of a file. Correct the path.")
    for field, hint in (("mask_path", " (an all-white mask keeps the whole image)"), ("depth_file_path", "")):
        without = [frame["file_path"] for frame in frames if not _is_name(frame.get(field))]
        if without and any(field in frame for frame in frames):
            raise InputError(
                f"{source}: {field} is given for some frames but not for {some(without)}. "
                f"Give one for every frame{hint}, or for none."
            )


FILES_OF_A_FRAME = ("file_path", "mask_path", "depth_file_path")


def could_exist(name: str) -> bool:
    """Whether a file system takes the name."""
    try:
        encoded = name.encode()
    except UnicodeEncodeError:
        return False
    parts = encoded.split(b"/")
    return b"\0" not in encoded and len(encoded) <= LONGEST_PATH and all(len(part) <= LONGEST_NAME for part in parts)


def check_poses(frames: list[dict[str, Any]], source: Path, need_spread: bool) -> None:
    """Poses are rigid 4 x 4 camera-to-world matrices; with `need_spread`, the cameras stand at more than one place."""
    poses = np.stack([_pose(frame, source) for frame in frames])
    names = [frame["file_path"] for frame in frames]

    def reject(bad: np.ndarray, finding: str, fix: str) -> None:
        if bad.any():
            raise InputError(f"{source}: transform_matrix of {some(np.array(names)[bad])} {finding}. {fix}")

    remove = "Recompute the pose, or remove the frame."
    reject(~np.isfinite(poses).all((1, 2)), "holds NaN or Inf", remove)
    reject(np.abs(poses[:, 3] - (0, 0, 0, 1)).max(1) > LAST_ROW_TOLERANCE, "has a last row that is not 0 0 0 1", remove)
    rotation = poses[:, :3, :3]
    skew = np.abs(rotation.transpose(0, 2, 1) @ rotation - np.eye(3)).max((1, 2))
    reject(
        skew > ROTATION_TOLERANCE,
        f"is not rigid (R^T R differs from 1 by {skew.max():.2g}, allowed {ROTATION_TOLERANCE:g})",
        "Take scale and shear out of the rotation.",
    )
    reject(np.linalg.det(rotation) < 0, "mirrors (its rotation has determinant -1)", "Flip one camera axis.")

    position = poses[:, :3, 3]
    if need_spread and np.ptp(position, axis=0).max() <= POSITION_TOLERANCE * np.abs(position).max():
        raise InputError(
            f"{source}: all {len(frames)} cameras stand at the same place, so the scene has no scale and no depth. "
            "Recompute the poses from images with parallax, or set --auto-scale-poses False."
        )
    _check_spread(position, names, source)


def _check_spread(positions: np.ndarray, names: Sequence[str], source: Path) -> None:
    """No camera is far outside the others' spread: all lengths are measured by the farthest one."""
    distance = np.linalg.norm(positions - np.median(positions, axis=0), axis=1)
    usual = np.quantile(distance, 0.75)
    far = distance > RATHER_FAR * usual
    if usual == 0 or not far.any():
        return
    which = some([f"{names[i]} ({distance[i] / usual:.3g} times)" for i in np.argsort(-distance)[: far.sum()]])
    finding = f"{source}: farther from the middle of the cameras than three quarters of them by much: {which}."
    if distance.max() > FAR_OUTSIDE * usual:
        raise InputError(f"{finding} Correct these poses, or remove the frames: the scene would shrink to a speck.")
    warn(f"{finding} If these poses are wrong, remove the frames: the scene is scaled to the farthest camera.")


def check_intrinsics(meta: dict[str, Any], source: Path) -> None:
    """Focal lengths, principal point, image size and distortion are there (globally or per frame) and make sense."""
    model = meta.get("camera_model", "OPENCV")
    drawn = [name for name, kind in CAMERA_MODEL_TO_TYPE.items() if kind in DRAWN]
    if not isinstance(model, str) or model not in drawn:
        known = isinstance(model, str) and model in CAMERA_MODEL_TO_TYPE
        raise InputError(
            f"{source}: camera_model {shown(repr(model))} is {'not drawn here' if known else 'unknown'}. Use one of "
            f"{', '.join(drawn)}{'; undistort the photographs to one of them' if known else ''}."
        )
    for key in INTRINSICS:
        for where, holder in _holders(meta, key):
            if key not in holder:
                hint = " (from a field of view: w / (2 tan(camera_angle_x / 2)))" if key in ("fl_x", "fl_y") else ""
                raise InputError(f"{source}: {key} is missing, at the top and in {where}. Add it, in pixels{hint}.")
            value = number(holder[key])
            possible = {"fl_x": value > 0, "fl_y": value > 0, "w": value >= 1, "h": value >= 1}.get(key, True)
            if not (possible and np.isfinite(value)):
                raise InputError(
                    f"{source}: {key} of {where} is {shown(repr(holder[key]))}. Give a number of pixels, above 0."
                )
    for frame in meta["frames"]:
        _check_lens(meta, frame, source)
    for key in ("k1", "k2", "k3", "k4", "p1", "p2"):
        for where, holder in _holders(meta, key):
            if not np.isfinite(number(holder.get(key, 0.0))):
                raise InputError(
                    f"{source}: {key} of {where} is {shown(repr(holder[key]))}. Give a number, 0 for none."
                )
    for where, holder in _holders(meta, "distortion_params"):
        values = holder.get("distortion_params", [0.0] * 6)
        if not (
            isinstance(values, list) and len(values) == 6 and np.isfinite([number(value) for value in values]).all()
        ):
            raise InputError(
                f"{source}: distortion_params of {where} is {shown(repr(values))}. Give six numbers: k1, k2, k3, k4, "
                "p1, p2."
            )
    _check_applied(meta, source)


def _check_lens(meta: dict[str, Any], frame: dict[str, Any], source: Path) -> None:
    """Focal length, principal point and image size go together."""
    fl_x, fl_y, cx, cy, w, h = (number((meta if key in meta else frame)[key]) for key in INTRINSICS)
    where = shown(frame["file_path"])
    if not all(SMALLEST <= side <= LARGEST for side in (w, h)):
        raise InputError(f"{source}: {where} is {w:g} x {h:g} pixels. Use images of {SMALLEST} to {LARGEST} a side.")
    for key, focal in (("fl_x", fl_x), ("fl_y", fl_y)):
        if not WIDEST * max(w, h) <= focal <= NARROWEST * max(w, h):
            raise InputError(
                f"{source}: {key} of {where} is {focal:g} for an image of {w:g} x {h:g}: no lens does that. Give it in "
                "pixels of this image."
            )
    if not 1 / ODDEST_PIXEL < fl_x / fl_y < ODDEST_PIXEL:
        raise InputError(
            f"{source}: fl_x and fl_y of {where} are {fl_x:g} and {fl_y:g}: pixels are squares, or nearly so. Give "
            "both in pixels of this image."
        )
    for key, center, side in (("cx", cx, w), ("cy", cy, h)):
        if not -FARTHEST_CENTER * side <= center <= (1 + FARTHEST_CENTER) * side:
            raise InputError(
                f"{source}: {key} of {where} is {center:g} for an image of {w:g} x {h:g}. Give it in pixels of this "
                "image."
            )


INTRINSICS = ("fl_x", "fl_y", "cx", "cy", "w", "h")


def check_unique(names: Iterable[Any], where: str) -> None:
    """No name occurs twice; `where` begins the message."""
    twice = [name for name, count in Counter(names).items() if count > 1]
    if twice:
        raise InputError(f"{where} name {some(twice)} more than once. Keep one of each.")


def check_exist(paths: Sequence[Path], source: Path, what: str) -> None:
    """Every file is there; `what` says what the files are."""
    missing = [path for path in paths if not path.is_file()]
    if missing:
        raise InputError(
            f"{source}: {len(missing)} of {len(paths)} {what} are missing: {some(missing)}. Restore them, or correct "
            "their paths (with the extension) or --downscale-factor."
        )


def check_headers(paths: Sequence[Path], sizes: Sequence[tuple[int, int]], what: str, fix: str) -> list[str]:
    """Every file is an image of the size (width, height) that its camera has; only headers are read.

    `what` says what the files are, and `fix` what to do if their size is another.

    Returns:
        The PIL modes of the files.
    """
    found = [read_header(path) for path in paths]
    wrong = [
        f"{path} is {have[0]} x {have[1]}, not {want[0]} x {want[1]}"
        for path, (have, _), want in zip(paths, found, sizes, strict=True)
        if have != tuple(want)
    ]
    if wrong:
        raise InputError(
            f"{len(wrong)} {what} do not match the size w x h of their cameras (divided by the downscale factor): "
            f"{some(wrong)}. {fix}"
        )
    return [mode for _, mode in found]


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def number(value: Any) -> float:
    """The value as nerfstudio would convert it, NaN if it would not."""
    if isinstance(value, bool):
        return math.nan
    try:
        return float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def _matrix(value: Any) -> np.ndarray:
    """The value as a float64 array, empty if it is ragged or not of numbers."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)


def _holders(meta: dict[str, Any], key: str) -> list[tuple[str, dict[str, Any]]]:
    """Who gives the value of `key`, by nerfstudio's rule: the top level if it has it, else every frame."""
    return [("the top level", meta)] if key in meta else [(shown(f["file_path"]), f) for f in meta["frames"]]


def _pose(frame: dict[str, Any], source: Path) -> np.ndarray:
    """transform_matrix as float64 [4, 4]."""
    pose = _matrix(frame.get("transform_matrix"))
    if pose.shape != (4, 4):
        raise InputError(
            f"{source}: transform_matrix of {shown(frame['file_path'])} is missing or not a 4 x 4 matrix of numbers. "
            "Give the camera-to-world matrix with its last row 0 0 0 1, or remove the frame."
        )
    return pose


def _check_applied(meta: dict[str, Any], source: Path) -> None:
    """applied_transform and applied_scale, if given, are a 3 x 4 matrix and a positive number."""
    if "applied_transform" in meta:
        matrix = _matrix(meta["applied_transform"])
        if matrix.shape != (3, 4) or not np.isfinite(matrix).all():
            raise InputError(f"{source}: applied_transform is not a 3 x 4 matrix of numbers. Correct or remove it.")
    if "applied_scale" in meta and not 0 < number(meta["applied_scale"]) < np.inf:
        raise InputError(
            f"{source}: applied_scale is {shown(repr(meta['applied_scale']))}. Give a positive number or remove it."
        )
