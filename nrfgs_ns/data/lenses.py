# SPDX-License-Identifier: Apache-2.0
"""From the intrinsics of a data set to nerfstudio's cameras, whose distortion can be undone."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, Cameras, CameraType

from nrfgs_ns.data.checks import number, shown
from nrfgs_ns.data.sight import MARGIN
from nrfgs_ns.errors import InputError

DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
"""nerfstudio's order of the parameters."""
FISHEYE_AT_LEAST = 1e-12
"""A distortion without effect, so that nerfstudio undistorts: it does only where some parameter is not 0."""
LEFT_OF_IMAGE = 0.25
"""Share of an image's pixels that undistortion must leave."""
LEAST_FOCAL, MOST_FOCAL = 0.02, 10.0
"""By what undistortion may change the focal length: a fisheye of 170 degrees becomes a pinhole of a fifth."""


def _column(meta: dict[str, Any], key: str) -> list[float]:
    """An intrinsic parameter of every frame, by nerfstudio's rule: the top level's if it has it."""
    return [number((meta if key in meta else frame)[key]) for frame in meta["frames"]]


def size_of(meta: dict[str, Any], frame: dict[str, Any]) -> tuple[int, int]:
    """Width and height of a frame's image in full size."""
    return tuple(int(number((meta if key in meta else frame)[key])) for key in ("w", "h"))


def _distortion(holder: dict[str, Any]) -> list[float]:
    """In nerfstudio's order, of the top level or of a frame."""
    given = holder.get("distortion_params", [holder.get(key, 0.0) for key in DISTORTION])
    return [number(value) for value in given]


def cameras_of(meta: dict[str, Any], poses: torch.Tensor, source: Path) -> Cameras:
    """The cameras in full size."""
    frames = meta["frames"]
    fx, fy, cx, cy = (torch.tensor(_column(meta, key)) for key in ("fl_x", "fl_y", "cx", "cy"))
    width, height = (torch.tensor(_column(meta, key)).int() for key in ("w", "h"))
    shared = any(key in meta for key in (*DISTORTION, "distortion_params"))
    distortion = torch.tensor([_distortion(meta if shared else frame) for frame in frames])
    kind = CAMERA_MODEL_TO_TYPE[meta.get("camera_model", "OPENCV")]
    if kind == CameraType.FISHEYE:
        distortion[(distortion == 0).all(dim=1), 0] = FISHEYE_AT_LEAST
    _check_distortion(fx, fy, cx, cy, width, height, distortion, kind, frames, source)
    return Cameras(poses, fx, fy, cx, cy, width, height, distortion, kind, metadata={})


def _check_distortion(fx, fy, cx, cy, width, height, distortion, kind: CameraType, frames, source: Path) -> None:
    """Undistorting leaves enough of every image."""
    numbers = torch.stack([fx, fy, cx, cy, width, height], dim=1)
    lenses, first = np.unique(torch.cat([numbers, distortion], dim=1).double().numpy(), axis=0, return_index=True)
    for lens, index in zip(lenses, first, strict=True):
        if not lens[6:].any():
            continue
        where = f"{source}: the distortion of {shown(frames[index]['file_path'])}"
        fx, fy, cx, cy, w, h, k1, k2, k3, k4, p1, p2 = lens
        K, size = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]]), (int(w), int(h))
        if kind == CameraType.FISHEYE:
            flat = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(
                K, np.array([k1, k2, k3, k4]), size, np.eye(3), balance=0
            )
            enough = True
        elif k4 != 0:
            raise InputError(f"{where} has k4 = {k4:g}, which is for fisheyes. Set it to 0, or undistort the images.")
        else:
            parameters = np.array([k1, k2, p1, p2, k3])
            flat, part = cv2.getOptimalNewCameraMatrix(K, parameters, size, 0)
            enough = part[2] * part[3] >= LEFT_OF_IMAGE * w * h and not _folds(K, parameters, size, flat, part)
        change = flat[[0, 1], [0, 1]] / (fx, fy)
        if not (enough and ((LEAST_FOCAL < change) & (change < MOST_FOCAL)).all()):
            raise InputError(
                f"{where} is so strong that undistorting leaves next to nothing of the image. Correct the parameters, "
                "or undistort the photographs yourself."
            )


def _folds(K: np.ndarray, distortion: np.ndarray, size: tuple[int, int], flat: np.ndarray, part: Sequence[int]) -> bool:
    """Whether undistortion takes pixels of its image, `part` (x, y, width, height) of that of the pinhole `flat`, in
    another order than they have in the photograph, or from beside it: the polynomial turns around before the edge."""
    left, top, columns, rows = part
    u, v = np.meshgrid(np.linspace(left, left + columns, 17), np.linspace(top, top + rows, 17))
    rays = np.stack([(u - flat[0, 2]) / flat[0, 0], (v - flat[1, 2]) / flat[1, 1], np.ones_like(u)], axis=-1)
    taken, _ = cv2.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, distortion)
    taken = taken.reshape(*u.shape, 2)
    across, down = np.diff(taken, axis=1)[:-1], np.diff(taken, axis=0)[:, :-1]
    in_order = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0] > 0
    beside = np.abs(taken / size - 0.5).max() > 0.5 + MARGIN
    return beside or not in_order.all()
