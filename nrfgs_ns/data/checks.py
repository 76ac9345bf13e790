# SPDX-License-Identifier: Apache-2.0
"""What can be wrong with a data set, found before any training time is spent.

Every check raises InputError with the file or field, what was found, and the mend. `source` is the transforms.json that
the messages name. What only deserves attention goes through `warn`.
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE
from nerfstudio.utils.rich_utils import CONSOLE
from PIL import Image

from nrfgs_ns.errors import InputError

ROTATION_TOLERANCE = 1e-2
"""Largest entry of |R^T R - 1| that is still a rotation. Rounding a pose to three decimals leaves 3e-3; a scale of 1 %
inside the rotation gives 2e-2, and would distort what the camera sees."""
POSITION_TOLERANCE = 1e-6
"""Camera positions that agree to this fraction of their size are one position in float32."""
SHOWN = 3
"""How many offenders a message lists before it counts the rest."""
UNREADABLE = (OSError, SyntaxError, ValueError, Image.DecompressionBombError)
"""What PIL raises for files that are damaged, or no images at all."""


def warn(message: str) -> None:
    """Prints one warning. Plain text: a file name may hold brackets, which the console would take for markup."""
    CONSOLE.print(f"Warning: {message}", style="bold yellow", markup=False, soft_wrap=True)


def some(items: Sequence[Any]) -> str:
    """The first few items for a message, and how many there are beyond them."""
    rest = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(str(item) for item in items[:SHOWN]) + rest


def read_transforms(data: Path) -> tuple[dict[str, Any], Path]:
    """Reads the transforms.json of `data`, a folder or the file itself.

    Returns:
        Its content, with `frames` a non-empty list of objects, and its path.
    """
    if not data.exists():
        raise InputError(f"{data}: no such file or folder. Check the path that --data names.")
    source = data if data.suffix == ".json" else data / "transforms.json"
    if not source.is_file():
        raise InputError(
            f"{source} is missing. Point --data at a folder that holds one, or make one from photos with "
            "`ns-process-data`."
        )
    try:
        meta = json.loads(source.read_text(encoding="utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{source} cannot be read as JSON: {error}. Repair the file or make it anew.") from error
    frames = meta.get("frames") if isinstance(meta, dict) else None
    if not isinstance(frames, list) or not frames or not all(isinstance(frame, dict) for frame in frames):
        raise InputError(f"{source}: `frames` must be a non-empty list of objects. Make the file anew.")
    return meta, source


def check_frames(frames: list[dict[str, Any]], source: Path) -> None:
    """Every frame names an image; an auxiliary image is named by all frames or by none."""
    nameless = [f"frames[{i}]" for i, frame in enumerate(frames) if not _is_name(frame.get("file_path"))]
    if nameless:
        raise InputError(f"{source}: {some(nameless)} without a file_path. Name the image, or remove the frame.")
    for field, hint in (("mask_path", " (an all-white mask keeps the whole image)"), ("depth_file_path", "")):
        without = [frame["file_path"] for frame in frames if not _is_name(frame.get(field))]
        if without and any(field in frame for frame in frames):
            raise InputError(
                f"{source}: {field} is given for some frames but not for {some(without)}. "
                f"Give one for every frame{hint}, or for none."
            )


def check_poses(frames: list[dict[str, Any]], source: Path, need_spread: bool) -> None:
    """Poses are rigid 4 x 4 camera-to-world matrices; with `need_spread`, the cameras stand at more than one place."""
    poses = np.stack([_pose(frame, source) for frame in frames])
    names = [frame["file_path"] for frame in frames]

    def reject(bad: np.ndarray, finding: str, mend: str) -> None:
        if bad.any():
            raise InputError(f"{source}: transform_matrix of {some(np.array(names)[bad])} {finding}. {mend}")

    remove = "Recompute the pose, or remove the frame."
    reject(~np.isfinite(poses).all((1, 2)), "holds NaN or Inf", remove)
    reject(np.abs(poses[:, 3] - (0, 0, 0, 1)).max(1) > POSITION_TOLERANCE, "has a last row that is not 0 0 0 1", remove)
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


def check_intrinsics(meta: dict[str, Any], source: Path) -> None:
    """Focal lengths, principal point, image size and distortion are there (globally or per frame) and make sense."""
    model = meta.get("camera_model", "OPENCV")
    if model not in CAMERA_MODEL_TO_TYPE:
        raise InputError(f"{source}: camera_model {model!r} is unknown. Use one of {', '.join(CAMERA_MODEL_TO_TYPE)}.")
    for key in ("fl_x", "fl_y", "cx", "cy", "w", "h"):
        for where, holder in _holders(meta, key):
            if key not in holder:
                hint = " (from a field of view: w / (2 tan(camera_angle_x / 2)))" if key in ("fl_x", "fl_y") else ""
                raise InputError(f"{source}: {key} is missing, at the top and in {where}. Add it, in pixels{hint}.")
            value = _number(holder[key])
            possible = {"fl_x": value > 0, "fl_y": value > 0, "w": value >= 1, "h": value >= 1}.get(key, True)
            if not (possible and np.isfinite(value)):
                raise InputError(f"{source}: {key} of {where} is {holder[key]!r}. Give a number of pixels, above 0.")
    for key in ("k1", "k2", "k3", "k4", "p1", "p2", "distortion_params"):
        for where, holder in _holders(meta, key):
            value = holder.get(key, 0.0)
            values = value if isinstance(value, list) else [value]
            if not all(np.isfinite(_number(value)) for value in values):
                raise InputError(f"{source}: {key} of {where} is {value!r}. Give numbers, 0 for none.")
    _check_applied(meta, source)


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
            "their paths (relative to the JSON file, with the extension) or --downscale-factor."
        )


def check_headers(paths: Sequence[Path], sizes: Sequence[tuple[int, int]], what: str, mend: str) -> list[str]:
    """Every file is an image of the size (width, height) that its camera has; only headers are read.

    `what` says what the files are, and `mend` what to do if their size is another.

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
            f"{some(wrong)}. {mend}"
        )
    return [mode for _, mode in found]


def read_header(path: Path) -> tuple[tuple[int, int], str]:
    """Size (width, height) and PIL mode of an image, without decoding it."""
    try:
        with Image.open(path) as image:
            return image.size, image.mode
    except UNREADABLE as error:
        raise InputError(
            f"{path} is not a readable image ({error}). Restore the file, or remove its frame from transforms.json."
        ) from error


def _is_name(value: Any) -> bool:
    return isinstance(value, str) and bool(value)


def _number(value: Any) -> float:
    """The value as nerfstudio would convert it, NaN if it would not."""
    try:
        return float(value)
    except (TypeError, ValueError):
        return float("nan")


def _matrix(value: Any) -> np.ndarray:
    """The value as a float64 array, empty if it is ragged or not of numbers."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError):
        return np.empty(0)


def _holders(meta: dict[str, Any], key: str) -> list[tuple[str, dict[str, Any]]]:
    """Who gives the value of `key`, by nerfstudio's rule: the top level if it has it, else every frame."""
    return [("the top level", meta)] if key in meta else [(frame["file_path"], frame) for frame in meta["frames"]]


def _pose(frame: dict[str, Any], source: Path) -> np.ndarray:
    """transform_matrix as float64 [4, 4]."""
    pose = _matrix(frame.get("transform_matrix"))
    if pose.shape != (4, 4):
        raise InputError(
            f"{source}: transform_matrix of {frame['file_path']} is missing or not a 4 x 4 matrix of numbers. Give the "
            "camera-to-world matrix with its last row 0 0 0 1, or remove the frame."
        )
    return pose


def _check_applied(meta: dict[str, Any], source: Path) -> None:
    """applied_transform and applied_scale, if given, are a 3 x 4 matrix and a positive number."""
    if "applied_transform" in meta:
        matrix = _matrix(meta["applied_transform"])
        if matrix.shape != (3, 4) or not np.isfinite(matrix).all():
            raise InputError(f"{source}: applied_transform is not a 3 x 4 matrix of numbers. Correct or remove it.")
    if "applied_scale" in meta and not 0 < _number(meta["applied_scale"]) < np.inf:
        raise InputError(f"{source}: applied_scale is {meta['applied_scale']!r}. Give a positive number or remove it.")
