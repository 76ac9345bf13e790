# SPDX-License-Identifier: Apache-2.0
"""Lenses with distortion: the pinholes of their undistorted photographs, which nerfstudio crops as OpenCV proposes."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from nerfstudio.cameras.cameras import Cameras, CameraType

from nrfgs_ns.data.checks import PIXELS
from nrfgs_ns.errors import InputError, shown

LENS = ("fx", "fy", "cx", "cy", "width", "height")
"""Fields of a camera that undistortion changes."""
MARGIN = 0.25
"""Largest displacement of a point by lens distortion, in image sizes."""
LEFT_OF_IMAGE = 0.25
"""Share of an image's pixels that undistortion must leave."""
LEAST_FOCAL, MOST_FOCAL = 0.02, 10.0
"""Change of the focal length by undistortion: a fisheye of 170 degrees becomes a pinhole of a fifth."""


def undistorted_cameras(lenses: Cameras) -> Cameras:
    """The pinholes [V] that would have taken the undistorted photographs of cameras [V]."""
    cameras = lenses[torch.arange(len(lenses))]  # a copy of each number, also of one for all
    cameras.camera_type = torch.full_like(lenses.camera_type, CameraType.PERSPECTIVE.value)
    cameras.distortion_params = None
    if (distortion := lenses.distortion_params) is None:
        return cameras
    table = torch.cat([*(getattr(lenses, name).float() for name in LENS), distortion], dim=-1).numpy()
    for index in distortion.any(dim=-1).nonzero()[:, 0].tolist():
        kind = CameraType(lenses.camera_type[index].item())
        _, _, flat, (x, y, width, height) = _undistorted(table[index], kind)
        lens = flat[0, 0], flat[1, 1], flat[0, 2] - x + 0.5, flat[1, 2] - y + 0.5, width, height
        for name, value in zip(LENS, lens, strict=True):
            getattr(cameras, name)[index] = float(value)
    return cameras


def _undistorted(lens: np.ndarray, kind: CameraType) -> tuple[np.ndarray, np.ndarray, np.ndarray, Sequence[int]]:
    """OpenCV's matrix and distortion of a lens [12], with pixel centres at whole numbers; the pinhole [3, 3] of the
    image as nerfstudio undistorts it, and the part of that which is kept: x, y, width, height."""
    fx, fy, cx, cy, w, h, k1, k2, k3, k4, p1, p2 = lens
    K = np.array([[fx, 0, cx - 0.5], [0, fy, cy - 0.5], [0, 0, 1]])
    size = int(w), int(h)
    if kind == CameraType.FISHEYE:
        distortion = np.array([k1, k2, k3, k4])
        flat = cv2.fisheye.estimateNewCameraMatrixForUndistortRectify(K, distortion, size, np.eye(3), balance=0)
        return K, distortion, flat, (0, 0, *size)
    distortion = np.array([k1, k2, p1, p2, k3])
    return K, distortion, *cv2.getOptimalNewCameraMatrix(K, distortion, size, 0)


def check_distortions(lenses: np.ndarray, kind: CameraType, frames: Sequence[dict[str, Any]], source: Path) -> None:
    """Check that undistorting leaves enough of the photographs, whose lenses are `checks.read_lenses`."""
    for lens, index in zip(*np.unique(lenses, axis=0, return_index=True), strict=True):
        if not lens[len(PIXELS) :].any():
            continue
        where = f"{source}: the distortion of {shown(frames[index]['file_path'])}"
        fx, fy, _, _, w, h, _, _, _, k4, _, _ = lens
        if kind != CameraType.FISHEYE and k4 != 0:
            raise InputError(f"{where} has k4 = {k4:g}, which is for fisheyes. Set it to 0, or undistort the images.")
        K, distortion, flat, part = _undistorted(lens, kind)
        is_cut = part[2] * part[3] < LEFT_OF_IMAGE * w * h
        enough = kind == CameraType.FISHEYE or not (is_cut or _folds(K, distortion, (w, h), flat, part))
        change = flat[[0, 1], [0, 1]] / (fx, fy)
        if not (enough and ((LEAST_FOCAL < change) & (change < MOST_FOCAL)).all()):
            raise InputError(f"{where} leaves next to nothing of the image. Correct it, or undistort the photographs.")


def _folds(K: np.ndarray, distortion: np.ndarray, size: tuple[int, int], flat: np.ndarray, part: Sequence[int]) -> bool:
    """Whether the polynomial turns around before the edge: undistortion takes pixels of `part` (x, y, width, height) of
    the pinhole `flat`'s image from beside the photograph, or in another order than there."""
    left, top, columns, rows = part
    u, v = np.meshgrid(np.linspace(left, left + columns, 17), np.linspace(top, top + rows, 17))
    rays = np.stack([(u - flat[0, 2]) / flat[0, 0], (v - flat[1, 2]) / flat[1, 1], np.ones_like(u)], axis=-1)
    taken, _ = cv2.projectPoints(rays.reshape(-1, 1, 3), np.zeros(3), np.zeros(3), K, distortion)
    taken = taken.reshape(*u.shape, 2)
    across, down = np.diff(taken, axis=1)[:-1], np.diff(taken, axis=0)[:, :-1]
    in_order = across[..., 0] * down[..., 1] - across[..., 1] * down[..., 0] > 0
    return np.abs(taken / size - 0.5).max() > 0.5 + MARGIN or not in_order.all()
