# SPDX-License-Identifier: Apache-2.0
"""Cameras of a data set: intrinsics and poses, checked, in the capture's world and in the training's.

In float32, numbers near ten million are a metre apart. Cameras far from the origin, such as georeferenced ones, are
therefore moved there in float64 first, and the way back is float64, too.
"""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from nerfstudio.cameras import camera_utils
from nerfstudio.cameras.cameras import CAMERA_MODEL_TO_TYPE, Cameras, CameraType
from nerfstudio.data.dataparsers.base_dataparser import DataparserOutputs, transform_poses_to_original_space
from torch import Tensor

from nrfgs_ns.data.checks import matrix, number, shown, some
from nrfgs_ns.errors import InputError

PIXELS = ("fl_x", "fl_y", "cx", "cy", "w", "h")
DISTORTION = ("k1", "k2", "k3", "k4", "p1", "p2")
"""nerfstudio's order of the parameters."""
UNREAD = ("k5", "k6", "s1", "s2", "s3", "s4", "is_fisheye")
"""OpenCV's larger models, which neither nerfstudio nor we undistort, and instant-ngp's name of a fisheye."""
DRAWN = (CameraType.PERSPECTIVE, CameraType.FISHEYE)
"""Pinholes, and cameras whose photographs are undistorted to a pinhole's."""
LENS = ("fx", "fy", "cx", "cy", "width", "height")
"""Fields of a camera that undistortion changes."""
SMALLEST, LARGEST = 4, 2**16
"""Pixels of an image along each side."""
WIDEST, NARROWEST = 0.1, 1e3
"""Focal lengths of lenses, in image sizes: fields of view of 157 degrees and of 3.4 minutes."""
FARTHEST_CENTER = 10.0
"""Largest distance of the principal point from the image's middle, in image sizes."""
FISHEYE_AT_LEAST = 1e-12
"""A distortion without effect, because nerfstudio undistorts only where some parameter is not 0."""
MARGIN = 0.25
"""Largest displacement of a point by lens distortion, in image sizes."""
LEFT_OF_IMAGE = 0.25
"""Share of an image's pixels that undistortion must leave."""
LEAST_FOCAL, MOST_FOCAL = 0.02, 10.0
"""Change of the focal length by undistortion: a fisheye of 170 degrees becomes a pinhole of a fifth."""
ROTATION_TOLERANCE = 1e-2
"""Largest entry of |R^T R - 1| of a rotation: rounding to three decimals leaves 3e-3, a scale of 1 % gives 2e-2."""
LAST_ROW_TOLERANCE = 1e-6
ORIENTATIONS = ("pca", "up", "vertical", "none")
POSITION_TOLERANCE = 1e-8
"""Relative difference of camera positions that count as one place; in UTM coordinates it is 5 cm."""
FAR_OUTSIDE = 100.0
"""A camera this many times as far from the middle as three in four has a wrong pose: the farthest scales the scene."""
FAR = 100.0
"""Distance of the cameras' mean from the origin, in their extents, above which they are moved in float64. Nearer ones
lose less than a hundredth of a pixel, and stay to the bit where nerfstudio puts them."""


def read_cameras(meta: dict[str, Any], source: Path, config: Any) -> tuple[Cameras, Tensor, float]:
    """The cameras of a transforms.json in full size, oriented, centred and scaled as a parser's options say.

    Returns:
        The cameras [V]; the transform [3, 4] from the frames' world to the cameras', before scaling; and the scale,
        also of what was applied before.
    """
    frames = meta["frames"]
    lenses = read_lenses(meta, source)
    scaled = config.auto_scale_poses and len(frames) > 1
    poses = check_poses(frames, source, need_spread=scaled)
    orientation = meta.get("orientation_override", config.orientation_method)
    if orientation not in ORIENTATIONS:
        fix = f"Use one of {', '.join(ORIENTATIONS)}, or remove it."
        raise InputError(f"{source}: orientation_override is {shown(repr(orientation))}. {fix}")
    placed, transform, scale = place(poses, orientation, config.center_method, scaled, config.scale_factor)
    return cameras_of(meta, lenses, placed, source), transform, scale * applied_scale(meta, source)


def check_poses(frames: list[dict[str, Any]], source: Path, need_spread: bool) -> np.ndarray:
    """Rigid camera-to-world matrices, float64 [V, 4, 4]; with `need_spread`, not all at one place."""
    names = np.array([frame["file_path"] for frame in frames])
    matrices = [matrix(frame.get("transform_matrix")) for frame in frames]

    def reject(bad: Any, finding: str) -> None:
        if np.any(bad):
            where = some(names[np.flatnonzero(bad)])
            raise InputError(f"{source}: transform_matrix of {where} {finding}, or remove the frame.")

    last_row = (0, 0, 0, 1)
    reject(
        [
            pose.shape != (4, 4) or not np.isfinite(pose).all() or abs(pose[3] - last_row).max() > LAST_ROW_TOLERANCE
            for pose in matrices
        ],
        "is not a 4 x 4 matrix of finite numbers with the last row 0 0 0 1. Give the camera-to-world matrix",
    )
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
    if not 0 < number(scale) < np.inf:
        raise InputError(f"{source}: applied_scale is {shown(repr(scale))}. Give a positive number or remove it.")
    return number(scale)


def applied_transform(meta: dict[str, Any], source: Path) -> Tensor:
    """The transform that the poses already have, float64 [3, 4]."""
    applied = matrix(meta["applied_transform"])
    if applied.shape != (3, 4) or not np.isfinite(applied).all():
        raise InputError(f"{source}: applied_transform is not a 3 x 4 matrix of numbers. Correct or remove it.")
    return torch.from_numpy(applied)


class PlacedOutputs(DataparserOutputs):
    """nerfstudio's outputs, whose way back may be in float64."""

    def transform_poses_to_original_space(self, poses: Tensor, camera_convention="opencv") -> Tensor:
        way_back = self.dataparser_transform
        return transform_poses_to_original_space(
            poses.to(way_back.dtype), way_back, self.dataparser_scale, camera_convention=camera_convention
        )


def place(
    poses: np.ndarray, orientation: str, centering: str, auto_scale: bool, factor: float
) -> tuple[Tensor, Tensor, float]:
    """Orient, centre and scale camera-to-world poses, float64 [V, 4, 4], as nerfstudio does.

    Returns:
        The poses, float32 [V, 3, 4]; the transform [3, 4] before scaling, float64 if they were far from the origin and
        otherwise float32; and the scale.
    """
    if len(poses) == 1 and orientation == "vertical":  # needs two cameras
        orientation = "up"
    positions = poses[:, :3, 3]
    center = positions.mean(axis=0)
    extent = np.ptp(positions, axis=0).max()
    far = centering != "none" and np.abs(center).max() > FAR * extent > 0
    offset = rounded(center, extent) if far else np.zeros(3)
    near = poses.copy()
    near[:, :3, 3] -= offset
    placed, transform = camera_utils.auto_orient_and_center_poses(
        torch.from_numpy(near.astype(np.float32)), method=orientation, center_method=centering
    )
    if not torch.isfinite(transform).all():
        raise InputError("The poses' up directions cancel. Give the parser --orientation-method none, or other poses.")
    reach = float(torch.max(torch.abs(placed[:, :3, 3])))
    scale = (1.0 / reach if auto_scale and reach > 0 else 1.0) * factor
    placed[:, :3, 3] *= scale
    if far:
        transform = transform.double()
        transform[:, 3] -= transform[:, :3] @ torch.from_numpy(offset)
    return placed[:, :3, :4], transform, scale


def rounded(place: np.ndarray, extent: float) -> np.ndarray:
    """A place rounded to units, or to a power of two of the extent if that is less."""
    step = min(1.0, 2.0 ** np.floor(np.log2(extent)))
    return np.round(place / step) * step


def after(transform: Tensor, earlier: Tensor | None) -> Tensor:
    """The product [3, 4] of two transforms, in the first one's precision."""
    if earlier is None:
        return transform
    return transform @ torch.cat([earlier.to(transform), torch.tensor([[0, 0, 0, 1]]).to(transform)], 0)


def read_lenses(meta: dict[str, Any], source: Path) -> np.ndarray:
    """Intrinsics of every frame, float64 [V, 12]: `PIXELS`, then `DISTORTION`; those of the top level hold for all."""
    _check_model(meta, source)
    shared = {key: meta[key] for key in (*PIXELS, *DISTORTION, "distortion_params") if key in meta}
    for key, value in shared.items():
        other = [frame["file_path"] for frame in meta["frames"] if key in frame and frame[key] != value]
        if other:
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


def cameras_of(meta: dict[str, Any], lenses: np.ndarray, poses: Tensor, source: Path) -> Cameras:
    """The cameras in full size, of `read_lenses` and poses [V, 3, 4]; InputError if undistorting leaves too little."""
    kind = CAMERA_MODEL_TO_TYPE[meta.get("camera_model", "OPENCV")]
    if kind == CameraType.FISHEYE:
        lenses[(lenses[:, len(PIXELS) :] == 0).all(axis=1), len(PIXELS)] = FISHEYE_AT_LEAST
    for lens, index in zip(*np.unique(lenses, axis=0, return_index=True), strict=True):
        if lens[len(PIXELS) :].any():
            name = shown(meta["frames"][index]["file_path"])
            _check_distortion(lens, kind, f"{source}: the distortion of {name}")
    fx, fy, cx, cy, width, height = torch.from_numpy(lenses[:, : len(PIXELS)]).float().unbind(1)
    distortion = torch.from_numpy(lenses[:, len(PIXELS) :]).float()
    return Cameras(poses, fx, fy, cx, cy, width.int(), height.int(), distortion, kind, metadata={})


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


def _check_distortion(lens: np.ndarray, kind: CameraType, where: str) -> None:
    """Check that undistorting leaves enough of the image."""
    fx, fy, _, _, w, h, _, _, _, k4, _, _ = lens
    K, distortion, flat, part = _undistorted(lens, kind)
    enough = True
    if kind != CameraType.FISHEYE:
        if k4 != 0:
            raise InputError(f"{where} has k4 = {k4:g}, which is for fisheyes. Set it to 0, or undistort the images.")
        enough = part[2] * part[3] >= LEFT_OF_IMAGE * w * h and not _folds(K, distortion, (w, h), flat, part)
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
