# SPDX-License-Identifier: Apache-2.0
"""Checks of a data set before any training time is spent.

Every check raises InputError with the file or field, its content, and the fix. `source` is the file that messages name.
"""

import math
import os
from collections import Counter
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import torch
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, CameraType
from nerfstudio.utils.rich_utils import CONSOLE
from torch import Tensor

from nrfgs_ns.data.pictures import read_size
from nrfgs_ns.errors import InputError, require, shown

SHOWN = 3
"""Items that a message lists before it counts the rest."""
PIXELS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
"""nerfstudio's order of the parameters."""
UNREAD = ("k5", "k6", "s1", "s2", "s3", "s4", "is_fisheye")
"""OpenCV's larger models, which neither nerfstudio nor we undistort, and instant-ngp's name of a fisheye."""
DRAWN = (CameraType.PERSPECTIVE, CameraType.FISHEYE)
"""Pinholes, and cameras whose photographs are undistorted to a pinhole's."""
SMALLEST, LARGEST = 4, 2**16
"""Pixels of an image along each side."""
WIDEST, NARROWEST = 0.1, 1e3
"""Focal lengths of lenses, in image sizes: fields of view of 157 degrees and of 3.4 minutes."""
FARTHEST_CENTER = 10.0
"""Largest distance of the principal point from the image's middle, in image sizes."""
ROTATION_TOLERANCE = 1e-2
"""Largest entry of |R^T R - 1| of a rotation: rounding to three decimals leaves 3e-3, a scale of 1 % gives 2e-2."""
LAST_ROW_TOLERANCE = 1e-6
POSITION_TOLERANCE = 1e-8
"""Relative difference of camera positions that count as one place; in UTM coordinates it is 5 cm."""
FAR_OUTSIDE = 100.0
"""A camera this many times as far from the middle as three in four has a wrong pose: the farthest scales the scene."""


def warn(message: str) -> None:
    """Print a warning as plain text: brackets in a file name are not markup."""
    CONSOLE.print(f"Warning: {message}", style="bold yellow", markup=False, soft_wrap=True)


def some(items: Sequence[Any]) -> str:
    """The first few items for a message, and the number of the others."""
    rest = f" and {len(items) - SHOWN} more" if len(items) > SHOWN else ""
    return ", ".join(shown(str(item)) for item in items[:SHOWN]) + rest


def number(value: Any) -> float:
    """The value as a float; NaN if it is not a number."""
    try:
        return math.nan if isinstance(value, bool) else float(value)
    except (TypeError, ValueError, OverflowError):
        return math.nan


def matrix(value: Any) -> np.ndarray:
    """The value as a float64 array; empty if it is ragged or not of numbers."""
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError, OverflowError):
        return np.empty(0)


def find_colmap(folder: Path) -> str | None:
    """Place of a COLMAP model in the folder of a data set."""
    for place in ("colmap/sparse/0", "sparse/0", "sparse", "."):
        if any((folder / place / f"cameras.{ending}").is_file() for ending in ("bin", "txt")):
            return place
    return None


def check_options(config: Any) -> None:
    """Check that the parser's numbers are in their ranges."""
    for name, least in (("scale_factor", 0), ("scene_scale", 0), ("downscale_factor", 1), ("eval_interval", 1)):
        value = getattr(config, name)
        holds = value is None or (0 < value < math.inf and value >= least)
        require(holds, f"--{name.replace('_', '-')}", value, "1 or more" if least else "positive")


def check_frames(frames: list[dict[str, Any]], source: Path) -> None:
    """Check that every frame names an image of its own, and that all frames or no frames name masks."""

    def without(key: str) -> list[int]:
        names = [frame.get(key) for frame in frames]
        return [row for row, name in enumerate(names) if not (isinstance(name, str) and name)]

    if nameless := [f"frames[{row}]" for row in without("file_path")]:
        raise InputError(f"{source}: {some(nameless)} without a file_path. Name the image, or remove the frame.")
    check_unique((os.path.normpath(frame["file_path"]) for frame in frames), f"{source}: frames")
    unmasked = [frames[row]["file_path"] for row in without("mask_path")]
    if unmasked and any("mask_path" in frame for frame in frames):
        fix = "Give one for every frame (an all-white mask keeps the whole image), or for none."
        raise InputError(f"{source}: mask_path is given for some frames but not for {some(unmasked)}. {fix}")


def read_lenses(meta: dict[str, Any], source: Path) -> np.ndarray:
    """Intrinsics of every frame, float64 [V, 12]: `PIXELS`, then `DISTORTION`; those of the top level hold for all."""
    _check_model(meta, source)
    shared = {key: meta[key] for key in (*PIXELS, *DISTORTION, "distortion_params") if key in meta}
    for key, value in shared.items():
        if other := [frame["file_path"] for frame in meta["frames"] if key in frame and frame[key] != value]:
            finding = f"{source}: {key} of {some(other)} is not the one at the top level, which holds for all frames"
            raise InputError(f"{finding}. Remove one of them.")
    return np.array([_lens({**frame, **shared}, source) for frame in meta["frames"]])


def _lens(values: dict[str, Any], source: Path) -> list[float]:
    of = f"of {shown(values['file_path'])}"
    fl_x, fl_y, cx, cy, w, h = pixels = [number(values.get(key)) for key in PIXELS]
    size = max(w, h)
    if not (
        all(SMALLEST <= side <= LARGEST for side in (w, h))
        and all(WIDEST * size <= focal <= NARROWEST * size for focal in (fl_x, fl_y))
        and all(abs(center - side / 2) <= FARTHEST_CENTER * side for center, side in ((cx, w), (cy, h)))
    ):
        lens = ", ".join(f"{key} {shown(repr(values[key])) if key in values else 'missing'}" for key in PIXELS)
        raise InputError(
            f"{source}: the lens {of} has {lens}: no lens does that. Give all in pixels of one image, {SMALLEST} to "
            f"{LARGEST} a side (from a field of view: fl_x = w / (2 tan(camera_angle_x / 2)))."
        )
    stored = values.get("distortion_params", [values.get(key, 0.0) for key in DISTORTION])
    distortion = [number(value) for value in stored] if isinstance(stored, list) else []
    if len(distortion) != len(DISTORTION) or not np.isfinite(distortion).all():
        raise InputError(f"{source}: distortion {of} is {shown(repr(stored))}. Give {', '.join(DISTORTION)} (0: none).")
    return pixels + distortion


def _check_model(meta: dict[str, Any], source: Path) -> None:
    """Check that the top level's camera model, which holds for all frames, can be drawn, and no other is named."""
    model = meta.get("camera_model", "OPENCV")
    drawn = [name for name, kind in CAMERA_MODEL_TO_TYPE.items() if kind in DRAWN]
    for holder in (meta, *meta["frames"]):
        where = "of the top level" if holder is meta else f"of {shown(holder['file_path'])}"
        named = holder.get("camera_model", model)
        if named not in drawn or CAMERA_MODEL_TO_TYPE[named] != CAMERA_MODEL_TO_TYPE[model]:
            fix = f"Use one of {', '.join(drawn)} at the top level for all frames, or undistort to one of them."
            raise InputError(f"{source}: camera_model {where} is {shown(repr(named))}. {fix}")
        for key in UNREAD if CAMERA_MODEL_TO_TYPE[model] != CameraType.FISHEYE else UNREAD[:-1]:
            if holder.get(key, 0) != 0:
                raise InputError(
                    f"{source}: {key} {where} is {shown(repr(holder[key]))}, which is not read. For a fisheye set "
                    "camera_model to OPENCV_FISHEYE; otherwise undistort the photographs, or fit a model of "
                    f"{', '.join(DISTORTION)}."
                )


def _is_affine(pose: np.ndarray) -> bool:
    """Whether an array is a 4 x 4 matrix of finite numbers with the last row 0 0 0 1."""
    finite = pose.shape == (4, 4) and np.isfinite(pose).all()
    return finite and np.allclose(pose[3], (0, 0, 0, 1), rtol=0, atol=LAST_ROW_TOLERANCE)


def check_poses(frames: list[dict[str, Any]], source: Path, need_spread: bool) -> np.ndarray:
    """Rigid camera-to-world matrices, float64 [V, 4, 4]; with `need_spread`, not all at one place."""
    names = np.array([frame["file_path"] for frame in frames])
    matrices = [matrix(frame.get("transform_matrix")) for frame in frames]

    def reject(bad: Any, finding: str) -> None:
        if np.any(bad):
            where = some(names[np.flatnonzero(bad)])
            raise InputError(f"{source}: transform_matrix of {where} {finding}, or remove the frame.")

    fault = "is not a 4 x 4 matrix of finite numbers with the last row 0 0 0 1. Give the camera-to-world matrix"
    reject([not _is_affine(pose) for pose in matrices], fault)
    poses = np.stack(matrices)
    rotation = poses[:, :3, :3]
    with np.errstate(over="ignore", invalid="ignore"):
        skew = np.abs(rotation.transpose(0, 2, 1) @ rotation - np.eye(3)).max((1, 2))
    fault = f"is not rigid (R^T R differs from 1 by {skew.max():.2g}). Take scale and shear out of the rotation"
    reject(~(skew <= ROTATION_TOLERANCE), fault)
    reject(np.linalg.det(rotation) < 0, "mirrors (its rotation has determinant -1). Flip one camera axis")

    position = poses[:, :3, 3]
    if need_spread and np.ptp(position, axis=0).max() <= POSITION_TOLERANCE * np.abs(position).max():
        fix = "Recompute the poses from images with parallax, or set --auto-scale-poses False."
        raise InputError(f"{source}: all {len(frames)} cameras stand at the same place: no scale, no depth. {fix}")
    distance = np.linalg.norm(position - np.median(position, axis=0), axis=1)
    usual = np.quantile(distance, 0.75)
    reject(
        (distance > FAR_OUTSIDE * usual) & (usual > 0),
        f"is more than {FAR_OUTSIDE:g} times as far from the middle of the cameras as three quarters of them, so the "
        "scene would shrink to a speck. Correct the pose",
    )
    return poses


def applied_scale(meta: dict[str, Any], source: Path) -> float:
    """The scale that the poses already have."""
    scale = meta.get("applied_scale", 1.0)
    holds = 0 < number(scale) < math.inf
    require(holds, f"{source}: applied_scale", shown(repr(scale)), "a positive number (or remove it)")
    return number(scale)


def applied_transform(meta: dict[str, Any], source: Path) -> Tensor:
    """The transform that the poses already have, float64 [3, 4]."""
    applied = matrix(meta["applied_transform"])
    if applied.shape != (3, 4) or not np.isfinite(applied).all():
        raise InputError(f"{source}: applied_transform is not a 3 x 4 matrix of numbers. Correct or remove it.")
    return torch.from_numpy(applied)


def check_unique(names: Iterable[Any], where: str) -> None:
    """Check that no name occurs twice; `where` begins the message."""
    if twice := [name for name, count in Counter(names).items() if count > 1]:
        raise InputError(f"{where} name {some(twice)} more than once. Keep one of each.")


def check_exist(paths: Sequence[Path], source: Path, what: str) -> None:
    """Check that every file exists; `what` is their kind."""
    missing = [path for path in paths if not os.path.isfile(path)]  # unlike Path's, False for a name too long
    if missing:
        fix = "Restore them, or correct their paths (with the extension) or --downscale-factor."
        raise InputError(f"{source}: {len(missing)} of {len(paths)} {what} are missing: {some(missing)}. {fix}")


def check_headers(paths: Sequence[Path], sizes: Sequence[tuple[int, int]], what: str, fix: str) -> None:
    """Check that every file is an image of the given size (width, height), by its header; `what` is their kind."""
    headers = [(path, read_size(path), tuple(size)) for path, size in zip(paths, sizes, strict=True)]
    wrong = [f"{path} is {w} x {h}, not {size[0]} x {size[1]}" for path, (w, h), size in headers if (w, h) != size]
    if wrong:
        raise InputError(f"{what}: {len(wrong)} do not match their cameras' (downscaled) size: {some(wrong)}. {fix}")
