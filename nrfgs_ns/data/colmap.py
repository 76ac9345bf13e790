# SPDX-License-Identifier: Apache-2.0
"""COLMAP models, binary or text (https://colmap.github.io/format.html). A damaged file raises InputError.

nerfstudio reads cameras and points in text. Its readers of images cut names at blanks, and its binary ones reserve
gigabytes where a damaged file announces many entries.
"""

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from nerfstudio.data.utils import colmap_parsing_utils as nerfstudio_colmap
from nerfstudio.data.utils.colmap_parsing_utils import CAMERA_MODEL_IDS, qvec2rotmat

from nrfgs_ns.data.checks import find_colmap, shown
from nrfgs_ns.errors import InputError

MODELS = {
    "SIMPLE_PINHOLE": ("f", "cx", "cy"),
    "PINHOLE": ("fl_x", "fl_y", "cx", "cy"),
    "SIMPLE_RADIAL": ("f", "cx", "cy", "k1"),
    "RADIAL": ("f", "cx", "cy", "k1", "k2"),
    "OPENCV": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "p1", "p2"),
    "OPENCV_FISHEYE": ("fl_x", "fl_y", "cx", "cy", "k1", "k2", "k3", "k4"),
    "SIMPLE_RADIAL_FISHEYE": ("f", "cx", "cy", "k1"),
    "RADIAL_FISHEYE": ("f", "cx", "cy", "k1", "k2"),
}
"""Camera models that can be undistorted, and their parameters as transforms.json names them."""
QUATERNION_TOLERANCE = 1e-2
"""Largest difference of a rotation quaternion's length from 1."""


class View(NamedTuple):
    """One photograph of a model."""

    id: int
    name: str
    camera: int
    world_to_camera: np.ndarray
    """float64 [4, 4], y down, z forwards"""


def read_model(folder: Path) -> tuple[dict[int, dict[str, Any]], list[View], Path]:
    """The cameras and photographs of a model.

    Returns:
        Cameras by id (camera_model, w, h and parameters, named as in transforms.json), the photographs by id, and the
        file of the photographs, for messages.

    Raises:
        InputError: a file is missing or damaged, or has a camera model that cannot be undistorted.
    """
    path = _file(folder, "cameras")
    read = nerfstudio_colmap.read_cameras_text if path.suffix == ".txt" else _cameras
    cameras = {id: _lens(*camera, path) for id, camera in _read(read, path).items()}
    path = path.with_stem("images")
    read = _images_text if path.suffix == ".txt" else _images
    views = sorted(_view(*image, path) for image in _read(read, path).values())
    if not views:
        raise InputError(f"{path} holds no photograph. Export the COLMAP model again.")
    strangers = [view.name for view in views if view.camera not in cameras]
    if strangers:
        raise InputError(f"{path}: the camera of {shown(strangers[0])} is missing. Export the COLMAP model again.")
    return cameras, views, path


def read_points(folder: Path) -> tuple[np.ndarray, np.ndarray, Path]:
    """Positions and colours, float64 [N, 3] each, of points3D.bin or points3D.txt, and the file."""
    path = _file(folder, "points3D")
    if path.suffix == ".txt":
        points = _read(nerfstudio_colmap.read_points3D_text, path)
        rows = [(*point.xyz, *point.rgb) for point in points.values()]
    else:
        rows = _read(_points, path)
    table = np.array(rows, dtype=np.float64).reshape(-1, 6)
    return table[:, :3], table[:, 3:], path


def _file(folder: Path, stem: str) -> Path:
    """A file of a model: binary first, as in COLMAP."""
    for path in (folder / f"{stem}.bin", folder / f"{stem}.txt"):
        if path.is_file():
            return path
    root = next((parent for parent in folder.parents if parent.is_dir()), folder)
    place = find_colmap(root)
    where = f"There is a COLMAP model in {root / place}: give" if place else "Name the folder of the COLMAP model with"
    raise InputError(f"{folder} holds neither {stem}.bin nor {stem}.txt. {where} --colmap-path.")


def _read(read: Callable[[Path], Any], path: Path) -> Any:
    try:
        return read(path)
    except InputError:
        raise
    except Exception as error:  # whatever damaged bytes lead to
        raise InputError(
            f"{path} cannot be read ({shown(str(error))}). Restore it, or export the COLMAP model again."
        ) from error


def _parameters(model: str, path: Path) -> tuple[str, ...]:
    if model not in MODELS:
        raise InputError(
            f"{path}: camera model {shown(model)} is not supported. Undistort the photographs (colmap "
            f"image_undistorter), or use one of {', '.join(MODELS)}."
        )
    return MODELS[model]


def _lens(id: int, model: str, width: int, height: int, values: np.ndarray, path: Path) -> dict[str, Any]:
    names = _parameters(model, path)
    if len(values) != len(names):
        raise InputError(f"{path}: a {model} camera has {len(values)} parameters instead of {len(names)}. Correct it.")
    lens = dict(zip(names, map(float, values), strict=True))
    if "f" in lens:
        lens["fl_x"] = lens["fl_y"] = lens.pop("f")
    kind = "OPENCV_FISHEYE" if "FISHEYE" in model else "OPENCV"
    return {"camera_model": kind, "w": width, "h": height, **lens}


def _view(id: int, quaternion: np.ndarray, position: np.ndarray, camera: int, name: str, path: Path) -> View:
    length = np.linalg.norm(quaternion)
    if not (abs(length - 1) <= QUATERNION_TOLERANCE and np.isfinite(position).all()):
        raise InputError(
            f"{path}: the pose of {shown(name)} holds NaN or Inf, or a quaternion that is not of length 1. Export the "
            "COLMAP model again."
        )
    pose = np.eye(4)
    pose[:3, :3], pose[:3, 3] = qvec2rotmat(quaternion), position
    return View(id, name, camera, pose)


class _Bytes:
    """A file's bytes, read from front to back; an error at the end."""

    def __init__(self, path: Path):
        self.data, self.at = path.read_bytes(), 0

    def take(self, layout: str) -> tuple:
        start = self.at
        self.skip(struct.calcsize(layout))
        return struct.unpack_from(layout, self.data, start)

    def skip(self, count: int) -> None:
        self.at += count
        if self.at > len(self.data):
            raise ValueError("it ends too soon")

    def end(self) -> None:
        if self.at < len(self.data):
            raise ValueError("more follows the last entry")

    def word(self) -> str:
        start = self.at
        self.at = self.data.index(b"\0", start) + 1
        return self.data[start : self.at - 1].decode("utf-8")


def _cameras(path: Path) -> dict[int, tuple]:
    file, cameras = _Bytes(path), {}
    for _ in range(file.take("<Q")[0]):
        id, number, width, height = file.take("<iiQQ")
        model = CAMERA_MODEL_IDS[number].model_name if number in CAMERA_MODEL_IDS else f"number {number}"
        cameras[id] = (id, model, width, height, file.take(f"<{len(_parameters(model, path))}d"))
    file.end()
    return cameras


def _images(path: Path) -> dict[int, tuple]:
    file, images = _Bytes(path), {}
    for _ in range(file.take("<Q")[0]):
        id, *pose, camera = file.take("<i7di")
        images[id] = (id, np.array(pose[:4]), np.array(pose[4:]), camera, file.word())
        file.skip(24 * file.take("<Q")[0])  # features
    file.end()
    return images


def _images_text(path: Path) -> dict[int, tuple]:
    images = {}
    lines = iter(path.read_text(encoding="utf-8").splitlines())
    for line in lines:
        if line.strip() and not line.lstrip().startswith("#"):
            id, *pose, camera, name = line.split(maxsplit=9)
            pose = np.array(pose, dtype=np.float64).reshape(7)
            images[int(id)] = (int(id), pose[:4], pose[4:], int(camera), name.strip())
            next(lines, None)  # features
    return images


def _points(path: Path) -> list[list[float]]:
    file, rows = _Bytes(path), []
    for _ in range(file.take("<Q")[0]):
        _, *row, _ = file.take("<Q3d3Bd")
        file.skip(8 * file.take("<Q")[0])  # track
        rows.append(row)
    file.end()
    return rows
